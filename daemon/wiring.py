"""The one place that chooses hardware, a recording or the simulation."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

from interfaces.errors import ConfigError
from kbmaps import RigidChain

from .config import Config
from .sources import Sources


@contextmanager
def open_sources(config: Config, *, sim: bool) -> Iterator[Sources]:
    """The sources that robot.toml asks for; with `sim`, the simulation in their place.

    Raises:
        ConfigError: no driver is configured, or the simulation cannot be made of this description.
        RecordingError: the configured recording cannot be read.
    """
    recording = _chosen_recording(config, sim=sim)
    if recording is not None:
        yield _recorded(config, recording)
    else:
        with _simulated(config) as sources:
            yield sources


def check_sources(config: Config, *, sim: bool) -> None:
    """ConfigError when `open_sources` would find nothing to open; opens nothing."""
    if _chosen_recording(config, sim=sim) is None:
        require_simulation()


def _chosen_recording(config: Config, *, sim: bool) -> Path | None:
    """The recording to play; None for the simulation."""
    if sim:
        return None
    if config.tables.drivers.recording is None:
        raise ConfigError(
            "no driver is configured",
            file=config.file,
            remedy="Give --sim for the simulated robot, or name a recording as recording in the table [drivers]",
        )
    return config.file.parent / config.tables.drivers.recording


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
    from vision.tracked_camera import TrackedCamera
    from vision.tracker import StereoTracker

    with SimWorld(config.robot, config.tables.sim, config.simulation) as world:
        marker = TrackedCamera(world.camera, StereoTracker(world.camera.calibration, config.tables.vision))
        yield Sources(world.joints, marker, world.clock, world)


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
