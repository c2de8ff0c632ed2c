"""One era after another: what is learnt since the nominal model, with whatever tools."""

from __future__ import annotations

import copy
from collections.abc import Iterator

import numpy as np

from daemon.config import LearnerConfig
from interfaces.records import Pair
from kbmaps import ChainBelief, ChainTolerances, KBMap, RigidChain

from .arm import KnownArm
from .claims import Claims
from .curve import Curve
from .era import NET, Era
from .fitting import Fit, Fitting
from .gate import DOUBT, explained, sound
from .members import PRIOR
from .memory import PairMemory
from .nominal import PAIRS_TO_REFIT, NominalModel, chain_tolerances
from .state import Counters, LearningHeader, LearningState, StateError

# RMS distance between a nominal model and reality that surprises nobody [m].
EXPECTED_M = 0.1


class Eras:
    """Begins the first era when the frame is known, and another one with each tool.

    Args:
        nominal: where learning starts.
        settings: of the learner.
        task_numbers: numbers for the solver's tasks that were never used.

    Attributes:
        present: the present era; None before the frame is known.
        claims: what its models are said to be wrong by. What they were in earlier eras counts.
        fitting: what is fitted as a whole.
        waiting: the pairs that wait for the first era.
    """

    def __init__(self, nominal: NominalModel, settings: LearnerConfig, task_numbers: Iterator[int]) -> None:
        self._nominal, self._settings, self._task_numbers = nominal, settings, task_numbers
        self._fingerprint = nominal.fingerprint(chain_tolerances(settings))
        self.claims = Claims(nominal.bases, EXPECTED_M)
        self.fitting = Fitting(nominal, chain_tolerances(settings))
        self.waiting = PairMemory(nominal.joints, settings.replay_capacity)
        self.present: Era | None = None

    @classmethod
    def at_nominal(cls, nominal: NominalModel, settings: LearnerConfig, task_numbers: Iterator[int]) -> Eras:
        """Before any pair."""
        eras = cls(nominal, settings, task_numbers)
        if nominal.frame_known:
            eras.present = eras._era(nominal.prior(), eras._drawn(nominal.chain))
        return eras

    @classmethod
    def restored(
        cls, state: LearningState, nominal: NominalModel, settings: LearnerConfig, task_numbers: Iterator[int]
    ) -> Eras:
        """As they were when `state` was taken.

        Raises:
            StateError: it belongs to another nominal model, or to other tolerances.
        """
        header, arrays = state.header, state.arrays
        eras = cls(nominal, settings, task_numbers)
        if header.fingerprint != eras._fingerprint:
            raise StateError(
                "it belongs to another nominal model or to other tolerances: robot.toml or the URDF has changed since"
            )
        eras.fitting.restore(header.next_fit, header.first_fit, arrays)
        eras.claims.restore(header.claims, arrays)
        if header.belief is None:
            eras.waiting.restore(arrays["q"], arrays["x"], header.kept_of, arrays.get("turns"))
        else:
            arm = KnownArm.from_bytes(header.belief, eras._tolerances, header.residual)
            eras.present = eras._era(KBMap(nominal.bases, arrays[NET + PRIOR]), arm)
            eras.present.restore(header, arrays)
        return eras

    def state(self, counters: Counters, curve: Curve) -> LearningState:
        """Everything that `restored` needs, with what is counted beside it."""
        q, x = self.memory.all()
        header = LearningHeader(
            fingerprint=self._fingerprint,
            counters=copy.copy(counters),
            claims=copy.deepcopy(self.claims.state()),
            curve=curve.points,
            curve_stride=curve.stride,
            kept_of=self.memory.count,
            next_fit=self.fitting.due_at,
            first_fit=self.fitting.is_first,
        )
        arrays = self.claims.arrays() | self.fitting.arrays() | {"q": q, "x": x}
        turns = self.memory.turns_since(0)
        if np.isfinite(turns).any():
            arrays["turns"] = turns
        if self.present is not None:
            arrays |= self.present.store(header)
        return LearningState(header, arrays)

    @property
    def memory(self) -> PairMemory:
        """The pairs with the present tool."""
        return self.waiting if self.present is None else self.present.memory

    def change_tool(self, era: Era) -> None:
        """From now on another tool than in `era`; nothing is known of it."""
        self.present = self._next(era, EXPECTED_M)

    def follow_change(self, era: Era, pair: Pair) -> bool:
        """Begin the era of another tool if the pairs that `era` doubted in a row are its first; `pair` is the last."""
        doubts = era.doubts
        if not (doubts.changed or (doubts.perhaps_changed and self._moved_together(era, era.limit_m(pair) / DOUBT))):
            return False
        q, x = doubts.run()
        distances = np.linalg.norm(era.model.predict(q) - x, axis=1)
        self.present = self._next(era, max(float(np.median(distances)), EXPECTED_M), first_fit=len(q))
        self.present.begin_with(q, x)
        return True

    def fitted(self, fit: Fit | None, pairs: int) -> int:
        """Go on from what was fitted to the first `pairs` pairs; how many of them are doubted now."""
        is_first = self.fitting.is_first
        self.fitting.done(pairs, fit)
        if fit is None:
            return 0
        if self.present is None:
            return 0 if fit.belief is None else self._begin_first(fit, fit.belief)
        doubted = self.present.set_aside(fit.prior) if is_first else 0
        self.present.change_prior(fit.prior)
        return doubted

    def _begin_first(self, fit: Fit, belief: ChainBelief) -> int:
        """The frame is known: the pairs that waited for it are learnt now, but for those that the fit contradicts."""
        (q, x), turns = self.waiting.all(), self.waiting.turns_since(0)
        belongs = sound(np.linalg.norm(x - fit.prior.predict(q), axis=1), self.claims.noise_m)
        self.waiting.clear()
        self.present = self._era(fit.prior, self._drawn(fit.chain))
        self.present.learn_waiting(q[belongs], x[belongs], turns[belongs], belief)
        return int((~belongs).sum())

    def _next(self, era: Era, expected_m: float, first_fit: int = PAIRS_TO_REFIT) -> Era:
        """That of another tool, which begins where `era` ends."""
        prior, arm = era.map, era.arm.updated(self.claims.wide, self.claims.residual)
        self.fitting.change_tool(prior, self._hand, first_fit)
        self.claims.change_tool(expected_m, era.answering)
        return self._era(prior, arm.with_other_tool())

    def _moved_together(self, era: Era, expected_m: float) -> bool:
        """Whether one other place of the marker on the hand explains the doubted pairs in a row."""
        q, x = era.doubts.run()
        answer = era.model.predict(q)
        # Without what the answering model knows beyond the map: it knows that with any tool.
        of_map = x - (answer - era.map.predict(q))
        moved = self._nominal.with_other_tool(era.map, self._hand, q, of_map)
        left = np.linalg.norm(of_map - moved.predict(q), axis=1)
        return explained(np.linalg.norm(x - answer, axis=1), left, expected_m)

    @property
    def _hand(self) -> RigidChain:
        """The chain that knows best how the hand is turned."""
        belief = self.claims.belief
        return self.fitting.chain if belief is None else belief.chain

    def _era(self, prior: KBMap, arm: KnownArm) -> Era:
        return Era(prior, arm, self.claims, self._settings, self._task_numbers)

    def _drawn(self, chain: RigidChain) -> KnownArm:
        return KnownArm(self._nominal.belief(chain, chain_tolerances(self._settings)), self._tolerances)

    @property
    def _tolerances(self) -> ChainTolerances:
        return self._nominal.tolerances(chain_tolerances(self._settings))
