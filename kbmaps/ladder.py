"""Several models side by side, of which the best predictor answers."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray, rows_or_vector
from kbmaps.chains.chain import RigidChain
from kbmaps.chains.parameters import ChainTolerances
from kbmaps.chains.rigid_learner import RigidLearner
from kbmaps.chains.rigid_recursive import RecursiveRigidLearner
from kbmaps.chains.tool_layer import ToolLayer
from kbmaps.contest import PrequentialComparison
from kbmaps.errors import KBMapsError, ModelFormatError, SettingError
from kbmaps.kernel.kernel_learner import KernelLearner
from kbmaps.maps.basis import learning_bases
from kbmaps.model import Estimate, Model
from kbmaps.packed import complete, count, flag, named, number, pack, restoring, unpack
from kbmaps.pairs import checked_pairs, runs, stored_pairs
from kbmaps.residual.learner import ResidualLearner
from kbmaps.trains.learner import TensorLearner

_KIND = "ladder, 2"
_RUNG = ("name", "class", "growth", "extrapolates", "asked", "failure", "model")
_STORED: tuple[type[Model], ...] = (
    KernelLearner,
    RecursiveRigidLearner,
    ResidualLearner,
    RigidLearner,
    TensorLearner,
    ToolLayer,
)
# Errors that a model may raise on unsuitable pairs. It is then left out, and the others continue. Other errors are bugs
# in a model's code and must surface. (numpy's LinAlgError is a ValueError.)
_FAILURES = (KBMapsError, ArithmeticError, np.linalg.LinAlgError)


@dataclass(frozen=True)
class Rung:
    """Model on a ladder, with its settings.

    Attributes:
        model: from now on it must learn through the ladder alone.
        growth: it learns the new pairs once they are this share of those it has learnt. 0 learns each pair at once.
        extrapolates: True if it may answer away from the data.

    Raises:
        SettingError: growth is negative or not finite.
    """

    model: Model
    growth: float = 0.25
    extrapolates: bool = True

    def __post_init__(self) -> None:
        if not (self.growth >= 0.0 and math.isfinite(self.growth)):
            raise SettingError(f"growth must be 0 or greater, got {self.growth!r}")


class Ladder(Model):
    """Holds models side by side, lets each learn at its own pace, and answers with the best predictor.

    Each pair is predicted by every model before it is learnt. The answer comes from the most trusted model that is not
    clearly worse than another on the last pairs (`PrequentialComparison`). Where that model has no data and may not
    extrapolate, the best of the models that may answers.

    A model that fails, has too few pairs yet, or predicts values that are not finite, is left out, without effect on
    the others. It keeps learning when due, and returns when its predictions are finite; its earlier predictions then do
    not count.

    When `learn` gets many pairs at once, the answering model has learnt all of them on return. With single pairs, each
    model learns when it is due.

    Args:
        rungs: the models by name, the most trusted first. A clear difference takes many pairs to show, so put first a
            model that errs little even where it is not the best: one that falls back by itself, or one with fewer free
            parameters.

    Raises:
        SettingError: no rung, none that extrapolates, models of different numbers of joints, or one that has learnt.

    Example:
        >>> import numpy as np
        >>> from kbmaps import ChainTolerances, Ladder, RigidChain
        >>> fixed = np.tile(np.eye(4), (3, 1, 1))
        >>> fixed[1:, 0, 3] = 0.3, 0.2  # links [m]
        >>> arm = RigidChain(fixed, axes=[[0, 0, 1], [0, 1, 0]], prismatic=[False, False])
        >>> drawing = arm.with_tool([0.0, 0.0, 0.1])  # wrong about the marker
        >>> ladder = Ladder.around(drawing, ChainTolerances(tool=0.1), [-1, -1], [1, 1])
        >>> q = np.random.default_rng(0).uniform(-1, 1, (20, 2))
        >>> ladder.learn(q, arm.positions(q))
        >>> ladder.predict([0.0, 0.0]).round(6) + 0.0
        array([0.5, 0. , 0. ])
    """

    def __init__(self, rungs: Mapping[str, Rung]) -> None:
        self._rungs = dict(rungs)
        self._joints = self._checked_joints()
        if any(rung.model.pairs for rung in rungs.values()):
            raise SettingError("the models of a ladder must not have learnt before it")
        self._q, self._x, self._sigma = np.empty((0, self._joints)), np.empty((0, 3)), np.empty(0)
        self._asked = dict.fromkeys(self._rungs, 0)
        self._failures: dict[str, str] = {}
        self._contest = PrequentialComparison()
        for name in self._rungs:
            self._hear(name, self._q)
        self._answering = self._answers_first()

    @classmethod
    def around(cls, nominal: RigidChain, tolerances: ChainTolerances, lower: ArrayLike, upper: ArrayLike) -> Ladder:
        """Return the usual ladder for a nominal arm: rigid chain with residual, rigid chain, tensor train.

        The residual comes first, which suits pairs that are spread: for a rigid arm it errs nearly as the chain does,
        and for another arm the chain is far off. On guided paths, the chain placed first is better away from them.

        Args:
            nominal: the nominal chain.
            tolerances: standard deviations of the real chain about it.
            lower, upper: joint limits (d,) [rad, m].

        Raises:
            ShapeError, NonFiniteError, BasisError: the limits do not fit the chain.
        """
        bases = learning_bases(lower, upper, nominal.prismatic.tolist())
        train = TensorLearner.around(
            nominal,
            bases,
            turn_std=_proper(tolerances.axes, math.radians(3.0)),
            shift_std=_proper(tolerances.points, 0.015),
            marker_std=_proper(tolerances.tool, 0.03),
        )
        residual = ResidualLearner(nominal, tolerances)
        return cls(
            {
                "residual": Rung(residual),
                "rigid": Rung(residual.rigid.twin()),
                "train": Rung(train, extrapolates=False),
            }
        )

    @property
    def joints(self) -> int:
        return self._joints

    @property
    def pairs(self) -> int:
        return len(self._q)

    @property
    def answering(self) -> str:
        """Name of the answering model."""
        return self._answering

    @property
    def models(self) -> Mapping[str, Model]:
        """Models by name. Do not call their `learn`."""
        return {name: rung.model for name, rung in self._rungs.items()}

    @property
    def failures(self) -> Mapping[str, str]:
        """Reasons why models are currently left out, by name."""
        return dict(self._failures)

    def errors(self) -> dict[str, float]:
        """Return each model's RMS prediction error on the last pairs, before learning them [m]."""
        return {
            name: math.sqrt(float(np.nanmean(squares)))
            for name, squares in self._contest.errors.items()
            if np.isfinite(squares).any()
        }

    def learn(self, q: ArrayLike, x: ArrayLike, sigma: ArrayLike | None = None) -> None:
        """Learn pairs q (n, d) [rad, m] and x (n, 3) [m], or one, in the order of recording; see `Model.learn`."""
        angles, positions, sigmas = checked_pairs(q, x, sigma, self._joints)
        begin, end = self.pairs, self.pairs + len(angles)
        self._q = np.concatenate([self._q, angles])
        self._x = np.concatenate([self._x, positions])
        self._sigma = np.concatenate([self._sigma, sigmas])
        while begin < end:
            until = min(end, max(begin + 1, self._next_due()))
            self._judge(slice(begin, until))
            for name in self._rungs:
                if until >= self._due(name):
                    self._teach(name, until)
            begin = until
        self._choose()
        if len(angles) > 1:
            self._catch_up()

    def predict(self, q: ArrayLike) -> FloatArray:
        angles = rows_or_vector("q", q, self._joints)
        if self._rungs[self._answering].extrapolates:
            return self._rungs[self._answering].model.predict(angles)
        return self.estimate(angles).x

    def jacobian(self, q: ArrayLike) -> FloatArray:
        angles = rows_or_vector("q", q, self._joints)
        rung = self._rungs[self._answering]
        if rung.extrapolates:
            return rung.model.jacobian(angles)
        batch = np.atleast_2d(angles)
        columns = rung.model.jacobian(batch)
        outside = ~rung.model.estimate(batch).in_support
        if outside.any():
            columns[outside] = self._fallback().jacobian(batch[outside])
        return columns[0] if angles.ndim == 1 else columns

    def estimate(self, q: ArrayLike) -> Estimate:
        angles = rows_or_vector("q", q, self._joints)
        batch, rung = np.atleast_2d(angles), self._rungs[self._answering]
        inside = rung.model.estimate(batch)
        outside = ~inside.in_support
        if rung.extrapolates or not outside.any():
            return inside.like(angles)
        fallback = self._fallback().estimate(batch[outside])
        x, sigma = inside.x.copy(), inside.sigma.copy()
        x[outside], sigma[outside] = fallback.x, fallback.sigma
        return Estimate(x, sigma, inside.in_support).like(angles)

    def to_bytes(self) -> bytes:
        entries = [
            {
                "name": name,
                "class": type(rung.model).__name__,
                "growth": rung.growth,
                "extrapolates": rung.extrapolates,
                "asked": self._asked[name],
                "failure": self._failures.get(name),
                "model": base64.b64encode(rung.model.to_bytes()).decode(),
            }
            for name, rung in self._rungs.items()
        ]
        errors = self._contest.errors
        fields = {"rungs": entries, "answering": self._answering, "judged": self._contest.pairs, "judges": list(errors)}
        stacked = np.array(list(errors.values())) if errors else np.empty((0, 0))
        return pack(_KIND, fields, {"q": self._q, "x": self._x, "sigma": self._sigma, "errors": stacked})

    @classmethod
    def from_bytes(cls, data: bytes, kinds: Sequence[type[Model]] = ()) -> Self:
        """Return the ladder in `data`.

        Args:
            data: the result of `to_bytes`.
            kinds: the classes of its models that are not of this package.

        Raises:
            ModelFormatError: wrong type of model, or damaged, or has models of unknown classes.
        """
        fields, arrays = unpack(data, _KIND)
        classes = {kind.__name__: kind for kind in (*_STORED, *kinds)}
        with restoring("a ladder"):
            named(fields, "the fields", ("rungs", "answering", "judged", "judges"))
            complete(arrays, ("q", "x", "sigma", "errors"))
            entries = [named(entry, "a rung", _RUNG) for entry in fields["rungs"]]
            ladder = cls.__new__(cls)
            ladder._rungs = {entry["name"]: _restored(entry, classes) for entry in entries}
            ladder._restore(fields, entries, arrays)
        return ladder

    def _restore(
        self, fields: Mapping[str, Any], entries: Sequence[Mapping[str, Any]], arrays: Mapping[str, FloatArray]
    ) -> None:
        self._joints = self._checked_joints()
        self._q, self._x, self._sigma = stored_pairs(arrays, self._joints)
        self._asked = {entry["name"]: count(entry["asked"], "asked") for entry in entries}
        failures = {entry["name"]: entry["failure"] for entry in entries}
        self._failures = {name: failure for name, failure in failures.items() if failure is not None}
        judges, errors = fields["judges"], arrays["errors"]
        if errors.ndim != 2 or not (errors >= 0.0)[~np.isnan(errors)].all() or not set(judges) <= set(self._rungs):
            raise ModelFormatError("its contest names unknown models")
        self._contest = PrequentialComparison(dict(zip(judges, errors, strict=True)), count(fields["judged"], "judged"))
        self._answering = fields["answering"]
        if len(self._rungs) != len(entries) or self._answering not in self._rungs:
            raise ModelFormatError("two of its models have one name, or the one that answers is not on it")
        if any(rung.model.pairs > self._asked[name] for name, rung in self._rungs.items()):
            raise ModelFormatError("a model on it has learnt more pairs than it was asked to")
        if max(*self._asked.values(), 0) > self.pairs or self._contest.pairs != self.pairs:
            raise ModelFormatError(f"it has {self.pairs} pairs, and its models had more, or others")
        if not {type(failure) for failure in failures.values()} <= {str, type(None)}:
            raise ModelFormatError("it is not said in words why a model is out")

    def _checked_joints(self) -> int:
        """Return the models' number of joints. Raises SettingError: they cannot form a ladder."""
        joints = {rung.model.joints for rung in self._rungs.values()}
        if len(joints) != 1:
            raise SettingError(f"a ladder needs models of one number of joints, got {sorted(joints) or 'none'}")
        if not any(rung.extrapolates for rung in self._rungs.values()):
            raise SettingError("a ladder needs a model that may extrapolate")
        return joints.pop()

    def _working(self) -> list[str]:
        return [name for name in self._rungs if name not in self._failures]

    def _answers_first(self) -> str:
        """Return the model that answers while there is nothing to compare: the first that may answer everywhere."""
        return next(name for name in (*self._working(), *self._rungs) if self._rungs[name].extrapolates)

    def _due(self, name: str) -> float:
        """Return the number of pairs at which a model learns again, or tries to."""
        asked = self._asked[name]
        return asked + max(1.0, self._rungs[name].growth * asked)

    def _next_due(self) -> int:
        return math.ceil(min(self._due(name) for name in self._rungs))

    def _judge(self, part: slice) -> None:
        """Record every model's prediction of pairs that it has not learnt."""
        squares: dict[str, FloatArray] = {}
        for name in self._working():
            try:
                errors = self._x[part] - self._rungs[name].model.predict(self._q[part])
            except _FAILURES as error:
                self._leave_out(name, str(error))
                continue
            with np.errstate(over="ignore"):  # an absurd prediction has an infinite error, which is ignored
                squares[name] = np.square(errors).sum(axis=1)
        for k in range(part.stop - part.start):
            self._contest.add({name: float(values[k]) for name, values in squares.items()})

    def _teach(self, name: str, until: int) -> None:
        """Teach a model the pairs that it has not learnt yet, up to `until`."""
        model = self._rungs[name].model
        part = slice(model.pairs, until)
        told = ~np.isnan(self._sigma[part])
        self._asked[name] = until
        try:
            for run in runs(told):
                these = slice(part.start + run.start, part.start + run.stop)
                model.learn(self._q[these], self._x[these], self._sigma[these] if told[run.start] else None)
        except _FAILURES as error:
            self._leave_out(name, str(error))
            return
        self._hear(name, self._q[part])

    def _hear(self, name: str, q: FloatArray) -> None:
        """Admit a model whose predictions at q (n, d) are finite; leave out any other."""
        try:
            finite = bool(np.isfinite(self._rungs[name].model.predict(q)).all())
        except _FAILURES as error:
            self._leave_out(name, str(error))
            return
        if finite:
            self._failures.pop(name, None)
        else:
            self._leave_out(name, "it predicted what is not finite")

    def _leave_out(self, name: str, reason: str) -> None:
        """Leave a model out until it has learnt on; its earlier predictions then do not count."""
        self._failures[name] = reason
        self._contest.forget(name)

    def _choose(self) -> None:
        working = self._working()
        self._answering = self._best(working) if working else self._answering

    def _best(self, names: Sequence[str]) -> str:
        present = self._answering if self._answering in names else None
        return self._contest.best(names, present or (names[0] if names else self._answers_first()))

    def _fallback(self) -> Model:
        """Return the model that answers where the answering model has no data and may not extrapolate."""
        return self._rungs[self._best([name for name in self._working() if self._rungs[name].extrapolates])].model

    def _catch_up(self) -> None:
        """Teach the answering model all pairs; if it fails, continue with the next best."""
        while self._working() and self._asked[self._answering] < self.pairs:
            self._teach(self._answering, self.pairs)
            self._choose()


def _restored(entry: Mapping[str, Any], classes: Mapping[str, type[Model]]) -> Rung:
    kind = classes.get(str(entry["class"]))
    if kind is None:
        raise ModelFormatError(f"the class {entry['class']} is not known. Name it in `kinds`, or learn again")
    model = kind.from_bytes(base64.b64decode(entry["model"], validate=True))
    return Rung(model, number(entry["growth"], "growth"), flag(entry["extrapolates"], "extrapolates"))


def _proper(tolerance: float, default: float) -> float:
    """Return a tolerance that a Gaussian prior can have."""
    return tolerance if 0.0 < tolerance < math.inf else default
