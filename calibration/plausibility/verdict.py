"""Result of the plausibility check, and its thresholds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from bodyschema.interfaces.errors import RecordingError

# With fewer rows a wrong reading may fit by chance, and another one is refused only if it fits `decisively` better.
FEWEST_ROWS = 40


@dataclass(frozen=True)
class _Thresholds:
    """Thresholds beyond which a way to read the recording is reported."""

    # Another reading is reported if the pairs fit this many times better, and mentioned from `as_good` times on. Arms
    # with tolerances of 0.5° and 1 mm, offsets of 10° and noise of 10 mm stay below 1.15 with all wrong readings.
    much_better: float = 1.5
    as_good: float = 1.15
    # With few rows, scattered ones with a wrong reading fit 20 to 570 times better in the right one. On guided paths of
    # up to 38 steps, whose rows err alike, one wrong reading fitted up to 9.7 times better than another.
    decisively: float = 10.0
    # A reading with one change is reported if it leaves at most half of this share of the spread, with two a third, and
    # so on. Right readings of real arms leave up to `right`, wrong ones down to 0.03 with four changes, 0.09 with two.
    named: float = 0.12
    right: float = 0.032
    turned_rad: float = math.radians(30.0)  # a known camera pose is not off by this much
    oriented_rad: float = math.radians(1.0)  # orientations of a tag on a nominal arm are no better than this


THRESHOLDS = _Thresholds()


@dataclass(frozen=True, slots=True)
class Plausibility:
    """Result of the plausibility check."""

    refusal: str | None = None  # reason why the recording cannot be of this robot in its present form, or None
    remedy: str = ""  # the remedy
    misread: bool = False  # True if another reading of the columns fits
    # how many times better it fits than the unchanged columns, or than those of any real arm if none fits
    better: float = 1.0
    warnings: tuple[str, ...] = ()  # sentences about possible problems
    undirected: tuple[str, ...] = ()  # joints whose sign these pairs do not determine

    @property
    def sentences(self) -> tuple[str, ...]:
        refused = () if self.refusal is None else (f"{self.refusal}. {self.remedy}",)
        return tuple(f"{text[0].upper()}{text[1:]}." for text in (*refused, *self.warnings))

    def require(self, file: Path | str, *, force: bool) -> tuple[str, ...]:
        """Return the warnings for a recording that is fitted.

        Raises:
            RecordingError: it cannot be of this robot in its present form.
        """
        if self.refusal is not None and not force:
            raise RecordingError(self.refusal, file=file, remedy=f"{self.remedy}. Or fit it as it is with --force")
        return self.sentences


def mm(distance_m: float) -> str:
    return f"{1e3 * distance_m:.3g} mm" if distance_m < 1.0 else f"{distance_m:.3g} m"
