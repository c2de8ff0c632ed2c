"""One learner host for many robots: the cost of each robot, and the lag of the instant models.

python benchmarks/fleet.py [--robots 1,10,25,50] [--rate 20] [--warm 20] [--seconds 20] [--processes 2]

Robots of six joints. Their pairs come over real zenoh from a process that publishes them and answers from their
history as samplers do. For each number of robots, after `--warm` seconds of pairs:

    pairs/s    pairs received from all robots
    cpu        CPU time of the host's processes per pair [ms]: of the threads that receive, learn and evaluate pairs;
               of the background (replay, findings, requests to the solver); of all others (zenoh, answers, statuses,
               checkpoints); of the solvers
    cores      the sum of these, in cores
    behind     pairs that are published but not yet learnt by the instant model when a robot is asked for a prediction:
               median, 99 % and maximum
    MB         memory of the host's processes per robot
    load       of the machine, other programs included
"""

from __future__ import annotations

import argparse
import itertools
import os
import socket
import subprocess
import tempfile
import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.tables import Column, Table, tables_option
from bodyschema.daemon.config import Config
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import Request, ZenohSession, client
from bodyschema.daemon.transport.wire import JointsRequest, PairMessage, PairsReply, PredictReply, decode, encode
from bodyschema.interfaces.errors import BodyschemaError
from bodyschema.interfaces.interpreter import module_command

JOINTS = 6
SIGMA_M = 2e-3
STEP_RAD = 0.015
LIMIT_S = 240.0
ASK_EVERY_S = 0.1
TICKS = os.sysconf("SC_CLK_TCK")
# Parts whose processor time is listed separately: threads by name, and the solver processes.
PARTS: tuple[str, ...] = ("learn_pairs", "background", "others", "solver")


def write_robot(folder: Path, name: str, sampler: str, learner: str) -> Path:
    """Write the description of an arm of six revolute joints; return the path of its robot.toml."""
    links = "".join(f'<link name="l{k}"/>' for k in range(JOINTS + 1))
    joints = "".join(
        f'<joint name="j{k}" type="revolute"><parent link="l{k}"/><child link="l{k + 1}"/>'
        f'<origin xyz="0.1 0.02 0.05"/><axis xyz="{k % 2} 0 {1 - k % 2}"/>'
        '<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>'
        for k in range(JOINTS)
    )
    folder.mkdir()
    (folder / "arm.urdf").write_text(f'<robot name="arm">{links}{joints}</robot>')
    file = folder / "robot.toml"
    file.write_text(
        f'[robot]\nname = "{name}"\nurdf = "arm.urdf"\njoints = {[f"j{k}" for k in range(JOINTS)]}\n'
        f'marker_link = "l{JOINTS}"\n[camera]\nparent_link = "l0"\n'
        f'[zenoh]\nsampler = "{sampler}"\nlearner = "{learner}"\n[daemon]\nstate_dir = "state"\n'
    )
    return file


def free_endpoint() -> str:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"tcp/127.0.0.1:{server.getsockname()[1]}"


class Walk:
    """Pairs of one robot: a walk of an arm with joint offsets, with history."""

    def __init__(self, config: Config, seed: int) -> None:
        self._config, self._rng = config, np.random.default_rng(seed)
        self._zeros = self._rng.normal(0.0, 0.03, JOINTS)
        self._q = np.zeros(JOINTS)
        self._store = f"store-{seed}"
        self.pairs: list[PairMessage] = []

    def step(self) -> bytes:
        self._q = np.clip(self._q + self._rng.normal(0.0, STEP_RAD, JOINTS), -2.5, 2.5)
        x = self._config.robot.chain.positions((self._q + self._zeros)[None])[0] + self._rng.normal(0.0, SIGMA_M, 3)
        variance = SIGMA_M**2
        pair = PairMessage(
            store=self._store,
            seq=len(self.pairs) + 1,
            segment=1,
            t=time.monotonic(),
            utc="2026-01-01T00:00:00Z",
            q=self._q.tolist(),
            x=(float(x[0]), float(x[1]), float(x[2])),
            cov=(variance, 0.0, 0.0, variance, 0.0, variance),
        )
        self.pairs.append(pair)
        return encode(pair)

    def history(self, request: Request) -> bytes:
        begin = int(request.parameters.get("from", "1"))
        page = self.pairs[begin - 1 : begin + 499]
        return encode(PairsReply(self._store, len(self.pairs), page), request.encoding)


@dataclass(frozen=True)
class Usage:
    """CPU time [s] by `PARTS` and memory [bytes] of a process and its children."""

    seconds: dict[str, float]
    memory: int

    @classmethod
    def of(cls, pid: int) -> Usage:
        seconds, memory = dict.fromkeys(PARTS, 0.0), 0
        for one in _family(pid):
            try:
                solves = b"solver_process" in Path(f"/proc/{one}/cmdline").read_bytes()
                shared = Path(f"/proc/{one}/statm").read_text().split()
                threads = [file.read_text() for file in Path(f"/proc/{one}/task").glob("*/stat")]
            except OSError:
                continue
            for thread in threads:
                name, _, fields = thread.partition("(")[2].rpartition(")")
                used = [int(ticks) for ticks in fields.split()[11:13]]
                seconds["solver" if solves else name if name in PARTS else "others"] += sum(used) / TICKS
            memory += (int(shared[1]) - int(shared[2])) * os.sysconf("SC_PAGE_SIZE")
        return cls(seconds, memory)


def _family(pid: int) -> list[int]:
    children = [child for file in Path(f"/proc/{pid}/task").glob("*/children") for child in file.read_text().split()]
    return [pid, *(one for child in children for one in _family(int(child)))]


class Asker(threading.Thread):
    """Client that asks the robots in turn for a prediction, and records how many pairs each instant model is behind."""

    def __init__(self, ends: list[str], walks: list[Walk]) -> None:
        super().__init__()
        self._ends, self._walks = ends, walks
        self._over = threading.Event()
        self.behind: list[int] = []

    def run(self) -> None:
        payload = encode(JointsRequest([0.0] * JOINTS))
        with ExitStack() as stack:
            buses = [stack.enter_context(client(end)) for end in self._ends]
            for turn in itertools.count():
                if self._over.wait(ASK_EVERY_S):
                    return
                robot = turn % len(self._walks)
                published = len(self._walks[robot].pairs)
                reply = buses[robot % len(buses)].ask_one(Keys(f"arm_{robot}").predict, payload, timeout_s=30.0)
                self.behind.append(max(published - decode(reply, PredictReply).pairs, 0))

    def end(self) -> None:
        self._over.set()
        self.join()


@dataclass(frozen=True)
class Course:
    """Rate of pairs of each robot, and durations before and during the measurement."""

    rate: float
    warm_s: float
    seconds: float


def measure(robots: int, course: Course, processes: int) -> list[object]:
    """Return the cells of one row of the table."""
    with tempfile.TemporaryDirectory() as folder:
        sampler, ends = free_endpoint(), [free_endpoint() for _ in range(processes)]
        files = [
            write_robot(Path(folder) / f"arm_{k}", f"arm_{k}", sampler, ends[k % processes]) for k in range(robots)
        ]
        walks = [Walk(Config.load(file), k) for k, file in enumerate(files)]
        command = module_command("bodyschema", "run", "learner", "--robot", str(folder), "--processes", str(processes))
        with ZenohSession(listen=sampler) as bus:
            publish = [bus.publisher(Keys(f"arm_{k}").pair, cache=256) for k in range(robots)]
            for k, walk in enumerate(walks):
                bus.answer(Keys(f"arm_{k}").pairs, walk.history)
                bus.token(Keys(f"arm_{k}").alive("sampler"))
            host = subprocess.Popen(command, stderr=subprocess.DEVNULL)
            try:
                _await_answers(ends, [f"arm_{k}" for k in range(robots)])
                return _row(host.pid, ends, walks, publish, course)
            finally:
                host.terminate()
                host.wait(60)


def _row(pid: int, ends: list[str], walks: list[Walk], publish: list, course: Course) -> list[object]:
    _publish(walks, publish, course.rate, course.warm_s)
    asker = Asker(ends, walks)
    asker.start()
    before, begin = Usage.of(pid), time.monotonic()
    published = _publish(walks, publish, course.rate, course.seconds)
    spent, after, load = time.monotonic() - begin, Usage.of(pid), os.getloadavg()[0]
    asker.end()
    used = {part: after.seconds[part] - before.seconds[part] for part in PARTS}
    median, late, worst = np.quantile(asker.behind, [0.5, 0.99, 1.0])
    per_pair = [1e3 * seconds / published for seconds in used.values()]
    cores, behind = sum(used.values()) / spent, [median, late, worst]
    return [len(walks), published / spent, *per_pair, cores, behind, after.memory / len(walks) / 1e6, load]


def _publish(walks: list[Walk], publish: list, rate: float, seconds: float) -> int:
    """Publish pairs of all robots in turns at their rate; return their number."""
    begin, published = time.monotonic(), 0
    while (now := time.monotonic() - begin) < seconds:
        while published < now * rate * len(walks):
            walk = published % len(walks)
            publish[walk](walks[walk].step())
            published += 1
        time.sleep(0.002)
    return published


def _await_answers(ends: list[str], names: list[str]) -> None:
    """Wait until every robot's learner answers; they start one after the other."""
    deadline = time.monotonic() + LIMIT_S
    for place, end in enumerate(ends):
        waiting = names[place :: len(ends)]
        while waiting:
            try:
                with client(end) as bus:
                    while waiting:
                        bus.ask_one(Keys(waiting[0]).status("learner"))
                        waiting.pop(0)
            except BodyschemaError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", default="1,10,25,50")
    parser.add_argument("--rate", type=float, default=20.0)
    parser.add_argument("--warm", type=float, default=20.0)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--processes", type=int, default=2)
    tables_option(parser)
    asked = parser.parse_args()
    columns = [
        Column("robots", "", "{}"),
        Column("pairs/s", "", "{:.0f}"),
        *(Column(f"{part}, a pair", "ms", "{:.2f}") for part in PARTS),
        Column("cores", "", "{:.2f}"),
        Column("behind: median, 99 %, most", "", "{:.0f}, {:.0f}, {:.0f}"),
        Column("memory of each", "MB", "{:.0f}"),
        Column("load", "", "{:.0f}"),
    ]
    table = Table("fleet", columns)
    for robots in map(int, asked.robots.split(",")):
        course = Course(asked.rate, asked.warm, asked.seconds)
        table.add(*measure(robots, course, min(asked.processes, robots)))
    table.save(asked.tables)


if __name__ == "__main__":
    main()
