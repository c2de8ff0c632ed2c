"""Orientation of the marker: several models side by side, the best predictor of which answers."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass

import msgspec
import numpy as np

from bodyschema.interfaces.records import FloatArray
from bodyschema.learning.model_bank import EXACT, PRIOR, RIGID
from bodyschema.learning.solvers.orientation import OrientationSolution
from bodyschema.learning.uncertainty import UncertaintySettings
from bodyschema.learning.variance_terms import unexplained
from kbmaps import (
    ChainBelief,
    ChainParameters,
    KBMap,
    OrientedChain,
    PrequentialComparison,
    RigidChain,
    SupportSet,
    fitted_orientation,
    rotation_matrices,
    rotation_vectors,
)

# Order of trust while errors do not decide.
TRUSTED = (RIGID, EXACT, PRIOR)


class OrientationSettings:
    # The marker's rotation on the nominal chain's hand is fitted whenever the pairs have doubled, up to this many
    # pairs.
    first_pairs = 64
    # Minimum number of pairs to trust the solved chain before it has predicted any.
    min_to_trust = 3


# Mean divided by RMS length of a Gaussian rotation vector with the same variance about each axis.
MEAN_OVER_RMS = 0.9213


class AngleMemory(msgspec.Struct):
    """Discounted sums over one model's recent prediction errors."""

    weight: float = 0.0  # effective number of errors
    angle: float = 0.0  # sum of their angles [rad]
    square: float = 0.0  # sum of their squares [rad²]
    noise: float = 0.0  # sum of the measurements' variances, all three axes [rad²]; 0 where not given
    ratio: float = 0.0  # sum of their squares, each divided by the predicted one

    def add(self, angle: float, noise: float, expected: float) -> None:
        """Add an error of this angle [rad].

        Args:
            angle: angle of the error [rad].
            noise: expected square of the measurement's noise [rad²].
            expected: expected square of noise and model error together [rad²].
        """
        self.weight = UncertaintySettings.discount * self.weight + 1.0
        self.angle = UncertaintySettings.discount * self.angle + angle
        self.square = UncertaintySettings.discount * self.square + angle**2
        self.noise = UncertaintySettings.discount * self.noise + noise
        self.ratio = UncertaintySettings.discount * self.ratio + angle**2 / max(expected, 1e-18)

    @property
    def inflation(self) -> float:
        """Ratio of the errors to the predicted ones, at least 1."""
        prior_weight = max(UncertaintySettings.warm_pairs - self.weight, 0.0)
        return math.sqrt(max((self.ratio + prior_weight) / max(self.weight, UncertaintySettings.warm_pairs), 1.0))


class OrientationState(msgspec.Struct, kw_only=True):
    """State of the orientation models in a checkpoint."""

    pairs: int  # number of pairs with an orientation
    answering: str  # the model that answers
    errors: dict[str, AngleMemory]  # prequential errors, by model
    # prior, chain, map: the models, as bytes; None before there are any
    prior: bytes | None
    chain: bytes | None
    map: bytes | None
    map_noise: float  # 1-sigma of an orientation about one axis around the map [rad]
    noise: float  # mean variance of the measured orientations about one axis [rad²]


@dataclass(frozen=True, eq=False)
class OrientationModel:
    """Answering model with its predicted error; later learning does not change it."""

    name: str  # of the model
    chain: OrientedChain  # the rigid chain that gives the uncertainty, and answers itself unless there is a map
    map: KBMap | None  # of e1, e2, e3
    in_sample: float  # 1-sigma about each axis at the data, in addition to the chain's uncertainty [rad]
    inflation: float  # ratio of the prediction errors to the predicted ones, at least 1
    support: SupportSet | None  # support of the data; None without data

    def rotations(self, q: FloatArray) -> FloatArray:
        """Return orientations (n, 3, 3) at q (n, d) [rad]."""
        return self.chain.orientation(q) if self.map is None else self.map.orientation(q, orthonormal=True)

    def predict(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return orientations (n, 3, 3) at q (n, d) [rad], and their variance about each axis (n, 3) [rad²]."""
        rotations, variance_at_q = self.chain.orientation_with_variance(q)
        if self.map is not None:
            chain_rotations, rotations = rotations, self.rotations(q)
            # Away from the data the map is no better than the chain; their difference measures its error.
            departure = rotation_vectors(rotations @ chain_rotations.swapaxes(1, 2))
            variance_at_q = variance_at_q + unexplained(self.support, q)[:, None] * np.square(departure)
        return rotations, self.inflation**2 * (self.in_sample**2 + variance_at_q)

    def with_orientation(self, kbmap: KBMap) -> KBMap:
        """Return `kbmap` with the nine planes of e1, e2, e3 in its bases."""
        turned = self.map if self.map is not None else self.chain.chain.to_kbmap(kbmap.bases, orientation=True)
        return KBMap(kbmap.bases, np.concatenate([kbmap.net[:3], turned.net[3:]]), kbmap.metadata)

    def expected_error(self, q: FloatArray) -> float:
        """Return the expected mean angle to the truth [rad], from the sigmas at q (n, d) [rad]."""
        return MEAN_OVER_RMS * float(np.sqrt(self.predict(q)[1].sum(axis=1)).mean())


class Orientations:
    """Learner of the orientation of one marker. Not thread-safe.

    Args:
        chain: the nominal chain, placed; it predicts orientations before the first solution.
    """

    def __init__(self, chain: RigidChain) -> None:
        parameters = ChainParameters(chain)
        self._nominal = ChainBelief(parameters, np.zeros(parameters.size), np.zeros((parameters.size, 0)))
        self._first: list[tuple[FloatArray, FloatArray]] = []
        self._chains: dict[str, OrientedChain] = {}
        self._map: KBMap | None = None
        self._map_noise = self._noise = 0.0
        self._comparison = PrequentialComparison()
        self.pairs = 0
        self.answering = PRIOR
        self.errors: dict[str, AngleMemory] = {}

    def model(self, support: SupportSet | None) -> OrientationModel | None:
        """Return the answering model; None before the first orientation."""
        return self._build_model(self.answering, support) if self.answering in self._names else None

    def prequential_rad(self) -> dict[str, float]:
        """Return the recent mean angle between prediction and measurement, before learning [rad], by model."""
        return {name: memory.angle / max(memory.weight, 1.0) for name, memory in self.errors.items() if memory.weight}

    def learn(self, q: FloatArray, turn: FloatArray, cov: FloatArray | None, support: SupportSet | None) -> None:
        """Predict the orientation of one pair, then learn it.

        Args:
            q: joint angles (d,) [rad].
            turn: unit quaternion x, y, z, w (4,).
            cov: covariance of the orientation (3, 3) [rad²], if it is known.
            support: support of the data; None without data.
        """
        measured = rotation_matrices("R", turn / np.linalg.norm(turn))
        noise = 0.0 if cov is None else float(np.trace(cov))
        squares: dict[str, float] = {}
        for name in self._names:
            rotation, variance = self._build_model(name, support).predict(q[None])
            angle = float(np.linalg.norm(rotation_vectors(measured[None] @ rotation.swapaxes(1, 2))))
            self.errors.setdefault(name, AngleMemory()).add(angle, noise, float(variance.sum()) + noise)
            squares[name] = angle**2
        self._comparison.add(squares)
        self.pairs += 1
        self._noise += (noise / 3.0 - self._noise) / min(self.pairs, 1.0 / (1.0 - UncertaintySettings.discount))
        self._fit_nominal(q, measured)
        self._choose()

    def take(self, solution: OrientationSolution) -> None:
        """Store the solver's solution for the orientations so far."""
        self._chains[RIGID] = solution.chain
        self._map, self._map_noise = solution.map, solution.map_noise
        if solution.map is None and self.answering == EXACT:
            self.answering = RIGID
        self._choose()

    def state(self) -> OrientationState:
        packed = {name: chain.to_bytes() for name, chain in self._chains.items()}
        return OrientationState(
            pairs=self.pairs,
            answering=self.answering,
            errors=copy.deepcopy(self.errors),
            prior=packed.get(PRIOR),
            chain=packed.get(RIGID),
            map=None if self._map is None else self._map.to_bytes(),
            map_noise=self._map_noise,
            noise=self._noise,
        )

    def restore(self, state: OrientationState) -> None:
        self.pairs, self.answering, self.errors = state.pairs, state.answering, dict(state.errors)
        packed: Mapping[str, bytes | None] = {PRIOR: state.prior, RIGID: state.chain}
        self._chains = {name: OrientedChain.from_bytes(data) for name, data in packed.items() if data is not None}
        self._map = None if state.map is None else KBMap.from_bytes(state.map)
        self._map_noise, self._noise = state.map_noise, state.noise

    @property
    def _names(self) -> tuple[str, ...]:
        return (*self._chains, EXACT) if self._map is not None else tuple(self._chains)

    def _build_model(self, name: str, support: SupportSet | None) -> OrientationModel:
        solved = self._chains.get(RIGID)
        chain = self._chains[PRIOR] if name == PRIOR or solved is None else solved
        spread = self._map_noise if name == EXACT else chain.noise
        inflation = self.errors.get(name, AngleMemory()).inflation
        mapped = self._map if name == EXACT else None
        return OrientationModel(name, chain, mapped, self._model_sigma(spread), inflation, support)

    def _model_sigma(self, spread: float) -> float:
        """Return the 1-sigma of the truth around a model [rad], about one axis, given that of the measurements.

        The measurements' claimed noise is subtracted, within the resolution of this number of pairs.
        """
        resolution = math.sqrt(2.0 / (3.0 * max(self.pairs, 1)))
        return math.sqrt(max(spread**2 - self._noise, spread**2 * resolution if self._noise else spread**2))

    def _fit_nominal(self, q: FloatArray, measured: FloatArray) -> None:
        if len(self._first) == OrientationSettings.first_pairs or self.pairs > OrientationSettings.first_pairs:
            return
        self._first.append((q, measured))
        count = len(self._first)
        if count & (count - 1) == 0:
            angles, rotations = (np.array(values) for values in zip(*self._first, strict=True))
            self._chains[PRIOR] = fitted_orientation(self._nominal, angles, rotations)

    def _choose(self) -> None:
        self.answering = self._comparison.best(TRUSTED, self.answering)
        untested = RIGID in self._chains and not self._comparison.compares(RIGID)
        if self.answering == PRIOR and self.pairs >= OrientationSettings.min_to_trust and untested:
            self.answering = RIGID
