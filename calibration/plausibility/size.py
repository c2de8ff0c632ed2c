"""Size of the measured positions against the lengths of the arm."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray
from bodyschema.learning.solvers.tolerance_selection import ToleranceSettings
from kbmaps import ChainParameters, ChainTolerances, RigidChain
from kbmaps.chains.parameters import WIDE
from kbmaps.chains.placement import Placements, place
from kbmaps.rotations import rotation_vectors

from .limits import BoolArray, LimitSettings
from .verdict import THRESHOLDS, Plausibility, mm


class _Settings:
    """Limits beyond which positions of another size are reported."""

    # Off by this many times its own uncertainty. Right recordings of real and generated arms come to 4.0, and fit
    # hardly better for it.
    far: float = 5.0
    other: float = 0.04  # Smaller ones are warned of: a joint whose ratio is 2 % off looks like positions 2.4 % off
    # The links are linearised about a fit with nominal links: two steps reach 0.1 % from a size that is 20 % off.
    steps: int = 3
    # Candidate noise levels, as shares of the residuals with nominal links: tolerances explain the rest of these.
    noises = np.geomspace(0.01, 2.0, 16)
    far_row: float = 5.0  # rows farther off than this multiple of the median are outliers


@dataclass(frozen=True, slots=True)
class Size:
    """Estimated size of measured positions, as a multiple of the true ones."""

    factor: float  # the multiple
    log_sigma: float  # 1-sigma of its logarithm, with the tolerances of links, joint offsets and marker integrated over
    error: float  # RMS distance of the nearest pairs from the nominal chain of that size, in the recording's unit

    @property
    def sigmas(self) -> float:
        """Distance from the right size, in units of its uncertainty."""
        return abs(math.log(self.factor)) / self.log_sigma


def wrong_size(size: Size, spread: float, before: float, best: float) -> Plausibility | None:
    """Return the verdict on positions that are too large or too small for the arm; None if they are not.

    Args:
        spread: spread of the positions [m].
        before: distance of the pairs with unchanged columns [m].
        best: the same, in the best reading of the columns.
    """
    far = size.sigmas > _Settings.far and size.error < THRESHOLDS.named / 2 * spread
    if not far or best < THRESHOLDS.as_good * size.error:
        return None
    factor, low, high = (size.factor * math.exp(k * size.log_sigma) for k in (0.0, -1.96, 1.96))
    text = (
        f"the positions are {factor:.3g} times as large as the arm makes them (95 %: {low:.4g} to {high:.4g}): "
        f"divided by that, the samples fit to {mm(size.error)}, and as they are to {mm(before)}"
    )
    remedy = (
        "Compare with what was measured: the size of the printed tag or the ball in [vision], the squares of the "
        "calibration board, the unit of the columns x, y, z. If these are right, the URDF is of an arm of another size"
    )
    if best > THRESHOLDS.much_better * size.error and abs(math.log(size.factor)) > _Settings.other:
        return Plausibility(f"it seems that {text}", remedy, misread=True)
    return Plausibility(warnings=(f"perhaps {text}. {remedy}",))


def size_of(chain: RigidChain, q: FloatArray, x: FloatArray, apart: NDArray[np.intp], exact_m: float) -> Size:
    """Estimate the size of positions x (n, 3) [m] at q (n, d) [rad, m].

    The links of an arm may be slightly longer than nominal, by tolerances determined from the pairs, but hardly all of
    them by the same factor.

    Args:
        apart: rows of poses far from each other. The errors of others are correlated with theirs.
        exact_m: distances below this are not distinguished [m].
    """
    log, sigma = 0.0, math.inf
    for _ in range(_Settings.steps):
        placed = _placed(chain, q[apart], x[apart] / math.exp(log))
        step, sigma = _log_size(chain, q[apart], placed, x[apart] / math.exp(log))
        log += step
    error = float(_placed(chain, q, x / math.exp(log)).errors(LimitSettings.measured_share)[0])
    return Size(math.exp(log), sigma, max(math.exp(log) * error, exact_m))


def log_evidences(
    chain: RigidChain, readings: list[tuple[FloatArray, FloatArray, float]], apart: NDArray[np.intp]
) -> FloatArray:
    """Return the log evidence (m,) of readings of the same pairs; links and size may be off by tolerances.

    Args:
        readings: joints q (n, d) [rad, m], positions x (n, 3) [m], and the number of the recording's units in 1 m.
        apart: as in `size_of`.
    """
    placed = [_placed(chain, q[apart], x[apart]) for q, x, _ in readings]
    good = np.all([_is_near(each.distances[0]) for each in placed], axis=0)
    found: list[float] = []
    for at, (q, x, scale) in zip(placed, readings, strict=True):
        logs = _evidence_by_tolerances(chain, q[apart], at, x[apart], good)[0]
        found.append(logs.max() + np.log(np.exp(logs - logs.max()).mean()) - 3.0 * good.sum() * math.log(scale))
    return np.array(found)


def _placed(chain: RigidChain, q: FloatArray, x: FloatArray) -> Placements:
    std = np.where(chain.prismatic, LimitSettings.slides_m, LimitSettings.zeros_rad)
    return place(chain, q[None], x[None], zeros_std=std, tool_std=LimitSettings.tool_m)


def _log_size(chain: RigidChain, q: FloatArray, placed: Placements, x: FloatArray) -> tuple[float, float]:
    """Return mean and 1-sigma of the logarithm of the positions' size, over all tolerances and noise levels."""
    evidence, means, variances = _evidence_by_tolerances(chain, q, placed, x, _is_near(placed.distances[0]))
    shares = np.exp(evidence - evidence.max())
    shares /= shares.sum()
    mean = float(shares @ means)
    return mean, math.sqrt(float(shares @ (variances + np.square(means - mean))))


def _is_near(distances: FloatArray) -> BoolArray:
    return distances <= _Settings.far_row * np.median(distances)


def _evidence_by_tolerances(
    chain: RigidChain, q: FloatArray, placed: Placements, x: FloatArray, good: BoolArray
) -> FloatArray:
    """Return log evidence, mean and variance (3, k) of the size from `good` rows, by tolerances and noise level."""
    distances, parameters = placed.distances[0], ChainParameters(chain)
    change = np.zeros(parameters.size)
    change[parameters.zeros], change[parameters.tool] = placed.zeros[0], placed.tools[0]
    tolerated = change.copy()
    change[parameters.base_turn] = rotation_vectors(placed.rotations)[0]
    change[parameters.base_shift] = placed.shifts[0]
    drawn, jacobian = parameters.linearised(change, q[good])
    jacobian = jacobian.reshape(-1, parameters.size)
    # The prior of zeros and marker is about nominal, not about their fit.
    residuals = (x[good] - drawn).ravel() + jacobian @ tolerated
    larger = (drawn - drawn.mean(axis=0)).ravel()
    noises = np.square(_Settings.noises * np.sqrt(np.square(distances[good]).mean() / 3.0))
    # The parameters explain only a few directions.
    basis, effects = np.linalg.qr(jacobian)
    both = np.stack([residuals, larger])
    within = both @ basis
    beyond = (both - within @ basis.T) @ (both - within @ basis.T).T
    found = [
        _posteriors(effects @ made, within, beyond, noises, len(residuals)) for made in _tolerance_roots(parameters)
    ]
    return np.concatenate(found, axis=1)


def _tolerance_roots(parameters: ChainParameters) -> Iterator[FloatArray]:
    """Yield roots (p, k) of the covariance for each of the tolerances, and the same with one link of any length."""
    _, _, tangents, _, marker = parameters.tables
    joints = len(tangents)
    for axes, points in ToleranceSettings.candidates:
        tolerances = ChainTolerances(
            axes=axes,
            points=points,
            zeros=LimitSettings.zeros_rad,
            slide_zeros=LimitSettings.slides_m,
            tool=LimitSettings.tool_m,
            base_rotation=WIDE,
            base_translation=WIDE,
        )
        root = np.diag(parameters.standard_deviations(tolerances))
        yield root
        for joint in range(1, joints):
            # Such a link moves all axes behind it, and the marker.
            moved = np.zeros((parameters.size, 3))
            moved[parameters.shifts] = (
                (tangents * (np.arange(joints) >= joint)[:, None, None]).swapaxes(1, 2).reshape(-1, 3)
            )
            moved[parameters.tool] = marker[:3, :3].T
            yield np.hstack([root, LimitSettings.tool_m * moved])


def _posteriors(
    effects: FloatArray, within: FloatArray, beyond: FloatArray, noises: FloatArray, count: int
) -> FloatArray:
    """Return log evidence, mean and variance (3, k) of the size, for each noise variance (k,).

    Args:
        effects: effects of parameters of variance 1 (p, k).
        within: residuals and the effect of the size, as far as the parameters can explain them (2, p).
        beyond: products of the rest (2, 2).
    """
    directions, sizes, _ = np.linalg.svd(effects, full_matrices=False)
    within = within @ directions
    variances = np.square(sizes) + noises[:, None]
    products = np.einsum("ip,jp,kp->kij", within, within, 1.0 / variances) + beyond / noises[:, None, None]
    # A prior of a factor e.
    precision = products[:, 1, 1] + 1.0
    unexplained = products[:, 0, 0] - np.square(products[:, 0, 1]) / precision
    volume = np.log(variances).sum(axis=1) + (count - len(sizes)) * np.log(noises) + np.log(precision)
    return np.stack([-0.5 * (unexplained + volume), products[:, 0, 1] / precision, 1.0 / precision])
