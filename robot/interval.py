"""Format values with their intervals."""

from __future__ import annotations

import math


def to_its_interval(value: float, half_width: float) -> tuple[str, str]:
    """Format a value and the half width of its interval: the latter with two digits, both with as many decimals."""
    if not 0.0 < half_width < math.inf:
        return f"{value:.6g}", f"± {half_width:g}"
    places = max(0, 1 - math.floor(math.log10(half_width)))
    return f"{value:.{places}f}", f"± {half_width:.{places}f}"
