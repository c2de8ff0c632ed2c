"""The one place that chooses hardware, a recording or the simulation."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

from interfaces.errors import ConfigError
from interfaces.protocols import Clock
from kbmaps import RigidChain

from .config import Config
from .joints_watch import ServoJoints
from .servo_wiring import require_servos, through_servos
from .sources import Sources
from .store import PairReader


@contextmanager
def open_sources(config: Config, *, sim: bool) -> Iterator[Sources]:
    """The sources that robot.toml asks for; with `sim`, the simulation in their place.

    Raises:
        ConfigError: no driver is configured, or the simulation cannot be made of this description.
        RecordingError: the configured recording cannot be read.
    """
    _require_source(config, sim=sim)
    recording = None if sim else _recording(config)
    if recording is not None:
        yield _recorded(config, recording)
    else:
        with _simulated(config) as sources:
            yield sources


def check_sources(config: Config, *, sim: bool) -> None:
    """ConfigError when `open_sources` would find nothing to open; opens nothing."""
    _require_source(config, sim=sim)
    if sim:
        require_simulation()


def open_joints(config: Config, clock: Clock) -> ServoJoints:
    """The encoders alone of the arm that robot.toml describes, not opened yet.

    Raises:
        ConfigError: no servos are configured.
        StoreError: the store, which tells where they were last, cannot be read.
    """
    from drivers.dynamixel.joints import DynamixelJoints

    servos = config.tables.drivers.dynamixel
    if servos is None:
        raise ConfigError(
            "no servos are configured", file=config.file, remedy="Add the table [drivers.dynamixel]: docs/hardware.md"
        )
    limits = list(zip(config.robot.lower.tolist(), config.robot.upper.tolist(), strict=True))
    return DynamixelJoints(servos, config.robot.joints, clock, limits=limits, last_pose=_last_pose(config))


def _last_pose(config: Config) -> list[float] | None:
    """Where the joints were at the newest pair [rad]."""
    if not config.store_file.exists():
        return None
    with PairReader(config.store_file) as pairs:
        last = pairs.last()
    return None if last is None or len(last.q) != len(config.robot.joints) else last.q.tolist()


def _require_source(config: Config, *, sim: bool) -> None:
    if sim and config.tables.sim.servo_bench:
        require_servos(config)
    if sim or config.tables.drivers.recording is not None:
        return
    if config.tables.drivers.dynamixel is not None:
        raise ConfigError(
            "the joints are servos, but nothing tells where the marker is: no camera is configured",
            file=config.file,
            remedy="Give --sim for the simulated robot, or name a recording as recording in the table [drivers]",
        )
    raise ConfigError(
        "no driver is configured",
        file=config.file,
        remedy="Give --sim for the simulated robot, or name a recording as recording in the table [drivers]",
    )


def _recording(config: Config) -> Path | None:
    recording = config.tables.drivers.recording
    return None if recording is None else config.file.parent / recording


def require_simulation() -> None:
    """ConfigError with the command to type when the simulation's packages are not installed."""
    if find_spec("pybullet") is None:
        raise ConfigError(
            "the simulation needs pybullet, which is not installed", remedy="Type: pip install 'bodyschema[sim]'"
        )


def demonstration_model() -> Path:
    """The robot.toml of the humanoid upper body that ships with the simulation, its URDF beside it."""
    from sim_backend.models import model_file

    return model_file("upper_body")


@contextmanager
def _simulated(config: Config) -> Iterator[Sources]:
    require_simulation()
    from sim_backend import SimWorld
    from sim_backend.guided_path import exact_encoders
    from vision.tracked_camera import TrackedCamera
    from vision.tracker import StereoTracker

    on_bench = config.tables.sim.servo_bench
    settings = exact_encoders(config.tables.sim) if on_bench else config.tables.sim
    with SimWorld(config.robot, settings, config.simulation) as world:
        marker = TrackedCamera(world.camera, StereoTracker(world.camera.calibration, config.tables.vision))
        joints = through_servos(config, world.joints) if on_bench else world.joints
        yield Sources(joints, marker, world.clock, world)


@contextmanager
def open_postures(config: Config, count: int) -> Iterator[Sources]:
    """The simulation's sources, the robot standing still in so many postures drawn independently.

    Raises:
        ConfigError: the simulation cannot be made of this description.
    """
    require_simulation()
    from sim_backend.posed import PosedWorld
    from sim_backend.postures import visible_postures
    from vision.tracked_camera import TrackedCamera
    from vision.tracker import StereoTracker

    postures = visible_postures(config.robot, config.tables.sim, count, config.simulation)
    with PosedWorld(config.robot, config.tables.sim, postures, config.simulation) as world:
        marker = TrackedCamera(world.camera, StereoTracker(world.camera.calibration, config.tables.vision))
        yield Sources(world.joints, marker, world.clock)


def simulated_truth(config: Config) -> RigidChain:
    """The true chain of the robot that the simulation makes of this description, for judges."""
    from sim_backend import true_chain

    return true_chain(config.robot, config.tables.sim, extension=config.simulation)


def _recorded(config: Config, file: Path) -> Sources:
    from drivers.replay import Replay
    from interfaces.recording import Recording

    drivers = config.tables.drivers
    replay = Replay(
        Recording.read(file, config.robot.joints),
        speed=drivers.speed,
        sigma_m=drivers.recording_sigma_m,
        calibration=config.robot.calibration,
    )
    return Sources(replay.joints, replay.marker, replay.clock)
