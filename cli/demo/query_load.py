"""A separate process that continuously asks the learner for predictions, as a robot's controller would.

It prints one JSON line per second: the number of answers and their latency.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np

from bodyschema.daemon.config import Config
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import ZenohSession, client
from bodyschema.daemon.transport.wire import JointsRequest, PredictReply, decode, encode
from bodyschema.interfaces.errors import BusError, RequestError


def main(robot_file: str, seed: str) -> None:
    """Ask until the input ends or the learner does not come back."""
    config = Config.load(Path(robot_file))
    rng = np.random.default_rng(int(seed))
    with _patient_client(config.tables.zenoh.learner) as bus:
        while True:
            print(json.dumps(_one_second(bus, config, rng)), flush=True)  # noqa: T201


def _patient_client(endpoint: str) -> ZenohSession:
    for _ in range(100):
        try:
            with client(endpoint):
                return ZenohSession(connect=endpoint, client=True)
        except BusError:
            time.sleep(0.2)
    raise BusError(f"nothing listens on {endpoint}")


def _one_second(
    bus: ZenohSession, config: Config, rng: np.random.Generator, rate_hz: float = 20.0
) -> dict[str, float | int]:
    key, robot = Keys(config.robot.name).predict, config.robot
    took: list[float] = []
    unanswered = refused = 0
    end = time.monotonic() + 1.0
    while time.monotonic() < end:
        q = rng.uniform(robot.lower, robot.upper)
        start = time.perf_counter()
        try:
            decode(bus.ask_one(key, encode(JointsRequest(q.tolist())), timeout_s=2.0), PredictReply)
            took.append(time.perf_counter() - start)
        except BusError:
            unanswered += 1
        except RequestError:
            refused += 1
        time.sleep(max(0.0, 1.0 / rate_hz - (time.perf_counter() - start)))
    return {
        "answers": len(took),
        "unanswered": unanswered,
        "refused": refused,
        "p50_ms": 1e3 * float(np.median(took)) if took else 0.0,
        "worst_ms": 1e3 * max(took, default=0.0),
    }


if __name__ == "__main__":
    main(*sys.argv[1:3])
