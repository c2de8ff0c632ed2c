"""The laws of `bodyschema.interfaces.protocols`, checked for every source that the sampler may read."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache
from importlib.util import find_spec
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from fake_capture import SIZE_PX, FakeCapture
from scripted_sources import COV, Scripted
from virtual_link import VirtualLink
from virtual_port import VirtualClock, VirtualPort

from bodyschema.cli.demo.scene import cube_tables
from bodyschema.daemon.config import Config
from bodyschema.daemon.wiring.emulators import through_emulator
from bodyschema.daemon.wiring.wiring import driver_of
from bodyschema.drivers.dynamixel.config import BusConfig, DynamixelConfig, ServoConfig
from bodyschema.drivers.dynamixel.emulator.chain import Chain, no_faults
from bodyschema.drivers.dynamixel.emulator.servo import Servo
from bodyschema.drivers.dynamixel.joints import DynamixelJoints
from bodyschema.drivers.dynamixel.models import BY_NAME
from bodyschema.drivers.emulator.device import Faults
from bodyschema.drivers.feetech.config import BusConfig as FeetechBus
from bodyschema.drivers.feetech.config import FeetechConfig
from bodyschema.drivers.feetech.emulator.arm import Chain as FeetechChain
from bodyschema.drivers.feetech.emulator.servo import Servo as FeetechServo
from bodyschema.drivers.feetech.joints import FeetechJoints
from bodyschema.drivers.feetech.models import BY_NAME as FEETECH_MODELS
from bodyschema.drivers.markers.config import UdpTable
from bodyschema.drivers.markers.datagram import SCHEMA, decode_datagram
from bodyschema.drivers.markers.fusing import FusedMarkers, Member
from bodyschema.drivers.markers.report import Packet
from bodyschema.drivers.markers.stream import MarkerStream
from bodyschema.drivers.replay import Replay
from bodyschema.drivers.ros2.config import Ros2Config
from bodyschema.drivers.ros2.emulator.node import Node, Send
from bodyschema.drivers.ros2.joints import Ros2Joints
from bodyschema.drivers.ros2.messages import encode_joint_state
from bodyschema.drivers.serial_lines.config import EncoderConfig, SerialLinesConfig
from bodyschema.drivers.serial_lines.emulator.board import EncoderBoard
from bodyschema.drivers.serial_lines.joints import SerialLineJoints
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import SourceEnded, SourceError, SourceLost
from bodyschema.interfaces.protocols import JointSource, MarkerSource, StereoCamera, StereoEyes
from bodyschema.interfaces.records import JointReading, MarkerFix, MarkerMiss, StereoFrame, frozen_array
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription
from bodyschema.sim_backend import CameraConfig, SimConfig, SimWorld, model_file
from bodyschema.sim_backend.config import SimTag
from bodyschema.vision.ball.tracker import StereoTracker
from bodyschema.vision.cameras.config import CamerasConfig
from bodyschema.vision.cameras.ideal import IdealCamera
from bodyschema.vision.cameras.opened import eyes_of
from bodyschema.vision.cameras.v4l2.device import OpenCapture
from bodyschema.vision.config import VisionConfig
from bodyschema.vision.rig.lens import Lens
from bodyschema.vision.rig.rectified import RectifiedCamera
from bodyschema.vision.rig.stereo_rig import CalibrationProvenance, StereoRig
from bodyschema.vision.tracked_camera import TrackedCamera
from bodyschema.vision.trackers import tracker_of

LIMIT_S = 500.0
WAIT_S = 0.005
SOME = 3
ROWS = 60
PICTURES = 50
TIMES = np.cumsum(np.random.default_rng(1).uniform(0.01, 0.1, ROWS))


@dataclass
class Rig:
    """A source under test, and the other sources that must be read for time to pass.

    Attributes:
        end: makes the source end; without it the source ends by itself.
    """

    source: Any
    other: Any = None
    end: Callable[[], None] | None = None

    @property
    def sources(self) -> list[Any]:
        return [self.source] if self.other is None else [self.source, self.other]

    @contextmanager
    def opened(self) -> Iterator[Rig]:
        with ExitStack() as stack:
            for source in self.sources:
                stack.enter_context(source)
            yield self

    def read(self, count: int = SOME) -> list[Any]:
        """Return the next `count` items of the source."""
        items: list[Any] = []
        deadline = time.monotonic() + LIMIT_S
        while len(items) < count:
            assert time.monotonic() < deadline
            item = self.source.read(WAIT_S)
            if item is not None:
                items.append(item)
            elif self.other is not None:
                self.other.read(WAIT_S)
        return items

    def read_to_the_end(self) -> None:
        """Read until SourceEnded is raised."""
        if self.end is not None:
            self.end()
        while True:
            self.read(1)


# --- implementations under test


def recording() -> Recording:
    rng = np.random.default_rng(2)
    return Recording(("a", "b"), rng.normal(size=(ROWS, 2)), rng.normal(size=(ROWS, 3)), t=TIMES)


@contextmanager
def replayed_joints() -> Iterator[Rig]:
    replay = Replay(recording(), speed=0)
    yield Rig(replay.joints, replay.marker)


@contextmanager
def replayed_marker() -> Iterator[Rig]:
    replay = Replay(recording(), speed=0)
    yield Rig(replay.marker, replay.joints)


@contextmanager
def scripted_joints() -> Iterator[Rig]:
    yield Rig(Scripted([JointReading(t, frozen_array([0.1, t])) for t in TIMES.tolist()], ("a", "b")))


@contextmanager
def scripted_marker() -> Iterator[Rig]:
    yield Rig(Scripted([MarkerFix(t, frozen_array([0.1, 0.2, t]), COV) for t in TIMES.tolist()]))


def upper_body() -> RobotDescription:
    """Return the simulated robot, with cameras of half the resolution: a quarter of the pixels to be rendered."""
    robot = RobotDescription.load(model_file("upper_body"))
    assert robot.calibration is not None
    (column, row), (width, height) = robot.calibration.principal_point_px, robot.calibration.image_size_px
    half = replace(
        robot.calibration,
        focal_px=robot.calibration.focal_px / 2.0,
        principal_point_px=(column / 2.0, row / 2.0),
        image_size_px=(width // 2, height // 2),
    )
    return replace(robot, calibration=half)


@contextmanager
def simulated_world() -> Iterator[SimWorld]:
    with SimWorld(upper_body(), SimConfig()) as world:
        yield world


def close(world: SimWorld) -> Callable[[], None]:
    return lambda: world.__exit__(None, None, None)


@contextmanager
def simulated_joints() -> Iterator[Rig]:
    with simulated_world() as world:
        yield Rig(world.joints, world.camera, close(world))


@contextmanager
def simulated_camera() -> Iterator[Rig]:
    with simulated_world() as world:
        yield Rig(world.camera, world.joints, close(world))


class Unrectified:
    """The simulated camera as two that are neither calibrated nor rectified."""

    serials = ("A1", "B2")

    def __init__(self, camera: StereoCamera) -> None:
        self._camera = camera
        self.image_size_px = camera.calibration.image_size_px

    def __enter__(self) -> Unrectified:
        self._camera.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._camera.__exit__(*error)

    def read(self, timeout_s: float) -> StereoFrame | None:
        return self._camera.read(timeout_s)


def rig_of(camera: StereoCamera) -> StereoRig:
    """Return the simulated camera's calibration as a rig of two cameras."""
    true = camera.calibration
    lens = Lens("pinhole", (true.focal_px, true.focal_px), true.principal_point_px, (0.0,) * 5)
    place = np.array([-true.baseline_m, 0.0, 0.0])
    made = CalibrationProvenance("2026-01-01T00:00:00Z", "none", 1, 0, 0.1, 0.1, 0.0)
    return StereoRig(lens, lens, np.zeros(3), place, true.image_size_px, Unrectified.serials, np.eye(24), made)


@contextmanager
def rectified_camera() -> Iterator[Rig]:
    with simulated_world() as world:
        yield Rig(RectifiedCamera(Unrectified(world.camera), rig_of(world.camera)), world.joints, close(world))


@contextmanager
def tracked_camera() -> Iterator[Rig]:
    with simulated_world() as world:
        yield Rig(TrackedCamera(world.camera, StereoTracker(world.camera.calibration)), world.joints, close(world))


@contextmanager
def eyes(tables: dict[str, Any], open_capture: OpenCapture = lambda _: FakeCapture()) -> Iterator[Rig]:
    """Yield cameras as [vision.cameras] asks for them, with their input in a folder of its own."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        write_pictures(folder)
        for device in ("left", "right", "device"):
            (folder / device).touch()
        text = msgspec.json.encode(tables).decode().replace("HERE/", f"{folder}/")
        config = msgspec.json.decode(text, type=CamerasConfig)
        yield Rig(eyes_of(config, folder, SystemClock(), open_capture))


def write_pictures(folder: Path) -> None:
    rng = np.random.default_rng(3)
    films = [
        cv2.VideoWriter(str(folder / f"{eye}.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, SIZE_PX) for eye in "lr"
    ]
    for number in range(PICTURES):
        for eye, film in zip("lr", films, strict=True):
            image = rng.integers(0, 255, (SIZE_PX[1], SIZE_PX[0], 3), np.uint8)
            cv2.imwrite(str(folder / f"{eye}_{number}.png"), image)
            film.write(image)
    for film in films:
        film.release()


def two_cameras() -> AbstractContextManager[Rig]:
    phases = iter([0.0, 0.004] * 100)
    two = {"left": "HERE/left", "right": "HERE/right", "image_size_px": SIZE_PX, "fourcc": "YUYV", "fps": 100.0}
    return eyes({"two": two}, lambda device: FakeCapture(phase_s=next(phases)))


def side_by_side_camera() -> AbstractContextManager[Rig]:
    one = {"device": "HERE/device", "image_size_px": SIZE_PX, "fourcc": "YUYV", "fps": 100.0}
    return eyes({"side_by_side": one}, lambda device: FakeCapture((2 * SIZE_PX[0], SIZE_PX[1])))


def image_folder() -> AbstractContextManager[Rig]:
    return eyes({"images": {"left": "l_*.png", "right": "r_*.png", "fps": 30.0, "speed": 0.0}})


def image_folder_in_its_own_time() -> AbstractContextManager[Rig]:
    return eyes({"images": {"left": "l_*.png", "right": "r_*.png", "fps": 50.0}})


def video_files() -> AbstractContextManager[Rig]:
    return eyes({"videos": {"left": "l.avi", "right": "r.avi", "speed": 0.0}})


def side_by_side_video() -> AbstractContextManager[Rig]:
    return eyes({"videos": {"side_by_side": "l.avi", "fps": 25.0, "speed": 0.0}})


@contextmanager
def ideal_camera() -> Iterator[Rig]:
    calibration = StereoCalibration(60.0, (31.5, 23.5), 0.1, SIZE_PX)
    with image_folder() as rig:
        yield Rig(IdealCamera(rig.source, calibration))


@contextmanager
def tracked_tags() -> Iterator[Rig]:
    """Yield a rig that tracks the demo's cube in the demo's hand."""
    robot = upper_body()
    tables = cube_tables(-np.array(robot.robot.marker_xyz))
    vision = msgspec.toml.decode(tables, type=dict[str, VisionConfig])["vision"]
    placed = vision.cluster.tags
    tags = tuple(SimTag(id=tag.id, xyz=tag.xyz, rpy=tag.rpy, side_m=vision.tag.side_m) for tag in placed)
    config = SimConfig(seed=0, camera=CameraConfig(tags=tags))
    with SimWorld(robot, config) as world:
        tracker = tracker_of(world.camera.calibration, vision)
        yield Rig(TrackedCamera(world.camera, tracker), world.joints, close(world))


@contextmanager
def emulated_servos(faults: Faults = no_faults) -> Iterator[Rig]:
    clock = VirtualClock()
    chain = Chain((Servo(BY_NAME["XM430-W350"], id, swinging(id)) for id in (1, 2)), faults)
    config = DynamixelConfig(
        {"arm": BusConfig("emulator")}, tuple(ServoConfig(name, id, "XM430-W350") for name, id in (("a", 1), ("b", 2)))
    )
    yield Rig(DynamixelJoints(config, ("a", "b"), clock, open_port=lambda *_: (VirtualPort(chain, clock), 0.0)))


@contextmanager
def emulated_feetech_servos(faults: Faults = no_faults) -> Iterator[Rig]:
    clock = VirtualClock()
    chain = FeetechChain((FeetechServo(FEETECH_MODELS["STS3215"], id, swinging(id)) for id in (1, 2)), faults)
    servos = tuple(ServoConfig(name, id, "STS3215") for name, id in (("a", 1), ("b", 2)))
    config = FeetechConfig({"arm": FeetechBus("emulator")}, servos)
    yield Rig(FeetechJoints(config, ("a", "b"), clock, open_port=lambda *_: (VirtualPort(chain, clock), 0.0)))


@contextmanager
def emulated_encoders(faults: Faults = no_faults) -> Iterator[Rig]:
    clock = VirtualClock()
    board = EncoderBoard({"a": (4096, swinging(1)), "b": (1024, swinging(2))}, begun_s=99.0, faults=faults)
    config = SerialLinesConfig("emulator", (EncoderConfig("a"), EncoderConfig("b")))
    yield Rig(SerialLineJoints(config, ("a", "b"), clock, open_port=lambda *_: VirtualPort(board, clock, 115_200)))


ARM = Path(__file__).parents[2] / "examples" / "desk_arm"


@contextmanager
def read_through_emulator(file: str, tables: str = "") -> Iterator[Rig]:
    """Yield joints of another source, read from an emulator by the driver that a robot.toml configures."""
    with TemporaryDirectory() as folder:
        arm = shutil.copytree(ARM, Path(folder) / "arm")
        with (arm / file).open("a", encoding="utf-8") as toml:
            toml.write(tables)
        config = Config.load(arm / file, {})
        poses = [JointReading(t, frozen_array([0.01 * k, 0.1, -0.01 * k, 0.2])) for k, t in enumerate(TIMES.tolist())]
        scripted = Scripted(poses, config.robot.joints)
        clock = SystemClock()
        yield Rig(through_emulator(config, scripted, lambda there: driver_of(there, config, clock, last_pose=None)))


def through_dynamixel_servos() -> AbstractContextManager[Rig]:
    return read_through_emulator("servos.toml")


def through_feetech_servos() -> AbstractContextManager[Rig]:
    return read_through_emulator("feetech.toml")


def through_encoders() -> AbstractContextManager[Rig]:
    return read_through_emulator("encoders.toml")


def through_ros_2() -> AbstractContextManager[Rig]:
    return read_through_emulator("robot.toml", '\n[drivers.ros2]\nrouter = "tcp/127.0.0.1:17447"\n')


def servos_that_fall_silent() -> AbstractContextManager[Rig]:
    said = count()
    return emulated_servos(lambda reply: reply if next(said) < 30 else replace(reply, data=b""))


@contextmanager
def ros_2_robot(send: Send = encode_joint_state) -> Iterator[Rig]:
    clock = VirtualClock()
    nodes = [Node({name: swinging(place)}, 50.0, name=name, send=send) for place, name in enumerate("ab")]
    yield Rig(Ros2Joints(Ros2Config(), ("a", "b"), clock, open_link=lambda *_: VirtualLink(nodes, clock)))


def ros_2_robot_that_falls_silent() -> AbstractContextManager[Rig]:
    said = count()
    return ros_2_robot(lambda message: encode_joint_state(message) if next(said) < 30 else None)


def feetech_servos_that_fall_silent() -> AbstractContextManager[Rig]:
    said = count()
    return emulated_feetech_servos(lambda reply: reply if next(said) < 30 else replace(reply, data=b""))


def encoders_that_fall_silent() -> AbstractContextManager[Rig]:
    said = count()
    return emulated_encoders(lambda reply: reply if next(said) < 300 else replace(reply, data=b""))


class SentPositions:
    """A `Receiver` of a datagram every 10 ms, in virtual time."""

    def __init__(self, clock: VirtualClock) -> None:
        self._clock = clock

    def open(self) -> None:
        pass

    def close(self) -> None:
        pass

    def receive(self, until: float) -> Packet:
        self._clock.wait_until(self._clock.now() + 0.01)
        told = {"schema": SCHEMA, "position": (0.1, 0.2, 0.3), "stamp": self._clock.now()}
        return Packet(msgspec.json.encode(told), "sender", self._clock.now())

    def silence(self) -> str:
        return ""


def stream_in(clock: VirtualClock) -> MarkerStream:
    return MarkerStream(UdpTable(), SentPositions(clock), decode_datagram, clock)


@contextmanager
def sent_positions() -> Iterator[Rig]:
    yield Rig(stream_in(VirtualClock()))


@contextmanager
def fused_positions() -> Iterator[Rig]:
    clock = VirtualClock()
    yield Rig(FusedMarkers([Member(name, stream_in(clock), np.eye(4)) for name in "ab"], clock))


def swinging(id: int) -> Callable[[float], float]:
    return lambda t: float(np.sin(t + id))


THROUGH = [through_dynamixel_servos, through_feetech_servos, through_encoders, through_ros_2]
SIMULATED = pytest.mark.skipif(find_spec("pybullet") is None, reason="no pybullet; to run it: pip install -e '.[sim]'")
ENDING_JOINTS = [replayed_joints, scripted_joints, pytest.param(simulated_joints, marks=SIMULATED), *THROUGH]
JOINTS = [*ENDING_JOINTS, emulated_servos, emulated_feetech_servos, emulated_encoders, ros_2_robot]
SILENT_SERVOS = [servos_that_fall_silent, feetech_servos_that_fall_silent]
SILENT = [*SILENT_SERVOS, encoders_that_fall_silent, ros_2_robot_that_falls_silent]
CAMERAS = [pytest.param(camera, marks=SIMULATED) for camera in (simulated_camera, rectified_camera)]
ENDING_EYES = [image_folder, video_files, side_by_side_video, ideal_camera]
WAITING_EYES = [two_cameras, side_by_side_camera, image_folder_in_its_own_time]
SENT = [sent_positions, fused_positions]
MARKERS = [replayed_marker, scripted_marker, pytest.param(tracked_camera, marks=SIMULATED)]
# They live as a tracked camera does.
TAGS = pytest.param(tracked_tags, marks=SIMULATED)
STANDING_STILL = [ENDING_JOINTS[2], *MARKERS[2:], *CAMERAS]
Make = Callable[[], AbstractContextManager[Rig]]
Shared = Callable[[Make], Rig]


@pytest.fixture(scope="module")
def shared() -> Iterator[Shared]:
    """Yield a function that returns a closed source of each kind, shared by all laws that leave it usable."""
    with ExitStack() as stack:
        yield cache(lambda make: stack.enter_context(make()))


@pytest.fixture(autouse=True)
def _patience(request: pytest.FixtureRequest) -> None:
    """Wait for an emulator that a full machine holds up; only sources that fall silent have to be found silent."""
    if "[through_" in request.node.name:
        request.getfixturevalue("patient_host")


@pytest.fixture(params=[*JOINTS, *MARKERS, *SENT, *CAMERAS, *ENDING_EYES, *WAITING_EYES])
def rig(request: pytest.FixtureRequest, shared: Shared) -> Rig:
    return shared(request.param)


# --- lifetime


def test_reading_before_opening_is_an_error(rig: Rig) -> None:
    with pytest.raises(SourceError):
        rig.source.read(0.05)


def test_times_increase_strictly_across_reopening(rig: Rig) -> None:
    times = []
    for _ in range(2):
        with rig.opened():
            times += [item.t for item in rig.read()]
    assert np.isfinite(times).all()
    assert (np.diff(times) > 0).all()


def test_opening_returns_the_source(rig: Rig) -> None:
    with rig.source as opened:
        assert opened is rig.source


def test_closing_again_does_no_harm(rig: Rig) -> None:
    with rig.opened():
        rig.read(1)
    for source in rig.sources:
        source.__exit__(None, None, None)
    with rig.opened():
        assert len(rig.read(1)) == 1


def test_reading_after_closing_is_an_error(rig: Rig) -> None:
    with rig.opened():
        rig.read(1)
    with pytest.raises(SourceError):
        rig.source.read(0.05)


def test_error_in_block_survives_closing(rig: Rig) -> None:
    with pytest.raises(ZeroDivisionError), rig.opened():
        raise ZeroDivisionError


# --- waiting


@pytest.mark.parametrize(
    "make", [replayed_joints, replayed_marker, ENDING_JOINTS[2], *SILENT, *MARKERS[2:], *CAMERAS, *WAITING_EYES]
)
def test_where_nothing_comes_in_time_none_is_returned(make: Make, shared: Shared) -> None:
    rig = shared(make)
    with rig.opened():
        for timeout_s in (0.01, 0.0):
            while rig.source.read(timeout_s) is not None:  # time stands still until the other source is read too
                continue


# --- what is read


@pytest.fixture(params=JOINTS)
def joints(request: pytest.FixtureRequest, shared: Shared) -> Iterator[tuple[JointSource, list[Any]]]:
    rig = shared(request.param)
    with rig.opened():
        yield rig.source, rig.read()


@pytest.fixture(scope="module", params=[*MARKERS, TAGS])
def seen(request: pytest.FixtureRequest, shared: Shared) -> tuple[MarkerSource, list[Any]]:
    """Return a closed marker source and what was read of it."""
    rig = shared(request.param)
    with rig.opened():
        return rig.source, rig.read()


@pytest.fixture(params=[*ENDING_EYES[:-1], *WAITING_EYES])
def looks(request: pytest.FixtureRequest, shared: Shared) -> Iterator[tuple[StereoEyes, list[Any]]]:
    rig = shared(request.param)
    with rig.opened():
        yield rig.source, rig.read()


@pytest.fixture(params=[*CAMERAS, ideal_camera])
def frames(request: pytest.FixtureRequest, shared: Shared) -> Iterator[tuple[StereoCamera, list[Any]]]:
    rig = shared(request.param)
    with rig.opened():
        yield rig.source, rig.read()


def is_frozen(array: np.ndarray, shape: tuple[int, ...]) -> bool:
    """Return True for a finite, read-only float64 array of this shape."""
    whole = bool(np.isfinite(array).all()) and not array.flags.writeable
    return whole and (array.shape, array.dtype) == (shape, np.float64)


def test_joint_source_gives_finite_angle_per_joint(joints) -> None:
    source, readings = joints
    assert isinstance(source, JointSource)
    assert len(source.joints) > 0
    assert all(type(reading) is JointReading and is_frozen(reading.q, (len(source.joints),)) for reading in readings)


def test_marker_source_gives_finite_position_or_reason(seen) -> None:
    source, items = seen
    assert isinstance(source, MarkerSource)
    assert all(type(item) is MarkerMiss or is_frozen(item.x, (3,)) for item in items)
    assert any(type(item) is MarkerFix for item in items)


def test_a_fix_has_a_positive_definite_covariance(seen) -> None:
    for fix in seen[1]:
        if isinstance(fix, MarkerFix):
            assert is_frozen(fix.cov, (3, 3))
            assert fix.cov == pytest.approx(fix.cov.T, rel=1e-9)
            assert np.linalg.eigvalsh(fix.cov)[0] > 0


def test_oriented_fix_has_unit_quaternion(seen) -> None:
    for fix in seen[1]:
        if isinstance(fix, MarkerFix) and fix.R is not None:
            assert is_frozen(fix.R, (4,))
            assert np.linalg.norm(fix.R) == pytest.approx(1.0, abs=1e-9)
        if isinstance(fix, MarkerFix) and fix.cov_R is not None:
            assert fix.R is not None
            assert is_frozen(fix.cov_R, (3, 3))
            assert np.linalg.eigvalsh(fix.cov_R)[0] > 0


def test_camera_gives_colour_images_of_calibrated_size(frames) -> None:
    camera, items = frames
    assert isinstance(camera, StereoCamera)
    width, height = camera.calibration.image_size_px
    for frame in items:
        assert type(frame) is StereoFrame
        for image in (frame.left, frame.right):
            assert (image.shape, image.dtype) == ((height, width, 3), np.uint8)


def test_stereo_eyes_give_equal_sizes_and_time_uncertainty(looks) -> None:
    source, items = looks
    assert isinstance(source, StereoEyes)
    width, height = source.image_size_px
    for frame in items:
        assert type(frame) is StereoFrame
        assert (type(frame.t), frame.t_sigma >= 0, type(frame.t_sigma)) == (float, True, float)
        for image in (frame.left, frame.right):
            assert (image.shape, image.dtype) == ((height, width, 3), np.uint8)


def test_eyes_tell_their_devices_apart(looks) -> None:
    left, right = looks[0].serials
    assert left
    assert right
    assert left != right


def read_through(make: Make, attempts: int = 5) -> list[Any]:
    """Return the rows that come through an emulator; begin again where a busy host held its lines up."""
    for _ in range(attempts - 1):
        with suppress(SourceLost), make() as rig, rig.opened():
            return rig.read(ROWS)
    with make() as rig, rig.opened():
        return rig.read(ROWS)


@pytest.mark.parametrize("make", THROUGH)
def test_emulated_servos_reproduce_source_joints_and_times(make: Make) -> None:
    told = read_through(make)
    assert [reading.t for reading in told] == TIMES.tolist()
    expected = [[0.01 * k, 0.1, -0.01 * k, 0.2] for k in range(ROWS)]
    assert np.abs(np.array([reading.q for reading in told]) - expected).max() <= np.pi / 4096 + 1e-9


# --- the end; nothing is read of a shared source after it


@pytest.mark.parametrize("make", [*ENDING_JOINTS, *MARKERS, *CAMERAS, *ENDING_EYES])
def test_the_end_is_said_each_time_one_reads(make: Make, shared: Shared) -> None:
    rig = shared(make)
    with rig.opened():
        rig.read(1)
        with pytest.raises(SourceEnded):
            rig.read_to_the_end()
        with pytest.raises(SourceEnded):
            rig.source.read(0.05)
