"""Track one ball of known size in the images of a single camera: direction, and depth from its size."""

from __future__ import annotations

import numpy as np

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray, MarkerFix, MarkerMiss, Reason, StereoFrame, frozen_array
from bodyschema.vision.config import VisionConfig
from bodyschema.vision.image_checks import check_calibration, check_images

from .blob import Disc, Region, find_patches, measure
from .colour import gate_of
from .settings import TrackSettings as _Settings
from .sphere import Pinhole


class OneEyeBallTracker:
    """Tracker of one coloured ball in the images of one camera.

    The direction is as precise as in a stereo image. The depth follows only from the ball's known radius, and nothing
    else confirms that an object is the ball. So two candidates give no fix.
    """

    def __init__(self, calibration: StereoCalibration, config: VisionConfig | None = None) -> None:
        """Prepare for images of `calibration`; raise ConfigError if it does not describe a camera."""
        check_calibration(calibration)
        self.calibration = calibration
        self.config = config or VisionConfig()
        self._gate = gate_of(self.config)
        self._eye = Pinhole(calibration.focal_px, calibration.principal_point_px)
        self._whole = Region(0, 0, *calibration.image_size_px)

    def track(self, frame: StereoFrame) -> MarkerFix | MarkerMiss:
        """Return the marker in `frame`, in the camera's optical frame, or the reason for a miss.

        Raises:
            SourceError: the image is not uint8 BGR of the calibration's size.
        """
        check_images(frame, self.calibration)
        found = self._disc(frame)
        located = self._located(found) if isinstance(found, Disc) else found
        if isinstance(located, Reason):
            return MarkerMiss(frame.t, located)
        x, cov = located
        return MarkerFix(frame.t, frozen_array(x), frozen_array(cov))

    def forget(self) -> None:
        """Do nothing: every frame is processed independently."""

    def _disc(self, frame: StereoFrame) -> Disc | Reason:
        """Return the one ball in the image, or the reason for a miss."""
        discs: list[Disc] = []
        reason = Reason.NO_MARKER
        for patch in find_patches(frame.left, self._whole, self._gate):
            outcome = measure(frame.left, patch, self._eye, self._gate, self.config)
            if isinstance(outcome, Reason):
                reason = outcome if reason is Reason.NO_MARKER else reason
            elif not any(outcome.is_same_as(disc) for disc in discs):
                discs.append(outcome)
        if len(discs) > 1:
            return Reason.AMBIGUOUS
        return discs[0] if discs else reason

    def _located(self, disc: Disc) -> tuple[FloatArray, FloatArray] | Reason:
        """Return the position (3,) [m] and its covariance (3, 3) [m²], or the reason for a miss."""
        radius_m = self.config.radius_m
        distance = radius_m * self._eye.distance_over_radius(disc.centre_px, disc.radius_px)
        sight = self._sight(disc, distance)
        for _ in range(_Settings.distance_rounds):
            outline = self._eye.outline(distance * sight, radius_m)
            if outline is None:
                return Reason.SIZE_MISMATCH
            distance *= outline.radius_px / disc.radius_px
            sight = self._sight(disc, distance)
        x = distance * sight
        # A pixel error only rotates the line of sight; the error along it comes from the size.
        across = (np.eye(3) - np.outer(sight, sight))[:, :2] * x[2] / self._eye.focal_px
        pixels = disc.cov_px + self.calibration.pixel_sigma**2 * np.eye(2)
        depth = (disc.radius_sigma_px / disc.radius_px) ** 2 + _Settings.radius_sigma**2
        return x, across @ pixels @ across.T + depth * np.outer(x, x)

    def _sight(self, disc: Disc, distance: float) -> FloatArray:
        """Return the unit vector (3,) to the ball's centre, for this distance [m]."""
        centre_px = self._eye.sphere_centre(disc.centre_px, distance / self.config.radius_m)
        ray = np.append((centre_px - np.array(self._eye.principal_point_px)) / self._eye.focal_px, 1.0)
        return ray / np.linalg.norm(ray)
