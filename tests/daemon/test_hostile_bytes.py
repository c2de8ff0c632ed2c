"""Bytes from outside, as bad as hypothesis can make them: an error of ours or a value, never anything else.

What kbmaps reads (models) is treated in the same way by tests/kbmaps/test_damaged_state.py, servos' bytes by the tests
of their drivers, messages of ROS 2 by tests/drivers/test_ros2_bytes.py.
"""

from __future__ import annotations

import math
import tracemalloc
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from guided_arm import Scene, new_learning, teach
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from small_arm import JOINTS, URDF, write_small_arm

from bodyschema.daemon import checkpoint, wire
from bodyschema.daemon.answers import Answers
from bodyschema.daemon.bus import Request
from bodyschema.daemon.checkpoint import CheckpointError
from bodyschema.daemon.config import Config, LearnerConfig
from bodyschema.daemon.going_on import DOES_NOT_FIT
from bodyschema.daemon.history import answer_pairs
from bodyschema.daemon.learning import DirectSolver, Learning, NominalModel, StateError
from bodyschema.daemon.router import RouterConfig
from bodyschema.daemon.status import LearnerStatus, SamplerStatus
from bodyschema.effects import Simulation
from bodyschema.interfaces.errors import BodyschemaError, ConfigError, RecordingError, RequestError
from bodyschema.interfaces.recording import Recording, joints_in
from bodyschema.interfaces.robot import RobotDescription
from bodyschema.interfaces.urdf import UrdfTree
from bodyschema.vision.rig_file import read_rig
from kbmaps import KBMapsError

MOST_BYTES = 200 * 2**20  # of memory that reading a small file may take
quick = settings(
    max_examples=40,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    phases=[Phase.explicit, Phase.reuse, Phase.generate],  # the bytes found say enough; shrinking them takes minutes
)
long = settings(quick, max_examples=5000)

# What is put in the middle of a text that was right.
NASTY = (
    b"nan", b"1e999", b"-inf", b"9" * 5000, b"0x" + b"f" * 50, b"\x00", b"\xff\xfe", b'"', b"'", b"[" * 2000,
    b"{" * 2000, b"a." * 2000, b"<x>" * 300, b"&a;", b"<!DOCTYPE a>", b"../../", b"file:///etc/passwd", b"true",
    b"null", b"\n", b",", b";",
)  # fmt: skip
KINDS = (
    wire.PairMessage, wire.PairsReply, wire.JointsRequest, wire.IkRequest, wire.CommandRequest, wire.CommandReply,
    wire.PredictReply, wire.JacobianReply, wire.IkReply, wire.ErrorReply, SamplerStatus, LearnerStatus,
)  # fmt: skip
# MessagePack has no larger integers; JSON's are among the nasty texts.
integers = st.integers(-(2**63), 2**64 - 1)
leaves = st.none() | st.booleans() | integers | st.floats() | st.text(max_size=5)
anything = st.recursive(
    leaves, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=3)
)


@st.composite
def mangled(draw: st.DrawFn, good: bytes) -> bytes:
    """Draw a valid file changed in a few places."""
    data = bytearray(good)
    for _ in range(draw(st.integers(1, 5))):
        place = draw(st.integers(0, len(data)))
        cut = draw(st.integers(0, 30))
        data[place : place + cut] = draw(st.sampled_from(NASTY) | st.binary(max_size=8) | st.just(bytes(data[:cut])))
    return bytes(data)


def taken(read: Callable[[], object]) -> object:
    """Return the value read, or None if the data were refused; fail on any other error or on high memory use."""
    tracemalloc.start()
    try:
        return read()
    except BodyschemaError:
        return None
    finally:
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert most < MOST_BYTES


# --- messages


@quick
@given(st.sampled_from(KINDS), st.sampled_from([wire.JSON, wire.MSGPACK]), st.binary(max_size=200))
def test_any_bytes_are_a_message_or_an_error(kind: type, encoding: str, data: bytes) -> None:
    taken(lambda: wire.decode(data, kind, encoding))


@quick
@given(st.data(), st.sampled_from(KINDS), st.sampled_from([wire.JSON, wire.MSGPACK]))
def test_any_values_in_a_messages_fields_are_a_message_or_an_error(
    data: st.DataObject, kind: type, encoding: str
) -> None:
    names = [field.encode_name for field in msgspec.structs.fields(kind)]
    values = data.draw(st.dictionaries(st.sampled_from(names), anything, max_size=len(names)))
    payload = wire.encode(values, encoding)
    message = taken(lambda: wire.decode(payload, kind, encoding))
    if isinstance(message, wire.PairMessage):
        taken(lambda: wire.pair_from_wire(message, 2))
    if isinstance(message, wire.JointsRequest):
        q = taken(lambda: wire.joint_angles(message, JOINTS))
        assert q is None or np.isfinite(q).all()


@pytest.mark.parametrize(
    ("encoding", "bomb"),
    [
        (wire.JSON, b'{"q":' + b"[" * 1_000_000),
        (wire.JSON, b'{"z":' + b"[" * 1_000_000),
        (wire.JSON, b'{"q":[' + b"9" * 1_000_000 + b"]}"),
        (wire.MSGPACK, b"\x81\xa1z" + b"\x91" * 1_000_000),
        (wire.MSGPACK, b"\x81\xa1q\xdd\xff\xff\xff\xff"),
        (wire.MSGPACK, b"\xdf\xff\xff\xff\xff"),
        (wire.MSGPACK, b"\x81\xa1q\xc6\xff\xff\xff\xff"),
    ],
)
def test_depth_and_declared_lengths_are_no_bombs(encoding: str, bomb: bytes) -> None:
    for kind in KINDS:
        assert taken(lambda kind=kind: wire.decode(bomb, kind, encoding)) is None


WILD = st.sampled_from([0.0, -0.0, 5e-324, 1e-308, 1e6, 1e155, -1e308, math.inf, math.nan, 2**63]) | st.floats()


@pytest.fixture(scope="module")
def answers(tmp_path_factory) -> Answers:
    robot = RobotDescription.load(write_small_arm(tmp_path_factory.mktemp("answers")))
    nominal = NominalModel.extended_by(Simulation(robot, ()))
    return Answers(Learning(nominal, LearnerConfig(), DirectSolver()), robot, lambda _: None)


@settings(quick, max_examples=12)
@given(st.lists(WILD, min_size=3, max_size=3), st.lists(WILD, min_size=2, max_size=2), st.booleans())
def test_wild_numbers_get_finite_answers_or_errors(answers: Answers, x: list, q: list, start: bool) -> None:
    where = {"start": q} if start else {"posture": q}
    for ask, question in (
        (answers.predict, {"q": q}),
        (answers.jacobian, {"q": [q, q]}),
        (answers.ik, {"x": x} | where),
    ):
        request = Request({}, wire.encode(question, wire.MSGPACK), wire.MSGPACK)
        reply = taken(lambda ask=ask, request=request: ask(request))
        assert isinstance(reply, bytes | None)
        numbers = [] if reply is None else msgspec.msgpack.decode(reply).values()
        flat = [np.ravel(value) for value in numbers if isinstance(value, float | list)]
        assert all(np.isfinite(value).all() for value in flat)


@pytest.mark.parametrize("x", [[1e308, 0.0, 0.0], [0.0, -1e155, 0.0], [2000.0, 0.0, 0.0]])
def test_a_position_that_is_not_in_metres_is_refused(answers: Answers, x: list[float]) -> None:
    request = Request({}, wire.encode({"x": x}), wire.JSON)
    with pytest.raises(RequestError, match="positions are in metres, at most 1000 on each axis"):
        answers.ik(request)


@quick
@given(st.dictionaries(st.sampled_from(["from", "to", "limit"]), st.text(max_size=25)))
def test_any_parameters_of_the_history_are_pairs_or_an_error(parameters: dict[str, str]) -> None:
    class Empty:
        identity = "uuid"

        def read(self, first: int, to: int, most: int) -> list[object]:
            assert 1 <= first <= to < 2**63
            return []

        def last_seq(self) -> int:
            return 0

    taken(lambda: answer_pairs(Empty(), Request(parameters, b"", wire.JSON)))  # pyright: ignore[reportArgumentType]


# --- files

RECORDING = (
    b"t,waist,shoulder,x,y,z,sx,sy,sz,segment\n"
    b"0,0.1,0.2,1,2,3,0.1,0.1,0.1,1\n1,0.1,0.2,1,2,3,0.1,0.1,0.1,1\n2,0.3,0.2,1,2,3,0.1,0.1,0.1,2\n"
)
ROBOT = """[zenoh]
sampler = "tcp/127.0.0.1:7447"
[daemon]
min_step_deg = 1.0
[vision]
marker = "ball"
[learner]
seed = 3
[[effects]]
effect = "joint_offset"
where = "waist"
parameters = { offset_rad = 0.1 }
"""
ROUTER = b'listen = "tls/127.0.0.1:7450"\n[tls]\nca = "ca.pem"\n[access."*"]\nviewer = ["anna"]\n'
CAMERAS = b'format = "bodyschema stereo rig 1"\nimage_size_px = [640, 480]\nmodel = "pinhole"\n[left]\nserial = ""\n'


def parquet(folder: Path) -> bytes:
    file = folder / "good.parquet"
    if not file.exists():
        (folder / "good.csv").write_bytes(RECORDING)
        Recording.read(folder / "good.csv", JOINTS).write_parquet(file)
    return file.read_bytes()


def read_bytes(folder: Path, name: str, data: bytes, read: Callable[[Path], object]) -> object:
    file = folder / name
    file.write_bytes(data)
    return taken(lambda: read(file))


def read_robot_toml(file: Path) -> Config:
    return Config.load(file, {})


def check_all_files(tmp_path: Path, data: st.DataObject) -> None:
    robot = write_small_arm(tmp_path, ROBOT)
    if data.draw(st.booleans()):
        read_bytes(tmp_path, robot.name, data.draw(mangled(robot.read_bytes())), read_robot_toml)
    else:
        (tmp_path / "arm.urdf").write_bytes(data.draw(mangled(URDF.encode())))
        taken(lambda: RobotDescription.load(robot))
    for name, good, read in (
        ("router.toml", ROUTER, RouterConfig.load),
        ("cameras.toml", CAMERAS, read_rig),
        ("a.csv", RECORDING, lambda file: (joints_in(file), Recording.read(file, JOINTS))),
        ("a.parquet", parquet(tmp_path), lambda file: (joints_in(file), Recording.read(file, JOINTS))),
    ):
        read_bytes(tmp_path, name, data.draw(mangled(good)), read)


@settings(quick, max_examples=12)
@given(st.data())
def test_a_mangled_file_is_read_or_refused(tmp_path: Path, data: st.DataObject) -> None:
    check_all_files(tmp_path, data)


@pytest.mark.soak
@pytest.mark.timeout(3600)
@long
@given(st.data())
def test_thousands_of_mangled_files_are_read_or_refused(tmp_path: Path, data: st.DataObject) -> None:
    check_all_files(tmp_path, data)


@pytest.mark.parametrize(
    "text",
    [
        "x = " + "9" * 5000,
        "x = " + "[" * 100_000,
        "x = " + "{a=" * 5000,
        "a." * 50_000 + "b = 1",
        "[" + "a." * 30_000 + "b]",
        "x = '" + "a" * 5_000_000 + "'",
    ],
)
def test_a_toml_file_that_would_take_for_ever_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "robot.toml").write_text(text + "\n")
    with pytest.raises(ConfigError):
        read_robot_toml(tmp_path / "robot.toml")


def urdf_of(inside: str) -> bytes:
    return f'<robot name="a">{inside}</robot>'.encode()


CHAIN = "".join(
    f'<link name="l{k}"/><joint name="j{k}" type="fixed"><parent link="l{k}"/><child link="l{k + 1}"/></joint>'
    for k in range(20_000)
)
RING = "".join(
    f'<joint name="j{a}" type="fixed"><parent link="{a}"/><child link="{b}"/></joint>' for a, b in ("bc", "cb")
)
ENTITIES = '<!DOCTYPE r [<!ENTITY a "aaaaaaaaaa">' + "".join(
    f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    ("urdf", "said"),
    [
        (urdf_of(CHAIN + '<link name="l20000"/>'), "more than 2,000 links"),
        (
            urdf_of('<link name="a"/><link name="b"/><link name="c"/>' + RING),
            "the links b, c hang on each other in a ring",
        ),
        (urdf_of("<link>" * 50_000 + "</link>" * 50_000), "not XML"),
        ((ENTITIES + ']><robot name="&i;"/>').encode(), "DOCTYPE|not XML"),
        (b'<!DOCTYPE r [<!ENTITY a SYSTEM "file:///etc/passwd">]><robot name="&a;"/>', "DOCTYPE|not XML"),
        (b'<robot name="' + b"a" * (17 * 2**20) + b'"/>', "larger than 16 MiB"),
    ],
)
def test_a_urdf_that_would_take_for_ever_or_read_other_files_is_refused(tmp_path: Path, urdf: bytes, said: str) -> None:
    (tmp_path / "a.urdf").write_bytes(urdf)
    with pytest.raises(ConfigError, match=said):
        UrdfTree.load(tmp_path / "a.urdf")


def test_an_include_in_a_urdf_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "secret").write_text('<link name="secret"/>')
    include = '<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="secret"/><link name="base"/>'
    (tmp_path / "a.urdf").write_bytes(urdf_of(include))
    assert UrdfTree.load(tmp_path / "a.urdf").links == ("base",)


@pytest.mark.parametrize(
    "text",
    [
        b"," * 5_000_000,
        b"a" * 10_000_000,
        RECORDING + b"," * 5_000_000 + b"\n",
        b",".join(b"c%d" % k for k in range(10**5)),
    ],
)
def test_a_recording_of_absurd_width_is_refused(tmp_path: Path, text: bytes) -> None:
    (tmp_path / "a.csv").write_bytes(text)
    with pytest.raises(RecordingError):
        Recording.read(tmp_path / "a.csv", JOINTS)


def test_a_small_parquet_file_of_billions_of_rows_is_refused_unread(tmp_path: Path) -> None:
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    same = arrow.array(np.zeros(1_000_000))
    table = arrow.table(dict.fromkeys((*JOINTS, "x", "y", "z"), same))
    with parquet.ParquetWriter(tmp_path / "a.parquet", table.schema) as writer:
        for _ in range(21):
            writer.write_table(table)
    assert (tmp_path / "a.parquet").stat().st_size < 1_000_000
    with pytest.raises(RecordingError, match="21,000,000 rows; of these columns at most 20,000,000 are read"):
        Recording.read(tmp_path / "a.parquet", JOINTS)


# --- checkpoints with a checksum that is right


@pytest.fixture(scope="module")
def stored(tmp_path_factory) -> tuple[dict[str, Any], bytes]:
    """Return header and arrays of a trained learner's checkpoint."""
    file, learning = tmp_path_factory.mktemp("state") / "learner.ckpt", new_learning()
    teach(learning, Scene.draw(0, 40).pairs, background=False)
    checkpoint.write_checkpoint(file, learning.state(), robot="arm", utc="")
    data = file.read_bytes()
    begin = checkpoint._PREFIX.size
    end = begin + checkpoint._PREFIX.unpack_from(data)[2]
    return msgspec.msgpack.decode(data[begin:end]), data[end : -checkpoint._CHECKSUM_BYTES]


def places(value: object, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the paths to all values inside."""
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [found for key, inner in inside for found in ((*path, key), *places(inner, (*path, key)))]


FORGED = [None, -1, 0, 2**63 - 1, math.nan, math.inf, 1e308, "", "x" * 99, b"", [], {}, [-1, -1], [2**40]]


@settings(quick, max_examples=30)
@given(st.integers(0, 2**20), st.sampled_from(FORGED))
@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning", "ignore:invalid value:RuntimeWarning")
def test_a_forged_checkpoint_is_restored_or_refused(tmp_path: Path, stored, place: int, value: object) -> None:
    header = deepcopy(stored[0])
    paths = places(header)
    *way, last = paths[place % len(paths)]
    spot = header
    for key in way:
        spot = spot[key]
    spot[last] = value
    packed = msgspec.msgpack.encode(header)
    body = checkpoint._PREFIX.pack(checkpoint.MAGIC, checkpoint.VERSION, len(packed)) + packed + stored[1]
    file = tmp_path / "learner.ckpt"
    file.write_bytes(body + checkpoint._checksum(body))
    try:
        state = checkpoint.read_checkpoint(file, robot="arm")
    except CheckpointError:
        return
    learning = new_learning()
    try:
        assert state is not None
        learning.restore(state)
    except (StateError, KBMapsError, *DOES_NOT_FIT):  # what the learner sets the file aside for
        return
    assert np.isfinite(learning.snapshot.predict(np.zeros((1, len(Scene.draw(0, 1).pairs[0].q)))).x).all()


# --- pairs that somebody publishes


@quick
@given(st.lists(st.binary(max_size=60) | st.just(b"{}"), max_size=5))
def test_published_bytes_that_are_no_pair_are_counted_and_learning_goes_on(payloads: list[bytes]) -> None:
    from bodyschema.daemon.feed import PairFeed
    from bodyschema.interfaces.clock import SystemClock

    def no_history(_begin: int) -> wire.PairsReply:
        raise RequestError("nobody")

    feed = PairFeed(new_learning(), no_history, SystemClock())
    for payload in payloads:
        feed.offer(payload)
    for _ in payloads:
        feed.step(0.0)
    assert feed._waiting.empty()
