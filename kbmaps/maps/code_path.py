"""Choice between the compiled path of the innermost loops (`csrc/`) and that of NumPy. Both agree up to rounding.

The compiled path exists if a C compiler was present when kbmaps was built. BODYSCHEMA_PURE=1 in the environment of a
process disables it.
"""

from __future__ import annotations

import os
from collections.abc import Generator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from importlib import import_module
from typing import Literal, Protocol, cast

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray, IntArray
from kbmaps.errors import SettingError
from kbmaps.maps.contraction import Check, NumpyNet
from kbmaps.maps.stack import BasisStack

KernelPath = Literal["compiled", "numpy"]


class NetKernel(Protocol):
    """Operations on a net, as in `NumpyNet`."""

    def outputs(self, q: ArrayLike, begin: int, end: int, /) -> FloatArray: ...
    def derivatives(self, q: ArrayLike, begin: int, end: int, /) -> FloatArray: ...
    def step(self, q: ArrayLike, x: ArrayLike, mu0: float, /) -> None: ...
    def replay(self, q: FloatArray, x: FloatArray, order: IntArray, mu0: FloatArray, /) -> None: ...


class FilterKernel(Protocol):
    """Compiled update of a `RigidFilter` with pairs, and linearisation of its chain.

    `learn` returns the number of learnt pairs, the noise² and the number of coordinates that this estimate rests on.
    `learn_one` checks its pair and writes it to a row (d + 4). It returns None, and changes nothing, if the pair is not
    float64 of the right shape, or invalid.
    """

    def learn(
        self,
        change: FloatArray,
        covariance: FloatArray,
        q: FloatArray,
        x: FloatArray,
        sigma: FloatArray,
        origin: FloatArray | None,
        noise_square: float,
        noise_coordinates: float,
        /,
    ) -> tuple[int, float, float]: ...

    def learn_one(
        self,
        change: FloatArray,
        covariance: FloatArray,
        row: FloatArray,
        q: ArrayLike,
        x: ArrayLike,
        sigma: ArrayLike | None,
        origin: FloatArray | None,
        noise_square: float,
        noise_coordinates: float,
        /,
    ) -> tuple[float, float] | None: ...

    def linearise(self, change: FloatArray, q: FloatArray, x: FloatArray, jacobian: FloatArray | None, /) -> None:
        """Write positions to x (n, 3), and derivatives by the active parameters to jacobian (n, 3, p) unless None."""


class _Compiled(Protocol):
    """Module kbmaps._kernels, built from csrc."""

    def Net(
        self,
        half_phases: FloatArray,
        mix: FloatArray,
        slides: FloatArray,
        planes: FloatArray,
        check_q: Check,
        check_x: Check,
        empty: object,
        /,
    ) -> NetKernel: ...

    def RigidFilter(self, *arrays: FloatArray) -> FilterKernel: ...


def _load() -> _Compiled | None:
    if os.environ.get("BODYSCHEMA_PURE", "") not in ("", "0"):
        return None
    try:
        return cast(_Compiled, import_module("kbmaps._kernels"))
    except ImportError:
        return None


_available = _load()
_chosen = ContextVar("_chosen", default=_available)


def kernels_in_use() -> KernelPath:
    """Return the path of maps and learners created now."""
    return "numpy" if _chosen.get() is None else "compiled"


def available() -> tuple[KernelPath, ...]:
    """Return the paths available in this process."""
    return ("numpy",) if _available is None else ("numpy", "compiled")


@contextmanager
def using(path: KernelPath) -> Generator[None]:
    """Create maps and learners on this path within the context; they keep it afterwards. For comparing the two paths.

    Raises:
        SettingError: there are no compiled kernels.
    """
    if path not in available():
        raise SettingError(
            f"the {path} kernels are not there; have a C compiler when installing, and no BODYSCHEMA_PURE"
        )
    before = _chosen.set(_available if path == "compiled" else None)
    try:
        yield
    finally:
        _chosen.reset(before)


def net_kernel(stack: BasisStack, planes: FloatArray, check_q: Check, check_x: Check) -> NetKernel:
    """Return the chosen path's kernel for a net; the arguments are those of `NumpyNet`."""
    compiled = _chosen.get()
    if compiled is None:
        return NumpyNet(stack, planes, check_q, check_x)
    checks = partial(_contiguous, check_q), partial(_contiguous, check_x)
    return compiled.Net(*stack.tables, planes, *checks, np.empty)


def filter_kernel(*arrays: FloatArray) -> FilterKernel | None:
    """Return the compiled loops of `RigidFilter`; None on the NumPy path."""
    compiled = _chosen.get()
    return None if compiled is None else compiled.RigidFilter(*(np.ascontiguousarray(array) for array in arrays))


def _contiguous(check: Check, values: ArrayLike) -> FloatArray:
    return np.ascontiguousarray(check(values))
