"""Tracker of a coloured ball in the images of two eyes: a marker fix, or the reason for a miss."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

import numpy as np

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import (
    FloatArray,
    ImageArray,
    MarkerFix,
    MarkerMiss,
    Reason,
    StereoFrame,
    frozen_array,
)
from bodyschema.vision.config import LONGEST_PAUSE_S, VisionConfig
from bodyschema.vision.image_checks import check_calibration, check_images
from bodyschema.vision.triangulate import Location

from .blob import Disc, Patch, Region, find_patches, measure, patch_at, rough_disc
from .colour import gate_of
from .match import StereoMatcher, is_reflection_of
from .settings import ContourSettings
from .settings import TrackSettings as _Settings
from .size import BallSize
from .sphere import Pinhole

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Track:
    """Track of the marker: time [s], (ul, vl, ur, vr) [px], their velocity [px/s], larger radius of the two [px]."""

    t: float
    centres_px: FloatArray
    velocity_px_s: FloatArray
    radius_px: float


@dataclass(frozen=True, slots=True)
class _Prediction:
    """Predicted image of the tracked marker in one eye: search region, centre (2,) [px] and radius [px]."""

    region: Region
    centre_px: FloatArray
    radius_px: float

    def fits(self, disc: Disc | Patch) -> bool:
        """Return True if a disc agrees with the prediction in this eye."""
        apart_px = max(float(np.linalg.norm(disc.centre_px - self.centre_px)), abs(disc.radius_px - self.radius_px))
        return apart_px < _Settings.prediction_tolerance * self.radius_px


@dataclass(frozen=True, slots=True)
class _LastFix:
    """Last fix: time [s], position (3,) [m], level of its colour [grey levels]."""

    t: float
    x: FloatArray
    level: float


@dataclass(frozen=True, slots=True)
class _RejectedCandidate:
    """Last rejected candidate: time [s], position (3,) [m], level [grey levels], and the reason."""

    t: float
    x: FloatArray
    level: float
    reason: Reason


@dataclass(frozen=True, slots=True)
class _Sighting:
    """Disc in a frame without a fix: time [s], distance of a marker of its size [m], level of its colour."""

    t: float
    distance_m: float
    level: float


class StereoTracker:
    """Tracker of one coloured ball in rectified stereo images.

    It searches near the position predicted from the last frames, otherwise in the whole images. `track` always returns
    a fix or the reason for a miss.
    """

    def __init__(self, calibration: StereoCalibration, config: VisionConfig | None = None) -> None:
        """Prepare for images of `calibration`; raise ConfigError if it does not describe a stereo pair."""
        check_calibration(calibration)
        self.calibration = calibration
        self.config = config or VisionConfig()
        self._gate = gate_of(self.config)
        self._eye = Pinhole(calibration.focal_px, calibration.principal_point_px)
        self._matcher = StereoMatcher(calibration, self.config)
        self._size = BallSize(calibration)
        width, height = calibration.image_size_px
        self._whole = Region(0, 0, width, height)
        self._track: _Track | None = None
        self._last: _LastFix | None = None
        self._rejected: _RejectedCandidate | None = None
        self._ambiguous_t = -math.inf
        self._recent_sightings: tuple[_Sighting, ...] = ()
        self._fixes = 0
        self._blur_px = (
            ContourSettings.usual_blur_px
        )  # blur of the marker's contour, from its last predicted image [px]

    def track(self, frame: StereoFrame) -> MarkerFix | MarkerMiss:
        """Return the marker in `frame`, in the left optical frame, or the reason for a miss.

        Raises:
            SourceError: the images are not uint8 BGR of the calibration's size.
        """
        check_images(frame, self.calibration)
        expected = self._predicted(frame.t)
        found = self._search(frame, *expected) if expected else None
        if not isinstance(found, Location):
            found = self._search(frame, None, None)
            if found is Reason.AMBIGUOUS:
                self._ambiguous_t = frame.t
        if isinstance(found, Location):
            found = self._contradiction(frame.t, found) or found
        if isinstance(found, Reason):
            if self._track is not None:
                _log.debug("marker lost at %.3f s: %s", frame.t, found)
            self._track = None
            return MarkerMiss(frame.t, found)
        self._ambiguous_t = -math.inf
        found = self._size.with_size_error(found)
        self._size.learn(found)
        self._remember(frame.t, found)
        self._adapt_colour(frame, found)
        ul, vl, ur, vr = (float(value) for value in found.centres_px)
        return MarkerFix(frame.t, frozen_array(found.x), frozen_array(found.cov), (ul, vl, ur, vr))

    def forget(self) -> None:
        """Search the whole images next time."""
        self._track = self._last = self._rejected = None
        self._ambiguous_t, self._recent_sightings = -math.inf, ()
        self._blur_px = ContourSettings.usual_blur_px
        self._gate.reset()
        self._size.forget()

    def _search(
        self, frame: StereoFrame, in_left: _Prediction | None, in_right: _Prediction | None
    ) -> Location | Reason:
        """Return the marker near its prediction, otherwise anywhere in view."""
        left_image, right_image = frame.images
        left, left_rough = self._discs(left_image, in_left)
        if left is Reason.NO_MARKER:
            return left
        right, right_rough = self._discs(right_image, in_right)
        lefts, rights = (
            rough if isinstance(discs, Reason) else discs + rough
            for discs, rough in ((left, left_rough), (right, right_rough))
        )
        if isinstance(left, Reason):
            answer = left
        elif isinstance(right, Reason):
            answer = right
        else:
            answer = self._matcher.match(left, right)
        # The marker may be the one of two that could not be measured in both eyes.
        if isinstance(answer, Location):
            answer = self._ambiguity(frame, answer, lefts, rights) or answer
        if isinstance(answer, Reason):
            self._recent_sightings = (
                tuple(self._sighting(frame.t, disc) for disc in (*lefts, *rights)) or self._recent_sightings
            )
        return answer

    def _ambiguity(self, frame: StereoFrame, found: Location, left: list[Disc], right: list[Disc]) -> Reason | None:
        """Return the reason why another object in view, measured or not, may be the marker instead."""
        reason = self._matcher.ambiguity(found, left, right)
        if reason is not None:
            return reason
        left_image, right_image = frame.images
        eyes = ((left, right, right_image, found.centres_px[:2]), (right, left, left_image, found.centres_px[2:]))
        for discs, others, image, centre_px in eyes:
            rest = [disc for disc in discs if np.linalg.norm(disc.centre_px - centre_px) > disc.radius_px]
            if not rest:
                continue
            mask = self._gate.mask(image)
            if any(
                self._matcher.may_be_second_marker(disc, others, mask, found, in_left=discs is left) for disc in rest
            ):
                return Reason.AMBIGUOUS
        return None

    def _discs(self, image: ImageArray, expected: _Prediction | None) -> tuple[list[Disc] | Reason, list[Disc]]:
        """Return the discs in one eye, or the reason for none, and the round objects that could not be measured.

        Once a disc fits the prediction, patches that are not whole are skipped.
        """
        region = self._whole if expected is None else expected.region
        patches = find_patches(image, region, self._gate)
        discs: list[Disc] = []
        rough: list[Disc] = []
        reason: Reason | None = None
        if expected is not None and not any(patch.is_whole and expected.fits(patch) for patch in patches):
            # The background of the ball has its colour, too.
            found = self._disc_at_prediction(image, expected)
            discs += [] if found is None else [found]
        for patch in patches:
            if any(np.linalg.norm(patch.centre_px - disc.centre_px) < disc.radius_px for disc in discs):
                continue
            if expected is not None and not patch.is_whole and any(expected.fits(disc) for disc in discs):
                continue
            outcome = self._measure_patch(image, patch, expected)
            if isinstance(outcome, Reason):
                reason = reason or outcome
                round_object = rough_disc(image, patch, self._gate)
                rough += [round_object] if round_object else []
            elif not any(outcome.is_same_as(disc) for disc in discs):
                discs.append(outcome)
        return discs or reason or Reason.NO_MARKER, rough

    def _disc_at_prediction(self, image: ImageArray, expected: _Prediction) -> Disc | None:
        """Return the marker if it can be measured from its predicted circle."""
        patch = patch_at(image, expected.centre_px, expected.radius_px, self._gate)
        outcome = None if patch is None else self._measure_patch(image, patch, expected)
        return outcome if isinstance(outcome, Disc) and expected.fits(outcome) else None

    def _measure_patch(self, image: ImageArray, patch: Patch, expected: _Prediction | None) -> Disc | Reason:
        """Return the ball at a patch, or the reason for none; start from its last blur if it is expected there."""
        blur_px = ContourSettings.usual_blur_px if expected is None else self._blur_px
        outcome = measure(image, patch, self._eye, self._gate, self.config, blur_px)
        if isinstance(outcome, Disc) and expected is not None and expected.fits(outcome):
            self._blur_px = outcome.blur_px
        return outcome

    def _predicted(self, t: float) -> tuple[_Prediction, _Prediction] | None:
        track = self._track
        if track is None or not 0 < t - track.t <= LONGEST_PAUSE_S:
            return None
        step = track.velocity_px_s * (t - track.t)
        half = (
            _Settings.region_radii * track.radius_px
            + _Settings.region_px
            + _Settings.region_steps * float(np.abs(step).max())
        )
        centres = (track.centres_px + step).reshape(2, 2)
        left, right = (self._region(centre, half) for centre in centres)
        if left is None or right is None:
            return None
        return _Prediction(left, centres[0], track.radius_px), _Prediction(right, centres[1], track.radius_px)

    def _region(self, centre_px: FloatArray, half_px: float) -> Region | None:
        width, height = self.calibration.image_size_px
        low = np.clip(np.floor(centre_px - half_px), 0, (width, height)).astype(int)
        high = np.clip(np.ceil(centre_px + half_px) + 1, 0, (width, height)).astype(int)
        return Region(*low.tolist(), *high.tolist()) if (high > low).all() else None

    def _contradiction(self, t: float, found: Location) -> Reason | None:
        """Return the reason why the detection contradicts the recent track, or None."""
        last = self._last
        if last is None or not 0 <= t - last.t <= _Settings.longest_memory_s:
            return self._contradiction_without_track(t, found)
        reason = self._size.contradicts(found)
        if reason is not None:
            return reason
        reason = self._rejected_again(t, found)
        if reason is None:
            is_copy = is_reflection_of(found, last.level, float(np.linalg.norm(last.x)))
            is_near_last = float(np.linalg.norm(found.x - last.x)) <= _Settings.copy_radii * self.config.radius_m
            if self._within_reach(found.x, last.x, t - last.t) and (is_near_last or not is_copy):
                return None
            reason = Reason.REFLECTION if is_copy else Reason.IMPLAUSIBLE_SPEED
        self._rejected = _RejectedCandidate(t, found.x, found.level, reason)
        return reason

    def _rejected_again(self, t: float, found: Location) -> Reason | None:
        """Return the reason of a recent refusal if this is the same object, otherwise None."""
        rejected = self._rejected
        if rejected is None or not 0 <= t - rejected.t <= LONGEST_PAUSE_S:
            return None
        is_similar = max(found.level, rejected.level) < _Settings.level_ratio * min(found.level, rejected.level)
        return rejected.reason if is_similar and self._within_reach(found.x, rejected.x, t - rejected.t) else None

    def _within_reach(self, x: FloatArray, from_x: FloatArray, seconds: float) -> bool:
        """Return True if an object can have moved from `from_x` to `x` (3,) [m] in that time."""
        reach_m = _Settings.jump_radii * self.config.radius_m + _Settings.fastest_m_s * min(
            seconds, _Settings.fair_pause_s
        )
        return float(np.linalg.norm(x - from_x)) <= reach_m

    def _contradiction_without_track(self, t: float, found: Location) -> Reason | None:
        """Return the reason why a detection without a recent track may not be the marker, or None."""
        if 0 <= t - self._ambiguous_t <= _Settings.longest_memory_s:
            # One of two similar objects has disappeared; the remaining one may be the wrong one.
            return Reason.AMBIGUOUS
        is_copy = any(
            0 <= t - seen.t <= _Settings.longest_memory_s
            and is_reflection_of(found, seen.level, _Settings.depth_size_ratio * seen.distance_m)
            for seen in self._recent_sightings
        )
        return Reason.REFLECTION if is_copy else None

    def _sighting(self, t: float, disc: Disc) -> _Sighting:
        radii = self._eye.distance_over_radius(disc.centre_px, disc.radius_px)
        return _Sighting(t, radii * self.config.radius_m, disc.level)

    def _remember(self, t: float, found: Location) -> None:
        velocity = np.zeros(4)
        if self._track is not None and 0 < t - self._track.t <= LONGEST_PAUSE_S:
            velocity = (found.centres_px - self._track.centres_px) / (t - self._track.t)
        radius_px = self.calibration.focal_px * self.config.radius_m / float(found.x[2])
        self._last, self._rejected = _LastFix(t, found.x, found.level), None
        self._track = _Track(t, found.centres_px, velocity, radius_px)

    def _adapt_colour(self, frame: StereoFrame, found: Location) -> None:
        """At intervals, let the colour gate learn from the middle of the ball in the left image."""
        self._fixes += 1
        if self._fixes % _Settings.colour_every:
            return
        half = max(1.0, 0.5 * self.calibration.focal_px * self.config.radius_m / float(found.x[2]))
        middle = self._region(found.centres_px[:2], half)
        if middle is not None:
            self._gate.adapt(middle.crop(frame.left))
