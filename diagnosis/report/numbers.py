"""Format the numbers of `diagnosis.json` for people: degrees, millimetres and percent, with significant digits only."""

from __future__ import annotations

import math
from dataclasses import dataclass

from .result import Cause, Interval, Rejected

_DEG = math.degrees(1.0)
# Factor and unit by the suffix of a number's name; the first match applies.
_UNITS: tuple[tuple[str, float, str], ...] = (
    ("_kgm", 1.0, " kg·m"),
    ("_kg", 1.0, " kg"),
    ("_rad_per_Nm", _DEG, "°/N·m"),
    ("hold_Nm", 1.0, " N·m"),
    ("hold_N", 1.0, " N"),
    ("_m_per_N", 1e3, " mm/N"),
    ("_rad", _DEG, "°"),
    ("_m", 1e3, " mm"),
    ("latency_s", 1e3, " ms"),
    ("_s", 1.0, " s"),
    ("_error", 100.0, " %"),
    ("ratio", 100.0, " %"),
    ("fraction", 100.0, " %"),
    ("share", 100.0, " %"),
)
_LABELS = {
    "scale_error": "scale",
    "focal_error": "focal length",
    "cycles_per_turn": "cycles a turn",
    "cycles_per_m": "cycles a metre",
    "t0": "at",
    "width": "play",
    "lag": "lags by",
    "length": "turns round over",
    "hold": "held by friction up to",
    **{f"{axis}_kgm": f"mass times {axis}" for axis in "xyz"},
    "fraction": "missing of a move",
    "rx": "turn about x",
    "ry": "turn about y",
    "rz": "turn about z",
    "x": "shift in x",
    "y": "shift in y",
    "z": "shift in z",
    "latency": "late by",
    "time_constant": "time constant",
    "share": "of the fixes",
}
# Parameters already given as amplitude and phase.
_REDUNDANT = ("sine_rad", "cosine_rad", "sine_m", "cosine_m")


class _Settings:
    min_digits, max_digits = 0, 6
    # Half widths of an interval above which a length [m] or an angle [rad] is not identifiable.
    untold = (("_rad", 0.5), ("_m", 0.1))
    lopsided = 0.3  # an interval whose halves differ by more than this share is written with both its ends


# Parameters of time and shape rather than size.
_NEVER_ZERO = ("t0", "cycles", "phase", "time_constant", "length", "hold")


@dataclass(frozen=True, slots=True)
class Number:
    """One formatted number of a cause."""

    label: str  # name of the quantity
    # value, interval: with unit; the interval as a half width or as both ends, "" where there is none
    value: str
    interval: str
    may_be_zero: bool  # True if its interval contains zero
    is_identifiable: bool = True  # True if the recording determines it

    def __str__(self) -> str:
        return f"{self.value} {self.interval}".rstrip()


def numbers_of(cause: Cause, *, timed: bool) -> list[Number]:
    """Return the formatted numbers of a cause.

    Args:
        timed: True if the recording has times; otherwise a moment is a row number.
    """
    names = [name for name in cause.parameters if name not in _REDUNDANT or not _has_amplitude(cause)]
    return [number(name, cause.parameters[name], timed=timed) for name in names]


def identifiable_values(cause: Cause) -> dict[str, float]:
    """Return a cause's numbers without shifts and rotations that are not identifiable; all if none is identifiable."""
    parts = {name for name in cause.parameters if name.removeprefix("r")[1:] in ("_m", "_rad")}
    identifiable = {
        n: of.value for n, of in cause.parameters.items() if n not in parts or number(n, of).is_identifiable
    }
    return (
        identifiable
        if identifiable.keys() & parts or not parts
        else {name: of.value for name, of in cause.parameters.items()}
    )


def significant_numbers(numbers: list[Number]) -> list[Number]:
    """Return the identifiable numbers that are not zero; if there are none, all identifiable ones."""
    identifiable = [n for n in numbers if n.is_identifiable] or numbers
    return [n for n in identifiable if not n.may_be_zero] or identifiable


def number(name: str, interval: Interval, *, timed: bool = True) -> Number:
    factor, unit = _unit(name, timed)
    value, low, high = (factor * v for v in (interval.value, *interval.ci95))
    half = 0.5 * (high - low)
    digits = _digits(half if half > 0.0 else 0.01 * abs(value))
    row = "row " if name == "t0" and not timed else ""
    return Number(
        label=_label(name),
        value=f"{row}{_fixed(value, digits, '+' if name.endswith(_SIGNED) else '')}{unit}",
        interval=_range(value, low, high, digits),
        may_be_zero=low <= 0.0 <= high and not name.startswith(_NEVER_ZERO),
        is_identifiable=not any(name.endswith(end) and half > factor * limit for end, limit in _Settings.untold),
    )


def _label(name: str) -> str:
    if name in _LABELS:
        return _LABELS[name]
    for end in ("_rad_per_Nm", "_m_per_N", "_kgm", "_kg", "_Nm", "_N", "_m_per_N", "_rad", "_m", "_s"):
        if name.endswith(end):
            base = name.removesuffix(end)
            return _LABELS.get(base, base)
    return name


def place(what: Cause | Rejected) -> str:
    """Return effect and joint by their names in files, as in `joint_coupling at elbow from shoulder`."""
    at = "" if what.where is None else f" at {what.where}"
    return f"{what.effect}{at}{'' if what.source is None else f' from {what.source}'}"


def chance(p: float) -> str:
    if p < 0.001:
        return "< 0.001"
    return "1" if p >= 0.995 else f"{p:.2g}"


def percent(share: float) -> str:
    if share >= 0.995:
        return "> 99 %"
    return "< 1 %" if share < 0.005 else f"{100.0 * share:.0f} %"


def share(of_hundred: float) -> str:
    """Format a share of a gain [%]."""
    return "< 1 %" if 0.05 <= of_hundred < 0.5 else f"{round(of_hundred)} %"


def mm(value: float | None) -> str:
    if value is None or not math.isfinite(value):
        return "–"
    return _fixed(value, 0 if value >= 100 else 1 if value >= 10 else 2 if value >= 0.1 else 3, "")


_SIGNED = ("offset_rad", "offset_m", "jump_rad", "jump_m", "_error", "ratio", "x_m", "y_m", "z_m", "k1")
_SIGNED += ("rx_rad", "ry_rad", "rz_rad")


def _unit(name: str, timed: bool) -> tuple[float, str]:
    if name == "t0":
        return 1.0, " s" if timed else ""
    return next(((factor, unit) for end, factor, unit in _UNITS if name.endswith(end)), (1.0, ""))


def _has_amplitude(cause: Cause) -> bool:
    return any(name.startswith("amplitude") for name in cause.parameters)


def _digits(half: float) -> int:
    """Return the digits that give the half width two significant figures."""
    if half <= 0.0 or not math.isfinite(half):
        return 3
    return min(max(1 - math.floor(math.log10(half)), _Settings.min_digits), _Settings.max_digits)


def _fixed(value: float, digits: int, sign: str) -> str:
    return f"{round(value, digits) + 0.0:{sign}.{digits}f}"


def _range(value: float, low: float, high: float, digits: int) -> str:
    half = 0.5 * (high - low)
    if not half > 0.0:
        return ""
    if abs(0.5 * (low + high) - value) > _Settings.lopsided * half:
        return f"({_fixed(low, digits, '')} … {_fixed(high, digits, '')})"
    return f"± {half:.{digits}f}"
