"""Run both processes in a network namespace of their own and degrade its network by kernel means.

unshare --net python kernel_network.py down|slow FOLDER PAIRS
"""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

from free_ports import free_endpoint
from two_processes import LIFE_LIMIT_S, expect_each_pair_learnt_once, learner_with, running, sampler_with, write_robot

from bodyschema.daemon.config import Config
from bodyschema.recordings.store.store import PairReader

SOME = 20
# Longer than a zenoh session lives without a sign of the other side.
LEASE_S = 3.0


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True)


def stored(config: Config, pairs: int) -> int:
    """Count the pairs in the store once there are at least `pairs`, without asking a process."""
    deadline = time.monotonic() + LIFE_LIMIT_S
    with PairReader(config.store_file) as store:
        while (last := store.last_seq()) < pairs:
            assert time.monotonic() < deadline
            time.sleep(0.05)
    return last


def lose_the_link(config: Config, pairs: int) -> None:
    """Block all packets until the store has this many more pairs and every session is over."""
    begun, done = time.monotonic(), stored(config, 1)
    ip("link", "set", "lo", "down")
    stored(config, done + pairs)
    while time.monotonic() < begun + LEASE_S:
        time.sleep(0.05)
    ip("link", "set", "lo", "up")


def go_slowly(config: Config, pairs: int) -> None:
    """Limit the kernel's bandwidth so that pairs and statuses queue up."""
    shape = ("rate", "400kbit", "burst", "3000", "latency", "300ms")
    subprocess.run(["tc", "qdisc", "add", "dev", "lo", "root", "tbf", *shape], check=True)
    learner_with(config, sampler_with(config, 0).pairs + pairs)
    subprocess.run(["tc", "qdisc", "del", "dev", "lo", "root"], check=True)


def main(how: str, folder: Path, pairs: int) -> None:
    ip("link", "set", "lo", "up")
    config = write_robot(folder, free_endpoint)
    with running(config, "sampler"), running(config, "learner"):
        learner_with(config, SOME)
        {"down": lose_the_link, "slow": go_slowly}[how](config, pairs)
        print(expect_each_pair_learnt_once(config).pairs)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]))
