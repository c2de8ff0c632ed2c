"""Find confounded causes: effects that explain much of the same error beside the best geometry.

An eccentric encoder and a joint that yields under the arm's weight both follow a sine of the joint angle. What one of
them explains beyond the best geometry, the other may explain as well. The recording then shows that an error exists,
but hardly which of the two it is.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from bodyschema.effects import Effect
from bodyschema.interfaces.records import FloatArray

from .fit import Fit
from .scan import Candidate, Scan

# Smallest Δχ² beside the geometry, and smallest explained share of its residuals, that count.
_WORTH, _EXPLAINS = 25.0, 0.01
# Smallest shared part of the directions, and of what the smaller effect explains.
_DIRECTION, _SHARED = 0.5, 0.7
# A ripple with fewer cycles per turn acts like an eccentric encoder.
_FEWEST_CYCLES = 1.5
# A direction with a smaller remaining share counts as zero.
_TOLD = 1e-7


@dataclass(frozen=True, eq=False)
class Alike:
    """Two confounded effects at one joint, each fitted alone beside the best geometry.

    Attributes:
        one: the effect that explains most at its joint.
        other: the effect that shares a direction with it.
        one_explains, other_explains: their shares of the squared error that the best geometry leaves.
        shared: the share of what `other` explains that `one` explains too.
        preferred: Δχ² of `one` less that of `other`.
    """

    one: Effect
    other: Effect
    one_explains: float
    other_explains: float
    shared: float
    preferred: float


@dataclass(frozen=True, eq=False)
class _Direction:
    """A candidate with an orthonormal basis (3 n, r) of the changes it makes beside the geometry."""

    candidate: Candidate
    basis: FloatArray
    explained: float


def alike(geometry: Fit, hypotheses: Iterable[Effect]) -> tuple[Alike, ...]:
    """Return the effects that share a direction with the strongest effect of each joint, beside the best geometry."""
    flat = geometry.orthogonal.reshape(geometry.left.size, -1)
    left = geometry.left.ravel()
    left = left - flat @ (flat.T @ left)
    whole = max(float(left @ left), 1e-300)
    by_joint: dict[str, list[_Direction]] = {}
    for candidate in Scan(geometry).candidates(h for h in hypotheses if _stays_at_a_joint(h)):
        effect = candidate.effect
        if candidate.gain < _WORTH or (effect.kind.is_periodic and effect.values[-1] < _FEWEST_CYCLES):
            continue
        basis = _beside(geometry, flat, effect)
        explained = float(np.square(basis.T @ left).sum()) / whole
        if explained >= _EXPLAINS:
            by_joint.setdefault(str(effect.where), []).append(_Direction(candidate, basis, explained))
    pairs = [pair for directions in by_joint.values() for pair in _with_strongest(directions, left, whole)]
    return tuple(sorted(pairs, key=lambda pair: -pair.one_explains))


def _stays_at_a_joint(effect: Effect) -> bool:
    kind = effect.kind
    return kind.at_joint and not kind.takes_source and not kind.begins and not kind.rigid


def _beside(geometry: Fit, flat: FloatArray, effect: Effect) -> FloatArray:
    columns = geometry.weighted(geometry.run.columns(effect)[:, :, effect.amounts]).reshape(len(flat), -1)
    columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    return _orthonormal(columns - flat @ (flat.T @ columns))


def _orthonormal(columns: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh(columns.T @ columns)
    told = values > _TOLD
    return columns @ (vectors[:, told] / np.sqrt(values[told]))


def _with_strongest(directions: list[_Direction], left: FloatArray, whole: float) -> list[Alike]:
    one = max(directions, key=lambda direction: direction.explained)
    pairs = []
    for other in directions:
        if other is one:
            continue
        cosines = np.linalg.svd(one.basis.T @ other.basis, compute_uv=False)
        fresh = _orthonormal(other.basis - one.basis @ (one.basis.T @ other.basis))
        both = one.explained + float(np.square(fresh.T @ left).sum()) / whole
        shared = (one.explained + other.explained - both) / other.explained
        if cosines.max(initial=0.0) ** 2 >= _DIRECTION and shared >= _SHARED:
            preferred = one.candidate.gain - other.candidate.gain
            effects = one.candidate.effect, other.candidate.effect
            pairs.append(Alike(*effects, one.explained, other.explained, min(shared, 1.0), preferred))
    return sorted(pairs, key=lambda pair: -pair.other_explains)
