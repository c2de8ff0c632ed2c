"""Whether a recording can be of this robot."""

from .check import Plausibility, plausibility, told_sigma
from .limits import beyond_limits, limits_text, require_units

__all__ = [
    "Plausibility",
    "beyond_limits",
    "limits_text",
    "plausibility",
    "require_units",
    "told_sigma",
]
