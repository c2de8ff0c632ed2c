"""Pairs of datagrams: the sampler reads joints and a UDP marker source, both live."""

from __future__ import annotations

import json
import math
import socket
import threading
import time
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import pytest
from test_sampler import sampling, small_arm

from bodyschema.daemon.sampler.sources import Sources
from bodyschema.daemon.wiring.wiring import stream_of
from bodyschema.drivers.markers.config import source_tables
from bodyschema.drivers.markers.datagram import SCHEMA
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.records import JointReading, frozen_array

LIMIT_S = 400.0
PAIRS = 12
AHEAD_S = 999.0
SIGMA_M = 2e-4


def waist(t: float) -> float:
    """Return the angle [rad] of the guided waist at `t` [s]: up to 20°/s."""
    return 0.5 * math.sin(0.7 * t)


class GuidedJoints:
    """Encoders of an arm whose waist turns, read now."""

    joints = ("waist", "shoulder")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def read(self, timeout_s: float) -> JointReading:
        time.sleep(0.004)
        t = time.monotonic()
        return JointReading(t, frozen_array([waist(t), 0.2]))


def send(port: int, stop: threading.Event) -> None:
    """Send the hand's position, at 0.3 m from the waist, each tenth datagram in millimetres."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        for seq in count():
            if stop.wait(0.008):
                return
            t = time.monotonic()
            x = np.array([0.3 * math.cos(waist(t)), 0.3 * math.sin(waist(t)), 0.0])
            told = {"schema": SCHEMA, "seq": seq, "stamp": t + AHEAD_S}
            told["position"] = (1000.0 * x if seq % 10 == 0 else x).tolist()
            out.sendto(json.dumps(told).encode(), ("127.0.0.1", port))


def test_datagrams_become_pairs_on_the_encoders_clock(tmp_path, endpoint) -> None:
    config = small_arm(tmp_path, endpoint)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    keys = {"kind": "udp", "port": port, "sigma_m": SIGMA_M, "latency_sigma_s": 0.0}
    clock = SystemClock()
    stream = stream_of(source_tables(keys, Path("robot.toml"), "")[0], clock)
    sources = Sources(
        GuidedJoints(), stream, clock, cameras=stream, marker_source_name="the positions by udp", live=True
    )
    stop = threading.Event()
    sender = threading.Thread(target=send, args=(port, stop))
    sender.start()
    with sampling(config, sources) as sampler:
        running = threading.Thread(target=sampler.run)
        running.start()
        end = time.monotonic() + LIMIT_S
        while sampler.status().pairs < PAIRS and time.monotonic() < end:
            time.sleep(0.05)
        health = sampler.status().health
        sampler.stop()
        running.join()
        pairs = sampler._store.read()
    stop.set()
    sender.join()
    assert len(pairs) >= PAIRS
    for pair in pairs:
        angle = math.atan2(pair.x[1], pair.x[0])
        # 2° is 0.1 s at this speed: a clock of its own would show.
        assert angle == pytest.approx(pair.q[0], abs=math.radians(2.0))
        np.testing.assert_allclose(pair.cov, SIGMA_M**2 * np.eye(3))
    [said] = [text for text in health if "metres away" in text]
    assert said.startswith("udp: ")
