"""All rows, in the order of the table."""

from __future__ import annotations

from pathlib import Path

from benchmarks.goals import choosing, costs, intervals, noise_free, noisy, not_rigid, tool_change
from benchmarks.goals.goal import Row


def rows(data: Path | None) -> list[Row]:
    """Return all rows.

    Args:
        data: folder with recordings; if None, rows that need them cannot be measured.
    """
    return [
        *noise_free.rows(),
        *noisy.rows(),
        *tool_change.rows(),
        *not_rigid.rows(data),
        *choosing.rows(),
        *costs.rows(),
        *intervals.rows(),
    ]
