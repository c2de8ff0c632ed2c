"""The laws of `bodyschema.interfaces.protocols.Clock`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from importlib.util import find_spec

import pytest

from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.protocols import Clock
from bodyschema.robot.description import RobotDescription
from bodyschema.sim_backend import SimConfig, SimWorld, model_file


@contextmanager
def system_clock() -> Iterator[Clock]:
    yield SystemClock()


@contextmanager
def simulated_clock() -> Iterator[Clock]:
    with SimWorld(RobotDescription.load(model_file("upper_body")), SimConfig()) as world:
        yield world.clock


SIMULATED = pytest.mark.skipif(find_spec("pybullet") is None, reason="no pybullet; to run it: pip install -e '.[sim]'")


@pytest.fixture(scope="module", params=[system_clock, pytest.param(simulated_clock, marks=SIMULATED)])
def clock(request: pytest.FixtureRequest) -> Iterator[Clock]:
    with request.param() as clock:
        yield clock


def test_monotonic_time_never_goes_back(clock: Clock) -> None:
    times = [clock.now() for _ in range(100)]
    assert times == sorted(times)


def test_wall_time_is_utc_with_milliseconds(clock: Clock) -> None:
    shown = clock.utc()
    assert datetime.fromisoformat(shown).utcoffset() == timedelta(0)
    assert len(shown) == len("2026-01-01T00:00:00.000+00:00")


def test_wall_time_begins_at_the_machine_s(clock: Clock) -> None:
    assert abs(datetime.fromisoformat(clock.utc()) - datetime.now(UTC)) < timedelta(minutes=10)
