"""Snapshot of a model that answers queries; later learning does not change it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.errors import RequestError
from bodyschema.interfaces.records import FloatArray
from bodyschema.learning.model_bank import LearntModel
from bodyschema.learning.orientation import MEAN_OVER_RMS, OrientationModel
from bodyschema.learning.solvers.solver import SolverSettings
from bodyschema.learning.uncertainty import PredictiveUncertainty
from bodyschema.learning.variance_terms import unexplained
from kbmaps import KBMap, SupportSet, quaternions

IN_SUPPORT = 0.25  # with a larger share of the prior's variance remaining, joint angles are not in the data's support


class NoFrameError(RequestError):
    """There is no model yet: the frame of the positions is unknown."""


@dataclass(frozen=True)
class Prediction:
    """Marker positions for a batch of joint angles."""

    x: FloatArray  # positions in the measurement frame (n, 3) [m]
    sigma: FloatArray  # their 1-sigma per axis (n, 3) [m]
    in_support: NDArray[np.bool_]  # True for each row near data (n,)
    # orientations in the measurement frame, quaternions x, y, z, w (n, 4); None if none are learnt
    R: FloatArray | None = None
    # their 1-sigma about each axis of the measurement frame (n, 3) [rad]; None likewise
    sigma_R: FloatArray | None = None


@dataclass(frozen=True)
class Snapshot:
    """Answering model at one moment."""

    answering: str  # its name
    model: LearntModel | None  # None while the frame is not known
    map: KBMap | None  # the best of the models that are KB-Maps, for export to a file; mostly the same one
    uncertainty: PredictiveUncertainty
    support: SupportSet | None  # support of the data with the current tool; None without data
    pairs: int  # number of pairs it had learnt
    newest_utc: str | None  # storage time of the last of them, ISO 8601; None before any since the learner started
    waiting_for: str  # missing information while there is no model
    orientation: OrientationModel | None = None  # the model of the marker's orientation; None if none was learnt
    # variance (n, 3) [m²] at positions (n, 3) [m] of errors that all pairs share, so that no pair shows them
    common: Callable[[FloatArray], FloatArray] | None = None

    @cached_property
    def digest(self) -> str:
        """Hash of the model; empty without one."""
        return self.model.digest if self.model is not None else ""

    def require_model(self) -> LearntModel:
        """Return the model; raise NoFrameError if there is none yet."""
        if self.model is None:
            raise NoFrameError(self.waiting_for)
        return self.model

    def require_map(self) -> KBMap:
        """Return the best KB-Map, with the planes of e1, e2, e3 if learnt; raise NoFrameError if there is none yet."""
        if self.map is None:
            raise NoFrameError(self.waiting_for)
        orientation = self.orientation
        return (
            self.map
            if orientation is None or self.map.size > SolverSettings.largest_net
            else orientation.with_orientation(self.map)
        )

    def predict(self, q: FloatArray) -> Prediction:
        """Return predictions for joint angles q (n, d) [rad].

        Raises:
            NoFrameError: there is no model.
            RequestError: an answer would not be a number.
        """
        x = self.require_model().predict(q)
        shared = 0.0 if self.common is None else self.common(x)
        sigma, in_support = np.sqrt(self.uncertainty.variance(q) + shared), unexplained(self.support, q) < IN_SUPPORT
        if not (np.isfinite(x).all() and np.isfinite(sigma).all()):
            raise RequestError("the model has no finite answer at these joint angles; angles are in radians")
        if self.orientation is None:
            return Prediction(x, sigma, in_support)
        rotations, variance = self.orientation.predict(q)
        return Prediction(x, sigma, in_support, quaternions(rotations), np.sqrt(variance))

    def expected_error_m(self, q: FloatArray) -> float:
        """Return the expected mean distance [m] to noise-free camera measurements, at q (n, d) [rad]."""
        return MEAN_OVER_RMS * float(np.sqrt(self.uncertainty.variance(q).sum(axis=1)).mean())

    def common_error_m(self, q: FloatArray) -> float | None:
        """Return the expected mean error [m] that all pairs share, at q (n, d) [rad]; None if unknown."""
        if self.common is None:
            return None
        return MEAN_OVER_RMS * float(np.sqrt(self.common(self.require_model().predict(q)).sum(axis=1)).mean())
