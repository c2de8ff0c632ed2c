"""One definition of error for the page: the distance between prediction and measurement, noise included."""

from __future__ import annotations

import math

from bodyschema.daemon.transport.status import LearnerStatus

from .documents import OutlookDocument

# Mean length of a normal vector in three dimensions, in units of its 1-sigma a coordinate.
_MEAN_LENGTH = math.sqrt(8.0 / math.pi)


def expected_error_m(status: LearnerStatus, claimed_m: float | None) -> float | None:
    """Return the mean distance [m] to expect between predictions and new measurements; None if the noise is unknown.

    Args:
        claimed_m: mean distance of predictions to the truth.
    """
    if claimed_m is None or status.calibration is None:
        return None
    return math.hypot(claimed_m, _MEAN_LENGTH * status.calibration.noise_m)


def expected_outlook(status: LearnerStatus) -> OutlookDocument | None:
    """Return the learner's forecast as errors on new pairs; None while there is none."""
    outlook = status.outlook
    if outlook is None or (now_m := expected_error_m(status, outlook.error_m)) is None:
        return None

    def expected(claimed: list[float]) -> list[float]:
        return [expected_error_m(status, each_m) or each_m for each_m in claimed]

    sentence = "Enough data where the arm was."
    if not outlook.enough:
        more = outlook.best_motion_m != outlook.like_so_far_m
        sentence = f"More data would help{f'; {outlook.best_motion} gains most' if more else ''}."
    return OutlookDocument(
        sentence,
        outlook.pairs,
        now_m,
        outlook.further_pairs,
        expected(outlook.like_so_far_m),
        outlook.best_motion,
        expected(outlook.best_motion_m),
    )
