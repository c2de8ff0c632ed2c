"""Prequential errors: every pair is predicted before it is learnt. They choose who answers, and say how well."""

from __future__ import annotations

import math
from collections.abc import Mapping

import msgspec
import numpy as np

from interfaces.records import FloatArray

# Weight of the error one pair back: the memory is about 50 pairs long.
DISCOUNT = 0.98
# Below this many pairs the expectation from before the data counts.
WARM = 10.0
# Pairs that a model has to have predicted before it may answer.
FEWEST_TO_ANSWER = 5.0
# A challenger has to be this much better than the model that answers.
CHALLENGE = 0.9


class ErrorMemory(msgspec.Struct):
    """Discounted sums over one model's recent prediction errors.

    Attributes:
        expected_m: RMS distance expected before there were errors [m].
        weight: how many errors count.
        distance: sum of their lengths [m].
        square: sums of their squares per axis [m²].
        noise: sums of the measurements' variances per axis [m²].
    """

    expected_m: float
    weight: float = 0.0
    distance: float = 0.0
    square: tuple[float, float, float] = (0.0, 0.0, 0.0)
    noise: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def add(self, error: FloatArray, variance: FloatArray) -> None:
        """One more error (3,) [m] against a measurement with the given variance per axis (3,) [m²]."""
        square, noise = np.square(error), variance
        self.weight = DISCOUNT * self.weight + 1.0
        self.distance = DISCOUNT * self.distance + math.sqrt(float(square.sum()))
        self.square = _triple(DISCOUNT * np.array(self.square) + square)
        self.noise = _triple(DISCOUNT * np.array(self.noise) + noise)

    @property
    def mean_m(self) -> float | None:
        """Mean distance between prediction and measurement [m]; None before any."""
        return self.distance / self.weight if self.weight else None

    @property
    def rms_m(self) -> float:
        """RMS distance between prediction and measurement [m], leaning on what was expected while errors are few."""
        missing = max(WARM - self.weight, 0.0)
        return math.sqrt((sum(self.square) + missing * self.expected_m**2) / max(self.weight, WARM))

    @property
    def sigma(self) -> FloatArray:
        """1-sigma per axis of the prediction against the truth (3,) [m]: the measurement's noise is taken out."""
        missing = max(WARM - self.weight, 0.0)
        square = (np.array(self.square) + missing * self.expected_m**2 / 3.0) / max(self.weight, WARM)
        noise = np.array(self.noise) / max(self.weight, 1.0)
        return np.sqrt(np.maximum(square - noise, noise * _resolution(self.weight)))


def trusted_share(memory: ErrorMemory) -> float:
    """The share of a new error that is the model's own and not the measurement's noise: the step to take, 0 to 1."""
    if not memory.weight:
        return 1.0
    own, noise = float(np.square(memory.sigma).sum()), sum(memory.noise) / memory.weight
    return own / (own + noise) if own > 0.0 else 0.0


def choose(errors: Mapping[str, ErrorMemory], present: str, handicap: Mapping[str, float]) -> str:
    """The model that shall answer: the best on recent pairs; the present one while nobody is clearly better.

    Args:
        errors: by model, the most trusted first: while errors are few, the first one answers.
        handicap: factor by which a model's errors count more than 1: recent pairs are neighbours, and do not show how
            wrong a model is beside their path.
    """
    tried = {
        name: memory.rms_m * handicap.get(name, 1.0)
        for name, memory in errors.items()
        if memory.weight >= FEWEST_TO_ANSWER
    }
    if present not in tried:
        present = next(iter(errors))
    if not tried:
        return present
    best = min(tried, key=lambda name: tried[name])
    return best if present not in tried or tried[best] < CHALLENGE * tried[present] else present


def _resolution(samples: float) -> float:
    """Relative standard deviation of a variance that was estimated from so many samples."""
    return math.sqrt(2.0 / max(samples, 2.0))


def _triple(values: FloatArray) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
