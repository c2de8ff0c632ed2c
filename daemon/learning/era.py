"""An era: what is learnt with one tool on top of one prior."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial

import numpy as np

from daemon.config import LearnerConfig
from interfaces.records import FloatArray, Pair
from kbmaps import ChainBelief, KBMap, follow_a_path

from .arm import KnownArm
from .claims import Claims
from .doubts import Doubts
from .gate import DOUBT, limit_m, sound
from .learnt import LearntModel
from .members import EXACT, INSTANT, PRIOR, RESIDUAL, RIGID, Members
from .memory import PairMemory, Permutations
from .orientation import OrientationModel, Orientations
from .orientation_solver import OrientationSolution
from .solver import Solved, Task
from .state import NET, LearningHeader
from .watch import LOOKED_BACK as KNOWN_PAIRS
from .watch import Reference, Watch

# So many of the learnt pairs say how well a model fits what it knows.
LOOKED_BACK = 500
# Pairs from which the errors of a prior that was fitted anew are taken, and that are replayed on top of it.
RECENT = 200
REPLAY_STEPS = 64
# So many of the pairs that came while the solver worked judge its solution.
JUDGED_LATE = 100
# With so many new pairs for each that a solution knows, the last solution was another one: it is judged by these alone.
JUDGED_ANEW = 0.25
LOOKED_BACK_IN_REPLAY = 4
# Of so many pairs, the chain is believed before it has predicted any. Of fewer, one that is wrong would not show.
FEWEST_TO_BELIEVE = 3


class Era:
    """Learns side by side the models of one tool, and chooses the one that answers.

    It has no lock of its own. What the eras before it taught comes as `prior`, `arm` and `claims`.

    Args:
        prior: the map to learn on top of.
        arm: what is known of the arm before the first pair.
        claims: what the models are said to be wrong by; followed here while the era lasts.
        settings: of the learner.
        task_numbers: numbers for the solver's tasks that no other era has.

    Attributes:
        members: the models.
        memory: the pairs with this tool.
        doubts: those that are doubted.
        orientations: how the marker is turned, where pairs say so.
        watch: whether the pairs show a change.
        arm: as given, or with the last solutions where these stand for pairs that are no longer kept.
        answering: the model that answers.
        task_number: of the solver's present task.
    """

    def __init__(
        self, prior: KBMap, arm: KnownArm, claims: Claims, settings: LearnerConfig, task_numbers: Iterator[int]
    ) -> None:
        self.members = Members(prior, settings.step_size)
        self.memory = PairMemory(prior.joints, settings.replay_capacity)
        self.doubts = Doubts(prior.joints)
        self.orientations = Orientations(arm.chain.chain)
        self.watch = Watch()
        self.arm = arm
        self.answering = self._answering_map = PRIOR
        self._claims, self._replays_per_pair = claims, settings.replays_per_pair
        claims.expect(arm.chain)
        self._order = Permutations(settings.seed)
        self._replays_due = 0.0
        self._solver_prior: KBMap | None = None
        self._task_numbers = task_numbers
        self.task_number = next(task_numbers)

    @property
    def model(self) -> LearntModel:
        """The model that answers."""
        return self.members.model(self.answering)

    @property
    def map(self) -> KBMap:
        """The answering model if it is a KB-Map, else the best that is one."""
        return self.members.map(self._answering_map)

    @property
    def task(self) -> Task:
        """What the solver has to solve."""
        known = self._solver_prior
        prior = known or self.members.prior
        return Task(
            self.task_number,
            prior,
            self.arm.chain,
            self.arm.residual,
            prior_stays=known is not None,
            tolerances=self.arm.tolerances,
        )

    @property
    def owes_replays(self) -> bool:
        """Whether there are replay steps to do."""
        return self._replays_due >= 1.0 and len(self.memory) > 0

    def limit_m(self, pair: Pair) -> float:
        """How far from its prediction the pair may lie before it is doubted [m]."""
        variance = np.diag(pair.cov)
        claimed = float(
            np.sqrt(
                self._claims.of(self.answering, partial(self.members.predict, self.answering))
                .variance(pair.q[None])
                .sum()
            )
        )
        recent = max(self._claims.errors[self.answering].rms_m, float(np.sqrt(variance.sum())))
        return limit_m(recent, claimed)

    def learn(self, pair: Pair) -> bool:
        """Learn one pair at once; False if it is doubted."""
        errors, limit = self.members.errors(pair.q, pair.x), self.limit_m(pair)
        if self.doubts.doubt(pair.q, pair.x, float(np.linalg.norm(errors[self.answering])), limit):
            self.members.learn(pair.q, errors[INSTANT], limit / DOUBT)  # a step no longer than any other
            self.watch.add(pair, kept=False)
            return False
        delayed = None if self.members.delayed is None else pair.x - self.members.delayed.predict(pair.q)
        self._claims.predicted(pair.q, pair.x, errors, np.diag(pair.cov), delayed)
        self._choose()
        self.members.learn(pair.q, errors[INSTANT], np.inf)
        self._learn_turn(pair.q, pair.R, pair.cov_R)
        self._keep(pair.q, pair.x, pair.R)
        self._replays_due += self._replays_per_pair
        self.watch.add(pair, kept=True)
        return True

    def learn_waiting(self, q: FloatArray, x: FloatArray, turns: FloatArray, belief: ChainBelief) -> None:
        """Learn pairs, q (n, d) and x (n, 3), that waited for the prior: each once, in their order.

        Args:
            turns: their orientations, quaternions (n, 4), NaN where a pair has none.
            belief: what they let believe of the chain.
        """
        self._claims.fitted(belief)
        variance = np.full(3, belief.noise**2)
        for row_q, row_x, turn in zip(q, x, turns, strict=True):
            errors = self.members.errors(row_q, row_x)
            self._claims.predicted(row_q, row_x, errors, variance)
            self.members.learn(row_q, errors[INSTANT], np.inf)
            self._learn_turn(row_q, turn)
            self._keep(row_q, row_x, turn)
        self._choose()
        self._replays_due += self._replays_per_pair * len(q)

    def begin_with(self, q: FloatArray, x: FloatArray) -> None:
        """Learn pairs, q (n, d) and x (n, 3), that were doubted until they began this era."""
        for row_q, row_x in zip(q, x, strict=True):
            self._keep(row_q, row_x)
        self.members.replay(q, x)

    def replay(self) -> int:
        """Some of the steps that are owed; how many they were."""
        if not self.owes_replays:
            return 0
        places = self._order.take(min(REPLAY_STEPS, int(self._replays_due)), len(self.memory))
        q, x = self.memory.at(places)
        seen = slice(LOOKED_BACK_IN_REPLAY)
        self._claims.replayed(x[seen] - self.members.predict(INSTANT, q[seen]))
        self.members.replay(q, x)
        self._replays_due -= len(places)
        return len(places)

    def set_aside(self, prior: KBMap) -> int:
        """Leave out those of the first pairs that `prior`, a robust fit to them, contradicts; how many they were.

        They are perhaps still those of the old tool.
        """
        (q, x), turns = self.memory.all(), self.memory.turns_since(0)
        belongs = sound(np.linalg.norm(x - prior.predict(q), axis=1), self._claims.noise_m)
        if belongs.all():
            return 0
        self.memory.clear()
        for row_q, row_x, turn in zip(q[belongs], x[belongs], turns[belongs], strict=True):
            self.memory.append(row_q, row_x, turn)
        self._order.restart()
        self._claims.forget_contest()
        self.task_number = next(self._task_numbers)
        return int((~belongs).sum())

    def change_prior(self, prior: KBMap) -> None:
        """Another prior was fitted to the same pairs."""
        q, x = self.memory.all()
        self.members.start_again(prior, q, x)
        self._claims.prior_changed(x[-RECENT:] - prior.predict(q[-RECENT:]))
        self._choose_map()
        self._replays_due += self._replays_per_pair * min(len(q), RECENT)

    def ask(self) -> None:
        """The solver works on all pairs up to here."""
        self._claims.solution_asked()
        self.members.ask()
        self.watch.asked()

    def take(self, solved: Solved, model: LearntModel, fed: int) -> None:
        """A solution of this era's task, for one of the models; the solver has `fed` pairs."""
        self.members.take(solved.name, model)
        q, x = self.memory.some(fed, LOOKED_BACK)
        neighbours = follow_a_path(self.members.prior, q)
        errors = x - model.predict(q)
        self._claims.solution_taken(solved.name, errors, solved.belief, solved.wide, neighbours=neighbours)
        self._judge_late(solved.name, model, solved.pairs)
        self._choose()
        if self.watch.wants_reference and solved.pairs == fed:
            self._offer(fed)

    def _offer(self, known: int) -> None:
        """The model that answers, of `known` pairs, may be what later pairs are held against."""
        belief, wide = self._claims.belief, self._claims.wide
        if belief is None or wide is None:
            return
        q, x, _ = self.memory.since(known - KNOWN_PAIRS, KNOWN_PAIRS)
        claim = self._claims.of(self.answering, self.model.predict)
        variance = self._claims.errors[PRIOR].noise_variance
        residual = self._claims.residual
        self.watch.offer(Reference(self.model, self.map, belief, wide, residual, claim, known, q, x, variance))

    def take_orientation(self, solution: OrientationSolution) -> None:
        """A solution of this era's task for the orientations."""
        self.orientations.take(solution)

    @property
    def orientation(self) -> OrientationModel | None:
        """The model that answers how the marker is turned; None where nothing was learnt of it."""
        return self.orientations.model(self._claims.support)

    def solve_from_what_is_known(self) -> None:
        """Where pairs are no longer kept, the last solutions stand for them in the place of what was before."""
        if EXACT in self.members.names and not self.memory.complete:
            self._solver_prior = self.members.map(EXACT)
            self.arm = self.arm.updated(self._claims.wide, self._claims.residual)

    def store(self, header: LearningHeader) -> dict[str, FloatArray]:
        """Write into `header` what `restore` has to know; the arrays that it needs beside the kept pairs."""
        header.answering, header.replays_due = self.answering, self._replays_due
        header.doubted_in_a_row = self.doubts.in_a_row
        header.belief = self.arm.chain.to_bytes()
        header.residual = None if self.arm.residual is None else self.arm.residual.to_bytes()
        header.replay_position = self._order.position
        header.orientation = self.orientations.state()
        q, x = self.doubts.run()
        return {"doubted_q": q, "doubted_x": x} | {NET + name: net for name, net in self.members.nets().items()}

    def restore(self, header: LearningHeader, arrays: Mapping[str, FloatArray]) -> None:
        """Go on from a state of an era with this prior and arm."""
        nets = {name.removeprefix(NET): net for name, net in arrays.items() if name.startswith(NET)}
        self.members.restore(nets, self._claims.residual)
        self.memory.restore(arrays["q"], arrays["x"], header.kept_of, arrays.get("turns"))
        if header.orientation is not None:
            self.orientations.restore(header.orientation)
        self.doubts.restore(arrays["doubted_q"], arrays["doubted_x"], header.doubted_in_a_row)
        self.answering, self._replays_due = header.answering, header.replays_due
        self._order.restore(header.replay_position)
        self._choose_map()
        self.solve_from_what_is_known()

    def _judge_late(self, name: str, model: LearntModel, pairs: int) -> None:
        """What came while the solver worked is new to its solution: a pair that it had not learnt judges it fairly."""
        q, x, _ = self.memory.since(max(pairs, self.memory.count - JUDGED_LATE))
        if len(q):
            self._claims.predicted_late(
                name, model.predict, q, x - model.predict(q), anew=len(q) >= JUDGED_ANEW * pairs
            )

    def _learn_turn(self, q: FloatArray, turn: FloatArray | None, cov: FloatArray | None = None) -> None:
        if turn is not None and np.isfinite(turn).all():
            self.orientations.learn(q, turn, cov, self._claims.support)

    def _keep(self, q: FloatArray, x: FloatArray, turn: FloatArray | None = None) -> None:
        self.memory.append(q, x, turn)
        self._claims.learnt(q)

    def _choose(self) -> None:
        self.answering = self._claims.best(self.answering)
        if self.answering == PRIOR and self.memory.count >= FEWEST_TO_BELIEVE and self._claims.untried(RIGID):
            self.answering = RIGID  # the same, after some pairs
        self._choose_map()

    def _choose_map(self) -> None:
        self._answering_map = self._claims.best_map(PRIOR) if self.answering == RESIDUAL else self.answering
