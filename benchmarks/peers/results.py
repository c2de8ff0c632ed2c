"""Measured results, kept in a JSON file that later runs extend."""

from __future__ import annotations

import json
import math
import os
import platform
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

Status = Literal["ok", "failed", "too slow", "refused"]
# A mean error above this [m] is a divergence: no arm here is longer than a few metres.
DIVERGED_M = 100.0


@dataclass(frozen=True)
class Outcome:
    """One competitor on one seed of a task with n pairs.

    Attributes:
        errors: mean error [m] of each test; empty unless the status is "ok".
        learn_s, predict_us: CPU time to learn all pairs [s], and to predict one row of a batch [µs].
        reason: reason why there are no errors.
    """

    task: str
    competitor: str
    pairs: int
    seed: int
    status: Status
    errors: dict[str, float] = field(default_factory=dict)
    learn_s: float = 0.0
    predict_us: float = 0.0
    reason: str = ""

    @property
    def key(self) -> tuple[str, str, int, int]:
        return self.task, self.competitor, self.pairs, self.seed


@dataclass(frozen=True)
class Growth:
    """Time and memory of one learner at one size; `what` names the quantity that has this size."""

    what: Literal["joints", "pairs"]
    competitor: str
    size: int
    seconds: float
    mebibytes: float


@dataclass
class Results:
    """All results so far.

    Attributes:
        bounds: (task, pairs, seed, test) -> the Bayesian bound [m].
        runs: time and machine of each run, newest last.
    """

    outcomes: dict[tuple[str, str, int, int], Outcome] = field(default_factory=dict)
    bounds: dict[tuple[str, int, int, str], float] = field(default_factory=dict)
    growth: list[Growth] = field(default_factory=list)
    runs: list[dict[str, Any]] = field(default_factory=list)

    @classmethod
    def load(cls, path: Path) -> Results:
        """Load the results of a file; return empty results if it does not exist."""
        if not path.exists():
            return cls()
        content = json.loads(path.read_text())
        outcomes = [Outcome(**entry) for entry in content["outcomes"]]
        return cls(
            {outcome.key: outcome for outcome in outcomes},
            {(task, pairs, seed, test): value for task, pairs, seed, test, value in content["bounds"]},
            [Growth(**entry) for entry in content["growth"]],
            content["runs"],
        )

    def save(self, path: Path) -> None:
        """Write a temporary file and move it into place, so that a killed run leaves the previous file."""
        content = {
            "runs": self.runs,
            "bounds": [[*key, value] for key, value in self.bounds.items()],
            "growth": [asdict(entry) for entry in self.growth],
            "outcomes": [asdict(outcome) for outcome in self.outcomes.values()],
        }
        written = path.with_suffix(".part")
        written.write_text(json.dumps(content, indent=None, separators=(",", ":")))
        os.replace(written, path)

    def forget(self, competitors: set[str]) -> None:
        """Drop the results of some competitors, to measure them again."""
        self.outcomes = {
            key: outcome for key, outcome in self.outcomes.items() if outcome.competitor not in competitors
        }
        self.growth = [entry for entry in self.growth if entry.competitor not in competitors]

    def of(self, task: str, competitor: str, pairs: int) -> list[Outcome]:
        wanted = (task, competitor, pairs)
        return [outcome for outcome in self.outcomes.values() if outcome.key[:3] == wanted]

    def bound(self, task: str, pairs: int, test: str) -> float | None:
        """Return the mean of the bound [m] over the seeds."""
        values = [value for key, value in self.bounds.items() if (key[0], key[1], key[3]) == (task, pairs, test)]
        return float(np.mean(values)) if values else None


@dataclass(frozen=True)
class Cell:
    """All seeds of one competitor on a task with n pairs.

    Attributes:
        mean, standard_error: over the seeds that finished [m]; None if none did.
        ran, failed: numbers of seeds that finished, and that failed or diverged.
        reason: reason why nothing ran.
    """

    mean: float | None
    standard_error: float | None
    ran: int
    failed: int
    learn_s: float | None
    predict_us: float | None
    reason: str


def cell(outcomes: list[Outcome], test: str) -> Cell:
    """Summarise the outcomes for one test."""
    good = [outcome for outcome in outcomes if outcome.status == "ok" and test in outcome.errors]
    failed = sum(outcome.status == "failed" for outcome in outcomes)
    reasons = [outcome.reason for outcome in outcomes if outcome.reason]
    if not good:
        return Cell(None, None, failed, failed, None, None, reasons[0] if reasons else "")
    errors = np.array([outcome.errors[test] for outcome in good])
    spread = float(errors.std(ddof=1) / math.sqrt(len(errors))) if len(errors) > 1 else None
    return Cell(
        float(errors.mean()),
        spread,
        len(good) + failed,
        failed,
        float(np.median([outcome.learn_s for outcome in good])),
        float(np.median([outcome.predict_us for outcome in good])),
        reasons[0] if reasons else "",
    )


def machine() -> dict[str, str]:
    """Describe the machine of a run."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    return {
        "processor": f"{model}, {os.cpu_count()} cores",
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "numpy": np.__version__,
    }
