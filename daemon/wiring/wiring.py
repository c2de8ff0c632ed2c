"""The one place that chooses hardware, a recording or the simulation."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from bodyschema.daemon.config import Config
from bodyschema.daemon.sampler.sources import Head, MarkerTopic, Powered, Sources, StampedJoints
from bodyschema.drivers.dynamixel.config import DynamixelConfig
from bodyschema.drivers.feetech.config import FeetechConfig
from bodyschema.drivers.ros2.config import Ros2Config
from bodyschema.drivers.serial_lines.config import SerialLinesConfig
from bodyschema.drivers.serial_lines.joints import SerialLineJoints
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import ConfigError, StoreError
from bodyschema.interfaces.extras import require_extra
from bodyschema.interfaces.protocols import Clock, JointSource
from bodyschema.interfaces.servos import EncoderJoints, ServoJoints
from bodyschema.recordings.store.store import PairReader
from bodyschema.robot.plugins import PluginConfig, load
from kbmaps import RigidChain

from .bench import require_bench, through_bench
from .powered import open_drives
from .simulation import simulation_settings

if TYPE_CHECKING:
    from bodyschema.drivers.ros2.joints import Ros2Joints

log = logging.getLogger(__name__)

Hardware = DynamixelConfig | FeetechConfig | SerialLinesConfig | Ros2Config | PluginConfig


@contextmanager
def open_sources(config: Config, *, sim: bool) -> Iterator[Sources]:
    """Yield the sources configured in robot.toml; with `sim`, the simulation instead.

    Raises:
        ConfigError: no driver or no cameras are configured, or the simulation cannot be made of this description.
        RecordingError: the configured recording cannot be read.
    """
    _require_source(config, sim=sim)
    recording = None if sim else _recording(config)
    if recording is not None:
        yield _recorded(config, recording)
    elif not sim:
        yield _real(config)
    else:
        with _simulated(config) as sources:
            yield sources


def check_sources(config: Config, *, sim: bool) -> None:
    """ConfigError when `open_sources` would find nothing to open; opens nothing."""
    _require_source(config, sim=sim)
    if sim:
        require_simulation()
        simulation_settings(config)


def open_joints(config: Config, clock: Clock) -> EncoderJoints:
    """Return only the encoders of the arm described in robot.toml, not opened yet.

    Raises:
        ConfigError: no servos and no ROS 2 robot are configured, or zero-force or gaze do not fit the robot.
    """
    hardware = config.tables.drivers.hardware
    if hardware is None:
        raise ConfigError(
            "no servos, encoders or ROS 2 robot are configured",
            file=config.file,
            remedy="Add the table [drivers.dynamixel], [drivers.feetech], [drivers.serial_lines] or [drivers.ros2]: "
            "docs/hardware.md",
        )
    return driver_of(hardware, config, clock, last_pose=_last_pose(config))


def driver_of(hardware: Hardware, config: Config, clock: Clock, *, last_pose: list[float] | None) -> EncoderJoints:
    """Return the driver of the joints of robot.toml on `hardware`, not opened yet.

    Args:
        last_pose: joint angles of the newest pair [rad]; None if unknown.
    """
    joints = config.robot.joints
    limits = list(zip(config.robot.lower.tolist(), config.robot.upper.tolist(), strict=True))
    match hardware:
        case DynamixelConfig():
            from bodyschema.drivers.dynamixel.joints import DynamixelJoints

            drives = open_drives(config, hardware, clock)
            return DynamixelJoints(hardware, joints, clock, limits=limits, last_pose=last_pose, drives=drives)
        case FeetechConfig():
            from bodyschema.drivers.feetech.joints import FeetechJoints

            return FeetechJoints(hardware, joints, clock, limits=limits, last_pose=last_pose)
        case SerialLinesConfig():
            return SerialLineJoints(hardware, joints, clock, limits=limits, last_pose=last_pose)
        case Ros2Config():
            return _ros2_joints(config, hardware, clock)
        case PluginConfig():
            return load("bodyschema.drivers", hardware.name)(joints, hardware.settings, clock)


def _ros2_joints(config: Config, robot: Ros2Config, clock: Clock) -> Ros2Joints:
    from bodyschema.drivers.ros2.joints import Ros2Joints

    return Ros2Joints(robot, config.robot.joints, clock, prismatic=config.robot.chain.prismatic.tolist())


def open_marker_topic(config: Config, clock: Clock) -> tuple[StampedJoints, MarkerTopic] | None:
    """Return the ROS 2 robot's joints and the topic for its expected marker position, neither opened yet.

    Return None if [drivers.ros2.marker] is not configured.
    """
    robot = config.tables.drivers.ros2
    if robot is None or robot.marker is None:
        return None
    from bodyschema.drivers.ros2.marker import MarkerPublisher

    return _ros2_joints(config, robot, clock), MarkerPublisher(robot, robot.marker)


def _last_pose(config: Config) -> list[float] | None:
    """Return the joint angles of the newest pair [rad]; None if unknown."""
    if not config.store_file.exists():
        return None
    try:
        with PairReader(config.store_file) as pairs:
            last = pairs.last()
    except StoreError as error:  # the sampler reports it, too, and repairs the store
        log.warning("where the joints were last is not known: %s", error)
        return None
    return None if last is None or len(last.q) != len(config.robot.joints) else last.q.tolist()


def _require_source(config: Config, *, sim: bool) -> None:
    if sim and config.tables.sim.servo_bench:
        require_bench(config)
    if sim or config.tables.drivers.recording is not None:
        return
    if config.tables.drivers.hardware is None:
        raise ConfigError(
            "no driver is configured",
            file=config.file,
            remedy="Give --sim for the simulated robot, or name a recording as recording in the table [drivers]; with "
            "an arm of your own: docs/hardware.md",
        )
    if config.tables.vision.cameras is None:
        raise ConfigError(
            "the joints have a driver, but nothing tells where the marker is: no cameras are configured",
            file=config.file,
            remedy="Add the table [vision.cameras] (docs/cameras.md); or give --sim for the simulated robot",
        )
    from .cameras import require_usable

    require_usable(config)


def connected_cameras() -> list[str]:
    """Return the cameras of this machine, by the names that stay."""
    from bodyschema.vision.cameras.serials import connected

    return connected()


def _recording(config: Config) -> Path | None:
    recording = config.tables.drivers.recording
    return None if recording is None else config.file.parent / recording


def require_simulation() -> None:
    """Raise ConfigError with the command to type when the simulation's packages are not installed."""
    require_extra("sim", "the simulation")


def demonstration_model() -> Path:
    """Return the path of the robot.toml of the humanoid upper body shipped with the simulation."""
    from bodyschema.sim_backend.models import model_file

    return model_file("upper_body")


def _real(config: Config) -> Sources:
    from bodyschema.vision.tracked_camera import TrackedCamera
    from bodyschema.vision.trackers import tracker_of

    from .cameras import camera_of, open_eyes

    clock = SystemClock()
    joints = open_joints(config, clock)
    eyes = open_eyes(config, clock)
    camera = camera_of(config, eyes)
    drives = joints.drives if isinstance(joints, ServoJoints) else ()
    return Sources(
        joints,
        TrackedCamera(camera, tracker_of(camera.calibration, config.tables.vision)),
        clock,
        powered=tuple(drive for drive in drives if isinstance(drive, Powered)),
        head=next((drive for drive in drives if isinstance(drive, Head)), None),
        cameras=eyes,
        calibration=camera.calibration,
        live=True,
    )


@contextmanager
def _simulated(config: Config) -> Iterator[Sources]:
    require_simulation()
    from bodyschema.sim_backend import SimWorld
    from bodyschema.sim_backend.guided_path import exact_encoders
    from bodyschema.vision.tracked_camera import TrackedCamera
    from bodyschema.vision.trackers import tracker_of

    on_bench = config.tables.sim.servo_bench
    settings = simulation_settings(config)
    settings = exact_encoders(settings) if on_bench else settings
    with SimWorld(config.robot, settings, config.simulation) as world:
        marker = TrackedCamera(world.camera, tracker_of(world.camera.calibration, config.tables.vision))
        joints = _through_bench(config, world.joints) if on_bench else world.joints
        yield Sources(joints, marker, world.clock, world)


def _through_bench(config: Config, joints: JointSource) -> JointSource:
    """Return the simulation's joints, read by the driver configured in robot.toml."""
    return through_bench(config, joints, lambda hardware: driver_of(hardware, config, SystemClock(), last_pose=None))


@contextmanager
def open_postures(config: Config, count: int) -> Iterator[Sources]:
    """Yield the simulation's sources with the robot at rest in `count` independently sampled postures.

    Raises:
        ConfigError: the simulation cannot be made of this description.
    """
    require_simulation()
    from bodyschema.sim_backend.posed import PosedWorld
    from bodyschema.sim_backend.postures import visible_postures
    from bodyschema.vision.tracked_camera import TrackedCamera
    from bodyschema.vision.trackers import tracker_of

    settings = simulation_settings(config)
    postures = visible_postures(config.robot, settings, count, config.simulation)
    with PosedWorld(config.robot, settings, postures, config.simulation) as world:
        marker = TrackedCamera(world.camera, tracker_of(world.camera.calibration, config.tables.vision))
        yield Sources(world.joints, marker, world.clock)


def simulated_truth(config: Config) -> RigidChain:
    """Return the simulation's ground-truth chain for this description, for evaluation only."""
    from bodyschema.sim_backend import true_chain

    return true_chain(config.robot, config.tables.sim, extension=config.simulation)


def _recorded(config: Config, file: Path) -> Sources:
    from bodyschema.drivers.replay import Replay
    from bodyschema.recordings.recording import Recording

    drivers = config.tables.drivers
    replay = Replay(
        Recording.read(file, config.robot.joints),
        speed=drivers.speed,
        sigma_m=drivers.recording_sigma_m,
        calibration=config.robot.calibration,
    )
    return Sources(replay.joints, replay.marker, replay.clock)
