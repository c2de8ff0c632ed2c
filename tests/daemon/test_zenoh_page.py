"""docs/zenoh.md and the clients in examples/ agree with the code and with a running sampler and learner."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import warm
from scripted_sources import Walk
from small_arm import write_small_arm

from bodyschema.cli.main import app
from bodyschema.daemon.config import Config
from bodyschema.daemon.sampler import history
from bodyschema.daemon.sampler.devices import session_of
from bodyschema.daemon.sampler.sampler import Sampler
from bodyschema.daemon.sampler.sources import Sources
from bodyschema.daemon.transport import wire
from bodyschema.daemon.transport.keys import CommandName, Keys
from bodyschema.daemon.transport.session import ZenohSession, client
from bodyschema.daemon.transport.wire import MSGPACK, IkReply, IkRequest, JointsRequest, PredictReply, decode, encode
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import RequestError
from bodyschema.interfaces.records import PairLimits, Reason
from bodyschema.learning.state import MAX_CURVE_POINTS
from bodyschema.recordings.store.store import PairStore
from bodyschema.robot.hand_eye import MarkerPose

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "zenoh.md").read_text(encoding="utf-8")
LIMIT_S = 500.0
KEYS = Keys("arm")


def section(heading: str) -> str:
    return re.search(rf"^##+ {heading}\n(.*?)(?=^##+ |\Z)", PAGE, re.MULTILINE | re.DOTALL)[1]


def rows(text: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("| `")]


def code(cell: str) -> str:
    return cell.strip("`").strip()


EXAMPLES = dict(zip(("PairMessage", "PredictReply"), re.findall(r"```json\n(.*?)```", PAGE, re.DOTALL), strict=True))


@pytest.mark.parametrize("name", EXAMPLES)
def test_page_examples_are_complete_valid_messages(name: str) -> None:
    assert json.loads(encode(decode(EXAMPLES[name].encode(), getattr(wire, name)))) == json.loads(EXAMPLES[name])


def test_the_page_s_commands_are_the_code_s() -> None:
    table = section("Commands")
    assert {name for row in rows(table) for name in re.findall(r"`(\w+)`", row[0])} == set(get_args(CommandName))


def test_the_page_has_every_key() -> None:
    whole = [KEYS.pair, KEYS.pairs, KEYS.predict, KEYS.jacobian, KEYS.ik, KEYS.model, KEYS.picture, KEYS.simulation]
    whole += [key(process) for key in (KEYS.status, KEYS.command, KEYS.alive) for process in ("sampler", "learner")]
    assert {code(row[0]) for row in rows(section("Keys"))} == {key.removeprefix("bodyschema/arm/") for key in whole}


def test_the_page_has_every_reason() -> None:
    assert [code(row[0]) for row in rows(section("Why a frame is rejected"))] == [reason.value for reason in Reason]


def test_the_page_s_limits_are_the_code_s() -> None:
    limits = section("Limits")
    assert f"| rows in a request | {wire.LARGEST_BATCH:,} |" in limits
    assert f"| samples in a reply | {history.LARGEST_REPLY} |" in limits
    assert f"| points of the learning curve | {MAX_CURVE_POINTS} |" in limits
    assert f"| within {PairLimits.farthest_m:.0f} m, else" in limits


# --- against a running learner


@pytest.fixture(scope="module")
def learner(tmp_path_factory, free_endpoint) -> Iterator[Config]:
    """Yield robot.toml of a learner that answers, without a sampler."""
    folder = tmp_path_factory.mktemp("robot")
    zenoh = f'[zenoh]\nsampler = "{free_endpoint()}"\nlearner = "{free_endpoint()}"\n'
    robot = write_small_arm(folder, zenoh + '[daemon]\nstate_dir = "state"\n')
    config, up = Config.load(robot, {}), threading.Event()
    with (folder / "log").open("wb") as log, ZenohSession(connect=config.tables.zenoh.learner) as bus:
        process = warm.Child("-m", "bodyschema", "run", "learner", "--robot", robot, stderr=log)
        try:
            bus.watch(KEYS.alive("learner"), lambda _: up.set())
            assert up.wait(LIMIT_S), (folder / "log").read_text()
            yield config
        finally:
            process.terminate()
            process.wait(LIMIT_S)


def run_example(name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the example as a separate program that cannot import the project."""
    command = [sys.executable, "-I", str(ROOT / "examples" / name), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False, cwd=os.sep)


def test_example_prints_the_learner_s_prediction(learner: Config) -> None:
    done = run_example("ask_predictions.py", "arm", learner.tables.zenoh.learner, "0.0", "0.0")
    assert (done.returncode, done.stderr) == (0, "")
    assert re.match(r"x = \[0\.3, .*\] m, 1-sigma \[.*\] m, away from all data\nmodel \w+ of 0 samples", done.stdout)


def test_example_exits_with_the_learner_s_error(learner: Config) -> None:
    done = run_example("ask_predictions.py", "arm", learner.tables.zenoh.learner, "0.0")
    assert (done.returncode, "this robot has 2 joints: waist, shoulder" in done.stderr) == (1, True)


def test_the_command_predict_prints_the_same(learner: Config) -> None:
    done = warm.run("-m", "bodyschema", "predict", "--robot", learner.file, "--", "0.0", "0.0")
    assert done.stdout.splitlines()[0].split("]")[:3] == ["x [mm", "  y [mm", "  z [mm"]
    assert done.stdout.splitlines()[1].split()[:3] == ["300.0", "0.0", "0.0"]


def predicted(learner: Config, capsys, *arguments: str) -> str:
    command = ["predict", "--robot", str(learner.file), *arguments]
    app(command, exit_on_error=False, result_action="return_value")
    return " ".join(capsys.readouterr().out.split())


def test_the_command_predict_speaks_of_one_vector(learner: Config) -> None:
    with pytest.raises(RequestError, match=r"^q is 1e\+308 at joint 'waist'"):
        app(["predict", "--robot", str(learner.file), "1e308", "0"], exit_on_error=False, result_action="return_value")


def test_predict_loads_no_numpy(learner: Config) -> None:
    last = "atexit.register(lambda: print('numpy' in sys.modules))"
    code = f"import atexit, sys; {last}; from bodyschema.cli.main import main; main()"
    command = [sys.executable, "-c", code, "predict", "--robot", str(learner.file), "0", "0"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    assert "300.0" in done.stdout
    assert done.stdout.splitlines()[-1] == "False"


def test_angle_beyond_limits_is_named_with_deg_hint(learner: Config, capsys) -> None:
    said = predicted(learner, capsys, "-60", "0")
    assert "waist cannot be at -60 rad: its limits are -3 to 3 rad (-171.9° to 171.9°). --deg takes degrees." in said
    assert "cannot be" not in predicted(learner, capsys, "--deg", "-60", "0")


def test_deg_hint_is_omitted_when_deg_was_given(learner: Config, capsys) -> None:
    said = predicted(learner, capsys, "--deg", "--", "0", "900")
    assert "shoulder cannot be at 15.71 rad: its limits are -2 to 2 rad (-114.6° to 114.6°). The answer" in said


def test_predictions_and_solutions_have_poses_in_json(learner: Config, capsys) -> None:
    [pose] = json.loads(predicted(learner, capsys, "--json", "--", "0", "0"))["poses"]
    app(
        ["ik", "0.3", "0", "0", "--json", "--robot", str(learner.file)],
        exit_on_error=False,
        result_action="return_value",
    )
    found = json.loads(capsys.readouterr().out)
    for told in (pose, found["pose"]):
        assert told["translation_m"] == pytest.approx([0.3, 0.0, 0.0], abs=1e-6)
        assert np.array(told["translation_covariance"]).reshape(3, 3).diagonal().min() > 0.0
        assert told["matrix"] is told["covariance"] is None  # this marker is a point
    assert found["schema"] == 1


def test_an_orientation_makes_a_matrix_and_covariance() -> None:
    x, turn = np.array([0.1, 0.2, 0.3]), np.array([0.0, 0.0, 1.0, 0.0])
    pose = MarkerPose.rows(x[None], np.array([[1e-3, 2e-3, 3e-3]]), turn[None], np.array([[0.01, 0.02, 0.03]]))[0]
    wanted = [[-1, 0, 0, 0.1], [0, -1, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]]
    assert np.array(pose.matrix) == pytest.approx(np.array(wanted))
    sigmas = np.sqrt(np.array(pose.covariance).reshape(6, 6).diagonal())
    assert sigmas == pytest.approx([1e-3, 2e-3, 3e-3, 0.01, 0.02, 0.03])


def test_raw_reply_poses_match_command_line_poses(learner: Config, capsys) -> None:
    with client(learner.tables.zenoh.learner) as bus:
        [raw] = json.loads(bus.ask_one(KEYS.predict, encode(JointsRequest([0.1, 0.2]))))["poses"]
        found = json.loads(bus.ask_one(KEYS.ik, encode(IkRequest((0.3, 0.0, 0.0)))))
        [there] = json.loads(bus.ask_one(KEYS.predict, encode(JointsRequest(found["q"]))))["poses"]
    assert [raw] == json.loads(predicted(learner, capsys, "--json", "--", "0.1", "0.2"))["poses"]
    assert found["pose"] == there


def ask_ik(learner: Config, request: IkRequest) -> IkReply:
    with client(learner.tables.zenoh.learner) as bus:
        return decode(bus.ask_one(KEYS.ik, encode(request)), IkReply)


def test_ik_solution_reaches_position_within_joint_limits(learner: Config) -> None:
    chain, target = learner.robot.chain, learner.robot.chain.positions([0.7, 0.0])
    reply = ask_ik(learner, IkRequest(tuple(target.tolist()), start=[0.5, 0.4], posture="middle"))
    assert (reply.converged, reply.reason) == (True, "reached")
    assert np.linalg.norm(chain.positions(reply.q) - target) < 1e-6
    assert ((learner.robot.lower <= reply.q) & (reply.q <= learner.robot.upper)).all()


def test_unreachable_position_is_answered_with_nearest_distance(learner: Config) -> None:
    reply = ask_ik(learner, IkRequest((0.0, 1.3, 0.0)))
    assert (reply.converged, reply.reason, round(reply.distance, 6)) == (False, "out_of_reach", 1.0)


def test_ik_command_exits_1_for_unreached_position(learner: Config) -> None:
    command = ("-m", "bodyschema", "ik", "--deg", "--robot", learner.file, "--")
    inside, outside = (warm.run(*command, x, "0", "0") for x in ("0.3", "0.8"))
    assert (inside.returncode, inside.stdout.splitlines()[2]) == (0, "reached")
    assert inside.stdout.splitlines()[0].split() == ["waist", "0.00", "deg"]
    assert outside.returncode == 1
    assert outside.stdout.splitlines()[2] == "out of reach: the nearest position found is 500.0 mm away"


def test_an_infinite_target_in_messagepack_is_refused(learner: Config) -> None:
    for request in (IkRequest((0.0, float("inf"), 0.0)), IkRequest((0.0, 0.0, 0.3), posture=[0.0, float("nan")])):
        with client(learner.tables.zenoh.learner) as bus, pytest.raises(RequestError, match="not finite"):
            bus.ask_one(KEYS.ik, encode(request, MSGPACK), encoding=MSGPACK)


@pytest.mark.parametrize(("key", "request_", "error"), [row for row in rows(section("Errors")) if len(row) == 3])
def test_the_page_s_error_replies_are_the_learner_s(learner: Config, key: str, request_: str, error: str) -> None:
    with client(learner.tables.zenoh.learner) as bus, pytest.raises(RequestError) as refused:
        bus.ask_one(f"bodyschema/arm/{code(key)}", code(request_).encode())
    assert str(refused.value) == code(error)


def test_page_quotes_error_for_nan_in_messagepack(learner: Config) -> None:
    request = encode(JointsRequest([0.1, float("nan")]), MSGPACK)
    with client(learner.tables.zenoh.learner) as bus, pytest.raises(RequestError) as refused:
        bus.ask_one(KEYS.predict, request, encoding=MSGPACK)
    assert f"`{refused.value}`" in PAGE


def test_a_request_in_messagepack_is_answered_in_messagepack(learner: Config) -> None:
    request = encode(JointsRequest([0.0, 0.0]), MSGPACK)
    with client(learner.tables.zenoh.learner) as bus:
        reply = decode(bus.ask_one(KEYS.predict, request, encoding=MSGPACK), PredictReply, MSGPACK)
    assert reply.x[0] == pytest.approx([0.3, 0.0, 0.0])


# --- against a running sampler


@contextmanager
def sampler_running(config: Config, sources: Sources) -> Iterator[None]:
    endpoint, up = config.tables.zenoh.sampler, threading.Event()
    with (
        PairStore(config.store_file, session_of(config, SystemClock())) as store,
        ZenohSession(listen=endpoint) as bus,
        ZenohSession(connect=endpoint, client=True) as watching,
    ):
        sampler = Sampler(config, sources, bus, store)
        thread = threading.Thread(target=sampler.run)
        thread.start()
        try:
            watching.watch(KEYS.alive("sampler"), lambda _: up.set())
            assert up.wait(LIMIT_S)
            yield
        finally:
            sampler.stop()
            thread.join(LIMIT_S)


def test_example_follows_stored_and_new_pairs_in_order(tmp_path, endpoint) -> None:
    tables = f'[zenoh]\nsampler = "{endpoint}"\n[daemon]\nstate_dir = "state"\n'
    config = Config.load(write_small_arm(tmp_path, tables), {})
    walk, resume_from_checkpoint = Walk(config.robot, 40), threading.Event()
    sources = walk.sources(fixes=[*walk.fixes[:20], resume_from_checkpoint, *walk.fixes[20:]])
    command = [sys.executable, "-I", str(ROOT / "examples" / "follow_pairs.py"), "arm", endpoint, "3", "40"]
    with (
        sampler_running(config, sources),
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=os.sep) as follower,
    ):
        try:
            lines = [follower.stdout.readline() for _ in range(10)]  # it has started with the stored pairs
            resume_from_checkpoint.set()
            lines += follower.stdout.readlines()
        finally:
            follower.kill()
    assert [int(line.split(" ")[0]) for line in lines] == list(range(3, 41))


def test_example_exits_with_message_without_sampler(endpoint) -> None:
    done = run_example("follow_pairs.py", "arm", endpoint)
    assert done.returncode == 1
    assert done.stderr.startswith("follow_pairs: ")
