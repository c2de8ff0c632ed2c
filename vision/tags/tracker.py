"""Track the pose of a tag, or of a rigid cluster of tags, in rectified images of one or two eyes."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import cv2
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
from bodyschema.vision.config import LONGEST_PAUSE_S
from bodyschema.vision.image_checks import check_calibration, check_images
from bodyschema.vision.pose import Pose, PoseEstimator, Sighting, angle_between, fitted_motion, initial_poses, mirrored
from bodyschema.vision.triangulate import triangulate

from .body import TagBody, bends
from .chessboard import ChessboardFinder
from .config import TagConfig
from .finder import Seen, TagFinder
from .image import TagImage
from .settings import TagSettings as _Settings

_log = logging.getLogger(__name__)

# Reasons, the most informative first, for a frame in which all tags were rejected.
_REASON_PRIORITY = (
    Reason.AMBIGUOUS,
    Reason.EPIPOLAR,
    Reason.OCCLUDED,
    Reason.NOT_STRAIGHT,
    Reason.BLURRED,
    Reason.LOW_CONTRAST,
    Reason.REPROJECTION,
    Reason.AT_BORDER,
    Reason.NO_MARKER,
)


class TagTracker:
    """Tracker of one marker made of tags in rectified images of one or two eyes.

    It searches near the marker's last position, otherwise in the whole images. `track` always returns a fix or the
    reason for a miss.

    A small plane looks nearly the same tilted to either side. Two eyes nearly always resolve this, one eye does not.
    Then the pose of the previous frame decides if it was unambiguous; otherwise the frame is ambiguous.
    """

    def __init__(
        self,
        calibration: StereoCalibration,
        body: TagBody,
        config: TagConfig | None = None,
        finder: ChessboardFinder | None = None,
        readout_s: float = 0.0,
        readout_sigma_s: float = 0.0,
    ) -> None:
        """Prepare for images of `calibration`, whose first and last rows are exposed `readout_s` [s] apart.

        If the readout is unknown, `readout_s` is 0 and `readout_sigma_s` its RMS.

        Raises:
            ConfigError: the calibration does not describe cameras, or a tag's number is not in the dictionary.
        """
        check_calibration(calibration)
        self.calibration, self.body, self.config = calibration, body, config or TagConfig()
        self._finder = finder or TagFinder(self.config, body.corners)
        self._bends = bends(body.corners[0]) if isinstance(finder, ChessboardFinder) else None
        self._whole = (0, 0, *calibration.image_size_px)
        self._is_known, self._readout_s, self._t_sigma = not readout_sigma_s, readout_s or readout_sigma_s, 0.0
        self._last: tuple[float, list[dict[int, FloatArray]], FloatArray] | None = None
        self._seen: tuple[float, list[dict[int, FloatArray]]] = -math.inf, []  # with refused frames
        self._previous = self._seen
        self._planes: dict[frozenset[int], tuple[FloatArray, FloatArray]] = {}
        self._was_found = False  # a marker found before is neither mirrored nor of another dictionary

    def track(self, frame: StereoFrame) -> MarkerFix | MarkerMiss:
        """Return the marker in `frame`, in the left optical frame, or the reason for a miss.

        Raises:
            SourceError: the images are not uint8 BGR of the calibration's size.
        """
        check_images(frame, self.calibration)
        self._previous = self._seen
        greys = [np.asarray(cv2.cvtColor(eye, cv2.COLOR_BGR2GRAY), np.uint8) for eye in frame.images]
        found: Pose | Reason = Reason.NO_MARKER
        regions = self._predicted(frame.t)
        if regions is not None:
            found = self._search(frame.t, greys, regions)
        if not isinstance(found, Pose):
            found = self._search(frame.t, greys, [self._whole] * len(greys))
        if found is Reason.NO_MARKER and not self._was_found:
            found = self._finder.suspicion(greys[0]) or found
        if isinstance(found, Reason):
            if self._last is not None:
                _log.debug("marker lost at %.3f s: %s", frame.t, found)
            self._last = None
            return MarkerMiss(frame.t, found)
        return self._fix(frame.t, found)

    def forget(self) -> None:
        """Search the whole images next time."""
        self._last, self._seen = None, (-math.inf, [])

    def _fix(self, t: float, pose: Pose) -> MarkerFix:
        ul, vl, ur, vr = self.calibration.project(pose.x).tolist()
        centres = (ul, vl, ur, vr) if self.calibration.is_stereo else None
        cov, cov_R = frozen_array(pose.cov[3:, 3:]), frozen_array(pose.cov[:3, :3])
        turn = frozen_array(_quaternion(pose.rotation))
        return MarkerFix(t, frozen_array(pose.x), cov, centres, self._t_sigma, R=turn, cov_R=cov_R)

    def _search(
        self, t: float, greys: Sequence[ImageArray], regions: Sequence[tuple[int, int, int, int]]
    ) -> Pose | Reason:
        found = [self._finder.find(grey, region) for grey, region in zip(greys, regions, strict=True)]
        seen = [{id: tag for id, tag in eye.items() if isinstance(tag, TagImage)} for eye in found]
        if not all(seen):
            return _best_reason(eye for eye, tags in zip(found, seen, strict=True) if not tags)
        if len(seen) > 1:
            if seen[0].keys().isdisjoint(seen[1]):
                return _best_reason(found)
            seen = self._consistent_tags(*seen)
            if isinstance(seen, Reason):
                return seen
        corners = [{id: tag.corners_px for id, tag in eye.items()} for eye in seen]
        self._seen = t, corners
        pose = self._pose(t, self._readout_corrected(t, seen) if self._readout_s else seen)
        if isinstance(pose, Pose):
            self._last, self._was_found = (t, corners, pose.rotation), True
        return pose

    def _readout_corrected(self, t: float, seen: list[dict[int, TagImage]]) -> list[dict[int, TagImage]]:
        """Return the tags with their corners at the time when the rolling shutter read the marker's middle row.

        Each corner is assumed to move as since the last frame. New tags are not moved, and the time is uncertain. If
        the readout is unknown, no corners are moved, and `skew_px` is the shift for a readout of 1 sigma.
        """
        row_s = self._readout_s / self.calibration.image_size_px[1]
        middle = np.mean([tag.corners_px[:, 1].mean() for eye in seen for tag in eye.values()])
        last_t, last = self._previous
        if not 0 < t - last_t <= LONGEST_PAUSE_S:
            last = []
        moved, self._t_sigma = [], 0.0
        for eye, previous in zip(seen, last or [{}] * len(seen), strict=True):
            tags = dict(eye)
            if eye.keys() - previous.keys():
                self._t_sigma = self._readout_s
            for id in eye.keys() & previous.keys():
                px = eye[id].corners_px
                since_s = t - last_t + row_s * (px[:, 1:] - previous[id][:, 1:])
                late_s = row_s * (px[:, 1:] - middle)
                skew_px = late_s * (px - previous[id]) / since_s
                tags[id] = (
                    replace(eye[id], corners_px=px - skew_px) if self._is_known else replace(eye[id], skew_px=skew_px)
                )
            moved.append(tags)
        return moved

    def _consistent_tags(
        self, left: dict[int, TagImage], right: dict[int, TagImage]
    ) -> list[dict[int, TagImage]] | Reason:
        """Return both eyes' tags, some of them common, without those whose rows differ."""
        both = left.keys() & right.keys()
        mismatched = {id for id in both if not self._rows_agree(left[id], right[id])}
        if mismatched.issuperset(both):
            return Reason.EPIPOLAR
        return [{id: tag for id, tag in eye.items() if id not in mismatched} for eye in (left, right)]

    def _rows_agree(self, left: TagImage, right: TagImage) -> bool:
        """Return True if the rows of a tag's corners differ by no more than noise, and its disparity is positive."""
        disparity = left.corners_px - right.corners_px
        rows = np.arange(1, len(left.cov_px), 2)
        cov = (left.cov_px + right.cov_px)[np.ix_(rows, rows)]
        sigma = math.sqrt(float(cov.mean()) + 2.0 * self.calibration.pixel_sigma**2)
        allowed = _Settings.epipolar_px + _Settings.epipolar_sigmas * sigma
        return abs(float(disparity[:, 1].mean())) <= allowed and bool((disparity[:, 0] > 0.0).all())

    def _pose(self, t: float, seen: list[dict[int, TagImage]]) -> Pose | Reason:
        """Return the one likely pose; a tag that contradicts the others is left out once."""
        found = self._most_likely_pose(t, seen)
        if isinstance(found, Pose) or found is not Reason.REPROJECTION or len(_ids(seen)) < 3:
            return found
        outcomes = []
        for id in sorted(_ids(seen)):
            others = [{key: tag for key, tag in eye.items() if key != id} for eye in seen]
            if others[0].keys() & others[-1].keys():
                outcomes.append(self._most_likely_pose(t, others))
        poses = [outcome for outcome in outcomes if isinstance(outcome, Pose)]
        return min(poses, key=lambda pose: pose.squares) if poses else found

    def _most_likely_pose(self, t: float, seen: list[dict[int, TagImage]]) -> Pose | Reason:
        sightings = [
            Sighting(self.body.corners[id], tag.corners_px, tag.cov_px, bool(eye), tag.skew_px)
            for eye, tags in enumerate(seen)
            for id, tag in tags.items()
        ]
        estimator = PoseEstimator(self.calibration, sightings)
        poses = self._minima(estimator, seen)
        if not poses:
            return Reason.EPIPOLAR if self.calibration.is_stereo else Reason.REPROJECTION
        best = poses[0]
        freedom = sum(sighting.pixels.size for sighting in sightings) - 6
        chi2_per_freedom, limit = best.squares / freedom, _Settings.max_reprojection**2
        if self.calibration.is_stereo:
            size_error, sigma = estimator.size_error(best)
            by_size = (
                chi2_per_freedom > limit and size_error**2 > 0.5 * best.squares * sigma**2
            )  # the larger part of the misfit
            if by_size or abs(size_error) > _Settings.size_tolerance + 4.0 * sigma:
                return Reason.SIZE_MISMATCH
        if chi2_per_freedom > limit:
            return Reason.REPROJECTION
        if len(poses) > 1 and (poses[1].squares - best.squares) / max(chi2_per_freedom, 1.0) < _Settings.clearly_worse:
            consistent = self._consistent_pose(t, poses[:2])
            if consistent is None:
                return Reason.AMBIGUOUS
            best = consistent
        # The part of the misfit beyond the claimed noise and chance (2-sigma) is treated as more noise.
        unexplained = max(chi2_per_freedom - 2.0 * math.sqrt(2.0 / freedom), 1.0)
        return Pose(best.rotation, best.x, best.cov * unexplained, best.squares)

    def _minima(self, estimator: PoseEstimator, seen: list[dict[int, TagImage]]) -> list[Pose]:
        """Return the distinct local minima of the squares, the most likely first."""
        poses: list[Pose] = []
        for rotation, x in self._initial_poses(seen):
            for turn in (rotation, self._mirrored(rotation, x, seen)):
                pose = estimator.refine(turn, x)
                if pose is not None and self._bends is not None:
                    pose = estimator.bent(pose, self._bends)
                if pose is not None and all(
                    angle_between(pose.rotation, other.rotation) > _Settings.two_poses_rad for other in poses
                ):
                    poses.append(pose)
        return sorted(poses, key=lambda pose: pose.squares)

    def _consistent_pose(self, t: float, poses: Sequence[Pose]) -> Pose | None:
        """Return the pose, of two, that is consistent with the last frame; None if that is unclear."""
        if self._last is None or not 0 < t - self._last[0] <= LONGEST_PAUSE_S:
            return None
        turned = [angle_between(self._last[2], pose.rotation) for pose in poses]
        nearest = int(np.argmin(turned))
        separation = angle_between(poses[0].rotation, poses[1].rotation)
        return poses[nearest] if turned[nearest] < _Settings.stayed * separation else None

    def _initial_poses(self, seen: list[dict[int, TagImage]]) -> list[tuple[FloatArray, FloatArray]]:
        """Return initial poses from the corners that all eyes see."""
        if not self.calibration.is_stereo:
            ids = list(seen[0])
            corners = np.concatenate([self.body.corners[id] for id in ids])
            return initial_poses(self.calibration, corners, np.concatenate([seen[0][id].corners_px for id in ids]))
        body, points = [], []
        for id in sorted(seen[0].keys() & seen[1].keys()):
            pixels = np.hstack([seen[0][id].corners_px, seen[1][id].corners_px])
            for corner, centres in zip(self.body.corners[id], pixels, strict=True):
                located = triangulate(self.calibration, centres, np.ones(4))
                if located is not None:
                    body.append(corner)
                    points.append(located[0])
        return [fitted_motion(np.array(body), np.array(points))] if len(points) >= 3 else []

    def _mirrored(self, rotation: FloatArray, x: FloatArray, seen: list[dict[int, TagImage]]) -> FloatArray:
        """Return the mirrored rotation, under which the (best-fitting) plane of the corners looks nearly the same."""
        middle, axes = self._plane(frozenset(_ids(seen)))
        return mirrored(rotation @ axes, x + rotation @ middle) @ axes.T

    def _plane(self, ids: frozenset[int]) -> tuple[FloatArray, FloatArray]:
        """Return the middle (3,) of some tags' corners, and axes (3, 3) of their plane, whose normal is the last."""
        if ids not in self._planes:
            corners = np.concatenate([self.body.corners[id] for id in sorted(ids)])
            middle = corners.mean(axis=0)
            axes = np.linalg.svd(corners - middle)[2].T
            axes[:, 2] *= np.sign(np.linalg.det(axes))
            self._planes[ids] = middle, axes
        return self._planes[ids]

    def _predicted(self, t: float) -> list[tuple[int, int, int, int]] | None:
        if self._last is None or not 0 < t - self._last[0] <= LONGEST_PAUSE_S:
            return None
        width, height = self.calibration.image_size_px
        regions = []
        for eye in self._last[1]:
            corners = np.concatenate(list(eye.values()))
            low, high = corners.min(axis=0), corners.max(axis=0)
            room = _Settings.region_share * (high - low).max() + _Settings.region_px
            low, high = np.floor(low - room).astype(int), np.ceil(high + room).astype(int)
            regions.append((max(low[0], 0), max(low[1], 0), min(high[0], width), min(high[1], height)))
        return regions


def _ids(seen: Iterable[dict[int, TagImage]]) -> set[int]:
    """Return the tag numbers seen by any eye."""
    return set[int]().union(*seen)


def _best_reason(eyes: Iterable[Seen]) -> Reason:
    """Return the most informative reason why tags were not measured; NO_MARKER if none was found."""
    reasons = {tag for eye in eyes for tag in eye.values() if isinstance(tag, Reason)}
    return next((reason for reason in _REASON_PRIORITY if reason in reasons), Reason.NO_MARKER)


def _quaternion(rotation: FloatArray) -> FloatArray:
    """Return the quaternion (4,) of a rotation (3, 3), its real part last and not negative."""
    vector = np.ravel(np.asarray(cv2.Rodrigues(rotation)[0], np.float64))
    angle = math.hypot(*vector)
    return np.append(0.5 * np.sinc(0.5 * angle / math.pi) * vector, math.cos(0.5 * angle))
