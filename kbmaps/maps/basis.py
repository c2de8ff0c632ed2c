"""Basis functions of one joint: three for a revolute joint, two for a prismatic one.

Every revolute basis spans {1, cos θ, sin θ}. It is evaluated through two half-angle sines

    first  = sin((θ − phase_first) / 2),    second = sin((θ − phase_second) / 2),

whose products first², first·second, second² span the same space. They stay exact where tan(θ/2) has a pole
(θ = ±π), and near the centre of a small range, where 1 − cos θ would cancel.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Literal, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray, frozen, numbers
from kbmaps.errors import LARGEST_NET, BasisError, ModelFormatError, NetSizeError, SingularAlphaError

BasisKind = Literal["bernstein", "trigonometric", "orthonormal", "prismatic", "prismatic_orthonormal"]

PARAMETER_NAMES: Mapping[BasisKind, tuple[str, ...]] = {
    "bernstein": ("alpha", "centre"),
    "trigonometric": (),
    "orthonormal": ("low", "high", "scale"),
    "prismatic": ("low", "high"),
    "prismatic_orthonormal": ("low", "high", "scale"),
}


class BasisSettings:
    singular_alpha_rad = (math.radians(80.0), math.radians(100.0))
    scale = 0.7


# Rounding of degrees to radians must not let 80 or 100 degrees through.
_ANGLE_ROUNDING = math.ulp(math.pi)


class Terms(NamedTuple):
    """Evaluation of a basis: weights = products @ mix.

    products = (first², first·second, second²) for a revolute joint with the sines of the module's docstring,
    and (1 − s, s) with s = (q − low) / (high − low) for a prismatic one, whose phases are (low, high − low).
    """

    phases: tuple[float, float]
    mix: FloatArray


def _bernstein(alpha: float, centre: float) -> Terms:
    if not 0.0 < alpha < math.pi:
        raise BasisError(f"alpha must lie between 0 and 180 deg, got {math.degrees(alpha):.6g} deg")
    least, most = BasisSettings.singular_alpha_rad
    if least - _ANGLE_ROUNDING <= alpha <= most + _ANGLE_ROUNDING:
        raise SingularAlphaError(math.degrees(alpha))
    # u = sin((θ−α)/2)/sin α and v = sin((θ+α)/2)/sin α give w = (u², −2 cos α·u·v, v²), which equals the
    # normalised weights of Ulbrich et al. 2009, eqs. (9)-(10) with γ = cos α.
    mix = np.diag([1.0, -2.0 * math.cos(alpha), 1.0]) / math.sin(alpha) ** 2
    return Terms((centre + alpha, centre - alpha), mix)


def _trigonometric() -> Terms:
    # first = sin(θ/2), second = cos(θ/2)
    return Terms((0.0, -math.pi), np.array([[1.0, -1.0, 0.0], [0.0, 0.0, 2.0], [1.0, 1.0, 0.0]]))


def _orthonormal(low: float, high: float, scale: float) -> Terms:
    _check_range(low, high)
    _check_scale(scale)
    centre = 0.5 * (low + high)
    # A range of more than a turn is treated as uniform over the circle.
    half_range = min(0.5 * (high - low), math.pi)
    nodes, shares = _legendre()
    sine_square_mean = float(shares @ np.sin(half_range * nodes) ** 2)
    # 1 − cos t as 2 sin²(t/2): no cancellation for small ranges.
    versine = 2.0 * np.sin(0.5 * half_range * nodes) ** 2
    versine_mean = float(shares @ versine)
    versine_std = math.sqrt(float(shares @ (versine - versine_mean) ** 2))
    cosine_like = scale / versine_std * np.array([versine_mean - 2.0, 0.0, versine_mean])
    sine_like = scale / math.sqrt(sine_square_mean) * np.array([0.0, 2.0, 0.0])
    constant = np.array([1.0, 0.0, 1.0])
    return Terms((centre, centre - math.pi), np.column_stack([constant, cosine_like, sine_like]))


def _prismatic(low: float, high: float) -> Terms:
    _check_range(low, high)
    return Terms((low, high - low), np.eye(2))


def _prismatic_orthonormal(low: float, high: float, scale: float) -> Terms:
    _check_range(low, high)
    _check_scale(scale)
    # A uniform s has mean 1/2 and standard deviation 1/√12.
    edge = 0.5 * math.sqrt(12.0) * scale
    return Terms((low, high - low), np.array([[1.0, -edge], [1.0, edge]]))


def _check_range(low: float, high: float) -> None:
    if not high - low >= 1e-6:
        raise BasisError(f"a joint's range must be wider than 1e-6, got low = {low!r}, high = {high!r}")


def _check_scale(scale: float) -> None:
    if not scale > 0.0:
        raise BasisError(f"scale must be greater than 0, got {scale!r}")


@cache
def _legendre() -> tuple[FloatArray, FloatArray]:
    """Return nodes on [−1, 1] and shares (sum 1) that integrate the squares of our functions to rounding."""
    nodes, shares = cast(tuple[FloatArray, FloatArray], np.polynomial.legendre.leggauss(32))
    return frozen(nodes), frozen(0.5 * shares)


_BUILDERS: Mapping[BasisKind, Callable[..., Terms]] = {
    "bernstein": _bernstein,
    "trigonometric": _trigonometric,
    "orthonormal": _orthonormal,
    "prismatic": _prismatic,
    "prismatic_orthonormal": _prismatic_orthonormal,
}


@dataclass(frozen=True)
class JointBasis:
    """Basis functions of one joint. Angles [rad], strokes of prismatic joints [m].

    Build it by one of the class methods. Two bases are equal when kind and parameters are.

    Raises:
        BasisError: the parameters do not give a basis; SingularAlphaError for alpha in 80..100 degrees.

    Example:
        >>> import numpy as np
        >>> from kbmaps import JointBasis
        >>> paper = JointBasis.bernstein(alpha=np.pi / 3)
        >>> paper.weights(np.pi / 3).round(9) + 0.0  # at the end of its range: the last control point alone
        array([0., 0., 1.])
    """

    kind: BasisKind
    parameters: tuple[float, ...]
    terms: Terms = field(init=False, repr=False, compare=False)
    matrix: FloatArray = field(init=False, repr=False, compare=False)
    """weights = (1, cos θ, sin θ) @ matrix; for a prismatic joint (1, q) @ matrix."""

    def __post_init__(self) -> None:
        names = PARAMETER_NAMES.get(self.kind)
        if names is None:
            raise BasisError(f"unknown kind of basis {self.kind!r}; known: {', '.join(PARAMETER_NAMES)}")
        if len(self.parameters) != len(names) or not all(math.isfinite(p) for p in self.parameters):
            raise BasisError(f"a {self.kind} basis needs finite {', '.join(names) or 'nothing'}; got {self.parameters}")
        terms = _BUILDERS[self.kind](*self.parameters)
        object.__setattr__(self, "terms", Terms(terms.phases, frozen(terms.mix)))
        object.__setattr__(self, "matrix", frozen(self._monomials_of_products() @ terms.mix))

    @classmethod
    def bernstein(cls, alpha: float, centre: float = 0.0) -> JointBasis:
        """Return the paper's basis: b0 at centre − alpha, b2 at centre + alpha, b1 where their tangents meet."""
        return cls("bernstein", (float(alpha), float(centre)))

    @classmethod
    def trigonometric(cls) -> JointBasis:
        """Return the basis {1, cos θ, sin θ}."""
        return cls("trigonometric", ())

    @classmethod
    def orthonormal(cls, low: float, high: float, scale: float = BasisSettings.scale) -> JointBasis:
        """Return a basis of the constant 1 and two functions of RMS `scale`, orthogonal on [low, high] [rad].

        Orthogonal for θ uniform on the range. A scale below one makes a learner that changes the coefficients as little
        as possible prefer smooth changes.
        """
        return cls("orthonormal", (float(low), float(high), float(scale)))

    @classmethod
    def prismatic(cls, low: float, high: float) -> JointBasis:
        """Return {1 − s, s} with s = (q − low) / (high − low): the Bernstein basis of degree one. Strokes [m]."""
        return cls("prismatic", (float(low), float(high)))

    @classmethod
    def prismatic_orthonormal(cls, low: float, high: float, scale: float = BasisSettings.scale) -> JointBasis:
        """Return a basis of the constant 1 and a linear function of RMS `scale`, orthogonal on [low, high] [m].

        Orthogonal for q uniform on the range.
        """
        return cls("prismatic_orthonormal", (float(low), float(high), float(scale)))

    @property
    def is_prismatic(self) -> bool:
        return self.kind.startswith("prismatic")

    @property
    def size(self) -> int:
        """Number of functions: 3 for a revolute joint, 2 for a prismatic one."""
        return 2 if self.is_prismatic else 3

    def weights(self, theta: ArrayLike) -> FloatArray:
        """Return the basis functions (..., size) at joint values (...) [rad or m]."""
        value = np.asarray(theta, dtype=np.float64)
        start, second = self.terms.phases
        if self.is_prismatic:
            share = (value - start) / second
            products = np.stack([1.0 - share, share], axis=-1)
        else:
            u = np.sin(0.5 * (value - start))
            v = np.sin(0.5 * (value - second))
            products = np.stack([u * u, u * v, v * v], axis=-1)
        return products @ self.terms.mix

    def derivatives(self, theta: ArrayLike) -> FloatArray:
        """Return the derivatives (..., size) of the basis functions [1/rad or 1/m]."""
        value = np.asarray(theta, dtype=np.float64)
        first, second = self.terms.phases
        if self.is_prismatic:
            slope = np.full(value.shape, 1.0 / second)
            products = np.stack([-slope, slope], axis=-1)
        else:
            middle = 0.5 * (first + second)
            sines = [0.5 * np.sin(value - phase) for phase in (first, middle, second)]
            products = np.stack(sines, axis=-1)
        return products @ self.terms.mix

    def change_to(self, other: JointBasis) -> FloatArray:
        """Return the matrix A (size, size) with: coefficients in `other` = A @ coefficients in this basis.

        Raises:
            BasisError: one of the two is prismatic, the other is not.
        """
        if self.is_prismatic != other.is_prismatic:
            raise BasisError(f"a {self.kind} basis cannot change to a {other.kind} one: prismatic and revolute joints")
        return cast(FloatArray, np.linalg.solve(other.matrix, self.matrix))

    def to_bernstein(self) -> JointBasis:
        """Return the Bernstein basis for this joint's control points: itself if it already is one.

        Otherwise alpha is three quarters of half the range, within 40..70 degrees, about the range's middle.
        """
        if self.kind in ("bernstein", "prismatic"):
            return self
        if self.kind == "trigonometric":
            return JointBasis.bernstein(math.radians(60.0))
        low, high, _ = self.parameters
        if self.kind == "prismatic_orthonormal":
            return JointBasis.prismatic(low, high)
        alpha = min(max(0.375 * (high - low), math.radians(40.0)), math.radians(70.0))
        return JointBasis.bernstein(alpha, 0.5 * (low + high))

    def _monomials_of_products(self) -> FloatArray:
        """Return the matrix M with products = (1, cos θ, sin θ) @ M, or (1, q) @ M."""
        first, second = self.terms.phases
        if self.is_prismatic:
            return np.array([[1.0 + first / second, -first / second], [-1.0 / second, 1.0 / second]])
        middle = 0.5 * (first + second)
        # sin x · sin y = (cos(x − y) − cos(x + y)) / 2
        columns = [(1.0, first), (math.cos(0.5 * (first - second)), middle), (1.0, second)]
        return 0.5 * np.array([[level, -math.cos(phase), -math.sin(phase)] for level, phase in columns]).T


def learning_bases(
    low: ArrayLike, high: ArrayLike, prismatic: Sequence[bool] | None = None, scale: float = BasisSettings.scale
) -> tuple[JointBasis, ...]:
    """Return the scaled orthonormal bases recommended for learners, one per joint, for the joints' ranges.

    Args:
        low, high: ends of each joint's range (d,) [rad, or m for a prismatic joint].
        prismatic: True for each joint that is prismatic; None means none.
        scale: RMS of the functions that are not constant.

    Raises:
        BasisError: a range is empty, or the lengths differ.

    Example:
        >>> from kbmaps import learning_bases
        >>> turning, sliding = learning_bases([-1.4, 0.0], [1.4, 0.3], prismatic=[False, True])
        >>> turning.kind, sliding.size
        ('orthonormal', 2)
    """
    lows = [float(v) for v in np.atleast_1d(numbers("low", low))]
    highs = [float(v) for v in np.atleast_1d(numbers("high", high))]
    kinds = [False] * len(lows) if prismatic is None else [bool(p) for p in prismatic]
    if not len(lows) == len(highs) == len(kinds):
        raise BasisError(f"need one range a joint: {len(lows)} low, {len(highs)} high, {len(kinds)} joint kinds")
    return tuple(
        JointBasis.prismatic_orthonormal(a, b, scale) if slides else JointBasis.orthonormal(a, b, scale)
        for a, b, slides in zip(lows, highs, kinds, strict=True)
    )


def check_bases(bases: Sequence[JointBasis], prismatic: Sequence[bool]) -> None:
    """Check bases for joints of these kinds; raise BasisError for a wrong number of bases, or one of the wrong kind."""
    if len(bases) != len(prismatic):
        raise BasisError(f"need {len(prismatic)} bases, one a joint; got {len(bases)}")
    for k, (basis, slides) in enumerate(zip(bases, prismatic, strict=True)):
        if basis.is_prismatic != bool(slides):
            wanted = "prismatic" if slides else "revolute"
            raise BasisError(
                f"joint {k + 1} of {len(bases)} is {wanted} but its basis is {basis.kind}; "
                "make the bases with learning_bases(low, high, prismatic=chain.prismatic)"
            )


def check_net_size(bases: Sequence[JointBasis], outputs: int) -> None:
    """Raise NetSizeError unless a net in these bases is of a sane size."""
    points = math.prod(basis.size for basis in bases)
    if points > LARGEST_NET:
        raise NetSizeError(points, outputs)


def describe_bases(bases: Sequence[JointBasis]) -> list[list[Any]]:
    """Return bases for JSON: [kind, parameters...] each."""
    return [[basis.kind, *basis.parameters] for basis in bases]


def parse_bases(value: Any) -> tuple[JointBasis, ...]:
    """Return the bases from `describe_bases`."""
    if not isinstance(value, list) or not value:
        raise ModelFormatError("the bases are not a list of at least one")
    return tuple(_parse_basis(entry) for entry in cast(list[Any], value))


def _parse_basis(entry: Any) -> JointBasis:
    parts = cast(list[Any], entry) if isinstance(entry, list) else []
    kind: Any = parts[0] if parts else None
    numbers = parts[1:]
    if not isinstance(kind, str) or kind not in PARAMETER_NAMES:
        raise ModelFormatError("a basis is of no known kind")
    if not all(isinstance(number, float) for number in numbers):
        raise ModelFormatError(f"the parameters of a {kind} basis are not all floating-point numbers")
    try:
        return JointBasis(cast(BasisKind, kind), tuple(numbers))
    except BasisError as error:
        raise ModelFormatError(f"the header describes an impossible basis: {error}") from error
