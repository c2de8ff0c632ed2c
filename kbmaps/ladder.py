"""Models side by side, of which the one that predicts best answers."""

from __future__ import annotations

import base64
import binascii
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self, cast

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray, rows, rows_or_vector
from kbmaps.chains.chain import RigidChain
from kbmaps.chains.parameters import ChainTolerances
from kbmaps.chains.rigid_learner import RigidLearner
from kbmaps.chains.rigid_recursive import RecursiveRigidLearner
from kbmaps.chains.tool_layer import ToolLayer
from kbmaps.contest import Contest
from kbmaps.errors import KBMapsError, ModelFormatError, SettingError
from kbmaps.kernel.kernel_learner import KernelLearner
from kbmaps.kernel.structured_learner import StructuredLearner
from kbmaps.maps.basis import learning_bases
from kbmaps.model import Estimate, Model
from kbmaps.packed import pack, unpack
from kbmaps.pairs import checked_pairs
from kbmaps.residual.learner import ResidualLearner
from kbmaps.trains.learner import TensorLearner

_KIND = "ladder, 1"
_STORED: tuple[type[Model], ...] = (
    KernelLearner,
    RecursiveRigidLearner,
    ResidualLearner,
    RigidLearner,
    StructuredLearner,
    TensorLearner,
    ToolLayer,
)
# What a model may raise on pairs that it cannot digest. It is out then, and the others go on.
_FAILURES = (KBMapsError, ArithmeticError, ValueError, np.linalg.LinAlgError)


@dataclass(frozen=True)
class Rung:
    """A model on a ladder, and how it is used.

    Attributes:
        model: it learns from now on through the ladder alone.
        growth: it learns what has come when that is this share of what it has learnt. 0 learns each pair at once.
        extrapolates: whether it may answer where no data was.

    Raises:
        SettingError: growth is negative or not finite.
    """

    model: Model
    growth: float = 0.25
    extrapolates: bool = True

    def __post_init__(self) -> None:
        if not (self.growth >= 0.0 and math.isfinite(self.growth)):
            raise SettingError(f"growth must be 0 or greater, got {self.growth!r}")


class Ladder:
    """Holds models side by side, lets each learn at its own pace, and answers with the one that predicts best.

    Each pair is predicted by every model before it is learnt. The most trusted model answers that is not clearly
    worse than another on the last pairs (`Contest`). Where it has no data and may not extrapolate, the best of those
    answers that may. A model that fails, or predicts what is not finite, is left out: it spoils nothing.

    When `learn` got many pairs at once, the model that answers has learnt all of them when it returns; with pairs one
    by one, models learn when it is their time.

    Args:
        rungs: the models by name, the most trusted first: what has fewer free numbers says more about places
            without data.

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
        joints = {rung.model.joints for rung in rungs.values()}
        if len(joints) != 1:
            raise SettingError(f"a ladder needs models of one number of joints, got {sorted(joints) or 'none'}")
        if not any(rung.extrapolates for rung in rungs.values()):
            raise SettingError("a ladder needs a model that may extrapolate")
        if any(rung.model.pairs for rung in rungs.values()):
            raise SettingError("the models of a ladder must not have learnt before it")
        self._rungs = dict(rungs)
        self._joints = joints.pop()
        self._q, self._x, self._sigma = np.empty((0, self._joints)), np.empty((0, 3)), np.empty(0)
        self._learnt = dict.fromkeys(self._rungs, 0)
        self._failures: dict[str, str] = {}
        self._contest = Contest()
        self._answering = self._answers_first()

    @classmethod
    def around(cls, nominal: RigidChain, tolerances: ChainTolerances, lower: ArrayLike, upper: ArrayLike) -> Ladder:
        """The usual ladder for a drawn arm: rigid chain with residual, rigid chain, tensor train.

        Args:
            nominal: the chain as drawn.
            tolerances: how far the real one may be from it.
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
        """Number of joints d."""
        return self._joints

    @property
    def pairs(self) -> int:
        """How many pairs have come."""
        return len(self._q)

    @property
    def answering(self) -> str:
        """The model that answers."""
        return self._answering

    @property
    def models(self) -> Mapping[str, Model]:
        """The models by name. Do not teach them."""
        return {name: rung.model for name, rung in self._rungs.items()}

    @property
    def failures(self) -> Mapping[str, str]:
        """Why models are out, by name."""
        return dict(self._failures)

    def errors(self) -> dict[str, float]:
        """RMS distance between prediction and measurement on the last pairs, before learning them [m], by model."""
        return {
            name: math.sqrt(float(np.nanmean(squares)))
            for name, squares in self._contest.errors.items()
            if np.isfinite(squares).any()
        }

    def learn(self, q: ArrayLike, x: ArrayLike, sigma: ArrayLike | None = None) -> None:
        """Pairs q (n, d) [rad, m] and x (n, 3) [m], or one, (d,) and (3,), in the order in which they came.

        Args:
            sigma: 1-sigma of the positions [m], () or (n,); None where it is to be estimated.

        Raises:
            ShapeError, NonFiniteError, SettingError (a sigma that is not positive): nothing has changed.
        """
        angles, positions, sigmas = checked_pairs(q, x, sigma, self._joints)
        begin, end = self.pairs, self.pairs + len(angles)
        self._q = np.concatenate([self._q, angles])
        self._x = np.concatenate([self._x, positions])
        self._sigma = np.concatenate([self._sigma, sigmas])
        while begin < end:
            until = min(end, max(begin + 1, self._next_due()))
            self._judge(slice(begin, until))
            for name in self._working():
                if until >= self._due(name):
                    self._teach(name, until)
            begin = until
        self._choose()
        if len(angles) > 1:
            self._catch_up()

    def predict(self, q: ArrayLike) -> FloatArray:
        """Positions (n, 3) [m] at q (n, d), or (3,) at q (d,).

        Raises:
            ShapeError, NonFiniteError
        """
        angles = rows_or_vector("q", q, self._joints)
        if self._rungs[self._answering].extrapolates:
            return self._rungs[self._answering].model.predict(angles)
        x = self.estimate(np.atleast_2d(angles)).x
        return x[0] if angles.ndim == 1 else x

    def estimate(self, q: ArrayLike) -> Estimate:
        """Positions at q (n, d), their 1-sigma per axis against the truth, and whether data was there.

        Raises:
            ShapeError, NonFiniteError
        """
        angles = rows("q", q, self._joints)
        rung = self._rungs[self._answering]
        inside = rung.model.estimate(angles)
        outside = ~inside.in_support
        if rung.extrapolates or not outside.any():
            return inside
        safe = self._rungs[self._best([name for name in self._working() if self._rungs[name].extrapolates])]
        fallback = safe.model.estimate(angles[outside])
        x, sigma = inside.x.copy(), inside.sigma.copy()
        x[outside], sigma[outside] = fallback.x, fallback.sigma
        return Estimate(x, sigma, inside.in_support)

    def to_bytes(self) -> bytes:
        """The ladder with all its models and pairs; `from_bytes` gives the same predictions to the last bit."""
        entries = [
            {
                "name": name,
                "class": type(rung.model).__name__,
                "growth": rung.growth,
                "extrapolates": rung.extrapolates,
                "learnt": self._learnt[name],
                "failure": self._failures.get(name),
                "model": base64.b64encode(rung.model.to_bytes()).decode(),
            }
            for name, rung in self._rungs.items()
        ]
        fields = {"rungs": entries, "answering": self._answering, "judged": self._contest.pairs}
        arrays = {
            "q": self._q,
            "x": self._x,
            "sigma": self._sigma,
        }
        arrays |= {f"errors of {name}": squares for name, squares in self._contest.errors.items()}
        return pack(_KIND, fields, arrays)

    @classmethod
    def from_bytes(cls, data: bytes, kinds: Sequence[type[Model]] = ()) -> Self:
        """The ladder in `data`.

        Args:
            kinds: the classes of models on it that are not of this package.

        Raises:
            ModelFormatError: it is none of this kind, or damaged, or has models of classes that are not known.
        """
        fields, arrays = unpack(data, _KIND)
        classes = {kind.__name__: kind for kind in (*_STORED, *kinds)}
        try:
            entries = cast(list[dict[str, Any]], fields["rungs"])
            models = {entry["name"]: _restored(entry, classes) for entry in entries}
            ladder = cls.__new__(cls)
            ladder._restore(fields, entries, models, arrays)
        except (KeyError, TypeError, ValueError, binascii.Error, KBMapsError) as error:
            raise ModelFormatError(f"the bytes do not describe a ladder: {error}") from error
        return ladder

    def _restore(
        self,
        fields: Mapping[str, Any],
        entries: Sequence[Mapping[str, Any]],
        models: Mapping[str, Model],
        arrays: Mapping[str, FloatArray],
    ) -> None:
        self._rungs = {
            entry["name"]: Rung(models[entry["name"]], float(entry["growth"]), bool(entry["extrapolates"]))
            for entry in entries
        }
        self._joints = next(iter(models.values())).joints
        self._q, self._x, self._sigma = arrays["q"], arrays["x"], arrays["sigma"]
        self._learnt = {entry["name"]: int(entry["learnt"]) for entry in entries}
        self._failures = {entry["name"]: entry["failure"] for entry in entries if entry["failure"] is not None}
        stored = {name: arrays.get(f"errors of {name}") for name in self._rungs}
        judged = {name: squares for name, squares in stored.items() if squares is not None}
        self._contest = Contest(judged, int(fields["judged"]))
        self._answering = str(fields["answering"])
        if self._answering not in self._rungs:
            raise ValueError("the model that answers is not on it")

    def _working(self) -> list[str]:
        return [name for name in self._rungs if name not in self._failures]

    def _answers_first(self) -> str:
        """Who answers while there is nothing to compare: the first that may answer everywhere."""
        return next(name for name in (*self._working(), *self._rungs) if self._rungs[name].extrapolates)

    def _due(self, name: str) -> float:
        """How many pairs it takes until a model learns again."""
        learnt = self._learnt[name]
        return learnt + max(1.0, self._rungs[name].growth * learnt)

    def _next_due(self) -> int:
        return math.ceil(min((self._due(name) for name in self._working()), default=0.0))

    def _judge(self, part: slice) -> None:
        """Every model predicts pairs that it has not learnt."""
        squares: dict[str, FloatArray] = {}
        for name in self._working():
            try:
                errors = self._x[part] - self._rungs[name].model.predict(self._q[part])
            except _FAILURES as error:
                self._failures[name] = str(error)
                continue
            with np.errstate(over="ignore"):  # an absurd prediction has an infinite error, which counts as none
                squares[name] = np.square(errors).sum(axis=1)
        for k in range(part.stop - part.start):
            self._contest.add({name: float(values[k]) for name, values in squares.items()})

    def _teach(self, name: str, until: int) -> None:
        """A model learns all pairs up to one."""
        part = slice(self._learnt[name], until)
        model, told = self._rungs[name].model, ~np.isnan(self._sigma[part])
        try:
            for run in _runs(told):
                these = slice(part.start + run.start, part.start + run.stop)
                model.learn(self._q[these], self._x[these], self._sigma[these] if told[run.start] else None)
            finite = bool(np.isfinite(model.predict(self._q[part])).all())
        except _FAILURES as error:
            self._failures[name] = str(error)
            return
        self._learnt[name] = until
        if not finite:
            self._failures[name] = "it predicted what is not finite"

    def _choose(self) -> None:
        working = self._working()
        self._answering = self._best(working) if working else self._answering

    def _best(self, names: Sequence[str]) -> str:
        present = self._answering if self._answering in names else None
        return self._contest.best(names, present or (names[0] if names else self._answers_first()))

    def _catch_up(self) -> None:
        """Who answers learns what has come; should that break it, the next best does."""
        while self._working() and self._learnt[self._answering] < self.pairs:
            self._teach(self._answering, self.pairs)
            self._choose()


def _restored(entry: Mapping[str, Any], classes: Mapping[str, type[Model]]) -> Model:
    kind = classes.get(str(entry["class"]))
    if kind is None:
        raise ModelFormatError(f"the class {entry['class']} is not known; name it in `kinds`")
    return kind.from_bytes(base64.b64decode(entry["model"], validate=True))


def _runs(values: np.ndarray) -> list[slice]:
    """Each run of equal values."""
    ends = [0, *(np.flatnonzero(values[1:] != values[:-1]) + 1).tolist(), len(values)]
    return [slice(start, end) for start, end in itertools.pairwise(ends)] if len(values) else []


def _proper(tolerance: float, default: float) -> float:
    """A tolerance that a Gaussian prior can have."""
    return tolerance if 0.0 < tolerance < math.inf else default
