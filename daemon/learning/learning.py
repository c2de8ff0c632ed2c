"""The learner: pairs in, models side by side, a snapshot that answers.

Two threads may use one object: one calls `learn`, the other `work`, and each holds the lock for short pieces only.
Whoever answers queries takes `snapshot`, which needs no lock.
"""

from __future__ import annotations

import copy
import threading

import numpy as np

from daemon.config import LearnerConfig
from daemon.status import CurvePoint
from interfaces.records import FloatArray, Pair
from kbmaps import ChainBelief, KBMap, ResidualModel, RigidChain, follow_a_path

from .arm import KnownArm
from .claims import Claims
from .curve import Curve
from .doubts import Doubts
from .fitting import Fit, Fitting
from .gate import DOUBT, explained, limit_m, sound
from .incoming import check_pair
from .learnt import LearntModel
from .members import EXACT, INSTANT, PRIOR, SOLVED, Members
from .memory import PairMemory, Permutations
from .nominal import PAIRS_TO_REFIT, NominalModel, chain_tolerances
from .outlook import Known
from .snapshot import Snapshot
from .solver import Solver, Task
from .solving import Solving
from .state import Counters, LearningHeader, LearningState, StateError

# RMS distance between a nominal model and reality that surprises nobody [m].
EXPECTED_M = 0.1
# Pairs that a model has to have predicted before its errors say what is to be expected.
FEWEST_TO_CLAIM = 5.0
# So many of the learnt pairs say how well a model fits what it knows.
LOOKED_BACK = 500
# Pairs from which the errors of a prior that was fitted anew are taken, and that are replayed on top of it.
RECENT = 200
REPLAY_STEPS = 64
# So many of the pairs that came while the solver worked judge its solution.
JUDGED_LATE = 100
# With so many new pairs for each that a solution knows, the last solution was another one.
MANY_NEW = 0.25
FEED_PAIRS = 256
REGION_RAD = np.radians(3.0)
REGION_SAMPLES = 256
LOOKED_BACK_IN_REPLAY = 4


class Learning:
    """Learns the forward kinematics of one robot from pairs."""

    def __init__(self, nominal: NominalModel, settings: LearnerConfig, solver: Solver) -> None:
        self._nominal, self._settings = nominal, settings
        self._solving = Solving(solver, settings.solve_every)
        self._lock = threading.Lock()
        self._counters, self._curve = Counters(), Curve()
        self._memory = PairMemory(nominal.joints, settings.replay_capacity)
        self._doubts = Doubts(nominal.joints)
        self._learnt_at: float | None = None
        self._task = 0
        self._tolerances = chain_tolerances(settings)
        self._begin_at_nominal()
        self._publish()

    @property
    def snapshot(self) -> Snapshot:
        """The model that answers now."""
        return self._snapshot

    @property
    def belief(self) -> ChainBelief | None:
        """What the pairs with the present tool let believe of the chain; None before the first solution."""
        return self._claims.belief

    @property
    def nominal(self) -> NominalModel:
        """Where learning starts."""
        return self._nominal

    @property
    def aligning(self) -> bool:
        """Whether the frame is not known yet."""
        return self._members is None

    @property
    def at_rest(self) -> bool:
        """Whether no work is left with the pairs that came: nothing to fit, to solve or to replay.

        For the thread that calls `work`.
        """
        with self._lock:
            count = self._memory.count
            if self._fitting.due(count):
                return False
            return self._members is None or (self._replays_due < 1.0 and self._solving.has_solved(self._task, count))

    @property
    def counters(self) -> Counters:
        """A copy of all that is counted."""
        with self._lock:
            return copy.copy(self._counters)

    @property
    def curve(self) -> list[CurvePoint]:
        """Mean prequential error [m] of the answering model over the pairs."""
        with self._lock:
            return self._curve.points

    def prequential_m(self) -> dict[str, float]:
        """Recent mean distance between prediction and measurement, before learning [m], by model."""
        with self._lock:
            means = {name: memory.mean_m for name, memory in self._claims.errors.items()}
        return {name: mean for name, mean in means.items() if mean is not None}

    def claimed_error_m(self) -> float | None:
        """Mean distance to the truth [m] that is claimed in the data's region; None while there are too few pairs.

        The region: within a few degrees (`REGION_RAD` per joint) of the kept pairs.
        """
        with self._lock:
            answering, snapshot, count = self._claims.errors.get(self._answering), self._snapshot, len(self._memory)
            if answering is None or answering.weight < FEWEST_TO_CLAIM:
                return None
            rng = np.random.default_rng(0)
            q, _ = self._memory.at(rng.integers(count, size=REGION_SAMPLES))
        return snapshot.expected_error_m(q + rng.normal(0.0, 1.0, q.shape) * self._nominal.reach(REGION_RAD))

    def known(self) -> Known | None:
        """What is known of the chain now; None before the first solution with the present tool.

        For the thread that calls `work`.
        """
        with self._lock:
            claims, memory = self._claims, self._memory
            if claims.belief is None or not self._solving.fed:
                return None
            seen, _ = memory.some(memory.count, LOOKED_BACK)
            q, x, _ = memory.since(self._solving.fed - LOOKED_BACK, LOOKED_BACK)  # those that the solver knows
            return Known(
                nominal=self._nominal,
                belief=claims.belief,
                tolerances=self._tolerances,
                claim=claims.of(self._answering),
                solved=self._answering in SOLVED,
                pairs=self._counters.since_change,
                seen=seen,
                q=q,
                x=x,
            )

    def learn(self, pair: Pair, now: float) -> None:
        """Learn one pair at once.

        Raises:
            RequestError: it is not a pair of this robot and store, or not newer than the last one; nothing changed.
        """
        with self._lock:
            check_pair(pair, self._counters, self._nominal.joints)
            self._counters.store, self._counters.last_seq = pair.store, pair.seq
            self._counters.pairs += 1
            self._counters.since_change += 1
            self._learnt_at = now
            if self._members is None:
                self._memory.append(pair.q, pair.x)
            else:
                self._learn_online(self._members, pair)
            self._publish()

    def refuse(self) -> None:
        """Count a pair that could not be taken."""
        with self._lock:
            self._counters.refused += 1

    def recovered(self, pairs: int) -> None:
        """Count pairs that had to be fetched from history."""
        with self._lock:
            self._counters.gaps_recovered += pairs

    def tool_changed(self) -> None:
        """From now on another tool: pairs so far no longer count, what they taught is where learning starts again."""
        with self._lock:
            self._change_tool(EXPECTED_M)
            self._publish()

    def reset_to_prior(self, *, forget_store: bool = False) -> None:
        """Forget what was learnt. With `forget_store`, pairs may come from another store, from its first one on."""
        with self._lock:
            if forget_store:
                self._counters = Counters(refused=self._counters.refused)
                self._curve, self._learnt_at = Curve(), None
            self._counters.since_change = 0
            self._begin_at_nominal()
            self._publish()

    def restart_solver(self) -> None:
        """The solver has lost its pairs: give them to it again. For the thread that calls `work`."""
        self._solving.restart()
        with self._lock:
            self._solve_from_what_is_known()

    def solve_soon(self) -> None:
        """Let the solver catch up although fewer than `solve_every` pairs are new. For that thread too."""
        self._solving.solve_soon()

    def work(self) -> bool:
        """One small piece of background work; False when there is none."""
        return self._fit() or self._serve_solver() or self._replay()

    def state(self) -> LearningState:
        """Everything needed to go on from here."""
        with self._lock:
            q, x = self._memory.all()
            doubted_q, doubted_x = self._doubts.all()
            arm = self._arm
            nets = {} if self._members is None else {name: m.net for name, m in self._members.maps.items()}
            header = LearningHeader(
                fingerprint=self._nominal.fingerprint,
                counters=copy.copy(self._counters),
                answering=self._answering,
                claims=copy.deepcopy(self._claims.state()),
                curve=self._curve.points,
                curve_stride=self._curve.stride,
                doubted_in_a_row=self._doubts.in_a_row,
                kept_of=self._memory.count,
                next_fit=self._fitting.due_at,
                first_fit=self._fitting.is_first,
                replays_due=self._replays_due,
                belief=None if arm is None else arm.chain.to_bytes(),
                residual=None if arm is None or arm.residual is None else arm.residual.to_bytes(),
            )
            kept = self._claims.arrays() | self._fitting.arrays()
        kept |= {"q": q, "x": x, "doubted_q": doubted_q, "doubted_x": doubted_x}
        return LearningState(header, kept | {f"net_{name}": net for name, net in nets.items()})

    def restore(self, state: LearningState) -> None:
        """Go on from a state; the solver gets the kept pairs again in the background.

        Raises:
            StateError: it belongs to another nominal model.
        """
        header = state.header
        if header.fingerprint != self._nominal.fingerprint:
            raise StateError("it belongs to another nominal model: robot.toml or the URDF has changed since")
        nets = {name[4:]: net for name, net in state.arrays.items() if name.startswith("net_")}
        with self._lock:
            if nets:
                self._begin(KBMap(self._nominal.bases, nets[PRIOR]), _stored_arm(header))
            else:
                self._begin_at_nominal()
            self._fitting.restore(header.next_fit, header.first_fit, state.arrays)
            self._claims = Claims(self._nominal.bases, EXPECTED_M)
            self._claims.restore(header.claims, state.arrays, state.arrays["q"])
            if nets:
                self._members_now.restore(nets, self._claims.residual)
            self._memory.restore(state.arrays["q"], state.arrays["x"], header.kept_of)
            self._solve_from_what_is_known()
            self._doubts.restore(state.arrays["doubted_q"], state.arrays["doubted_x"], header.doubted_in_a_row)
            self._counters, self._answering = header.counters, header.answering
            self._curve = Curve(header.curve, header.curve_stride)
            self._replays_due = header.replays_due
            self._publish()

    def _begin_at_nominal(self) -> None:
        self._fitting = Fitting(self._nominal)
        self._claims = Claims(self._nominal.bases, EXPECTED_M)
        if self._nominal.frame_known:
            self._begin(self._nominal.prior(), self._drawn(self._nominal.chain))
        else:
            self._begin(None, None)

    def _drawn(self, chain: RigidChain) -> KnownArm:
        return KnownArm(self._nominal.belief(chain, self._tolerances))

    def _begin(self, prior: KBMap | None, arm: KnownArm | None) -> None:
        """Start anew from `prior` and what is known of the arm (None: wait for an alignment), with no pairs."""
        self._members = Members(prior, self._settings.step_size) if prior is not None else None
        self._arm = arm
        self._answering = PRIOR
        self._memory.clear()
        self._doubts.clear()
        self._order = Permutations(self._settings.seed)
        self._replays_due = 0.0
        self._solver_prior: KBMap | None = None
        self._task += 1

    @property
    def _members_now(self) -> Members:
        if self._members is None:
            raise RuntimeError("there are no models before the alignment")
        return self._members

    def _learn_online(self, members: Members, pair: Pair) -> None:
        errors, variance = members.errors(pair.q, pair.x), np.diag(pair.cov)
        limit = self._limit_m(pair.q, variance)
        if self._doubts.doubt(pair.q, pair.x, float(np.linalg.norm(errors[self._answering])), limit):
            self._counters.doubted += 1
            members.learn(pair.q, errors[INSTANT], limit / DOUBT)  # a step no longer than any other
            if self._doubts.changed or (self._doubts.perhaps_changed and self._moved_together(limit / DOUBT)):
                self._follow_change()
            return
        delayed = None if members.delayed is None else pair.x - members.delayed.predict(pair.q)
        self._claims.predicted(pair.q, errors, variance, delayed)
        self._answering = self._claims.best(self._answering)
        self._curve.add(self._counters.pairs, self._claims.errors[self._answering].mean_m or 0.0)
        members.learn(pair.q, errors[INSTANT], np.inf)
        self._keep(pair.q, pair.x)
        self._replays_due += self._settings.replays_per_pair

    def _limit_m(self, q: FloatArray, variance: FloatArray) -> float:
        claimed = float(np.sqrt(self._claims.of(self._answering).variance(q[None]).sum()))
        recent = max(self._claims.errors[self._answering].rms_m, float(np.sqrt(variance.sum())))
        return limit_m(recent, claimed)

    def _keep(self, q: FloatArray, x: FloatArray) -> None:
        self._memory.append(q, x)
        self._claims.learnt(q)

    def _moved_together(self, expected_m: float) -> bool:
        """Whether one other place of the marker on the hand explains the doubted pairs in a row."""
        q, x = self._doubts.run()
        kbmap, answer = self._best_map(self._members_now), self._members_now.models[self._answering].predict(q)
        # Without what the answering model knows beyond the map: it knows that with any tool.
        of_map = x - (answer - kbmap.predict(q))
        moved = self._nominal.with_other_tool(kbmap, self._hand, q, of_map)
        left = np.linalg.norm(of_map - moved.predict(q), axis=1)
        return explained(np.linalg.norm(x - answer, axis=1), left, expected_m)

    @property
    def _hand(self) -> RigidChain:
        """The chain that knows best how the hand is turned."""
        belief = self._claims.belief
        return self._fitting.chain if belief is None else belief.chain

    def _best_map(self, members: Members) -> KBMap:
        """The answering model if it is a KB-Map, else the best that is one."""
        answering = self._answering
        return members.maps[answering if answering in members.maps else self._claims.best_map(PRIOR)]

    def _follow_change(self) -> None:
        """The doubted pairs in a row are the new truth: begin again with them."""
        run_q, run_x = self._doubts.run()
        distances = np.linalg.norm(self._members_now.models[self._answering].predict(run_q) - run_x, axis=1)
        self._change_tool(max(float(np.median(distances)), EXPECTED_M), first_fit=len(run_q))
        for q, x in zip(run_q, run_x, strict=True):
            self._keep(q, x)
        self._members_now.replay(run_q, run_x)
        self._counters.since_change = len(run_q)

    def _change_tool(self, expected_m: float, first_fit: int = PAIRS_TO_REFIT) -> None:
        self._counters.changes += 1
        self._counters.since_change = 0
        if self._members is None or self._arm is None:
            self._begin_at_nominal()
        else:
            before = self._best_map(self._members)
            arm = self._arm.updated(self._claims.belief, self._claims.residual)
            self._fitting.change_tool(before, self._hand, first_fit)
            self._claims.change_tool(expected_m, self._answering)
            self._begin(before, arm.with_other_tool())

    def _fit(self) -> bool:
        """Fit what is not known, or a changed tool, when it is due."""
        with self._lock:
            if not self._fitting.due(self._memory.count):
                return False
            task, count, fitting = self._task, self._memory.count, copy.copy(self._fitting)
            q, x = self._memory.all()
        fit = fitting.fit(q, x)
        with self._lock:
            if task != self._task:
                return True
            if fit is not None and fitting.is_first:
                self._set_aside(fit.prior)
            self._fitting.done(count, fit)
            if fit is not None and self._members is None:
                self._start_members(fit)
            elif fit is not None:
                self._change_prior(self._members_now, fit.prior)
            self._publish()
        return True

    def _set_aside(self, prior: KBMap) -> None:
        """Doubt those of the first pairs that a robust fit to them contradicts: perhaps still the old tool."""
        q, x = self._memory.all()
        belongs = sound(np.linalg.norm(x - prior.predict(q), axis=1), self._claims.noise_m)
        if belongs.all():
            return
        self._counters.doubted += int((~belongs).sum())
        self._memory.clear()
        for row_q, row_x, belonging in zip(q, x, belongs, strict=True):
            (self._memory.append if belonging else self._doubts.set_aside)(row_q, row_x)
        self._order.restart()
        self._claims.forget_contest()
        self._task += 1

    def _solve_from_what_is_known(self) -> None:
        """Where pairs are no longer kept, the last solutions stand for them in the place of what was before."""
        members = self._members
        if self._arm is not None and members is not None and EXACT in members.maps and not self._memory.complete:
            self._solver_prior = members.maps[EXACT]
            self._arm = self._arm.updated(self._claims.belief, self._claims.residual)

    def _change_prior(self, members: Members, prior: KBMap) -> None:
        q, x = self._memory.all()
        members.start_again(prior, q, x)
        self._claims.prior_changed(x[-RECENT:] - prior.predict(q[-RECENT:]))
        self._replays_due += self._settings.replays_per_pair * min(len(q), RECENT)

    def _start_members(self, fit: Fit) -> None:
        """The first alignment: the pairs that waited for it are learnt now, each once, in their order."""
        q, x = self._memory.all()
        self._begin(fit.prior, self._drawn(fit.chain))
        members = self._members_now
        for row_q, row_x in zip(q, x, strict=True):
            errors = members.errors(row_q, row_x)
            self._claims.predicted(row_q, errors, np.zeros(3))
            members.learn(row_q, errors[INSTANT], np.inf)
            self._keep(row_q, row_x)
        self._answering = self._claims.best(self._answering)
        self._replays_due = self._settings.replays_per_pair * len(q)

    def _serve_solver(self) -> bool:
        """Give the solver its pairs, ask it from time to time, take what it found."""
        solving = self._solving
        with self._lock:
            if self._members is None or self._arm is None:
                return False
            known = self._solver_prior
            prior = known or self._members.prior
            task = Task(self._task, prior, self._arm.chain, self._arm.residual, prior_stays=known is not None)
        if solving.busy:
            return self._take_solution()
        if solving.begin(task):
            return True
        with self._lock:
            if task.number != self._task:
                return True
            q, x, fed = self._memory.since(solving.fed, FEED_PAIRS)
            if not len(q) and solving.due:
                self._claims.solution_asked()
                self._members_now.ask()
        if len(q):
            solving.feed(q, x, fed)
        elif solving.due:
            solving.ask()
        else:
            return False
        return True

    def _take_solution(self) -> bool:
        solved = self._solving.poll()
        if solved is None:
            return False
        with self._lock:
            if solved.task == self._task and solved.model is not None:
                self._members_now.take(solved.name, solved.model)
                q, x = self._memory.some(self._solving.fed, LOOKED_BACK)
                errors, neighbours = x - solved.model.predict(q), follow_a_path(self._members_now.prior, q)
                self._claims.solution_taken(solved.name, errors, solved.belief, neighbours=neighbours)
                self._judge_late(solved.name, solved.model, solved.pairs)
                self._publish()
        return True

    def _judge_late(self, name: str, model: LearntModel, pairs: int) -> None:
        """What came while the solver worked is new to its solution: a pair that it had not learnt judges it fairly."""
        q, x, _ = self._memory.since(max(pairs, self._memory.count - JUDGED_LATE))
        if len(q):
            self._claims.predicted_late(name, q, x - model.predict(q), anew=len(q) >= MANY_NEW * pairs)
            self._answering = self._claims.best(self._answering)

    def _replay(self) -> bool:
        with self._lock:
            if self._members is None or self._replays_due < 1.0 or not len(self._memory):
                return False
            places = self._order.take(min(REPLAY_STEPS, int(self._replays_due)), len(self._memory))
            q, x = self._memory.at(places)
            seen = slice(LOOKED_BACK_IN_REPLAY)
            self._claims.replayed(x[seen] - self._members.maps[INSTANT].predict(q[seen]))
            self._members.replay(q, x)
            self._replays_due -= len(places)
            self._counters.replayed += len(places)
            self._publish()
        return True

    def _publish(self) -> None:
        members = self._members
        self._snapshot = Snapshot(
            answering=self._answering,
            model=members.models[self._answering] if members is not None else None,
            map=self._best_map(members) if members is not None else None,
            claim=self._claims.of(self._answering),
            support=self._claims.support,
            pairs=self._counters.pairs,
            learnt_at=self._learnt_at,
            waiting_for=self._waiting_for(),
        )

    def _waiting_for(self) -> str:
        needed, have = self._nominal.pairs_to_align, self._memory.count
        return (
            f"there is no model yet: robot.toml says {self._nominal.unknown}, so positions have no frame until about "
            f"{needed} pairs have come ({have} so far). Start the sampler with `bodyschema sampler` and guide the arm"
        )


def _stored_arm(header: LearningHeader) -> KnownArm | None:
    if header.belief is None:
        return None
    residual = None if header.residual is None else ResidualModel.from_bytes(header.residual)
    return KnownArm(ChainBelief.from_bytes(header.belief), residual)
