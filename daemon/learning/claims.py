"""What each model is said to be wrong by: at the data, away from it, and as its predictions have shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from bodyschema.interfaces.records import FloatArray
from kbmaps import ChainBelief, Contest, JointBasis, Recent, ResidualModel, SupportSet

from .members import INSTANT, PRIOR, RESIDUAL, RIGID, SOLVED, TRUSTED
from .misfit import misfit
from .scores import ErrorMemory
from .unknowns import ChainLayer, DepartureLayer, GrowingSupport, Layer, Predict, Where

_SUPPORT, _CONTEST = "support_q", "squares_"


@dataclass(frozen=True)
class Claim:
    """The 1-sigma of a model.

    Attributes:
        inside: where data was, per axis (3,) [m].
        layers: what the data that the model knows leave open.
        surprise: by how much its predictions were worse than claimed, at least 1.
    """

    inside: FloatArray
    layers: tuple[Layer | ChainLayer | DepartureLayer, ...] = ()
    surprise: float = 1.0

    def variance(self, q: FloatArray) -> FloatArray:
        """Variance per axis of predictions at q (n, d) [rad], shape (n, 3) [m²]."""
        return self.variance_there(Where(q))

    def variance_there(self, where: Where) -> FloatArray:
        """As `variance`."""
        left_open = sum((layer.variance(where) for layer in self.layers), np.zeros((len(where.q), 3)))
        return self.surprise**2 * (self.inside**2 + left_open)

    def beyond_chain(self, q: FloatArray) -> FloatArray:
        """The part of it that is no uncertainty of the chain's numbers at q (n, d) [rad], shape (n, 3) [m²]."""
        where = Where(q)
        open_layers = (layer.variance(where) for layer in self.layers if isinstance(layer, Layer) and layer.sigma > 0.0)
        return self.inside**2 + sum(open_layers, np.zeros((len(q), 3)))


class ClaimsState(msgspec.Struct, kw_only=True):
    """The part of the claims that is not arrays.

    Attributes:
        errors: prequential errors, by model.
        judged: how many pairs there were for the contest so far.
        trusted: the models, the most trusted first.
        residuals: errors of the instant learner on pairs that it has learnt already; None before any.
        misfits: what each solution misses at pairs that it knows, 1-sigma per axis [m].
        misfits_before: what each missed with the last tool, 1-sigma per axis [m].
        belief: what the pairs let believe of the chain, as bytes; None before that was asked.
        wide: the same, were it not for how well the arm seems to be made.
        residual: the chain with residual, as bytes; None before its first solution.
    """

    errors: dict[str, ErrorMemory]
    judged: int
    trusted: tuple[str, ...]
    residuals: ErrorMemory | None
    misfits: dict[str, tuple[float, float, float]]
    misfits_before: dict[str, tuple[float, float, float]]
    belief: bytes | None
    wide: bytes | None
    residual: bytes | None


class Claims:
    """Follows errors and data of all models since the prior was made.

    Args:
        bases: what is learnt in.
        expected_m: RMS distance between prior and reality that is expected before there are errors [m].
    """

    def __init__(self, bases: Sequence[JointBasis], expected_m: float) -> None:
        self._bases = bases
        self._misfits_before: dict[str, FloatArray] = {}
        self._trusted = TRUSTED
        self._begin(expected_m)

    def _begin(self, expected_m: float) -> None:
        self._expected_m = expected_m
        self.errors = {name: ErrorMemory(expected_m) for name in (PRIOR, INSTANT)}
        self._contest = Contest()
        self._residuals: ErrorMemory | None = None
        self._misfits: dict[str, FloatArray] = {}
        self._support = GrowingSupport(self._bases)
        self._asked: SupportSet | None = None
        self._solved: dict[str, SupportSet | None] = {}
        self._expected: ChainBelief | None = None
        self._belief: ChainBelief | None = None
        self._wide: ChainBelief | None = None
        self._residual: ResidualModel | None = None

    def best(self, present: str) -> str:
        """The model that shall answer; `present` while there is nothing to compare."""
        return self._contest.best(self._trusted, present)

    def best_map(self, present: str) -> str:
        """The best of the models that are KB-Maps; `present` while there is nothing to compare."""
        return self._contest.best([name for name in self._trusted if name != RESIDUAL], present)

    def recent(self, answering: str) -> Recent:
        """How far the models were off on the last pairs, each as old as the newest solution."""
        return self._contest.recent(answering)

    @property
    def support(self) -> SupportSet | None:
        """Where data with the present tool was; None before any."""
        return self._support.view

    @property
    def noise_m(self) -> float:
        """RMS distance between measurement and truth [m], as the measurements say."""
        return float(np.sqrt(self.errors[PRIOR].noise_variance.sum()))

    @property
    def belief(self) -> ChainBelief | None:
        """What the pairs with the present tool let believe of the chain; None before that was asked."""
        return self._belief

    @property
    def wide(self) -> ChainBelief | None:
        """The same, were it not for how well the arm seems to be made: what pairs with another tool are added to."""
        return self._wide

    @property
    def residual(self) -> ResidualModel | None:
        """What the pairs with the present tool let believe of the arm as no rigid chain; None before that is solved."""
        return self._residual

    def change_tool(self, expected_m: float, answered: str = PRIOR) -> None:
        """Another tool: nothing is known of the models' errors; what is believed of the arm, `expect` says anew.

        The solved model that answered with the last tool is trusted first with this one: the arm is the same.
        """
        if answered in SOLVED:
            self._trusted = (answered, *(name for name in TRUSTED if name != answered))
        self._misfits_before |= self._misfits
        self._begin(expected_m)

    def expect(self, belief: ChainBelief) -> None:
        """What is believed of the chain before the first pair with the present tool."""
        self._expected = belief

    def fitted(self, belief: ChainBelief) -> None:
        """What the first pairs let believe of the chain, before any solution."""
        self._belief = self._wide = belief

    def untried(self, name: str) -> bool:
        """Whether there is a solution for this model that has predicted too few pairs to be compared."""
        return name in self._misfits and not self._contest.compares(name)

    def predicted(
        self,
        where: Where,
        x: FloatArray,
        predictions: Mapping[str, FloatArray],
        variances: FloatArray,
        delayed: FloatArray | None = None,
    ) -> None:
        """Pairs, in their order, each of which was predicted before it was learnt.

        Args:
            where: their q (n, d) [rad].
            x: what was measured (n, 3) [m].
            predictions: of it (n, 3) [m] by model.
            variances: the measurements' (n, 3) [m²].
            delayed: what the instant learner as old as the solutions predicts (n, 3) [m]. On a path a few pairs are
                far, so the models are compared at the same age.
        """
        for name, predicted in predictions.items():
            errors = x - predicted
            claimed = self.of(name, lambda _, predicted=predicted: predicted).variance_there(where) + variances
            self.errors[name].add(errors, variances, np.square(errors).sum(axis=1) / claimed.sum(axis=1))
        compared = dict(predictions) if delayed is None else {**predictions, INSTANT: delayed}
        self._contest.add({name: np.square(x - each).sum(axis=1) for name, each in compared.items()})

    def learnt(self, q: FloatArray) -> None:
        """Pairs have been learnt at q (n, d) [rad]."""
        self._support.add(q)

    def replayed(self, errors: FloatArray) -> None:
        """Errors (n, 3) [m] of the instant learner at pairs that it has learnt before."""
        self._residuals = self._residuals or ErrorMemory(self._expected_m)
        self._residuals.add(errors, self.errors[PRIOR].noise_variance)

    def solution_asked(self) -> None:
        """The solver works on all pairs up to here."""
        self._asked = self._support.view

    def solution_taken(
        self,
        name: str,
        errors: FloatArray,
        belief: ChainBelief | ResidualModel | None,
        wide: ChainBelief | None = None,
        *,
        neighbours: bool,
    ) -> None:
        """A solution answers for this model from now on.

        Args:
            errors: its errors (n, 3) [m] at pairs that it knows, in their order.
            belief: what is believed of the arm now; None: as before.
            wide: of a chain, the same, were it not for how well it seems to be made.
            neighbours: whether these pairs follow a path.
        """
        self.errors.setdefault(name, ErrorMemory(self._expected_m))
        self._solved[name] = self._asked
        if isinstance(belief, ResidualModel):
            self._residual = belief
        elif belief is not None:
            self._belief, self._wide = belief, wide or belief
        noise = self.errors[PRIOR].noise_variance
        before = self._misfits_before.get(name, self._misfits_before.get(RIGID, np.zeros(3)))
        scatter = 0.0 if belief is None else belief.noise
        self._misfits[name] = misfit(errors, noise, before, neighbours=neighbours, scatter=scatter)

    def predicted_late(
        self, name: str, predict: Predict, q: FloatArray, errors: FloatArray, instant: FloatArray, *, anew: bool
    ) -> None:
        """A solution that was found only now predicts the last pairs, of which it knows none.

        Args:
            predict: its positions (n, 3) [m] at q (n, d) [rad].
            q: where (n, d) [rad], in their order.
            errors: measured minus predicted (n, 3) [m].
            instant: the same of the instant learner as it was when the solution was asked for, NaN where it had learnt
                the pair by then: what that gains it is no merit.
            anew: whether it knows so much more than the last one that what that predicted says nothing of it.
        """
        if anew:
            self._contest.forget(name)
            self.errors[name] = ErrorMemory(self._expected_m)
        for each, missed in ((name, errors), (INSTANT, instant)):
            self._contest.add_late(each, np.square(missed).sum(axis=1))
        noise = self.errors[PRIOR].noise_variance
        claimed = self.of(name, predict).variance(q) + noise
        self.errors[name].add(errors, noise, np.square(errors).sum(axis=1) / claimed.sum(axis=1))

    def forget_contest(self) -> None:
        """Some pairs were no pairs of this tool after all."""
        self._contest = Contest()

    def prior_changed(self, errors: FloatArray) -> None:
        """Another prior for the same pairs; its errors (n, 3) [m] at them."""
        noise = self.errors[PRIOR].noise_variance
        self.errors[PRIOR] = ErrorMemory(self._expected_m)
        self._contest.forget(PRIOR)
        self.errors[PRIOR].add(errors, noise)

    def of(self, name: str, predict: Predict | None = None) -> Claim:
        """What is claimed for one model.

        Args:
            predict: its positions (n, 3) [m] at q (n, d) [rad]; None where there is no model yet.
        """
        memory = self.errors.get(name, ErrorMemory(self._expected_m))
        belief = self._belief or self._expected
        if belief is None or predict is None:
            return Claim(memory.sigma)
        none = np.zeros(3)
        if name in SOLVED:
            chain = self._residual if name == RESIDUAL and self._residual is not None else belief
            return Claim(self._misfits.get(name, none), (ChainLayer(chain), self._rest(name)), memory.surprise)
        if name == PRIOR:
            # The prior is a chain as well, or was learnt with the last tool; it misses what such a chain does.
            inside = self._misfits.get(RIGID, self._misfits_before.get(RIGID, none))
            departure = DepartureLayer(predict, belief)
        else:
            inside = (memory if self._residuals is None else self._residuals).sigma
            departure = DepartureLayer(predict, belief, self.support)
        return Claim(inside, (ChainLayer(belief), departure, self._rest(RIGID)), memory.surprise)

    def _rest(self, name: str) -> Layer:
        """Where no data was, the arm may differ from the chain by as much again as it was seen to."""
        missed = self._misfits.get(RESIDUAL if name == RESIDUAL else RIGID, np.zeros(3))
        return Layer(self._solved.get(name), float(np.sqrt(np.square(missed).mean())))

    def state(self) -> ClaimsState:
        """Everything needed to go on from here that is not in `arrays`."""
        return ClaimsState(
            errors=self.errors,
            judged=self._contest.pairs,
            trusted=self._trusted,
            residuals=self._residuals,
            misfits={name: _triple(missed) for name, missed in self._misfits.items()},
            misfits_before={name: _triple(missed) for name, missed in self._misfits_before.items()},
            belief=None if self._belief is None else self._belief.to_bytes(),
            wide=None if self._wide is None else self._wide.to_bytes(),
            residual=None if self._residual is None else self._residual.to_bytes(),
        )

    def arrays(self) -> dict[str, FloatArray]:
        """The configurations (n, d) [rad] that stand for all data, and squared errors (k,) [m²] by model."""
        return {_SUPPORT: self._support.configurations} | {
            _CONTEST + name: values.copy() for name, values in self._contest.errors.items()
        }

    def restore(self, state: ClaimsState, arrays: Mapping[str, FloatArray]) -> None:
        """Go on from a state and its `arrays`."""
        self._support.add(arrays[_SUPPORT])
        self.errors, self._residuals = dict(state.errors), state.residuals
        squares = {name.removeprefix(_CONTEST): v for name, v in arrays.items() if name.startswith(_CONTEST)}
        self._contest = Contest(squares, state.judged)
        self._misfits = {name: np.array(missed) for name, missed in state.misfits.items()}
        self._trusted = state.trusted
        self._misfits_before = {name: np.array(missed) for name, missed in state.misfits_before.items()}
        self._belief = None if state.belief is None else ChainBelief.from_bytes(state.belief)
        self._wide = None if state.wide is None else ChainBelief.from_bytes(state.wide)
        self._residual = None if state.residual is None else ResidualModel.from_bytes(state.residual)
        self._asked = self._support.view
        self._solved = dict.fromkeys(self._misfits, self._asked)


def _triple(values: FloatArray) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
