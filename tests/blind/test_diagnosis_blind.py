"""`diagnose` on cases that nobody has looked at: their seeds come from the commit, else from the date.

How many failures are allowed follows from how often each scenario failed in a sealed run with as many pairs,
`python -m tests.blind.sealed --pairs 600 --scenario ...`, whose counts stand in `SEALED`. The true rate of failures is
taken to be the upper end of the 95 % interval (Clopper and Pearson) around such a count, which leaves a margin. The
number of failures among cases with the rates p_1, ..., p_n has the distribution that is the convolution of their
[1 - p_i, p_i]; allowed are as many as are exceeded with a probability of at most 1/1000 over all tests here together.
"""

from __future__ import annotations

import hashlib
import subprocess
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binomtest

from .judgement import Crash, told
from .sealed import Case, Record, judged

pytestmark = pytest.mark.timeout(600)

PAIRS = 600
CASES = {"one": 8, "two": 3, "three": 2, "outliers": 4, "none": 4, "outside": 4}
# Scenario: failures, and cases, in the sealed run.
SEALED: dict[str, tuple[int, int]] = {}
BY_CHANCE = 1e-3
TESTS = 3


def _origin() -> str:
    """What the seeds come from."""
    asked = ["git", "rev-parse", "HEAD"]
    try:
        done = subprocess.run(asked, cwd=Path(__file__).parent, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return datetime.now(UTC).date().isoformat()
    return done.stdout.strip()


@pytest.fixture(scope="module")
def records() -> list[Record]:
    """All cases, judged; those of a scenario have neighbouring seeds."""
    origin = _origin()
    first = int.from_bytes(hashlib.sha256(origin.encode()).digest()[:3], "big")
    print(f"seeds from {first}, drawn from {origin}")
    cases = [Case(name, first + k, PAIRS) for name, count in CASES.items() for k in range(count)]
    return list(judged(cases))


def _failed(record: Record) -> bool:
    return isinstance(record, Crash) or record.outcome in ("wrong", "missed")


def _allowed(scenarios: Sequence[str]) -> int:
    """Failures that are exceeded with a probability of at most BY_CHANCE / TESTS."""
    odds = np.ones(1)
    for name in scenarios:
        rate = binomtest(*SEALED[name]).proportion_ci(method="exact").high
        odds = np.convolve(odds, [1.0 - rate, rate])
    exceeded = 1.0 - np.cumsum(odds)
    return int(np.flatnonzero(exceeded <= BY_CHANCE / TESTS)[0])


def _check(records: Sequence[Record], names: Sequence[str]) -> None:
    chosen = [record for record in records if record.scenario in names]
    failed = [record for record in chosen if _failed(record)]
    listed = "\n".join(f"{told(record)}\n    {record.command}" for record in failed)
    allowed = _allowed([record.scenario for record in chosen])
    assert len(failed) <= allowed, f"{len(failed)} of {len(chosen)} failed, {allowed} may:\n{listed}"


def test_what_is_hidden_is_named(records: list[Record]) -> None:
    _check(records, ("one", "two", "three", "outliers"))


def test_nothing_is_found_where_nothing_is_hidden(records: list[Record]) -> None:
    _check(records, ("none",))


def test_what_is_outside_the_table_gets_no_name(records: list[Record]) -> None:
    _check(records, ("outside",))


def test_the_thresholds_can_be_missed() -> None:
    for names in (("one", "two", "three", "outliers"), ("none",), ("outside",)):
        scenarios = [name for name in names for _ in range(CASES[name])]
        assert _allowed(scenarios) < len(scenarios)
