"""Latency of `predict` over loopback TCP at d = 7, while the learner learns, replays and solves.

Three processes as in real use: the learner, a client that asks 250 times a second, and this one, which replaces the
sampler: it has 3,000 pairs in its history and publishes 30 more a second. Run: python benchmarks/predict_latency.py
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from bodyschema.daemon.config import Config
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import Request, ZenohSession, client
from bodyschema.daemon.transport.status import LearnerStatus
from bodyschema.daemon.transport.wire import JointsRequest, PairMessage, PairsReply, decode, encode
from bodyschema.interfaces.errors import BusError
from bodyschema.interfaces.interpreter import module_command
from bodyschema.interfaces.records import FloatArray
from bodyschema.sim_backend import model_file

STORED_PAIRS = 3000
PAIRS_PER_S = 30.0
STEP_DEG = 2.0
TOOL_SHIFT_M = (0.03, -0.02, 0.05)
NOISE_M = 0.002
QUERY_EVERY_S = 0.004
PHASE_S = 20.0
PAGE = 500
STORE = "00000000-0000-4000-8000-000000000000"


class StandInSampler:
    """Pairs of a robot with a tool that the nominal model does not know, stored and published."""

    def __init__(self, config: Config, count: int) -> None:
        rng = np.random.default_rng(1)
        robot = config.robot
        q = walk(rng, count, np.maximum(robot.lower, -1.2), np.minimum(robot.upper, 1.2))
        x = robot.chain.with_tool(TOOL_SHIFT_M).positions(q) + NOISE_M * rng.normal(size=(count, 3))
        cov = (NOISE_M**2, 0.0, 0.0, NOISE_M**2, 0.0, NOISE_M**2)
        self._pairs = [
            PairMessage(STORE, seq, 1, seq / PAIRS_PER_S, "", row_q.tolist(), tuple(row_x.tolist()), cov)
            for seq, (row_q, row_x) in enumerate(zip(q, x, strict=True), 1)
        ]
        self.stored = 0

    def history(self, request: Request) -> bytes:
        """Answer `pairs` like the sampler."""
        begin = int(request.parameters["from"])
        page = self._pairs[begin - 1 : min(self.stored, begin - 1 + PAGE)]
        return encode(PairsReply(STORE, self.stored, page), request.encoding)

    def next(self) -> bytes:
        """Store one more pair and return it as published."""
        self.stored += 1
        return encode(self._pairs[self.stored - 1])


def walk(rng: np.random.Generator, count: int, low: FloatArray, high: FloatArray) -> FloatArray:
    """Return joint angles (count, d) [rad]: straight segments between random waypoints in steps of 2 degrees."""
    step, q = np.radians(STEP_DEG), [(low + high) / 2]
    goal = rng.uniform(low, high)
    while len(q) < count:
        if np.linalg.norm(goal - q[-1]) < step:
            goal = rng.uniform(low, high)
        way = goal - q[-1]
        q.append(q[-1] + step * way / np.linalg.norm(way))
    return np.array(q)


def ask(robot_file: Path) -> None:
    """Query the learner until the phase ends, then print the latencies [s] as JSON (runs in its own process)."""
    config = Config.load(robot_file)
    rng = np.random.default_rng(2)
    low, high = np.maximum(config.robot.lower, -1.2), np.minimum(config.robot.upper, 1.2)
    requests = [encode(JointsRequest(row.tolist())) for row in rng.uniform(low, high, (100, len(low)))]
    key, latencies = Keys(config.robot.name).predict, []
    with client(config.tables.zenoh.learner) as bus:
        end = time.monotonic() + PHASE_S
        while time.monotonic() < end:
            begin = time.perf_counter()
            bus.ask_one(key, requests[len(latencies) % len(requests)])
            latencies.append(time.perf_counter() - begin)
            time.sleep(QUERY_EVERY_S)
    print(json.dumps(latencies))


def asked(robot_file: Path) -> FloatArray:
    """Return the latencies [ms] measured by another process."""
    command = [sys.executable, __file__, "--ask", str(robot_file)]
    done = subprocess.run(command, check=True, capture_output=True, timeout=PHASE_S + 60.0)
    return 1e3 * np.array(json.loads(done.stdout))


@contextmanager
def running_learner(robot_file: Path, endpoint: str) -> Iterator[None]:
    """Run `bodyschema run learner` in the `with` statement, which is entered after its first answer."""
    command = module_command("bodyschema", "run", "learner", "--robot", str(robot_file))
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL)
    try:
        while process.poll() is None:
            try:
                with client(endpoint):
                    break
            except BusError:
                time.sleep(0.1)
        yield
    finally:
        process.terminate()
        process.wait(20.0)


def learner_status(config: Config) -> LearnerStatus:
    """Return the learner's status."""
    with client(config.tables.zenoh.learner) as bus:
        return decode(bus.ask_one(Keys(config.robot.name).status("learner")), LearnerStatus)


def write_robot(folder: Path) -> Path:
    """Write the shipped model with its own ports and state directory; return its robot.toml."""
    model = model_file("upper_body")
    for file in model.parent.glob("*.urdf"):
        (folder / file.name).write_bytes(file.read_bytes())
    ports = f'[zenoh]\nsampler = "tcp/127.0.0.1:{free_port()}"\nlearner = "tcp/127.0.0.1:{free_port()}"\n'
    robot_file = folder / "robot.toml"
    robot_file.write_text(f'{model.read_text()}\n{ports}[daemon]\nstate_dir = "state"\n')
    return robot_file


def free_port() -> int:
    """Return a free TCP port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def measure(robot_file: Path) -> tuple[FloatArray, FloatArray]:
    """Return latencies [ms] of an idle learner, and of one that learns."""
    config = Config.load(robot_file)
    keys, endpoints = Keys(config.robot.name), config.tables.zenoh
    sampler = StandInSampler(config, STORED_PAIRS + int(PAIRS_PER_S * (PHASE_S + 60.0)))
    with ZenohSession(listen=endpoints.sampler) as bus, running_learner(robot_file, endpoints.learner):
        bus.answer(keys.pairs, sampler.history)
        idle = asked(robot_file)
        sampler.stored = STORED_PAIRS
        bus.token(keys.alive("sampler"))
        while learner_status(config).pairs < STORED_PAIRS:
            time.sleep(0.1)
        time.sleep(5.0)
        stop = threading.Event()
        publisher = threading.Thread(target=feed, args=(bus, keys, sampler, stop))
        publisher.start()
        before = learner_status(config)
        busy = asked(robot_file)
        after = learner_status(config)
        stop.set()
        publisher.join()
    print(
        f"while asked: {after.pairs - before.pairs} pairs learnt, {after.replayed - before.replayed} replay steps, "
        f"answering: {after.answering}, prequential {1e3 * after.prequential_m[after.answering]:.1f} mm"
    )
    return idle, busy


def feed(bus: ZenohSession, keys: Keys, sampler: StandInSampler, stop: threading.Event) -> None:
    """Publish pairs at their rate until `stop` is set."""
    publish = bus.publisher(keys.pair)
    while not stop.wait(1.0 / PAIRS_PER_S):
        publish(sampler.next())


def main() -> None:
    """Measure and print."""
    with tempfile.TemporaryDirectory() as folder:
        idle, busy = measure(write_robot(Path(folder)))
    for name, latencies in (("idle", idle), ("learning", busy)):
        p50, p99, worst = np.percentile(latencies, (50, 99, 100))
        print(f"{name:9s} p50 {p50:.3f} ms, p99 {p99:.3f} ms, worst {worst:.2f} ms of {len(latencies)} answers")
    ratios = np.percentile(busy, (50, 99)) / np.percentile(idle, (50, 99))
    print(f"learning / idle: p50 {ratios[0]:.2f}, p99 {ratios[1]:.2f}; goals while learning: p50 < 1 ms, p99 < 5 ms")
    print(f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--ask"]:
        ask(Path(sys.argv[2]))
    else:
        main()
