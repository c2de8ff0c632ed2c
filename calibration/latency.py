"""Estimate the latency of camera timestamps from encoder and marker readings of a moving arm.

The marker is at the position that belongs to the joint angles at the middle of the exposure. With the correct time
shift, the positions follow most closely from the angles. A smooth function of the angles gives the shift roughly, for
any arm. The nominal chain, fitted within its tolerances, gives it more precisely, because it has less freedom to follow
a wrong shift.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.optimize import minimize_scalar

from bodyschema.interfaces.errors import BodyschemaError
from bodyschema.interfaces.records import FloatArray, frozen_array
from kbmaps import ChainParameters, ChainTolerances, DegenerateDataError, RigidChain, align


class LatencySettings:
    min_fixes: int = 60
    blocks: int = 10
    rival: float = 1.15  # a second minimum is a rival if its residual is below this multiple of the best one's
    apart_s: float = 0.03  # minimum distance of a rival
    # relative to the largest motion: a direction without motion
    small: float = 1e-3
    ridge: float = 1e-6
    finer: int = 8
    largest_sigma_s: float = 0.0025
    shortest_s: float = 3.0
    # required of the joint that moves most
    min_turn_rad: float = np.radians(1.0)
    min_slide_m: float = 0.005
    # required ratio of the marker's RMS motion to its part that does not follow the joints
    follows: float = 4.0
    little_m: float = 0.01
    settling: int = 5  # steps to reach the loosely fitted chain; from there two are enough
    refined_s: float = 0.024  # on both sides of the smooth function's estimate
    earliest_s, latest_s = -0.05, 0.25  # search range
    step_s: float = 0.004
    # Prior deviations of an arm from its URDF; they only constrain what the pairs do not determine.
    loose = ChainTolerances(axes=0.02, points=0.005, zeros=0.1, tool=0.1, base_rotation=0.5, base_translation=0.5)


class LatencyError(BodyschemaError):
    """The motion does not determine the latency."""


@dataclass(frozen=True)
class Wiggle:
    """Encoder readings and marker fixes, each with its own timestamp."""

    # t_joints, q: times and angles of the encoders [s] (n,), [rad or m] (n, d)
    t_joints: FloatArray
    q: FloatArray
    # t_marker, x: times and positions of the marker [s] (m,), [m] (m, 3)
    t_marker: FloatArray
    x: FloatArray

    def __post_init__(self) -> None:
        for name in ("t_joints", "q", "t_marker", "x"):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))

    def with_stamps_later(self, by_s: float) -> Wiggle:
        """Return the same data with the marker's timestamps `by_s` later [s]."""
        return replace(self, t_marker=self.t_marker + by_s)

    def angles(self, t: FloatArray) -> FloatArray:
        """Return the joint angles at times (m,), shape (m, d).

        A cubic B-spline has the readings as coefficients; it does not pass through them. Linear interpolation has half
        the noise variance midway between two readings, so it would favour latencies that put the images between
        readings. The spline's noise is nearly the same everywhere, and its symmetric weights introduce no delay.
        """
        return self._spline(np.interp(t, *self._places))

    @cached_property
    def _spline(self) -> BSpline:
        return _smooth(self.q)

    @cached_property
    def _places(self) -> tuple[FloatArray, FloatArray]:
        """Times [s], and the indices of the readings at them."""
        numbers = np.linspace(0.0, len(self.q) - 1.0, LatencySettings.finer * (len(self.q) - 1) + 1)
        return np.asarray(_smooth(self.t_joints)(numbers), dtype=np.float64), numbers


def _smooth(values: FloatArray) -> BSpline:
    """Return the uniform cubic B-spline with these coefficients, extended by the first and the last one."""
    edge = np.repeat(values[[0, -1]], 2, axis=0)
    padded = np.concatenate([edge[:2], values, edge[2:]])
    return BSpline(np.arange(len(padded) + 4) - 4.0, padded, 3)


@dataclass(frozen=True, slots=True)
class Latency:
    """Result of the estimate."""

    latency_s: float  # from the exposure's middle to the timestamp, with its 1-sigma sigma_s [s]
    sigma_s: float
    fixes: int  # number of positions used
    residual_m: float  # RMS distance of these from the positions that the angles predict
    speed_m_s: float  # RMS speed of the marker


def latency_of(wiggle: Wiggle, chain: RigidChain) -> Latency:
    """Estimate the latency of the marker's timestamps relative to the encoders'.

    Args:
        chain: approximate chain; only the curvature of its map matters.

    Raises:
        LatencyError: too few fixes, too little motion, or motion that repeats itself.
    """
    _require_motion(wiggle, chain)
    fit = _Fit.of(wiggle, chain)
    step_s, ends_s = LatencySettings.step_s, (LatencySettings.earliest_s, LatencySettings.latest_s)
    grid = np.arange(ends_s[0], ends_s[1] + step_s, step_s)
    cost = np.array([fit.cost(lag) for lag in grid])
    best = int(np.argmin(cost))
    _require_following(fit, cost[best])
    if best in (0, len(grid) - 1):
        raise LatencyError(
            f"{_strange(fit, cost[best])} They agree best at {1e3 * ends_s[best > 0]:.0f} ms, the end of the search: "
            "the real latency may be beyond (fewer buffers, a higher rate or a shorter exposure: docs/cameras.md)"
        )
    _require_one(grid, cost, best)
    fit, near_s, residual_m = _nearest(fit, grid[best])
    lag = _minimum(fit, near_s)
    sigma_s = _sigma(fit, lag)
    if sigma_s > LatencySettings.largest_sigma_s:
        raise LatencyError(
            f"the latency is known to {1e3 * sigma_s:.1f} ms only. Move the arm faster, to and fro, or longer "
            "(--seconds), the marker in sight of both eyes"
        )
    speed = float(np.sqrt(np.mean(np.sum(np.gradient(wiggle.x, wiggle.t_marker, axis=0) ** 2, axis=1))))
    return Latency(lag, sigma_s, len(fit.x), residual_m, speed)


@dataclass(frozen=True)
class _Fit:
    """The terms of the smooth function, and the positions to fit: those whose angles are known at every lag."""

    wiggle: Wiggle
    chain: RigidChain
    t: FloatArray
    x: FloatArray
    centre: FloatArray
    axes: FloatArray  # (d, k): principal directions of the joints' motion, each scaled to 1

    @classmethod
    def of(cls, wiggle: Wiggle, chain: RigidChain) -> _Fit:
        t = wiggle.t_marker
        inside = t - LatencySettings.latest_s - LatencySettings.step_s >= wiggle.t_joints[0]
        inside &= t - LatencySettings.earliest_s + LatencySettings.step_s <= wiggle.t_joints[-1]
        if inside.sum() < LatencySettings.min_fixes:
            raise LatencyError(_too_few(wiggle, int(inside.sum())))
        centre = wiggle.q.mean(axis=0)
        _, size, directions = np.linalg.svd(wiggle.q - centre, full_matrices=False)
        size = size / math.sqrt(len(wiggle.q))
        moving = size > LatencySettings.small * size[0]
        axes = directions[moving].T / size[moving]
        return cls(wiggle, chain, t[inside], wiggle.x[inside], centre, axes)

    @property
    def unknowns(self) -> int:
        """Number of fitted parameters."""
        return 3 * self.terms(0.0).shape[1]

    @property
    def motion_m(self) -> float:
        return math.sqrt(float(np.mean(np.sum((self.x - self.x.mean(axis=0)) ** 2, axis=1))))

    def terms(self, lag: float) -> FloatArray:
        """Return the nominal position, and a polynomial of second degree in the angles, at all fixes: (m, p)."""
        q = self.wiggle.angles(self.t - lag)
        u = (q - self.centre) @ self.axes
        rows, columns = np.triu_indices(u.shape[1])
        nominal = self.chain.positions(q)
        return np.hstack([np.ones((len(q), 1)), u, u[:, rows] * u[:, columns], nominal - nominal.mean(axis=0)])

    def residual(self, lag: float, keep: NDArray[np.bool_] | slice = slice(None)) -> FloatArray:
        """Return the residual of the fitted smooth function, shape (m, 3) [m]."""
        A, x = self.terms(lag)[keep], self.x[keep]
        scale = np.linalg.norm(A, axis=0) + np.finfo(float).tiny
        A = A / scale
        weights = np.linalg.solve(A.T @ A + LatencySettings.ridge * np.eye(A.shape[1]), A.T @ x)
        return x - A @ weights

    def whitened(self, lag: float) -> _Fit:
        """Return the same fit with positions whitened by the covariance of the residual at `lag` (larger in depth)."""
        return replace(self, x=self.x @ _whitening(self.residual(lag)).T)

    def cost(self, lag: float, keep: NDArray[np.bool_] | slice = slice(None)) -> float:
        """Return the sum of squares of the residual [m²], or in units of the noise."""
        return float(np.sum(self.residual(lag, keep) ** 2))


@dataclass(frozen=True)
class _RigidFit:
    """The nominal chain with its tolerances, and the positions to fit."""

    wiggle: Wiggle
    parameters: ChainParameters
    t: FloatArray
    x: FloatArray
    start: FloatArray  # (p,)
    white: FloatArray  # (3, 3): whitening matrix of position differences

    @classmethod
    def of(cls, smooth: _Fit, lag: float) -> _RigidFit:
        """Place the chain by the smooth function's positions.

        Raises:
            DegenerateDataError: the positions do not determine its pose.
        """
        placed = align(
            smooth.chain, smooth.wiggle.angles(smooth.t - lag), smooth.x, pose_known=False, marker_known=False
        )
        parameters = ChainParameters(placed.chain)
        noise_m = max(placed.rms, np.finfo(float).tiny)
        return cls(smooth.wiggle, parameters, smooth.t, smooth.x, np.zeros(parameters.size), np.eye(3) / noise_m)

    @property
    def unknowns(self) -> int:
        """Number of fitted parameters."""
        return self.parameters.size

    def fitted(
        self, lag: float, keep: NDArray[np.bool_] | slice = slice(None), steps: int = 2
    ) -> tuple[FloatArray, FloatArray]:
        """Return the best-fitting parameter changes (p,), by Gauss-Newton from `start`, and the residual.

        The residual has shape (m, 3) [m].
        """
        q, x, change = self.wiggle.angles(self.t - lag)[keep], self.x[keep], self.start
        information = self.parameters.standard_deviations(LatencySettings.loose) ** -2.0
        for _ in range(steps):
            positions, jacobian = self.parameters.linearised(change, q)
            J = (self.white @ jacobian).reshape(-1, len(change))
            r = ((x - positions) @ self.white.T).ravel()
            slope = J.T @ r - information * change
            change = change + np.linalg.solve(J.T @ J + np.diag(information), slope)
        return change, x - self.parameters.positions(change, q)

    def residual(self, lag: float, keep: NDArray[np.bool_] | slice = slice(None)) -> FloatArray:
        """Return the residual of the best-fitting chain in units of the noise, shape (m, 3)."""
        return self.fitted(lag, keep)[1] @ self.white.T

    def whitened(self, lag: float) -> _RigidFit:
        """Return the same fit with residuals whitened by their covariance at `lag` (larger in depth)."""
        start, left = self.fitted(lag, steps=LatencySettings.settling)
        return replace(self, start=start, white=_whitening(left))

    def cost(self, lag: float, keep: NDArray[np.bool_] | slice = slice(None)) -> float:
        """Return the sum of squares of residual and parameter changes, each divided by its sigma."""
        change, left = self.fitted(lag, keep)
        prior = self.parameters.standard_deviations(LatencySettings.loose)
        return float(np.sum((left @ self.white.T) ** 2) + np.sum((change / prior) ** 2))


_AnyFit = _Fit | _RigidFit


def _nearest(smooth: _Fit, lag: float) -> tuple[_AnyFit, float, float]:
    """Return the better fit of nominal chain and smooth function, in units of the noise.

    Also return its approximate latency [s] and RMS residual [m].
    """
    left = smooth.residual(lag)
    unexplained = smooth.whitened(lag), lag, _rms(left)
    try:
        rigid = _RigidFit.of(smooth, lag).whitened(lag)
        refined_s, step_s = LatencySettings.refined_s, LatencySettings.step_s
        grid = lag + np.arange(-refined_s, refined_s + step_s, step_s)
        near_s = float(grid[int(np.argmin([rigid.cost(each) for each in grid]))])
        rigid = rigid.whitened(near_s)
    except (DegenerateDataError, np.linalg.LinAlgError):
        return unexplained
    explained = rigid.fitted(near_s)[1]
    if _volume(explained, rigid.unknowns) > _volume(left, smooth.unknowns):
        return unexplained
    return rigid, near_s, _rms(explained)


def _rms(left: FloatArray) -> float:
    """Return the RMS length of vectors (m, 3)."""
    return math.sqrt(float(np.mean(np.sum(left**2, axis=1))))


def _volume(left: FloatArray, unknowns: int) -> float:
    """Return the determinant [m⁶] of the covariance of a fit's residual (m, 3), corrected for the fitted parameters.

    It weights each direction by its own noise, as the likelihood does, so that depth does not dominate the other two.
    """
    return float(np.linalg.det(left.T @ left / max(len(left) - unknowns / 3.0, 1.0)))


def _whitening(residual: FloatArray) -> FloatArray:
    """Return the matrix, shape (3, 3), that transforms residuals (m, 3) to unit covariance."""
    noise = residual.T @ residual / len(residual)
    least = LatencySettings.small * float(np.trace(noise)) + np.finfo(float).tiny
    return np.asarray(np.linalg.inv(np.linalg.cholesky(noise + least * np.eye(3))), dtype=np.float64)


def _require_motion(wiggle: Wiggle, chain: RigidChain) -> None:
    """Raise LatencyError if there are too few readings, or the joints hardly moved in them."""
    if len(wiggle.t_joints) < 2:
        raise LatencyError("there are no encoder readings")
    span = np.ptp(wiggle.q, axis=0)
    if not (span > np.where(chain.prismatic, LatencySettings.min_slide_m, LatencySettings.min_turn_rad)).any():
        turned = np.degrees(span[~chain.prismatic])
        most = f"{turned.max():.1f}° at most" if len(turned) else f"{1e3 * span.max():.1f} mm at most"
        raise LatencyError(
            f"the joints hardly moved: {most}. Move the arm while the time runs; `bodyschema watch joints` shows "
            "whether the encoders follow"
        )


def _require_following(fit: _Fit, cost: float) -> None:
    """Raise LatencyError if the marker hardly moves with the joints."""
    residual_m = math.sqrt(cost / len(fit.x))
    moved_m = fit.motion_m
    if moved_m > LatencySettings.follows * residual_m:
        return
    if moved_m < LatencySettings.little_m:
        raise LatencyError(
            f"the marker moved by {1e3 * moved_m:.1f} mm only (RMS), hardly more than its noise. Move joints that "
            "bring it far: not one that turns it on the spot"
        )
    raise LatencyError(_strange(fit, cost))


def _strange(fit: _Fit, cost: float) -> str:
    """Return the message for a marker that does not move with the joints."""
    moved_m, residual_m = fit.motion_m, math.sqrt(cost / len(fit.x))
    earliest_ms, latest_ms = 1e3 * LatencySettings.earliest_s, 1e3 * LatencySettings.latest_s
    return (
        f"the marker does not follow the joints: of {1e3 * moved_m:.0f} mm of motion (RMS) {1e3 * residual_m:.0f} mm "
        f"do not go with them at any latency from {earliest_ms:.0f} to {latest_ms:.0f} ms. Is it the marker "
        "that is found (`bodyschema watch cameras`), are the joints in the order of robot.toml (`bodyschema watch "
        "joints`), and do the cameras stand still?"
    )


def _too_few(wiggle: Wiggle, fixes: int) -> str:
    """Return the reason for too few fixes with known angles at every latency: short, slow or out of sight."""
    t, usable = wiggle.t_marker, f"the marker was seen {fixes} times, {LatencySettings.min_fixes} are needed"
    span_s = min(t[-1], wiggle.t_joints[-1]) - max(t[0], wiggle.t_joints[0])
    if span_s < LatencySettings.shortest_s:
        return f"{usable}: encoders and cameras looked on together for {max(span_s, 0.0):.1f} s only. Move for 5 s"
    rate_hz = 1.0 / max(float(np.quantile(np.diff(t), 0.1)), 1e-3)
    earliest_s, latest_s, fewest = LatencySettings.earliest_s, LatencySettings.latest_s, LatencySettings.min_fixes
    if rate_hz * (span_s - latest_s + earliest_s) < 1.2 * fewest:
        seconds = math.ceil(1.2 * fewest / rate_hz + latest_s - earliest_s)
        return (
            f"{usable}: the cameras give {rate_hz:.1f} images a second. Give --seconds {seconds}, or make them faster: "
            "a shorter exposure, or buffers = 2 (docs/cameras.md)"
        )
    return f"{usable}: keep it in sight of both eyes all the time; `bodyschema watch cameras` shows why it is not found"


def _minimum(fit: _AnyFit, near_s: float, keep: NDArray[np.bool_] | slice = slice(None)) -> float:
    span = near_s - 2 * LatencySettings.step_s, near_s + 2 * LatencySettings.step_s
    found: Any = minimize_scalar(
        lambda lag: fit.cost(lag, keep), bounds=span, method="bounded", options={"xatol": 1e-6}
    )
    return float(found.x)


def _sigma(fit: _AnyFit, lag: float) -> float:
    """Return the 1-sigma [s] of the latency, from a jackknife over stretches of time.

    The jackknife accounts for correlated residuals. The result is at least the sigma for independent residuals.
    """
    blocks = np.arange(len(fit.x)) * LatencySettings.blocks // len(fit.x)
    without = np.array([_minimum(fit, lag, blocks != block) for block in range(LatencySettings.blocks)])
    jackknife = math.sqrt((LatencySettings.blocks - 1) * float(np.mean((without - without.mean()) ** 2)))
    residual, step = fit.residual(lag), 1e-3
    slope = (fit.residual(lag + step) - fit.residual(lag - step)) / (2 * step)
    free = max(residual.size - fit.unknowns - 1, 1)
    independent = math.sqrt(float(np.sum(residual**2)) / free / float(np.sum(slope**2)))
    return max(jackknife, independent)


def _require_one(grid: FloatArray, cost: FloatArray, best: int) -> None:
    """Raise LatencyError if another latency fits nearly as well."""
    inner = np.r_[False, (cost[1:-1] <= cost[:-2]) & (cost[1:-1] <= cost[2:]), False]
    rivals = (
        inner
        & (np.abs(grid - grid[best]) > LatencySettings.apart_s)
        & (np.sqrt(cost) < LatencySettings.rival * math.sqrt(cost[best]))
    )
    if rivals.any():
        other = grid[rivals][0]
        raise LatencyError(
            f"{1e3 * grid[best]:.0f} ms and {1e3 * other:.0f} ms fit nearly as well: the motion repeats itself. Move "
            "irregularly, more than one joint"
        )
