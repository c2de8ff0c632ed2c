"""The page's side of zenoh: processes that come, go and come back."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from small_arm import write_small_arm
from told_statuses import LEARNER, SAMPLER

from bodyschema.daemon.config import Config
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import ZenohSession
from bodyschema.daemon.transport.wire import (
    CommandReply,
    CommandRequest,
    PairMessage,
    PairsReply,
    PredictReply,
    decode,
    encode,
)
from bodyschema.dashboard.hub import Hub
from bodyschema.dashboard.watch import ProcessFollower
from bodyschema.interfaces.errors import BusError, RequestError
from bodyschema.robot.urdf import inverse

LIMIT_S = 500.0
KEYS = Keys("arm")


def until(holds: Callable[[], Any]) -> Any:
    deadline = time.monotonic() + LIMIT_S
    while not (found := holds()):
        assert time.monotonic() < deadline, "it did not come in time"
        time.sleep(0.02)
    return found


@pytest.fixture
def config(tmp_path: Path, free_endpoint) -> Config:
    tables = f'[zenoh]\nsampler = "{free_endpoint()}"\nlearner = "{free_endpoint()}"\n'
    return Config.load(write_small_arm(tmp_path, tables), {})


@pytest.fixture
def hub() -> Hub:
    return Hub()


@pytest.fixture
def watch(config: Config, hub: Hub) -> Iterator[ProcessFollower]:
    with ProcessFollower(config, hub) as watch:
        yield watch


def document(hub: Hub, topic: str) -> Any:
    return json.loads(hub.all()).get(topic)


@contextmanager
def process(
    endpoint: str, name: str, status: object, answers: dict[str, Callable[..., bytes]], router: str = ""
) -> Iterator[None]:
    """Run one of the two processes as zenoh shows it; it publishes its state continuously."""
    with ZenohSession(listen=endpoint, connect=router or None, settings={"mode": "router"} if router else None) as bus:
        for key, answer in answers.items():
            bus.answer(key, answer)
        bus.token(KEYS.alive(name))
        publish, done = bus.publisher(KEYS.status(name)), threading.Event()

        def say() -> None:
            while not done.wait(0.1):
                publish(encode(status))

        thread = threading.Thread(target=say)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()


def predict(request) -> bytes:
    n = len(json.loads(request.payload)["q"])
    return encode(PredictReply([[0.5, 0.0, 0.0]] * n, [[0.0] * 3] * n, [True] * n, "6b6f", 9, None))


def command(request) -> bytes:
    name = decode(request.payload, CommandRequest).command
    if name == "tool_changed":
        return encode(CommandReply(name, "another tool"))
    raise RequestError("the learner has nothing to do with that")


def learner(config: Config, status: object = LEARNER):
    answers = {KEYS.predict: predict, KEYS.command("learner"): command}
    return process(config.tables.zenoh.learner, "learner", status, answers)


def sampler(config: Config, pairs: int):
    stored = [
        PairMessage("2f9a", seq, 1, 0.1 * seq, "", [0.01 * seq, 0.0], (0.5, 0.0, 0.003), (1e-6, 0, 0, 1e-6, 0, 1e-6))
        for seq in range(1, pairs + 1)
    ]

    def answer(request) -> bytes:
        first = int(request.parameters["from"])
        return encode(PairsReply("2f9a", pairs, stored[first - 1 : first + 99]))

    status = msgspec.structs.replace(SAMPLER, pairs=pairs)
    return process(config.tables.zenoh.sampler, "sampler", status, {KEYS.pairs: answer})


def test_learner_disappearance_and_return_are_noticed(config, hub, watch) -> None:
    def answers() -> bool:
        found = document(hub, "learner")
        return found is not None and found["answers"]

    with learner(config):
        until(answers)
    until(lambda: not answers())
    assert document(hub, "learner")["status"]["pairs"] == LEARNER.pairs  # the last known state is still shown
    with learner(config):
        until(answers)


@pytest.mark.parametrize("here", [True, False])
def test_learner_behind_router_is_seen(tmp_path, hub, free_endpoint, here) -> None:
    meeting, own = free_endpoint(), free_endpoint()
    tables = f'[zenoh]\nsampler = "{free_endpoint()}"\nlearner = "{own}"\nrouter = "{meeting}"\n'
    config = Config.load(write_small_arm(tmp_path, tables), {})
    with (
        ZenohSession(listen=meeting, settings={"mode": "router"}),
        process(own if here else free_endpoint(), "learner", LEARNER, {}, meeting),
        ProcessFollower(config, hub),
    ):
        until(lambda: (found := document(hub, "learner")) and found["answers"])


def test_residuals_combine_sampler_pairs_and_learner_answers(config, hub, watch) -> None:
    told = msgspec.structs.replace(LEARNER, pairs=250, last_seq=250, pairs_since_change=250)
    with sampler(config, 250), learner(config, told):
        cloud = until(lambda: (found := document(hub, "cloud")) and len(found["x"]) == 250 and found)
        assert cloud["residual"][0] == [0.0, 0.0, 0.003]
        assert [segment["pairs"] for segment in document(hub, "segments")] == [250]
        assert until(lambda: any(document(hub, "series")["predict_s"]))


def test_unknown_state_fields_are_passed_on(config, hub, watch) -> None:
    newer = msgspec.to_builtins(LEARNER) | {"mood": "fine"}
    with learner(config, newer):
        until(lambda: (found := document(hub, "learner")) and found["status"] and found["status"]["mood"] == "fine")


def test_unreadable_state_is_reported_and_survived(config, hub, watch) -> None:
    with learner(config, {"robot": 3}):
        said = until(lambda: (found := document(hub, "learner")) and found["problem"])
    assert "another version" in said
    with learner(config):
        until(lambda: document(hub, "learner")["status"] is not None)


def test_where_to_move_next_is_told_in_words(config, hub, watch) -> None:
    with learner(config):
        outlook = until(lambda: document(hub, "outlook"))
    assert "moving shoulder over its range gains most" in outlook["sentence"]


def test_errors_have_the_noise_in_them(config, hub, watch) -> None:
    with learner(config):
        outlook = until(lambda: document(hub, "outlook"))
        expected = until(lambda: [each for each in document(hub, "series")["expected_m"] if each])
    # Mean distance of a measurement from the truth, by simulation.
    noise_m = np.linalg.norm(np.random.default_rng(0).normal(0.0, 0.00126, (100_000, 3)), axis=1).mean()
    assert expected[0] == pytest.approx(np.hypot(0.0066, noise_m), rel=1e-2)
    assert outlook["now_m"] == pytest.approx(np.hypot(0.0006, noise_m), rel=1e-2)


def test_the_arm_stands_at_the_newest_pair(config, hub, watch) -> None:
    told = msgspec.structs.replace(LEARNER, calibration=None)
    with sampler(config, 20), learner(config, told):
        arm = until(lambda: (found := document(hub, "arm")) and found["predicted"] and found)
    robot = config.robot
    T = inverse(robot.camera.pose)
    places = (arm["links"][arm["hand"]][:3], arm["measured"], arm["predicted"])
    seen = [T[:3, :3] @ np.array(point) + T[:3, 3] for point in places]
    assert (arm["pair"], len(arm["trail"]), arm["radii"]) == (20, 19, None)
    np.testing.assert_allclose(seen[0], robot.chain.positions(np.array([[0.2, 0.0]]))[0], atol=1e-4)
    np.testing.assert_allclose(seen[1:], [[0.5, 0.0, 0.003], [0.5, 0.0, 0.0]], atol=1e-4)
    assert arm["apart_m"] == pytest.approx(0.003)


def test_many_browsers_cause_one_picture_request(config, hub, watch) -> None:
    asked: list[int] = []

    def picture(_) -> bytes:
        asked.append(1)
        return b"jpeg"

    with process(config.tables.zenoh.sampler, "sampler", SAMPLER, {KEYS.picture: picture}):
        assert until(lambda: _pictured(watch)) == b"jpeg"
        assert {watch.picture() for _ in range(5)} == {b"jpeg"}
    assert len(asked) <= 2


def _pictured(watch: ProcessFollower) -> bytes | None:
    try:
        return watch.picture()
    except BusError:
        return None


def test_a_command_gets_the_process_own_words(config, watch) -> None:
    with learner(config):
        until(lambda: _answered(watch))
        with pytest.raises(RequestError, match="nothing to do with that"):
            watch.command("learner", "pause")


def _answered(watch: ProcessFollower) -> bool:
    try:
        return watch.command("learner", "tool_changed") == "another tool"
    except BusError:
        return False


def test_without_a_sampler_nobody_has_the_pairs(watch) -> None:
    with pytest.raises(BusError, match="bodyschema run sampler"):
        watch.history(10)
