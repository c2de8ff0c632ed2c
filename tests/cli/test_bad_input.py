"""User errors at the command line and over zenoh, and the messages they produce."""

from __future__ import annotations

import contextlib
import io
import json
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from queue import Queue
from unittest import mock

import pytest
import warm
from small_arm import ROBOT, URDF, write_long_arm, write_small_arm

from bodyschema.cli.main import main
from bodyschema.daemon.config import Config
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import ZenohSession, client
from bodyschema.daemon.transport.status import LearnerStatus
from bodyschema.daemon.transport.wire import decode
from bodyschema.interfaces.errors import BusError, RequestError

LIMIT_S = 500.0
DAEMON = ("-m", "bodyschema")
PROCESSES = ("run",)
KEYS = Keys("arm")
RECORDING = "waist,shoulder,x,y,z\n" + "".join(f"{0.03 * k},0.1,0.3,0.0{k},0.5\n" for k in range(1, 9))
# Root may write wherever it likes; without this capability it is as everybody.
WITHOUT_ROOTS_RIGHTS = """import ctypes, os, sys
PR_CAPBSET_DROP, CAP_DAC_OVERRIDE = 24, 1
ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, CAP_DAC_OVERRIDE, 0, 0, 0)
os.execv(sys.executable, [sys.executable, "-m", "bodyschema", *sys.argv[1:]])"""
# SQLite reports a file size limit in the same words as a full disk.


def run(*arguments: object, cwd: Path, by: tuple[str, ...] = DAEMON) -> subprocess.CompletedProcess[str]:
    if by == DAEMON:
        return warm.run(*by, *arguments, cwd=cwd)
    command = [sys.executable, *by, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False, cwd=cwd)


def run_here(*arguments: object, cwd: Path, stdin: str = "") -> subprocess.CompletedProcess[str]:
    """Run a command that leaves the process's state unchanged, like `run` but in this process."""
    command, out, err = ["bodyschema", *map(str, arguments)], io.StringIO(), io.StringIO()
    typed = io.TextIOWrapper(io.BytesIO(stdin.encode()))
    with (
        mock.patch.multiple(sys, argv=command, stdin=typed),
        contextlib.chdir(cwd),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        pytest.raises(SystemExit) as ended,
    ):
        main()
    return subprocess.CompletedProcess(command, ended.value.code, out.getvalue(), err.getvalue())


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file): file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()}


def refused(*arguments: object, cwd: Path, stdin: str = "") -> str:
    """Return the one line with which the command fails; assert that it changed nothing."""
    before = contents(cwd)
    done = run(*arguments, cwd=cwd) if arguments[0] in PROCESSES else run_here(*arguments, cwd=cwd, stdin=stdin)
    assert contents(cwd) == before
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("bodyschema: ")
    return done.stderr.removeprefix("bodyschema: ").rstrip()


@pytest.fixture
def robot(tmp_path: Path, free_endpoint: Callable[[], str]) -> Path:
    """Return robot.toml of an arm that replays walk.csv as encoders and camera; the working directory of `run`."""
    (tmp_path / "walk.csv").write_text(RECORDING)
    tables = f'[zenoh]\nsampler = "{free_endpoint()}"\nlearner = "{free_endpoint()}"\n[daemon]\nstate_dir = "state"\n'
    return write_small_arm(tmp_path, tables + '[drivers]\nrecording = "walk.csv"\nspeed = 0\n')


def fix(file: Path, right: str, wrong: str) -> None:
    text = file.read_text()
    assert right in text
    file.write_text(text.replace(right, wrong))


# --- files


@pytest.mark.parametrize(
    ("command", "right", "wrong", "line", "said"),
    [
        (
            "run sampler",
            '"arm.urdf"',
            '"leg.urdf"',
            None,
            "cannot read the URDF: No such file or directory. Fix [robot]",
        ),
        (
            "run learner",
            '"arm.urdf"',
            '"leg.urdf"',
            None,
            "cannot read the URDF: No such file or directory. Fix [robot]",
        ),
        ("run sampler", '"waist", ', '"wrist", ', 4, "there is no joint 'wrist' in arm.urdf. Did you mean 'waist'?"),
        ("run", '"waist", ', '"wrist", ', 4, "there is no joint 'wrist' in arm.urdf. Did you mean 'waist'?"),
        ("run learner", '"hand"', '"hnd"', 5, "there is no link 'hnd' in arm.urdf. Did you mean 'hand'?"),
        ("run sampler", "state_dir", "statedir", 12, "unknown key 'statedir' in [daemon]. Did you mean 'state_dir'?"),
        ("run learner", "state_dir", "statedir", 12, "unknown key 'statedir' in [daemon]. Did you mean 'state_dir'?"),
        ("replay", '"arm.urdf"', '"leg.urdf"', None, "cannot read the URDF: No such file or directory. Fix [robot]"),
        ("config", "state_dir", "statedir", 12, "unknown key 'statedir' in [daemon]. Did you mean 'state_dir'?"),
    ],
)
def test_nothing_starts_with_a_wrong_description(robot, command, right, wrong, line, said) -> None:
    fix(robot, right, wrong)
    message = refused(*command.split(), *(["walk.csv"] if command == "replay" else []), cwd=robot.parent)
    assert message.startswith("leg.urdf: " if line is None else f"robot.toml, line {line}: ")
    assert said in message


@pytest.mark.parametrize("command", ["config", "run learner", "run", "replay walk.csv"])
def test_too_many_joints_error_names_limit_and_alternative(tmp_path, command) -> None:
    write_long_arm(tmp_path, joints=13)
    message = refused(*command.split(), cwd=tmp_path)
    assert message.startswith("robot.toml, line 4: 13 joints are too many for the learner: their map has 1,594,323")
    assert "Name at most 12 in joints" in message
    assert "kbmaps.RigidLearner or kbmaps.TensorLearner" in message


def test_twelve_joints_are_in_order(tmp_path) -> None:
    write_long_arm(tmp_path, joints=12)
    done = run_here("config", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_folder_for_robot_toml_is_refused(robot) -> None:
    assert (
        refused("run", "sampler", "--robot", ".", cwd=robot.parent)
        == ".: a folder, not a file. Name the robot.toml in it"
    )


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.csv", b"hello\n", "a.csv, line 1, column waist: there is no column for the joint 'waist'"),
        ("a.csv", b"", "a.csv: the file is empty"),
        ("a.csv", b"waist,shoulder,x,y,z\n\xff\xfe\x00\x01\n", "a.csv, line 2: the byte 0xff is not UTF-8 text"),
        ("a.csv", b"waist,shoulder,x,y,z\n0,0,1,2,3\n0,nan,1,2,3\n", "a.csv, line 3, column shoulder: nan is not"),
        ("a.csv", b"waist,shoulder,x,y,z\n0,0,1,2,3\n0,0,1,2\n", "a.csv, line 3, column z: 4 fields where the header"),
        ("a.parquet", b"PAR1" + bytes(100), "a.parquet: not a whole Parquet file"),
        ("a.txt", b"waist", "a.txt: recordings end in .csv or .parquet"),
    ],
)
def test_unreadable_recording_error_names_its_location(robot, name, content, said) -> None:
    (robot.parent / name).write_bytes(content)
    assert refused("replay", name, cwd=robot.parent).startswith(said)


def test_a_folder_for_a_recording_is_refused(robot) -> None:
    (robot.parent / "a.csv").mkdir()
    assert refused("replay", "a.csv", cwd=robot.parent) == "a.csv: a folder, not a file. Name the recording in it"


@pytest.mark.parametrize("name", ["a.csv", "a.txt", "a"])
def test_a_recording_that_is_not_there_is_refused(robot, name) -> None:
    assert refused("replay", name, cwd=robot.parent).startswith(f"{name}: there is no such file")


def test_sampler_leaves_no_store_for_unreadable_recording(robot) -> None:
    fix(robot.parent / "walk.csv", "0.03,", "0.03x,")
    assert "walk.csv, line 2, column waist: '0.03x' is not a number" in refused("run", "sampler", cwd=robot.parent)


# --- joint angles at the command line


@pytest.mark.parametrize(
    ("values", "stdin", "said"),
    [
        (["0.1"], "", "q has 1 numbers; this robot has 2 joints: waist, shoulder"),
        (["0.1", "nan"], "", "q is not finite at joint 'shoulder'"),
        ([], "", "no joint angles, and standard input is empty; give 2 (waist, shoulder)"),
        ([], "0.1 0.2", "standard input is not a JSON list of 2 numbers (waist, shoulder), or a list of such lists"),
        ([], "[[0.1, 0.2], [0.3]]", "row 1 of q has 1 numbers; this robot has 2 joints: waist, shoulder"),
    ],
)
def test_joint_angles_that_are_none_are_refused(robot, values, stdin, said) -> None:
    assert refused("predict", *values, cwd=robot.parent, stdin=stdin) == said


def test_a_letter_among_the_joint_angles_is_named(robot) -> None:
    done = run_here("predict", "0.1", "o.2", cwd=robot.parent)
    assert (done.returncode, 'unable to convert "o.2" into float' in done.stderr) == (2, True)


# --- ports and disks


@pytest.mark.parametrize("process", ["sampler", "learner"])
def test_port_in_use_error_names_endpoint_and_fix(robot, process) -> None:
    endpoint = getattr(Config.load(robot, {}).tables.zenoh, process)
    before = sorted(robot.parent.rglob("*"))
    with ZenohSession(listen=endpoint):
        said = refused("run", process, cwd=robot.parent)
    assert said == (
        f"the port of {endpoint} is in use. Stop the other bodyschema, "
        "or give another endpoint in the table [zenoh] of robot.toml"
    )
    assert sorted(robot.parent.rglob("*")) == before


@pytest.mark.parametrize(
    ("state_dir", "said"),
    [
        pytest.param(
            "locked",
            "cannot write {}: Permission denied. Give a --state-dir that can be written",
            marks=pytest.mark.soak,
        ),
        ("locked/new", "cannot make the directory {}: Permission denied. Give another one with --state-dir"),
    ],
)
def test_sampler_exits_on_unwritable_state_dir(robot, state_dir, said) -> None:
    folder = robot.parent / state_dir
    (robot.parent / "locked").mkdir(mode=0o555)
    done = run("run", "sampler", "--state-dir", folder, cwd=robot.parent, by=("-c", WITHOUT_ROOTS_RIGHTS))
    assert done.returncode == 1
    assert said.format(folder if "new" in state_dir else folder / "pairs.sqlite") in done.stderr
    assert list((robot.parent / "locked").iterdir()) == []


# --- one process without the other


@contextlib.contextmanager
def process_running(config: Config, process: str, by: tuple[str, ...] = DAEMON) -> Iterator[None]:
    """Run a process and stop it when the context ends."""
    up = threading.Event()
    with tempfile.TemporaryFile() as log, ZenohSession(connect=getattr(config.tables.zenoh, process)) as bus:
        words = (*by, "run", process, "--robot", config.file)
        child = (
            warm.Child(*words, stderr=log) if by == DAEMON else subprocess.Popen([sys.executable, *words], stderr=log)
        )
        try:
            bus.watch(KEYS.alive(process), lambda _alive: up.set())
            assert up.wait(LIMIT_S), (log.seek(0), log.read())
            yield
        finally:
            child.terminate()
            child.wait(LIMIT_S)


def test_silent_listener_is_not_reported_as_absent(free_endpoint) -> None:
    endpoint = free_endpoint()
    with (
        socket.create_server(("127.0.0.1", int(endpoint.rpartition(":")[2]))),
        pytest.raises(BusError, match=r"listens on .* but does not answer"),
        client(endpoint, open_timeout_s=0.5),
    ):
        pass


@pytest.fixture(scope="module")
def lonely_learner(tmp_path_factory, free_endpoint) -> Iterator[Config]:
    """Yield a learner without a sampler, with an unknown camera pose and a read-only state folder."""
    folder: Path = tmp_path_factory.mktemp("lonely")
    (folder / "arm.urdf").write_text(URDF)
    (folder / "state").mkdir(mode=0o555)
    zenoh = f'[zenoh]\nsampler = "{free_endpoint()}"\nlearner = "{free_endpoint()}"\n'
    (folder / "robot.toml").write_text(f'{ROBOT}pose_known = false\n{zenoh}[daemon]\nstate_dir = "state"\n')
    config = Config.load(folder / "robot.toml", {})
    with process_running(config, "learner", ("-c", WITHOUT_ROOTS_RIGHTS)):
        yield config


def learner_status(config: Config) -> LearnerStatus:
    with client(config.tables.zenoh.learner) as bus:
        return decode(bus.ask_one(KEYS.status("learner")), LearnerStatus)


def test_prediction_without_pairs_fails_for_unknown_camera_pose(lonely_learner) -> None:
    said = refused("predict", "--", "0.1", "-0.2", cwd=lonely_learner.file.parent)
    assert said == (
        "there is no model yet: robot.toml says [camera] pose_known = false, so positions have no frame until about "
        "10 samples have come (0 so far). Start the sampler with `bodyschema run sampler` and guide the arm"
    )


@pytest.mark.parametrize(
    ("key", "payload"),
    [
        (KEYS.predict, b'{"q": [0.1, 0.2]}'),
        (KEYS.jacobian, b'{"q": [0.1, 0.2]}'),
        (KEYS.ik, b'{"x": [0.1, 0.2, 0.3]}'),
        (KEYS.model, b""),
    ],
)
def test_model_query_before_first_pair_gets_error_reply(lonely_learner, key, payload) -> None:
    with client(lonely_learner.tables.zenoh.learner) as bus, pytest.raises(RequestError, match="no frame"):
        bus.ask_one(key, payload)


def test_refused_requests_change_nothing_of_the_learner(lonely_learner) -> None:
    def unchanged() -> tuple[object, ...]:
        status = learner_status(lonely_learner)
        return status.pairs, status.last_seq, status.replayed, status.changes, status.model, status.refused

    before = unchanged()
    with client(lonely_learner.tables.zenoh.learner) as bus:
        for payload in (b"", b"{", b'{"q": []}', b'{"q": [1]}', b'{"q": ["a", 1]}', b'{"command": "dance"}', b"\xff"):
            for key in (KEYS.predict, KEYS.jacobian, KEYS.ik, KEYS.command("learner")):
                with pytest.raises(RequestError):
                    bus.ask_one(key, payload)
    assert unchanged() == before


def test_learner_without_sampler_names_endpoint_and_start_command(lonely_learner) -> None:
    status = learner_status(lonely_learner)
    assert (status.state, status.sampler_alive) == ("waiting", False)
    assert status.health[0] == (
        f"no sampler on {lonely_learner.tables.zenoh.sampler}, so no new samples; start it with `bodyschema run "
        "sampler`. Predictions go on"
    )


def test_status_of_lone_learner_names_sampler_command(lonely_learner) -> None:
    done = run_here("status", cwd=lonely_learner.file.parent)
    text = " ".join(done.stdout.split())
    assert done.returncode == 0
    assert f"sampler does not answer on {lonely_learner.tables.zenoh.sampler}. Start it with `bodyschema run s" in text


def test_learner_refuses_a_sampler_command(lonely_learner) -> None:
    said = refused("command", "zero_force_on", "--to", "learner", cwd=lonely_learner.file.parent)
    assert said == "zero_force_on is a command of the sampler: drop --to"


def test_sampler_refuses_a_learner_command(lonely_learner) -> None:
    said = refused("command", "tool_changed", "--to", "sampler", cwd=lonely_learner.file.parent)
    assert said == "tool_changed is a command of the learner: drop --to"


def test_ik_rejects_a_non_finite_target(lonely_learner) -> None:
    said = refused("ik", "nan", "0", "1", cwd=lonely_learner.file.parent)
    assert said == "nan, 0, 1 is no position: give three finite numbers in metres"


def test_recording_without_a_sampler_is_refused(lonely_learner) -> None:
    said = refused("record", "a.csv", cwd=lonely_learner.file.parent)
    assert said.startswith(f"nothing listens on {lonely_learner.tables.zenoh.sampler}. Start")


def test_unwritable_checkpoint_is_reported_and_learner_keeps_running(lonely_learner) -> None:
    said = refused("command", "checkpoint", cwd=lonely_learner.file.parent)
    assert said == (
        f"the checkpoint {lonely_learner.checkpoint_file} could not be written: Permission denied. "
        "Learning continues; give a --state-dir that can be written"
    )
    assert said in learner_status(lonely_learner).health


def test_sampler_runs_without_learner_and_predict_names_remedy(robot) -> None:
    config, published = Config.load(robot, {}), Queue()
    with process_running(config, "sampler"), client(config.tables.zenoh.sampler) as bus:
        bus.subscribe(KEYS.status("sampler"), published.put)
        while json.loads(published.get(timeout=LIMIT_S))["state"] != "ended":
            continue
        done = run_here("predict", "0.1", "0.2", cwd=robot.parent)
        pairs = json.loads(bus.ask_one(KEYS.status("sampler")))["pairs"]
    assert done.returncode == 1
    assert f"nothing listens on {config.tables.zenoh.learner}. Start the daemon with `bodyschema run`" in done.stderr
    assert pairs == 8
