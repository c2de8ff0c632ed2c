"""One learner host for many robots: what each costs, and whether the instant models keep up.

python benchmarks/fleet.py [--robots 1,10,25,50] [--rate 20] [--seconds 20] [--processes 1]

Robots of six joints, whose pairs come over real zenoh from a process that publishes them and answers from their
history as samplers do. For each number of robots:

    cpu    of the host's processes per robot, in % of one core: in all; the instant pass and answers; the solver
    pairs  learnt of those published, at the end
    lag    from a pair's publication until the learner has learnt it, at the median and in the worst robot, in pairs
    memory of the host's processes per robot
"""

from __future__ import annotations

import argparse
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from daemon.bus import Bus, Request, client
from daemon.config import Config
from daemon.keys import Keys
from daemon.status import LearnerStatus
from daemon.wire import PairMessage, PairsReply, decode, encode
from interfaces.errors import BodyschemaError

JOINTS = 6
SIGMA_M = 2e-3
STEP_RAD = 0.015
LIMIT_S = 240.0
TICKS = os.sysconf("SC_CLK_TCK")


def write_robot(folder: Path, name: str, sampler: str, learner: str) -> Path:
    """Description of an arm of six joints that turn; the path of its robot.toml."""
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
    """One robot's pairs: a walk of an arm whose zeros are off, with history."""

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
    """Of a process and its children: processor time [s] of those that solve and of the others, and memory [bytes]."""

    learners_s: float
    solvers_s: float
    memory: int

    @classmethod
    def of(cls, pid: int) -> Usage:
        seconds, memory = {True: 0.0, False: 0.0}, 0
        for one in _family(pid):
            try:
                command = Path(f"/proc/{one}/cmdline").read_bytes()
                fields = Path(f"/proc/{one}/stat").read_text().rpartition(")")[2].split()
                shared = Path(f"/proc/{one}/statm").read_text().split()
            except OSError:
                continue
            seconds[b"solver_process" in command] += (int(fields[11]) + int(fields[12])) / TICKS
            memory += (int(shared[1]) - int(shared[2])) * os.sysconf("SC_PAGE_SIZE")
        return cls(seconds[False], seconds[True], memory)


def _family(pid: int) -> list[int]:
    children = [child for file in Path(f"/proc/{pid}/task").glob("*/children") for child in file.read_text().split()]
    return [pid, *(one for child in children for one in _family(int(child)))]


def _counted(bus: Bus, names: list[str]) -> dict[str, int]:
    """How many pairs each robot has learnt."""
    counts = {}
    for name in names:
        counts[name] = decode(bus.ask_one(Keys(name).status("learner"), timeout_s=30.0), LearnerStatus).pairs
    return counts


def measure(robots: int, rate: float, seconds: float, processes: int) -> str:
    """One row of the table."""
    with tempfile.TemporaryDirectory() as folder:
        sampler, ends = free_endpoint(), [free_endpoint() for _ in range(processes)]
        files = [
            write_robot(Path(folder) / f"arm_{k}", f"arm_{k}", sampler, ends[k % processes]) for k in range(robots)
        ]
        walks = [Walk(Config.load(file), k) for k, file in enumerate(files)]
        command = [sys.executable, "-m", "daemon", "learner", "--robot", folder, "--processes", str(processes)]
        with Bus(listen=sampler) as bus:
            publish = [bus.publisher(Keys(f"arm_{k}").pair, cache=256) for k in range(robots)]
            for k, walk in enumerate(walks):
                bus.answer(Keys(f"arm_{k}").pairs, walk.history)
                bus.token(Keys(f"arm_{k}").alive("sampler"))
            host = subprocess.Popen(command, stderr=subprocess.DEVNULL)
            try:
                return _row(host.pid, ends, walks, publish, rate, seconds)
            finally:
                host.terminate()
                host.wait(60)


def _row(pid: int, ends: list[str], walks: list[Walk], publish: list, rate: float, seconds: float) -> str:
    names = [f"arm_{k}" for k in range(len(walks))]
    _await_answers(ends, names)
    before, begin, published = Usage.of(pid), time.monotonic(), 0
    load = os.getloadavg()[0]
    while (now := time.monotonic() - begin) < seconds:
        while published < now * rate * len(walks):
            walk = published % len(walks)
            publish[walk](walks[walk].step())
            published += 1
        time.sleep(0.002)
    spent, after = time.monotonic() - begin, Usage.of(pid)
    # Asked of all ends; each knows its own robots.
    behind = []
    for place, end in enumerate(ends):
        with client(end) as asked:
            own = names[place :: len(ends)]
            counts = _counted(asked, own)
            behind += [len(walks[names.index(name)].pairs) - counts[name] for name in own]
    per_robot = 100.0 / spent / len(walks)
    memory_mb = after.memory / len(walks) / 1e6
    learnt = 1.0 - sum(max(b, 0) for b in behind) / published
    return (
        f"| {len(walks)} | {per_robot * (after.learners_s - before.learners_s):.1f} | "
        f"{per_robot * (after.solvers_s - before.solvers_s):.1f} | {published / spent / len(walks):.1f} | "
        f"{learnt:.0%} | {statistics.median(behind):.0f}, {max(behind)} | {memory_mb:.0f} | {load:.0f} |"
    )


def _await_answers(ends: list[str], names: list[str]) -> None:
    """Until every robot's learner answers: they come up one after the other."""
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
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--processes", type=int, default=1)
    asked = parser.parse_args()
    print("| robots | CPU, learning | CPU, solver | pairs/s came | learnt | behind, worst | MB | load |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for robots in map(int, asked.robots.split(",")):
        print(measure(robots, asked.rate, asked.seconds, min(asked.processes, robots)), flush=True)


if __name__ == "__main__":
    main()
