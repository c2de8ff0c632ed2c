"""The one place that selects hardware, a recording or the simulation."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bodyschema.daemon.config import Config
from bodyschema.daemon.sampler.reconnect import ReconnectingSource
from bodyschema.daemon.sampler.sources import (
    THE_CAMERAS,
    GazeMode,
    JoinedHealth,
    MarkerTopic,
    Picture,
    PoweredMode,
    ReportsHealth,
    Sources,
    StampedJoints,
)
from bodyschema.daemon.wiring.emulators import require_emulator, through_emulator
from bodyschema.daemon.wiring.simulation import simulation_settings
from bodyschema.drivers.checks import Check
from bodyschema.drivers.dynamixel.config import DynamixelConfig
from bodyschema.drivers.feetech.config import FeetechConfig
from bodyschema.drivers.markers.config import AnySource, NatnetTable, Ros2Table, UdpTable, ZenohTable
from bodyschema.drivers.markers.datagram import decode_datagram
from bodyschema.drivers.markers.fusing import FusedMarkers, Member
from bodyschema.drivers.markers.keys import KeyReceiver, topic_receiver
from bodyschema.drivers.markers.natnet.client import NatnetReceiver
from bodyschema.drivers.markers.stream import MarkerStream, stream_checks
from bodyschema.drivers.markers.udp import UdpReceiver
from bodyschema.drivers.ros2.config import Ros2Config
from bodyschema.drivers.serial_lines.config import SerialLinesConfig
from bodyschema.drivers.serial_lines.joints import SerialLineJoints
from bodyschema.effects.gravity import GravityLoad
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import ConfigError, StoreError
from bodyschema.interfaces.extras import require_extra
from bodyschema.interfaces.protocols import Clock, JointSource, MarkerSource
from bodyschema.interfaces.records import FloatArray
from bodyschema.interfaces.servos import EncoderJoints, ServoJoints
from bodyschema.recordings.store.store import PairReader
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.plugins import PluginConfig, load
from bodyschema.robot.toml_file import line_of, read_toml
from kbmaps import RigidChain

if TYPE_CHECKING:
    from bodyschema.drivers.dynamixel.gaze import Gaze
    from bodyschema.drivers.dynamixel.zero_force import ZeroForce
    from bodyschema.drivers.ros2.joints import Ros2Joints
    from bodyschema.interfaces.protocols import StereoCamera
    from bodyschema.vision.tracked_camera import TrackedCamera

log = logging.getLogger(__name__)

Hardware = DynamixelConfig | FeetechConfig | SerialLinesConfig | Ros2Config | PluginConfig


@contextmanager
def open_sources(config: Config, *, sim: bool) -> Iterator[Sources]:
    """Yield the sources configured in robot.toml; with `sim`, the simulation instead.

    Raises:
        ConfigError: no driver or no cameras are configured, or this description cannot be simulated.
        RecordingError: the configured recording cannot be read.
    """
    _require_source(config, sim=sim)
    recording = config.tables.drivers.recording
    if sim:
        with _simulated_sources(config) as sources:
            yield sources
    else:
        yield (
            _hardware_sources(config)
            if recording is None
            else _recorded_sources(config, config.file.parent / recording)
        )


def check_sources(config: Config, *, sim: bool) -> None:
    """Raise ConfigError if `open_sources` would find nothing to open; open nothing."""
    _require_source(config, sim=sim)
    if sim:
        require_extra("sim", "the simulation")
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
    joints, limits = config.robot.joints, config.robot.limits
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
    except StoreError as error:  # the sampler reports it too, and repairs the store
        log.warning("where the joints were last is not known: %s", error)
        return None
    return None if last is None or len(last.q) != len(config.robot.joints) else last.q.tolist()


def _require_source(config: Config, *, sim: bool) -> None:
    if sim and config.tables.sim.servo_bench:
        require_emulator(config)
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
        if config.tables.marker_source:
            return
        raise ConfigError(
            "the joints have a driver, but nothing measures the marker's position: no cameras are configured",
            file=config.file,
            remedy="Add the table [vision.cameras] (docs/cameras.md) or [marker_source] (docs/marker_sources.md); or "
            "give --sim for the simulated robot",
        )
    from .cameras import require_usable

    require_usable(config)


def connected_cameras() -> list[str]:
    """Return the cameras of this machine, by their persistent names."""
    from bodyschema.vision.cameras.v4l2.serials import connected

    return connected()


def demonstration_model() -> Path:
    """Return the path of the robot.toml of the humanoid upper body shipped with the simulation."""
    from bodyschema.sim_backend.models import model_file

    return model_file("upper_body")


def _hardware_sources(config: Config) -> Sources:
    clock = SystemClock()
    joints = open_joints(config, clock)
    marker, health, calibration, picture = _open_marker(config, clock)
    drives = joints.drives if isinstance(joints, ServoJoints) else ()
    return Sources(
        joints,
        marker,
        clock,
        powered=tuple(drive for drive in drives if isinstance(drive, PoweredMode)),
        head=next((drive for drive in drives if isinstance(drive, GazeMode)), None),
        cameras=health,
        marker_source_name=_name_of_marker_source(config),
        calibration=calibration,
        picture=picture,
        live=True,
    )


def _open_marker(
    config: Config, clock: Clock
) -> tuple[MarkerSource, ReportsHealth, StereoCalibration | None, Picture | None]:
    """Return the marker source, not opened yet, its health, and the calibration and picture of the cameras."""
    tables = config.tables.marker_source
    streams = [stream_of(table, clock) for table in tables]
    if config.tables.vision.cameras is None and len(streams) == 1:
        return streams[0], streams[0], None, None
    members = [Member(table.label, stream, table.pose) for table, stream in zip(tables, streams, strict=True)]
    calibration = picture = None
    healths: list[ReportsHealth] = [*streams]
    if config.tables.vision.cameras is not None:
        from .cameras import seen_through

        cameras, eyes, calibration, picture = _tracked_cameras(config, clock)
        further = config.tables.vision.further_cameras
        if not tables and not further:
            return cameras, eyes, calibration, picture
        members.insert(0, Member("cameras", cameras, np.eye(4)))
        healths.insert(0, eyes)
        for place, table in enumerate(further, 1):
            others, health, _, _ = _tracked_cameras(seen_through(config, table), clock)
            members.insert(place, Member(table.name, others, table.pose))
            healths.insert(place, health)
    for place, member in enumerate(members):
        member.source = reopening = ReconnectingSource(member.source, f"the positions by {member.name}", clock)
        healths[place] = JoinedHealth([reopening, healths[place]])
    fused = FusedMarkers(members, clock)
    return fused, JoinedHealth([fused, *healths]), calibration, picture


def _name_of_marker_source(config: Config) -> str:
    """Return the name of the marker source in messages."""
    tables = config.tables
    names = [*(table.name for table in tables.vision.further_cameras), *(table.label for table in tables.marker_source)]
    if tables.vision.cameras is not None:
        if not names:
            return THE_CAMERAS
        names.insert(0, "cameras")
    return f"the positions by {' and '.join(names)}"


def _tracked_cameras(config: Config, clock: Clock) -> tuple[MarkerSource, ReportsHealth, StereoCalibration, Picture]:
    """Return the cameras of robot.toml with their tracker, not opened yet, their health, calibration and picture."""
    from bodyschema.vision.cameras.depth_check import DepthChecked
    from bodyschema.vision.cameras.realsense import RealsenseCamera

    from .cameras import camera_of, open_eyes

    eyes = open_eyes(config, clock)
    camera, vision = camera_of(config, eyes), config.tables.vision
    tracked = _tracked(camera, config)
    if eyes is not camera or not isinstance(eyes, RealsenseCamera):
        return tracked, eyes, camera.calibration, tracked.picture
    checked = DepthChecked(tracked, eyes, vision.radius_m if vision.marker == "bright_ball" else 0.0)
    return checked, JoinedHealth([eyes, checked]), camera.calibration, tracked.picture


def _tracked(camera: StereoCamera, config: Config) -> TrackedCamera:
    """Return a camera with the tracker of robot.toml, not opened yet."""
    from bodyschema.vision.cameras.annotate import Annotator
    from bodyschema.vision.tracked_camera import TrackedCamera
    from bodyschema.vision.trackers import tracker_of

    vision = config.tables.vision
    annotator = Annotator(camera.calibration, vision)
    return TrackedCamera(camera, tracker_of(camera.calibration, vision), annotator, *vision.readout)


def open_streams(config: Config, clock: Clock) -> list[MarkerStream]:
    """Return the marker sources of robot.toml, not opened yet.

    Raises:
        ConfigError: it has none.
    """
    if not config.tables.marker_source:
        raise ConfigError(
            "no marker source is configured",
            file=config.file,
            remedy="Add the table [marker_source]: docs/marker_sources.md",
        )
    return [stream_of(table, clock) for table in config.tables.marker_source]


def marker_source_checks(config: Config) -> Iterator[Check]:
    """Yield checks of the data of each marker source of robot.toml. Open it for that."""
    clock = SystemClock()
    for stream in open_streams(config, clock):
        yield from stream_checks(stream, clock)


def marker_source_lines(config: Config) -> Iterator[str]:
    """Yield lines on the source of the marker's positions."""
    for table in config.tables.marker_source:
        body = "" if table.body is None else f", body {table.body}"
        yield f"marker positions by {table.label} ({table.kind}) at {table.endpoint}{body}, in {table.unit}"
        known = "" if table.latency_sigma_s is not None else ", not measured"
        yield (
            f"measured {1e3 * table.latency_s:.1f} ms before their time stamp ± {1e3 * table.sigma_s:.1f} ms{known}; "
            f"1-sigma {1e3 * table.sigma_m:.2g} mm where none is sent"
        )


@contextmanager
def _simulated_sources(config: Config) -> Iterator[Sources]:
    require_extra("sim", "the simulation")
    from bodyschema.sim_backend import SimWorld
    from bodyschema.sim_backend.world import exact_encoders

    on_emulator = config.tables.sim.servo_bench
    settings = simulation_settings(config)
    settings = exact_encoders(settings) if on_emulator else settings
    with SimWorld(config.robot, settings, config.simulation) as world:
        marker = _tracked(world.camera, config)
        joints: JointSource = world.joints
        if on_emulator:
            joints = through_emulator(
                config, joints, lambda hardware: driver_of(hardware, config, SystemClock(), last_pose=None)
            )
        yield Sources(joints, marker, world.clock, world, picture=marker.picture)


@contextmanager
def open_postures(config: Config, count: int) -> Iterator[Sources]:
    """Yield the simulation's sources with the robot at rest in `count` independently sampled postures.

    Raises:
        ConfigError: this description cannot be simulated.
    """
    require_extra("sim", "the simulation")
    from bodyschema.sim_backend.posed import PosedWorld, visible_postures

    settings = simulation_settings(config)
    postures = visible_postures(config.robot, settings, count, config.simulation)
    with PosedWorld(config.robot, settings, postures, config.simulation) as world:
        yield Sources(world.joints, _tracked(world.camera, config), world.clock)


def simulated_truth(config: Config) -> RigidChain:
    """Return the simulation's ground-truth chain for this description, for evaluation only."""
    from bodyschema.sim_backend import true_chain

    return true_chain(config.robot, config.tables.sim, extension=config.simulation)


def _recorded_sources(config: Config, file: Path) -> Sources:
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


def stream_of(table: AnySource, clock: Clock) -> MarkerStream:
    """Return the source, not opened yet; `clock` must be the machine's monotonic one."""
    match table:
        case UdpTable():
            return MarkerStream(table, UdpReceiver(table, clock), decode_datagram, clock)
        case ZenohTable():
            return MarkerStream(table, KeyReceiver(table, table.key, clock), decode_datagram, clock)
        case NatnetTable():
            motive = NatnetReceiver(table, clock)
            return MarkerStream(table, motive, motive.decode, clock)
        case Ros2Table():
            return MarkerStream(table, *topic_receiver(table, clock), clock)


def holding_torques(robot: RobotDescription) -> Callable[[FloatArray], FloatArray]:
    """Return a function from joint angles [rad] (d,) to gravity torques [N·m] (d,), by the URDF's masses.

    Raises:
        ConfigError: the URDF states no masses that a joint bears.
    """
    load = GravityLoad(robot)
    if not load.known:
        raise ConfigError(
            "the URDF states no masses, so the arm's weight is unknown",
            file=robot.tree.file,
            remedy="Give its links <inertial> with mass and origin, or take [drivers.dynamixel.zero_force] out",
        )
    return lambda q: -load.torques(q[None])[0]


def open_drives(config: Config, servos: DynamixelConfig, clock: Clock) -> tuple[ZeroForce | Gaze, ...]:
    """Return the drives that may move the joints: those in robot.toml, inactive until requested.

    Raises:
        ConfigError: the URDF states no masses, or robot.toml declares that the arm is held in another way.
    """
    joints, drives = config.robot.joints, []
    _check_hold(config, servos)
    if servos.zero_force is not None:
        from bodyschema.drivers.dynamixel.zero_force import ZeroForce

        torques = holding_torques(config.robot)
        drives.append(ZeroForce(servos, servos.zero_force, joints, torques, clock))
    if servos.gaze is not None:
        from bodyschema.drivers.dynamixel.gaze import Gaze

        drives.append(Gaze(servos.gaze, joints, config.robot.limits, clock))
    return tuple(drives)


def _check_hold(config: Config, servos: DynamixelConfig) -> None:
    """Raise ConfigError if [robot] hold, used by the diagnosis, contradicts [drivers.dynamixel]."""
    hold, is_configured = config.robot.robot.hold, servos.zero_force is not None
    if is_configured == (hold == "zero_force"):
        return
    what = (
        f'[drivers.dynamixel.zero_force] bears the arm, but hold = "{hold}" in [robot] says otherwise to the diagnosis'
        if is_configured
        else 'hold = "zero_force" in [robot], but nothing bears the arm: there is no [drivers.dynamixel.zero_force]'
    )
    raise ConfigError(
        what,
        file=config.file,
        line=line_of(read_toml(config.file)[1], ("robot", "hold")),
        remedy='Write hold = "zero_force" in [robot]' if is_configured else "Add the table, or change hold",
    )
