"""Tool or marker offset on a known arm: three numbers, learnt from single pairs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Protocol, Self, cast, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import BoolArray, FloatArray, frozen, rows, rows_or_vector
from kbmaps.chains.carried import packable, unpacked
from kbmaps.chains.chain import RigidChain
from kbmaps.chains.marker_fit import MarkerKnowledge, MarkerPosterior, Residuals, fit_marker
from kbmaps.chains.rigid_filter import NOISE_COORDINATES
from kbmaps.errors import DegenerateDataError, ModelFormatError, SettingError
from kbmaps.maps.kbmap import POSITION_OUTPUTS, KBMap
from kbmaps.model import Estimate, Model, PoseModel
from kbmaps.packed import complete, count, named, numbers, or_infinite, pack, restoring, unless_infinite, unpack
from kbmaps.pairs import checked_pairs
from kbmaps.robust import UNCALIBRATED_SIGMAS

_KIND = "tool layer, 1"
# Finite stand-in for an infinite spread [m].
_WIDE = 1e6
# Number of pairs kept to judge outliers; older ones remain in sums.
_RECENT = 128
_RESIDUALS = ("rotations", "residuals", "sigma")
_SUMS = ("information", "pull", "square", "inner")
_NUMBERS = ("errors", "count", "noise_count", "noise_square")


@runtime_checkable
class _Estimating(Protocol):
    """Model with an uncertainty."""

    def estimate(self, q: ArrayLike) -> Estimate:
        """Return positions at q (n, d) with their uncertainty."""
        ...


class ToolLayer(Model):
    """Adds a marker offset to a fixed model: f(q) + R(q) δ, with δ in the marker's frame.

    δ is learnt by least squares. The pairs enter through sums, at a constant cost and memory; outliers are judged among
    the last 128 or more. The result is the posterior of a Gaussian δ, with the noise that maximises the evidence where
    none was given. The order of the pairs does not matter, except for the outliers among the older ones.

    Args:
        model: an arm with orientations: a `RigidChain`, a `KBMap` that has them, or any `PoseModel`; it must not
            change.
        spread: 1-sigma of each component of δ before the first pair [m]; infinity leaves it to the pairs alone.
        noise: initial 1-sigma of a coordinate where pairs come without their sigma [m].
        outlier_sigmas: pairs farther off than this many robust standard deviations do not count.

    Raises:
        SettingError: one of these is not positive.
        ShapeError: a `KBMap` without orientation.
    """

    def __init__(
        self,
        model: PoseModel,
        *,
        spread: float = 1.0,
        noise: float = 0.01,
        outlier_sigmas: float = 6.0,
    ) -> None:
        if not (noise > 0.0 and math.isfinite(noise)):
            raise SettingError(f"noise must be finite and greater than 0 m, got {noise!r}")
        if not outlier_sigmas > 0.0:
            raise SettingError(f"outlier_sigmas must be greater than 0, got {outlier_sigmas!r}")
        self._model: PoseModel = model
        self._outlier_sigmas = float(outlier_sigmas)
        covariance = np.eye(3) * _checked_spread("spread", spread) ** 2
        self._before = MarkerKnowledge.before(np.zeros(3), covariance, noise, NOISE_COORDINATES)
        self._recent = self._residuals(np.empty((0, self.joints)), np.empty((0, 3)), np.empty(0))
        self._pairs = 0
        self._moved: KBMap | RigidChain | None = None
        self._fit: tuple[MarkerKnowledge, MarkerPosterior, BoolArray] | None = None

    @property
    def joints(self) -> int:
        return self._model.joints

    @property
    def pairs(self) -> int:
        """Number of learnt pairs, those before a tool change included."""
        return self._pairs

    @property
    def shift(self) -> FloatArray:
        """δ (3,) [m] in the marker's frame (read-only)."""
        return frozen(self._posterior().shift)

    @property
    def covariance(self) -> FloatArray:
        """Covariance (3, 3) [m²] of δ (read-only)."""
        return frozen(self._posterior().covariance)

    @property
    def noise(self) -> float:
        """Estimated 1-sigma of a coordinate [m] of the pairs that came without theirs."""
        return self._posterior().noise

    @property
    def inliers(self) -> BoolArray:
        """True for each recent pair (n,) that is not an outlier."""
        return self._fitted()[2].copy()

    def learn(self, q: ArrayLike, x: ArrayLike, sigma: ArrayLike | None = None) -> None:
        angles, positions, sigmas = checked_pairs(q, x, sigma, self.joints)
        self._recent = self._recent.joined(self._residuals(angles, positions, sigmas))
        self._pairs += len(angles)
        self._fit = None
        if len(self._recent) >= 2 * _RECENT:
            self._sum_up()

    def tool_changed(self, tolerance: float) -> None:
        """Allow for a marker that was moved, by `tolerance` (1-sigma of each component [m]); keep the noise estimate.

        Raises:
            SettingError: the tolerance is not positive.
        """
        moved = np.eye(3) * _checked_spread("tolerance", tolerance) ** 2
        known, posterior, _ = self._fitted()
        coordinates = known.noise_count + 3.0 * known.count
        self._before = MarkerKnowledge.before(
            posterior.shift, posterior.covariance + moved, posterior.noise, coordinates
        )
        self._recent, self._fit = self._recent[:0], None

    def predict(self, q: ArrayLike) -> FloatArray:
        angles = rows_or_vector("q", q, self.joints)
        return self._model.predict(angles) + self._model.orientation(angles) @ self._posterior().shift

    def jacobian(self, q: ArrayLike) -> FloatArray:
        """Return the derivative (3, d) of the position [m/rad, or m/m], or (n, 3, d) for q (n, d).

        Exact on a `KBMap` or a `RigidChain`, and on any model whose orientations are rotations.
        """
        if isinstance(self._model, KBMap | RigidChain):
            _, posterior, _ = self._fitted()
            if self._moved is None:
                self._moved = self._model.with_tool(posterior.shift)
            return self._moved.jacobian(q)
        lever = self._model.orientation(q) @ self._posterior().shift
        turning = self._model.angular_jacobian(q).swapaxes(-1, -2)
        return self._model.jacobian(q) + np.cross(turning, lever[..., None, :]).swapaxes(-1, -2)

    def orientation(self, q: ArrayLike, *, orthonormal: bool = False) -> FloatArray:
        """Return the model's orientations (n, 3, 3), or (3, 3) at q (d,): a tool does not turn the marker's frame."""
        return self._model.orientation(q, orthonormal=orthonormal)

    def angular_jacobian(self, q: ArrayLike) -> FloatArray:
        """Return the model's angular velocities (n, 3, d), or (3, d) at q (d,), of the orthonormal orientation."""
        return self._model.angular_jacobian(q)

    def estimate(self, q: ArrayLike) -> Estimate:
        """Return positions at q (n, d), or (d,), their 1-sigma per axis against the truth, and True where data is near.

        The model's own variance adds to that of δ. Every pair determines all of δ, so δ is equally certain at all
        configurations. Once there is a pair of the current tool, support is that of the model, or everywhere if the
        model has none.
        """
        angles = rows_or_vector("q", q, self.joints)
        batch = np.atleast_2d(angles)
        posterior, rotations = self._posterior(), self._model.orientation(batch)
        variance = np.einsum("nij,jk,nik->ni", rotations, posterior.covariance, rotations)
        inside = np.full(len(batch), len(self._recent) > 0 or self._before.count > 0.0)
        if isinstance(self._model, _Estimating):
            behind = self._model.estimate(batch)
            variance, inside = variance + np.square(behind.sigma), inside & behind.in_support
        return Estimate(self.predict(batch), np.sqrt(variance), inside).like(angles)

    def baked(self) -> KBMap | RigidChain:
        """Return the model with the offset built in, exactly: for a KB-Map G + E1 δ1 + E2 δ2 + E3 δ3.

        Raises:
            SettingError: the model is neither a `KBMap` nor a `RigidChain`.
        """
        if isinstance(self._model, KBMap | RigidChain):
            return self._model.with_tool(self.shift)
        raise SettingError(f"a {type(self._model).__name__} cannot take in a tool; only a KBMap or a RigidChain can")

    def to_bytes(self) -> bytes:
        """Return the layer's state; `from_bytes` restores the same predictions to the last bit.

        A model that is neither a `KBMap` nor a `RigidChain` is not stored.
        """
        behind, arrays = packable(self._model)
        fields: dict[str, Any] = {
            "outlier_sigmas": unless_infinite(self._outlier_sigmas),
            "pairs": self._pairs,
            "known": {name: getattr(self._before, name) for name in _NUMBERS},
            "model": behind,
        }
        recent = {"rotations": self._recent.rotations, "residuals": self._recent.errors, "sigma": self._recent.sigma}
        return pack(_KIND, fields, {name: getattr(self._before, name) for name in _SUMS} | recent | arrays)

    @classmethod
    def from_bytes(cls, data: bytes, model: PoseModel | None = None) -> Self:
        """Return the layer in `data`.

        Args:
            data: the result of `to_bytes`.
            model: the layer's model, if it is not stored.

        Raises:
            ModelFormatError: wrong type of model, or damaged, or the layer's model is missing.
        """
        fields, arrays = unpack(data, _KIND)
        with restoring("a tool layer"):
            named(fields, "the fields", ("outlier_sigmas", "pairs", "known", "model"))
            outlier_sigmas = or_infinite(fields["outlier_sigmas"], "outlier_sigmas")
            layer = cls(unpacked(fields["model"], arrays, model), outlier_sigmas=outlier_sigmas)
            complete(arrays, (*_SUMS, *_RESIDUALS, *packable(layer._model)[1]))
            sums = {name: _shaped(arrays[name], getattr(layer._before, name)) for name in _SUMS}
            scalars = numbers(named(fields["known"], "what is known", _NUMBERS))
            layer._before = replace(layer._before, **cast(dict[str, Any], sums | scalars))
            layer._recent = _residuals(arrays)
            layer._pairs = count(fields["pairs"], "the number of pairs")
            if len(layer._recent) > layer._pairs or min(scalars.values()) < 0.0:
                raise ModelFormatError("its numbers do not fit each other")
        return layer

    def _residuals(self, q: FloatArray, x: FloatArray, sigma: FloatArray) -> Residuals:
        return Residuals(self._model.orientation(q), x - self._model.predict(q), sigma)

    def _sum_up(self) -> None:
        """Reduce all but the last pairs to sums, without their outliers."""
        _, _, inliers = self._fitted()
        old = len(self._recent) - _RECENT
        self._before = self._before.given(self._recent[:old][inliers[:old]])
        self._recent, self._fit = self._recent[old:], None

    def _fitted(self) -> tuple[MarkerKnowledge, MarkerPosterior, BoolArray]:
        if self._fit is None:
            self._moved = None
            self._fit = fit_marker(self._before, self._recent, self._outlier_sigmas)
        return self._fit

    def _posterior(self) -> MarkerPosterior:
        return self._fitted()[1]


def _checked_spread(name: str, spread: float) -> float:
    if not spread > 0.0:
        raise SettingError(f"{name} must be greater than 0 m (infinity included), got {spread!r}")
    return min(float(spread), _WIDE)


def _residuals(arrays: Mapping[str, FloatArray]) -> Residuals:
    """Return the stored recent pairs. Raises ModelFormatError, KeyError."""
    rotations, errors, sigma = (arrays[name] for name in _RESIDUALS)
    if sigma.ndim != 1 or (sigma <= 0.0).any():
        raise ModelFormatError("the sigmas of a stored layer are not positive numbers, one a pair")
    n = len(sigma)
    return Residuals(_shaped(rotations, np.empty((n, 3, 3))), _shaped(errors, np.empty((n, 3))), sigma)


def _shaped(array: FloatArray, like: FloatArray) -> FloatArray:
    """Return the array if it is finite and of this shape. Raises ModelFormatError."""
    if array.shape != like.shape or not np.isfinite(array).all():
        raise ModelFormatError(f"an array of finite numbers of shape {like.shape} was expected, got {array.shape}")
    return array


def with_refitted_tool(
    kbmap: KBMap, chain: RigidChain, q: ArrayLike, x: ArrayLike, sigma: float | None = None
) -> KBMap:
    """Return the map after its marker was moved to another place on the last link, or the tool was changed.

    The offset δ is fitted, robustly, to pairs seen since: x ≈ f(q) + R(q) δ with the orientation R of the nominal
    chain (`ToolLayer`). With E the nets of R it is built in exactly, G ← G + E δ. Errors of R itself are left to a
    learner.

    Args:
        kbmap: the map as learnt before the change; of its outputs only the position moves.
        chain: the nominal chain, which supplies the orientations.
        q, x: pairs since the change, (n, d) [rad, m] and (n, 3) [m].
        sigma: noise of one coordinate [m], if known.

    Raises:
        ShapeError, NonFiniteError, SettingError, DegenerateDataError (no pairs)
    """
    angles, positions = rows("q", q, chain.joints), rows("x", x, POSITION_OUTPUTS)
    if not len(angles):
        raise DegenerateDataError("a marker's move needs at least 1 pair seen since; record more")
    positions_net = kbmap.net[:POSITION_OUTPUTS]
    oriented = KBMap(kbmap.bases, np.concatenate([positions_net, chain.orientation_maps(kbmap.bases)]))
    layer = ToolLayer(oriented, spread=math.inf, outlier_sigmas=UNCALIBRATED_SIGMAS)
    layer.learn(angles, positions, sigma)
    net = kbmap.net.copy()
    net[:POSITION_OUTPUTS] = oriented.with_tool(layer.shift).net[:POSITION_OUTPUTS]
    return KBMap(kbmap.bases, net, kbmap.metadata)
