"""What each model is said to be wrong by: at the data, away from it, and as its predictions have shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from interfaces.records import FloatArray
from kbmaps import JointBasis, SupportSet

from .members import EXACT, INSTANT, PRIOR
from .scores import ErrorMemory
from .unknowns import Layer, Unknowns

# The data leave shapes open that the prior's own error shows little of. Measured on guided paths of simulated arms:
# the errors a few degrees beside the path are mostly 0.6 to 1.7 times what the prior's error lets expect.
OPEN_SHARE = 1.1
# The prior stays: its error is remembered for a thousand pairs.
PRIOR_DISCOUNT = 0.999


@dataclass(frozen=True)
class Claim:
    """The 1-sigma of a model.

    Attributes:
        inside: where data was, per axis (3,) [m].
        layers: what the data that the model knows leave open.
        surprise: by how much its predictions were worse than claimed, at least 1.
    """

    inside: FloatArray
    layers: tuple[Layer, ...] = ()
    surprise: float = 1.0

    def variance(self, q: FloatArray) -> FloatArray:
        """Variance per axis of predictions at q (n, d) [rad], shape (n, 3) [m²]."""
        left_open = sum((layer.variance(q) for layer in self.layers), np.zeros(len(q)))
        return self.surprise**2 * (self.inside**2 + left_open[:, None])


class ClaimsState(msgspec.Struct, kw_only=True):
    """The part of the claims that is not arrays.

    Attributes:
        errors: prequential errors, by model.
        delayed: those of the instant learner as it was when the exact solution was asked for.
        residuals: errors on pairs that are learnt already, by model.
        misfit: errors of the prior, over longer.
        arm_sigma: 1-sigma of the prior before the tool was changed [m].
    """

    errors: dict[str, ErrorMemory]
    delayed: ErrorMemory
    residuals: dict[str, ErrorMemory]
    misfit: ErrorMemory
    arm_sigma: float | None


class Claims:
    """Follows errors and data of all models since the prior was made.

    Args:
        bases: what is learnt in.
        expected_m: RMS distance between prior and reality that is expected before there are errors [m].
    """

    def __init__(self, bases: Sequence[JointBasis], expected_m: float) -> None:
        self._unknowns = Unknowns(bases)
        self._begin(expected_m)

    def _begin(self, expected_m: float) -> None:
        self._expected_m = expected_m
        self.errors = {name: ErrorMemory(expected_m) for name in (PRIOR, INSTANT)}
        self._delayed = ErrorMemory(expected_m)
        self._residuals: dict[str, ErrorMemory] = {}
        self._misfit = ErrorMemory(expected_m, discount=PRIOR_DISCOUNT)
        self._asked: tuple[Layer, ...] | None = None
        self._solved: tuple[Layer, ...] | None = None

    @property
    def compared(self) -> Mapping[str, ErrorMemory]:
        """Errors by model that may be compared.

        A solution is some pairs old when it is judged, and on a path that is far: the instant learner is judged as old.
        """
        return self.errors | {INSTANT: self._delayed} if self._delayed.weight else self.errors

    @property
    def support(self) -> SupportSet | None:
        """Where data with the present tool was; None before any."""
        return self._unknowns.support

    @property
    def noise_m(self) -> float:
        """RMS distance between measurement and truth [m], as the measurements say."""
        return float(np.sqrt(self.errors[PRIOR].noise_variance.sum()))

    @property
    def arm_configurations(self) -> FloatArray:
        """The configurations (n, d) [rad] that stand for all data, with any tool."""
        return self._unknowns.arm_configurations

    def change_tool(self, expected_m: float) -> None:
        """Another tool: a new prior with other errors, and what was not known of the arm is not known now."""
        self._unknowns.change_tool(self._prior_sigma)
        self._begin(expected_m)

    def predicted(self, q: FloatArray, errors: Mapping[str, FloatArray], variance: FloatArray) -> None:
        """Errors (3,) [m] by model at q (d,) [rad], before learning, against a measurement with this variance (3,)."""
        for name, error in errors.items():
            claimed = self.of(name).variance(q[None])[0] + variance
            self.errors[name].add(error, variance, float(np.square(error).sum() / claimed.sum()))
        self._misfit.add(errors[PRIOR], variance)

    def predicted_by_delayed(self, error: FloatArray, variance: FloatArray) -> None:
        """Error (3,) [m] of the instant learner as it was when the exact solution was asked for."""
        self._delayed.add(error, variance)

    def learnt(self, q: FloatArray) -> None:
        """A pair has been learnt at q (d,) [rad]."""
        self._unknowns.add(q)

    def replayed(self, name: str, errors: FloatArray) -> None:
        """Errors (n, 3) [m] of a model at pairs that it has learnt before."""
        memory = self._residuals.setdefault(name, ErrorMemory(self._expected_m))
        for error in errors:
            memory.add(error, self.errors[PRIOR].noise_variance)

    def solution_asked(self) -> None:
        """The exact solver works on all pairs up to here."""
        self._asked = self._unknowns.layers(self._prior_sigma)

    def solution_taken(self, errors: FloatArray) -> None:
        """The exact solver's solution answers from now on; its errors (n, 3) [m] at pairs that it knows."""
        self.errors.setdefault(EXACT, ErrorMemory(self._expected_m))
        self._solved = self._asked
        self._residuals.pop(EXACT, None)
        self.replayed(EXACT, errors)

    def prior_changed(self, errors: FloatArray) -> None:
        """Another prior for the same pairs; its errors (n, 3) [m] at them."""
        noise = self.errors[PRIOR].noise_variance
        self.errors[PRIOR] = ErrorMemory(self._expected_m)
        self._misfit = ErrorMemory(self._expected_m, discount=PRIOR_DISCOUNT)
        for error in errors:
            self.errors[PRIOR].add(error, noise)
            self._misfit.add(error, noise)

    def of(self, name: str) -> Claim:
        """What is claimed for one model."""
        memory = self.errors.get(name, ErrorMemory(self._expected_m))
        if name == PRIOR:
            return Claim(memory.sigma)
        layers = self._solved if name == EXACT else None
        inside = self._residuals.get(name, memory).sigma
        return Claim(inside, layers or self._unknowns.layers(self._prior_sigma), memory.surprise)

    def state(self) -> ClaimsState:
        """Everything needed to go on from here, but `arm_configurations`."""
        return ClaimsState(
            errors=self.errors,
            delayed=self._delayed,
            residuals=self._residuals,
            misfit=self._misfit,
            arm_sigma=self._unknowns.arm_sigma,
        )

    def restore(self, state: ClaimsState, arm_configurations: FloatArray, q: FloatArray) -> None:
        """Go on from a state; q (n, d) [rad] are the pairs with the present tool."""
        for row in arm_configurations:
            self._unknowns.add(row)
        if state.arm_sigma is not None:
            self._unknowns.change_tool(state.arm_sigma)
        for row in q:
            self._unknowns.add(row)
        self.errors, self._residuals = dict(state.errors), dict(state.residuals)
        self._delayed, self._misfit = state.delayed, state.misfit

    @property
    def _prior_sigma(self) -> float:
        return OPEN_SHARE * float(np.sqrt(np.square(self._misfit.sigma).mean()))
