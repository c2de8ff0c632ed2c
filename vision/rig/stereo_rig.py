"""Calibration of two cameras, or of one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from bodyschema.interfaces.errors import BodyschemaError, SourceError
from bodyschema.interfaces.records import FloatArray, frozen_array

from .lens import DISTORTION_NAMES, Lens, Model

_POSE_NAMES = ("rx_rad", "ry_rad", "rz_rad", "tx_m", "ty_m", "tz_m")


class CalibrationError(BodyschemaError):
    """Cameras could not be calibrated, or a calibration does not belong to these cameras."""


class OtherCameras(CalibrationError, SourceError):
    """The cameras are not the calibrated ones: as a source they fail until the right ones are plugged in."""


@dataclass(frozen=True)
class CalibrationProvenance:
    """Provenance of a calibration."""

    date: str  # ISO 8601 in UTC
    board: str  # the calibration board
    views: int  # number of image pairs used
    left_out: int  # number of pairs left out as outliers
    reprojection_px: float  # RMS reprojection error of the corners per image coordinate, in the fit [px]
    held_out_px: float  # the same in held-out views [px]
    scale_sigma: float  # 1-sigma of the board's size, as a share of it; it is in the covariance too


@dataclass(frozen=True, eq=False)
class StereoRig:
    """Two lenses and the right eye's pose relative to the left one, with their uncertainty.

    A point x in the left eye's frame (x right, y down, z forward) is at R x + t in the right one's.
    """

    # left, right: the lenses, of one model
    left: Lens
    right: Lens
    rotation_rad: FloatArray  # rotation vector of R, shape (3,) [rad]
    translation_m: FloatArray  # t, shape (3,) [m]
    image_size_px: tuple[int, int]  # width and height of both eyes' images
    serials: tuple[str, str]  # serial numbers of the left and the right device; "" if unknown
    covariance: FloatArray  # of `vector`, shape (p, p)
    provenance: CalibrationProvenance  # provenance

    def __post_init__(self) -> None:
        for name in ("rotation_rad", "translation_m", "covariance"):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))

    @property
    def model(self) -> Model:
        """The lenses' model."""
        return self.left.model

    @property
    def vector(self) -> FloatArray:
        """All parameters: left lens, right lens, rotation vector [rad], translation [m]."""
        return np.concatenate([self.left.vector, self.right.vector, self.rotation_rad, self.translation_m])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters in `vector`."""
        return parameter_names(self.model)

    @property
    def sigma(self) -> FloatArray:
        """1-sigma of `vector`."""
        return np.sqrt(np.diag(self.covariance))

    @cached_property
    def R_right_left(self) -> FloatArray:
        """Rotation (3, 3) of directions from the left eye's frame to the right eye's."""
        return frozen_array(cv2.Rodrigues(self.rotation_rad)[0])

    @property
    def baseline_m(self) -> float:
        """Distance of the eyes [m]."""
        return float(np.linalg.norm(self.translation_m))

    @property
    def baseline_sigma_m(self) -> float:
        """Its 1-sigma [m]."""
        along = self.translation_m / self.baseline_m
        return float(np.sqrt(along @ self.covariance[-3:, -3:] @ along))

    def with_vector(self, vector: FloatArray) -> StereoRig:
        """Return the rig with other parameters, all else the same."""
        left, right, rotation, translation = split(self.model, vector)
        return StereoRig(
            left, right, rotation, translation, self.image_size_px, self.serials, self.covariance, self.provenance
        )

    def require(self, image_size_px: tuple[int, int], serials: tuple[str, ...]) -> None:
        """Raise OtherCameras if these cameras are not the calibrated ones. An unknown serial fits all."""
        _require_size(image_size_px, self.image_size_px)
        if len(serials) != len(self.serials):
            raise OtherCameras(
                "this is the calibration of two cameras, but one looks alone. Name both in [vision.cameras], or "
                "calibrate the one: `bodyschema calibrate cameras`"
            )
        if all(self.serials) and serials == self.serials[::-1] and serials != self.serials:
            raise OtherCameras(
                f"left and right are exchanged: {serials[0]} is the right camera of this calibration. Exchange "
                "left and right where the cameras are configured"
            )
        for eye, serial, known in zip(("left", "right"), serials, self.serials, strict=True):
            if known and serial and serial != known:
                raise OtherCameras(
                    f"the {eye} camera is {serial}, calibrated was {known}: this is the calibration of another pair. "
                    "Name its own file, or calibrate: `bodyschema calibrate cameras`"
                )


@dataclass(frozen=True, eq=False)
class OneEyeRig:
    """A single camera: its lens with its uncertainty."""

    left: Lens  # the lens, as that of a pair's left eye
    image_size_px: tuple[int, int]  # width and height of its images
    serials: tuple[str]  # serial number of the device; "" if unknown
    covariance: FloatArray  # of `vector`, shape (p, p)
    provenance: CalibrationProvenance  # provenance

    def __post_init__(self) -> None:
        object.__setattr__(self, "covariance", frozen_array(self.covariance))

    @property
    def model(self) -> Model:
        """The lens's model."""
        return self.left.model

    @property
    def vector(self) -> FloatArray:
        """All parameters: those of the lens."""
        return self.left.vector

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters in `vector`."""
        return tuple(f"left.{name}" for name in _lens_names(self.model))

    @property
    def sigma(self) -> FloatArray:
        """1-sigma of `vector`."""
        return np.sqrt(np.diag(self.covariance))

    def require(self, image_size_px: tuple[int, int], serials: tuple[str, ...]) -> None:
        """Raise OtherCameras if this camera is not the calibrated one. An unknown serial fits all."""
        _require_size(image_size_px, self.image_size_px)
        if len(serials) != 1:
            raise OtherCameras(
                "this is the calibration of one camera, but two look. Name one in [vision.cameras.one], or calibrate "
                "both: `bodyschema calibrate cameras`"
            )
        if self.serials[0] and serials[0] and serials != self.serials:
            raise OtherCameras(
                f"the camera is {serials[0]}, calibrated was {self.serials[0]}. Name its own file, or calibrate: "
                "`bodyschema calibrate cameras`"
            )


Rig = StereoRig | OneEyeRig


def _require_size(image_size_px: tuple[int, int], calibrated_px: tuple[int, int]) -> None:
    """Raise OtherCameras if the images differ in size from those of the calibration."""
    if image_size_px != calibrated_px:
        is_, was = ("x".join(map(str, size)) for size in (image_size_px, calibrated_px))
        raise OtherCameras(
            f"the cameras give images of {is_}, they were calibrated with {was}. Set that size, or calibrate "
            "again: `bodyschema calibrate cameras`"
        )


def _lens_names(model: Model) -> tuple[str, ...]:
    return ("fx_px", "fy_px", "cx_px", "cy_px", *DISTORTION_NAMES[model])


def parameter_names(model: Model) -> tuple[str, ...]:
    """Return the parameter names of a rig of two eyes with lenses of this model."""
    lens = _lens_names(model)
    return (*(f"left.{name}" for name in lens), *(f"right.{name}" for name in lens), *_POSE_NAMES)


def lens_of_one(model: Model, vector: FloatArray) -> Lens | None:
    """Return the lens if the vector has the parameters of a single camera, otherwise None."""
    return Lens.from_vector(model, vector) if len(vector) == len(_lens_names(model)) else None


def split(model: Model, vector: FloatArray) -> tuple[Lens, Lens, FloatArray, FloatArray]:
    """Split a vector of all parameters into left lens, right lens, rotation vector [rad] and translation [m]."""
    n = 4 + len(DISTORTION_NAMES[model])
    left, right = Lens.from_vector(model, vector[:n]), Lens.from_vector(model, vector[n : 2 * n])
    return left, right, vector[2 * n : 2 * n + 3], vector[2 * n + 3 :]


def lenses_of(model: Model, vector: FloatArray) -> tuple[Lens, ...]:
    """Return the lenses in a vector of all parameters: one, or left and right."""
    alone = lens_of_one(model, vector)
    return split(model, vector)[:2] if alone is None else (alone,)


def triangulated(rig: StereoRig, left_px: FloatArray, right_px: FloatArray) -> FloatArray:
    """Return points (n, 3) [m] in the left camera's own frame, seen at (n, 2) [px] by each eye.

    A point is the middle of the shortest line between both rays.
    """
    a = np.column_stack([rig.left.directions(left_px), np.ones(len(left_px))])
    b = np.column_stack([rig.right.directions(right_px), np.ones(len(right_px))]) @ rig.R_right_left
    eye = -rig.R_right_left.T @ rig.translation_m
    aa, bb, ab = (np.einsum("ni,ni->n", *pair) for pair in ((a, a), (b, b), (a, b)))
    ae, be = a @ eye, b @ eye
    nearness = aa * bb - ab**2
    along_a = (ae * bb - ab * be) / nearness
    along_b = (ab * ae - aa * be) / nearness
    return 0.5 * (along_a[:, None] * a + eye + along_b[:, None] * b)


def covariance_of(rig: StereoRig, figures: Callable[[StereoRig], FloatArray]) -> FloatArray:
    """Return the covariance (m, m) of figures (m,) computed from a rig, to first order."""
    vector, sigma = rig.vector, rig.sigma
    slopes = []
    for k, step in enumerate(1e-3 * sigma):
        forward, backward = (
            figures(rig.with_vector(vector + sign * step * np.eye(len(vector))[k])) for sign in (1, -1)
        )
        slopes.append((forward - backward) / (2.0 * step))
    J = np.array(slopes)
    return J.T @ rig.covariance @ J
