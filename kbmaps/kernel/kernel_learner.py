"""Learner of KB-Maps of any number of joints, through their kernel.

Ulbrich et al. 2009, eqs. (16)-(18), in dual form.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Protocol, Self, cast

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray, require_positive, rows_or_vector
from kbmaps.chains.chain import RigidChain
from kbmaps.chains.parameters import chain_arrays, chain_from_arrays
from kbmaps.errors import DegenerateDataError, ModelFormatError, SettingError
from kbmaps.kernel.kernel_fit import KernelFit, Observations, Precision, ProductKernel
from kbmaps.maps.basis import JointBasis, check_net_size, describe_bases, parse_bases
from kbmaps.maps.kbmap import POSITION_OUTPUTS, KBMap
from kbmaps.maps.support import SUPPORT_LIMIT
from kbmaps.memory import Memory, describe_memory, parse_memory
from kbmaps.model import Estimate, Model
from kbmaps.packed import complete, count, named, number, pack, restoring, unpack
from kbmaps.pairs import checked_pairs, stored_pairs, with_units


class Predictor(Protocol):
    """Model that predicts positions."""

    def predict(self, q: ArrayLike) -> FloatArray:
        """Return positions (n, 3) [m] at q (n, d) [rad, m], or (3,) at q (d,)."""
        ...


class Origin:
    """Predictor of the origin of the measurement frame everywhere: the prior without any knowledge."""

    def __init__(self, joints: int) -> None:
        self.joints = joints

    def predict(self, q: ArrayLike) -> FloatArray:
        """Return zeros (n, 3), or (3,) at q (d,)."""
        return np.zeros((*rows_or_vector("q", q, self.joints).shape[:-1], 3))


def packable(model: object) -> tuple[dict[str, Any], dict[str, FloatArray]]:
    """Return fields and arrays for `kbmaps.packed` from which `unpacked` restores the model.

    For any other type than `KBMap`, `RigidChain` or `Origin`, only the type's name is stored.
    """
    if isinstance(model, KBMap):
        bases = describe_bases(model.bases)
        return {"type": "KBMap", "bases": bases, "outputs": len(model.net)}, {"net": model.net.reshape(-1)}
    if isinstance(model, RigidChain):
        return {"type": "RigidChain"}, chain_arrays(model)
    if isinstance(model, Origin):
        return {"type": "Origin", "joints": model.joints}, {}
    return {"type": type(model).__name__}, {}


def unpacked(fields: Any, arrays: Mapping[str, FloatArray], given: object | None) -> Any:
    """Return the model that `packable` described, or the one `given` if its type is not stored in bytes.

    Raises:
        ModelFormatError: the type is not stored, and no model or one of another type was given.
        KeyError, TypeError, ValueError, KBMapsError: the description is damaged.
    """
    described = cast(dict[str, Any], fields) if isinstance(fields, dict) else {}
    name = described.get("type")
    if name == "KBMap":
        bases = parse_bases(described["bases"])
        return KBMap(bases, arrays["net"].reshape(described["outputs"], *(basis.size for basis in bases)))
    if name == "RigidChain":
        return chain_from_arrays(arrays)
    if name == "Origin":
        return Origin(count(described["joints"], "the number of joints"))
    if given is None or type(given).__name__ != name:
        raise ModelFormatError(
            f"the model behind this one, a {name}, does not travel in its bytes: restore it and pass it in"
        )
    return given


class KeptPairs:
    """The last pairs, with the predictions of the learner's prior model for them.

    Attributes:
        q, x, sigma, behind: configurations (n, d), positions (n, 3), their 1-sigma (n,), NaN if unknown, and the prior
            model's positions (n, 3).
        total: number of pairs so far.
    """

    STORED = ("q", "x", "sigma", "behind")

    def __init__(self, joints: int, memory: Memory) -> None:
        self._memory = memory
        self.q, self.x = np.empty((0, joints)), np.empty((0, 3))
        self.sigma, self.behind = np.empty(0), np.empty((0, 3))
        self.total = 0

    def __len__(self) -> int:
        return len(self.q)

    def checked(self, q: ArrayLike, x: ArrayLike, sigma: ArrayLike | None) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return checked pairs for `add`; raise ShapeError, NonFiniteError, SettingError for other arrays."""
        return checked_pairs(q, x, sigma, self.q.shape[1])

    def add(self, q: FloatArray, x: FloatArray, sigma: FloatArray, model: Predictor) -> None:
        """Add checked pairs; drop the oldest as the memory requires."""
        behind = model.predict(q)
        kept = self._memory.kept(len(self.q) + len(q))
        self.q = _last(self.q, q, kept)
        self.x = _last(self.x, x, kept)
        self.sigma = _last(self.sigma, sigma, kept)
        self.behind = _last(self.behind, behind, kept)
        self.total += len(q)

    def observations(self, kernel: ProductKernel) -> Observations:
        """Return the pairs, weighted by their sigma and their age."""
        pairs = with_units(self.q, self.x, self.sigma)
        shares = self._memory.weights(len(self.q))
        weights = shares / np.square(pairs.unit)
        scale = np.sqrt(weights)
        return Observations(
            weights=kernel.joint_weights(self.q),
            scale=scale,
            errors=(self.x - self.behind) * scale[:, None],
            count=float(shares.sum()),
            log_weights=-2.0 * float(shares @ np.log(pairs.unit)),
            noise_known=pairs.known,
        )

    @property
    def mean_unit(self) -> float:
        """Root mean square of the pairs' units: with an estimated noise of 1, the noise of a coordinate [m]."""
        return float(np.sqrt(np.square(with_units(self.q, self.x, self.sigma).unit).mean()))

    def arrays(self) -> dict[str, FloatArray]:
        """Return the state as arrays for `kbmaps.packed`."""
        return {"q": self.q, "x": self.x, "sigma": self.sigma, "behind": self.behind}

    def restore(self, arrays: Mapping[str, FloatArray], total: int) -> None:
        """Restore the pairs from `arrays`.

        Raises:
            ModelFormatError: they do not fit each other.
            KeyError: one is missing.
        """
        q, x, sigma = stored_pairs(arrays, self.q.shape[1])
        behind = arrays["behind"]
        if behind.shape != x.shape or not np.isfinite(behind).all() or total < len(q):
            raise ModelFormatError("the stored pairs and what was predicted for them do not fit each other")
        self.q, self.x, self.sigma, self.behind, self.total = q, x, sigma, behind, total


def _last(old: FloatArray, new: FloatArray, kept: int) -> FloatArray:
    return np.concatenate([old, new])[-kept:] if kept else old


_KIND = "kernel learner, 1"


class _Settings:
    rounding = 1e-11  # rounding of positions, relative to the largest coordinate
    # Step of slopes [rad, m]: large enough that rounding costs only two digits, small enough for a map that is not
    # exactly of this form.
    slope_step = 1e-2


_THIRD_OF_A_TURN = 2.0 * math.pi / 3.0


def sampled_map(model: Predictor, bases: Sequence[JointBasis]) -> KBMap:
    """Return the KB-Map in these bases that agrees with a model at 3^d configurations (2 for each prismatic joint).

    If the model is a KB-Map in another form, such as a rigid chain or a kernel learner around one, they agree
    everywhere.

    Raises:
        NetSizeError: more than 3^13 control points.
        BasisError, and errors of the model for joint values outside its domain.
    """
    check_net_size(bases, POSITION_OUTPUTS)
    nodes = [_nodes(basis) for basis in bases]
    grid = np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1).reshape(-1, len(nodes))
    net = model.predict(grid).T.reshape(3, *(len(values) for values in nodes))
    for k, (basis, values) in enumerate(zip(bases, nodes, strict=True)):
        solved = np.linalg.inv(basis.weights(values))
        net = np.moveaxis(np.tensordot(solved, net, axes=(1, k + 1)), 0, k + 1)
    return KBMap(tuple(bases), net)


def _nodes(basis: JointBasis) -> FloatArray:
    """Return values at which the basis functions differ well: the ends of the range and the middle [rad, m]."""
    if basis.is_prismatic:
        return np.array(basis.parameters[:2])
    if basis.kind == "orthonormal":
        low, high, _ = basis.parameters
        centre, reach = 0.5 * (low + high), 0.5 * (high - low)
    elif basis.kind == "bernstein":
        reach, centre = basis.parameters
    else:
        centre, reach = 0.0, _THIRD_OF_A_TURN
    return centre + min(reach, _THIRD_OF_A_TURN) * np.array([-1.0, 0.0, 1.0])


def slopes(model: Predictor, q: ArrayLike, bases: Sequence[JointBasis]) -> FloatArray:
    """Return the derivative (3, d) [m/rad, or m/m] of a model's positions at q (d,), or (n, 3, d) at q (n, d).

    f(θ + h) − f(θ − h) = 2 sin h f'(θ) for any f = a + b cos θ + c sin θ and any h. So this is exact for KB-Maps in any
    form; likewise with 2 h for a prismatic joint.
    """
    angles = rows_or_vector("q", q, len(bases))
    step = _Settings.slope_step
    steps = step * np.eye(len(bases))
    flat = angles.reshape(-1, 1, len(bases))
    ahead, behind = (model.predict((flat + direction * steps).reshape(-1, len(bases))) for direction in (1.0, -1.0))
    lengths = np.array([2.0 * (step if basis.is_prismatic else math.sin(step)) for basis in bases])
    columns = (ahead - behind).reshape(len(flat), len(bases), 3) / lengths[:, None]
    return columns.swapaxes(1, 2).reshape(*angles.shape[:-1], 3, len(bases))


class KernelLearner(Model):
    """Learner of a KB-Map around a prior from n pairs, with n² numbers instead of 3^d control points.

    Gives the same solution as `ExactLearner` if both can be computed. Use this one for fewer pairs than control
    points, and for more joints than a net has room for. The fit runs on first use after `learn`, at n³ / 3
    multiplications for each λ that is tried (0.3 s at 1,000 pairs). It depends only on the pairs that the memory keeps.

    Args:
        bases: the metric of "nearest to the prior"; scaled orthonormal ones (`learning_bases`) are advised.
        prior: prediction far from all pairs: a `RigidChain`, a `KBMap`, or any object with `predict`, which must not
            change meanwhile (`rebase`); None for the origin of the measurement frame.
        precision: λ = (noise / standard deviation of the control points)² as in `ExactLearner.solve`; "evidence"
            selects the most probable one; None explains noise-free pairs exactly, up to the number of control points.
        memory: the old pairs that count.

    Raises:
        SettingError: a precision that is neither None, "evidence", nor a number above 0.
        DegenerateDataError: `noise`, `log_evidence`, `prior_precision` and `prior_std` before the first pair.
    """

    def __init__(
        self,
        bases: Sequence[JointBasis],
        prior: Predictor | None = None,
        *,
        precision: Precision = "evidence",
        memory: Memory | None = None,
    ) -> None:
        if isinstance(precision, float | int):
            require_positive("precision", precision)
        elif precision not in (None, "evidence"):
            raise SettingError(f'precision must be None, "evidence" or a number, got {precision!r}')
        self._kernel = ProductKernel(bases)
        self._precision: Precision = precision
        self._memory = Memory() if memory is None else memory
        self._pairs = KeptPairs(self.joints, self._memory)
        self._fit: KernelFit | None = None
        self._prior: Predictor = Origin(self.joints) if prior is None else prior

    @property
    def joints(self) -> int:
        return self._kernel.joints

    @property
    def bases(self) -> tuple[JointBasis, ...]:
        return self._kernel.bases

    @property
    def pairs(self) -> int:
        """Number of learnt pairs, including those that no longer count."""
        return self._pairs.total

    @property
    def kept(self) -> int:
        """Number of pairs that count."""
        return len(self._pairs)

    @property
    def noise(self) -> float:
        """Noise of a measured coordinate, 1-sigma [m]: estimated, or given with the pairs."""
        return math.sqrt(self._fitted().noise_variance) * self._pairs.mean_unit

    @property
    def log_evidence(self) -> float | None:
        """Log marginal likelihood of the pairs; None for the exact solution."""
        return self._fitted().log_evidence

    def predict(self, q: ArrayLike) -> FloatArray:
        angles = rows_or_vector("q", q, self.joints)
        batch = np.atleast_2d(angles)
        x = self._prior.predict(batch)
        if self.kept:
            x = x + self._fitted().mean(self._kernel.joint_weights(batch))
        return x[0] if angles.ndim == 1 else x

    def jacobian(self, q: ArrayLike) -> FloatArray:
        """Return the derivative (3, d) of the position [m/rad, or m/m], or (n, 3, d) at q (n, d).

        Exact if the prior model is a KB-Map, also in another form such as a chain.
        """
        return slopes(self, q, self.bases)

    def to_kbmap(self) -> KBMap:
        """Return the learnt map with its 3^d control points, exact if the prior model is a KB-Map or a rigid chain.

        Raises:
            NetSizeError: more than 3^13 control points.
        """
        return sampled_map(self, self.bases)

    @property
    def prior_precision(self) -> float:
        """λ of the current fit; 0 for the exact one."""
        return self._fitted().precision

    @property
    def prior_std(self) -> float:
        """Standard deviation of the control points around the prior [m]."""
        return math.sqrt(self._fitted().prior_variance)

    def learn(self, q: ArrayLike, x: ArrayLike, sigma: ArrayLike | None = None) -> None:
        """Learn pairs. DegenerateDataError: there are more than control points, and no precision to weigh them."""
        angles, positions, sigmas = self._pairs.checked(q, x, sigma)
        kept = self._memory.kept(self.kept + len(angles))
        points = math.prod(basis.size for basis in self.bases)
        if self._precision is None and kept > points:
            raise DegenerateDataError(
                f"{kept} pairs cannot all be explained by {points} control points; give a precision, a window of at "
                f"most {points} pairs, or use ExactLearner"
            )
        self._pairs.add(angles, positions, sigmas, self._prior)
        self._fit = None

    def rebase(self, prior: Predictor) -> None:
        """Replace the prior for the same pairs, or use the same one after it has changed."""
        self._pairs.behind = prior.predict(self._pairs.q)
        self._prior, self._fit = prior, None

    def estimate(self, q: ArrayLike) -> Estimate:
        """Return positions at q (n, d), or (d,), their 1-sigma per axis against the truth, and True near data.

        Support has its own rule here: a configuration is in support if the pairs leave at most `SUPPORT_LIMIT` of its
        prior variance. With fewer pairs than control points, each pair determines independent directions and is known
        to within its noise. By the rule of `Estimate`, almost nothing except the pairs themselves would then be in
        support. If λ is so large that more than the limit remains even at the pairs, they are not in support either.
        Before the first pair, sigma is infinite: only pairs can show the quality of the prior.
        """
        angles = rows_or_vector("q", q, self.joints)
        batch = np.atleast_2d(angles)
        n = len(batch)
        if not self.kept:
            unknown = Estimate(self._prior.predict(batch), np.full((n, 3), np.inf), np.zeros(n, dtype=np.bool_))
            return unknown.like(angles)
        weights = self._kernel.joint_weights(batch)
        fit = self._fitted()
        sigma = np.sqrt(np.repeat(fit.variance(weights)[:, None], 3, axis=1))
        return Estimate(self.predict(batch), sigma, fit.unexplained(weights) <= SUPPORT_LIMIT).like(angles)

    def to_bytes(self) -> bytes:
        """Return the learner with the pairs that count.

        A prior that is neither a `KBMap` nor a `RigidChain` is not stored. A replacement has to predict the same at the
        pairs, up to rounding; elsewhere predictions differ as the priors do.
        """
        behind, arrays = packable(self._prior)
        fields: dict[str, Any] = {
            "bases": describe_bases(self.bases),
            "precision": self._precision,
            "memory": describe_memory(self._memory),
            "pairs": self.pairs,
            "prior": behind,
        }
        return pack(_KIND, fields, self._pairs.arrays() | arrays)

    @classmethod
    def from_bytes(cls, data: bytes, prior: Predictor | None = None) -> Self:
        """Return the learner in `data`.

        Args:
            data: the result of `to_bytes`.
            prior: the learner's prior, if it is not stored.

        Raises:
            ModelFormatError: wrong type of model, or damaged, or its prior is missing or predicts otherwise.
        """
        fields, arrays = unpack(data, _KIND)
        with restoring("a kernel learner"):
            named(fields, "the fields", ("bases", "precision", "memory", "pairs", "prior"))
            behind = unpacked(fields["prior"], arrays, prior)
            precision, memory = _parse_precision(fields["precision"]), parse_memory(fields["memory"])
            learner = cls(parse_bases(fields["bases"]), behind, precision=precision, memory=memory)
            complete(arrays, (*KeptPairs.STORED, *packable(behind)[1]))
            learner._pairs.restore(arrays, count(fields["pairs"], "the number of pairs"))
            if not _same(learner._prior.predict(learner._pairs.q), learner._pairs.behind):
                raise ModelFormatError("the prior predicts otherwise than the one that the stored learner had")
        return learner

    def _fitted(self) -> KernelFit:
        if not self.kept:
            raise DegenerateDataError("there is nothing to tell before the first pair was learnt")
        if self._fit is None:
            self._fit = KernelFit(self._kernel, self._pairs.observations(self._kernel), self._precision)
        return self._fit


def _same(x: FloatArray, other: FloatArray) -> bool:
    """Return True if positions (n, 3) are the same up to the rounding of other batches."""
    return bool((np.abs(x - other) <= _Settings.rounding * np.abs(other).max(initial=0.0)).all())


def _parse_precision(value: Any) -> Precision:
    """Return a stored precision. Raises ModelFormatError."""
    return value if value is None or value == "evidence" else number(value, "the precision")
