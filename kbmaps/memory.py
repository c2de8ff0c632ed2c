"""Memory of a learner: the number of old pairs that count, and their weight."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from kbmaps.arrays import FloatArray
from kbmaps.errors import SettingError
from kbmaps.packed import count, named, number

_NOTHING = float(np.finfo(np.float64).eps)  # a smaller weight next to that of a new pair has no effect on a float64 sum


@dataclass(frozen=True)
class Memory:
    """Treatment of old pairs.

    Attributes:
        window: number of the last pairs that count; None means all.
        forgetting: factor by which each new pair reduces the weight of all before; 1 forgets nothing. The pairs are
            then worth about 1 / (1 − forgetting) in all. If that is fewer than the control points to be determined, the
            evidence keeps to the prior.

    Raises:
        SettingError: a window below 1, forgetting not within 0..1 or 0 itself.
    """

    window: int | None = None
    forgetting: float = 1.0

    def __post_init__(self) -> None:
        if self.window is not None and self.window < 1:
            raise SettingError(f"a window must hold at least 1 pair, got {self.window}")
        if not (0.0 < self.forgetting <= 1.0 and math.isfinite(self.forgetting)):
            raise SettingError(
                f"forgetting must be greater than 0 and at most 1 (which forgets nothing), got {self.forgetting!r}"
            )

    def kept(self, pairs: int) -> int:
        """Return the number of last pairs that count, out of `pairs`."""
        longest = math.inf if self.forgetting == 1.0 else math.log(_NOTHING) / math.log(self.forgetting) + 1.0
        return int(min(pairs, longest if self.window is None else min(longest, self.window)))

    def weights(self, pairs: int) -> FloatArray:
        """Return weights (pairs,) of pairs in order of arrival: 1 for the last."""
        return self.forgetting ** np.arange(pairs - 1, -1, -1.0)


def describe_memory(memory: Memory) -> dict[str, float | None]:
    """Return a memory for JSON."""
    return {"window": memory.window, "forgetting": memory.forgetting}


def parse_memory(value: Any) -> Memory:
    """Return the memory from `describe_memory`; raise ModelFormatError, SettingError if it does not describe one."""
    described = named(value, "the memory", ("window", "forgetting"))
    window = None if described["window"] is None else count(described["window"], "the window")
    return Memory(window, number(described["forgetting"], "forgetting"))
