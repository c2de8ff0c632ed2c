"""Matching of the marker's discs in the left and the right eye."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import ImageArray, Reason
from bodyschema.vision.config import VisionConfig
from bodyschema.vision.triangulate import Location, locate

from .blob import Disc
from .settings import TrackSettings as _Settings


class StereoMatcher:
    """Check of pairs of discs against the geometry of two eyes and one ball of known size."""

    def __init__(self, calibration: StereoCalibration, config: VisionConfig) -> None:
        self._calibration, self._config = calibration, config

    def match(self, left: Sequence[Disc], right: Sequence[Disc]) -> Location | Reason:
        """Return the one pair that fits, or the reason for none; both sequences contain at least one disc."""
        outcomes = [self._check(one, other) for one, other in product(left, right)]
        found = _without_reflections([outcome for outcome in outcomes if isinstance(outcome, Location)])
        if len(found) == 1:
            return found[0] if found[0].roughness < _Settings.rough_limit else Reason.OCCLUDED
        if found:
            return Reason.AMBIGUOUS
        # The check that rejected the best pair.
        return Reason.SIZE_MISMATCH if Reason.SIZE_MISMATCH in outcomes else Reason.EPIPOLAR

    def ambiguity(self, found: Location, left: Sequence[Disc], right: Sequence[Disc]) -> Reason | None:
        """Return the reason why the pair `found` may not be the marker, or None.

        Another pair, of measured or rough discs, may be the marker too, or `found` may be a mirror image of that pair.
        """
        others = [
            [disc for disc in discs if np.linalg.norm(disc.centre_px - centre_px) > disc.radius_px]
            for discs, centre_px in ((left, found.centres_px[:2]), (right, found.centres_px[2:]))
        ]
        outcomes = (self._check(one, other) for one, other in product(*others))
        other_pairs = [outcome for outcome in outcomes if isinstance(outcome, Location)]
        rest = _without_reflections([found, *other_pairs])
        if not any(one is found for one in rest):
            return Reason.REFLECTION
        return Reason.AMBIGUOUS if len(rest) > 1 else None

    def may_be_second_marker(
        self, disc: Disc, others: Sequence[Disc], mask: ImageArray, found: Location, *, in_left: bool
    ) -> bool:
        """Return True if a disc of one eye may be a second marker that the other eye sees too, but not as a disc.

        Args:
            disc: a measured or rough disc, not that of the marker found.
            others: the discs of the other eye; pairs with these were checked before.
            mask: pixels of the marker's colour in the other eye, shape (height, width).
            found: the marker.
            in_left: True if `disc` is the left eye's.
        """
        if any(self._is_similar(disc, other) for other in others):
            return False
        radius_px = self._calibration.focal_px * self._config.radius_m / float(found.x[2])
        if disc.level < _Settings.mirrored_light * found.level and disc.radius_px < radius_px:
            return False
        u, v = disc.centre_px
        disparity_px = self._calibration.baseline_m * disc.radius_px / self._config.radius_m
        ends_px = disparity_px / _Settings.depth_size_ratio, disparity_px * _Settings.depth_size_ratio
        first, last = (u - ends_px[1], u - ends_px[0]) if in_left else (u + ends_px[0], u + ends_px[1])
        # The square inside the disc.
        half = max(1, round(disc.radius_px / math.sqrt(2.0)))
        rows = mask[max(round(v) - half, 0) : max(round(v) + half + 1, 0)]
        if not len(rows):
            return False
        columns = np.arange(max(math.floor(first), half), min(math.ceil(last), mask.shape[1] - 1 - half) + 1)
        own_u, own_v = found.centres_px[2:] if in_left else found.centres_px[:2]
        if abs(own_v - v) <= radius_px + half:
            columns = columns[np.abs(columns - own_u) > radius_px + half]
        total = np.concatenate([[0.0], np.cumsum(rows.mean(axis=0) / 255.0)])
        shares = (total[columns + half + 1] - total[columns - half]) / (2 * half + 1)
        return bool((shares > _Settings.min_shown).any())

    def _check(self, left: Disc, right: Disc) -> Location | Reason:
        location = locate(self._calibration, self._config.radius_m, left, right)
        if location is None:
            return Reason.EPIPOLAR
        _, vl, _, vr = location.centres_px
        sigma = math.sqrt(location.variances_px[1] + location.variances_px[3])
        if abs(vl - vr) > _Settings.epipolar_px + _Settings.epipolar_sigmas * sigma:
            return Reason.EPIPOLAR
        # Noise of the difference between the sizes in the two eyes.
        size_sigma = math.hypot(*location.size_sigmas.tolist())
        sizes: list[float] = location.sizes.tolist()
        if not self._sizes_fit(sizes, size_sigma):
            return Reason.SIZE_MISMATCH
        disagreement = (
            math.log(sizes[0] / sizes[1]) / math.hypot(size_sigma, _Settings.size_tolerance),
            (vl - vr) / sigma,
        )
        # A disturbance shifts the two eyes' centres differently: it shows in the sizes and in the rows.
        # Birge's ratio, squared, minus 1, its expectation by chance.
        variance_factor = max(1.0, (disagreement[0] ** 2 + disagreement[1] ** 2) / len(disagreement) - 1.0)
        return replace(location, cov=variance_factor * location.cov)

    def _is_similar(self, one: Disc, other: Disc) -> bool:
        """Return True if two discs, one of each eye, are at the same row and of the same size."""
        size = max(one.radius_px, other.radius_px) / min(one.radius_px, other.radius_px)
        rows_px = abs(float(one.centre_px[1] - other.centre_px[1]))
        return size <= _Settings.eye_size_ratio and rows_px <= _Settings.epipolar_px

    def _sizes_fit(self, sizes: Sequence[float], sigma: float) -> bool:
        between_eyes = max(sizes) / min(sizes) / (1.0 + _Settings.epipolar_sigmas * sigma)
        against_depth = max(*sizes, 1.0 / min(sizes))
        return between_eyes <= _Settings.eye_size_ratio and against_depth <= _Settings.depth_size_ratio


def _without_reflections(found: list[Location]) -> list[Location]:
    """Return the locations without the dimmer, farther mirror images of the brightest one."""
    if len(found) < 2:
        return found
    first = max(found, key=lambda one: one.level)
    return [one for one in found if not is_reflection_of(one, first.level, float(np.linalg.norm(first.x)))]


def is_reflection_of(one: Location, level: float, distance_m: float) -> bool:
    """Return True if `one` may be the mirror image of a marker of `level` [grey levels] at `distance_m` [m]."""
    return one.level < _Settings.mirrored_light * level and float(np.linalg.norm(one.x)) > distance_m
