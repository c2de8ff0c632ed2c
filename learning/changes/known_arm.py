"""Posterior of the arm itself, independent of its tool."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray
from bodyschema.learning.changes.monitor import DetectedChange
from bodyschema.learning.solvers.solver import fitted_belief
from bodyschema.learning.status import TOOL, NamingSettings
from kbmaps import ChainBelief, ChainTolerances, ChangeKind, Explanation, KBMap, ResidualModel, any_change, explanations


@dataclass(frozen=True, eq=False)
class KnownArm:
    """Current knowledge of the arm."""

    chain: ChainBelief  # posterior as a rigid chain
    tolerances: ChainTolerances  # those of its prior
    residual: ResidualModel | None = None  # posterior as a chain with deviations, or None

    @classmethod
    def from_bytes(cls, chain: bytes, tolerances: ChainTolerances, residual: bytes | None) -> KnownArm:
        known = None if residual is None else ResidualModel.from_bytes(residual)
        return cls(ChainBelief.from_bytes(chain), tolerances, known)

    def updated(self, chain: ChainBelief | None, residual: ResidualModel | None) -> KnownArm:
        """Return the arm with newer posteriors; None keeps the current one."""
        return KnownArm(chain or self.chain, self.tolerances, residual or self.residual)

    def with_other_tool(self) -> KnownArm:
        """Return the same arm with another marker position on the hand."""
        residual = None if self.residual is None else self.residual.with_other_tool(ArmSettings.other_tool_m)
        return KnownArm(self.chain.with_other_tool(ArmSettings.other_tool_m), self.tolerances, residual)

    def widened(self, columns: NDArray[np.intp], std: FloatArray) -> KnownArm:
        """Return the same arm with the uncertainty of some chain parameters increased.

        Args:
            columns: indices (k,) of these parameters.
            std: 1-sigma of each change (k,) [rad, m].
        """
        residual = None if self.residual is None else self.residual.widened(columns, std)
        return KnownArm(self.chain.widened(columns, std), self.tolerances, residual)


class ArmSettings:
    min_probability: float = 0.02  # an unnamed change widens every kind at least this probable
    # 1-sigma of the changed part: this multiple of its most probable change, and at least this many noises.
    widening: float = 3.0
    min_noises: float = 3.0
    folds: int = 4  # number of runs of neighbours left out in turn to compare the new model with the old one
    clip_sigmas: float = 5.0  # pairs farther from a prediction than this many sigmas are clipped
    min_pairs_before: int = 10  # minimum number of pairs before the change that update the previous posterior
    # 1-sigma of each coordinate [m] of the marker's displacement by another tool, and of an unknown marker position
    # about the nominal one.
    other_tool_m: float = 0.25


@dataclass(frozen=True, eq=False)
class Adapted:
    """State from which learning continues."""

    prior: KBMap  # the map on top of which to learn
    arm: KnownArm  # prior of the arm before the first pair since the change
    belief: ChainBelief  # posterior of the chain after these pairs


class ArmBeforeChange:
    """Knowledge of the arm before a change, with the evidence of the pairs since.

    Args:
        detected: the change.
        arm: prior of the arm before the first pair of its regime; it supplies the tolerances.
    """

    def __init__(self, detected: DetectedChange, arm: KnownArm) -> None:
        self._change, self._reference = detected, detected.reference
        unaffected = [k for k in range(min(detected.earliest, detected.first)) if detected.kept[k]]
        q, x, cov = detected.q[unaffected], detected.x[unaffected], detected.cov[unaffected]
        wide = self._reference.wide
        if len(unaffected) >= ArmSettings.min_pairs_before:
            wide = fitted_belief(wide, q, self._of_chain(q, x), cov)
        self._before = arm.updated(wide, self._reference.residual)

    def explain(self, q: FloatArray, x: FloatArray) -> list[Explanation]:
        """Return the probability of each kind of change after the pairs since then, q (n, d) [rad] and x (n, 3) [m].

        The first pairs may be from before the change. They are left out once as many others are available.
        """
        detected, belief = self._change, self._before.chain
        ambiguous = max(detected.latest - detected.first, 0)
        if len(q) >= 2 * ambiguous:
            q, x = q[ambiguous:], x[ambiguous:]
        kinds = (*detected.kinds, any_change(belief.parameters))
        return explanations(belief, kinds, q, self._of_chain(q, x), detected.noise_m, detected.shared)

    def adapt(
        self, found: Sequence[Explanation], q: FloatArray, x: FloatArray, cov: FloatArray | None = None
    ) -> Adapted:
        """Widen the prior of suspected parts, and relearn them from the pairs since, q (n, d) [rad] and x (n, 3) [m].

        Args:
            found: probability of each kind of change, the most probable first.
            cov: as in `PairMemory.append`.
        """
        arm = self._widened_arm(found)
        belief = fitted_belief(arm.chain, q, self._of_chain(q, x), cov)
        bases, known = self._reference.map.bases, self._reference.belief.chain
        net = self._reference.map.net[:3] + belief.chain.to_kbmap(bases).net - known.to_kbmap(bases).net
        return Adapted(KBMap(bases, net), arm, belief)

    def improves_prediction(
        self, found: Sequence[Explanation], q: FloatArray, x: FloatArray, cov: FloatArray | None = None
    ) -> bool:
        """Return True if an adapted model predicts held-out pairs since the change better than the old one.

        Runs of q (n, d) [rad] and x (n, 3) [m], n at least 2, are left out in turn.
        """
        arm, y = self._widened_arm(found), self._of_chain(q, x)
        limit = ArmSettings.clip_sigmas * self._change.noise_m
        old_errors = np.minimum(np.linalg.norm(y - self._reference.belief.predict(q), axis=1), limit)
        new_errors = np.empty(len(q))
        for left_out in np.array_split(np.arange(len(q)), min(ArmSettings.folds, len(q))):
            others = np.setdiff1d(np.arange(len(q)), left_out)
            belief = fitted_belief(arm.chain, q[others], y[others], None if cov is None else cov[others])
            new_errors[left_out] = np.minimum(np.linalg.norm(y[left_out] - belief.predict(q[left_out]), axis=1), limit)
        return float(np.square(new_errors).sum()) < float(np.square(old_errors).sum())

    def _of_chain(self, q: FloatArray, x: FloatArray) -> FloatArray:
        """Return the part of positions x (n, 3) [m] that the chain must explain, without the model's other terms."""
        return x - self._reference.offset_from_chain(q)

    def _widened_arm(self, found: Sequence[Explanation]) -> KnownArm:
        arm = self._before
        named = found[0].probability >= NamingSettings.named_probability
        kinds = found[:1] if named else [e for e in found if e.probability >= ArmSettings.min_probability]
        for each in kinds:
            if each.kind.name == TOOL:
                arm = arm.with_other_tool()
            else:
                arm = arm.widened(each.kind.columns, self._change_sigmas(each.kind, each.change))
        return arm

    def _change_sigmas(self, kind: ChangeKind, change: FloatArray) -> FloatArray:
        moves = change / kind.units
        size = ArmSettings.widening * float(np.sqrt(np.square(moves).mean()))
        return kind.units * min(max(size, ArmSettings.min_noises * self._change.noise_m), ArmSettings.other_tool_m)
