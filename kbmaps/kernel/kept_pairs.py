"""Storage of the pairs within a learner's memory."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray
from kbmaps.chains.carried import Predictor
from kbmaps.errors import ModelFormatError
from kbmaps.kernel.kernel_fit import Observations
from kbmaps.kernel.product_kernel import ProductKernel
from kbmaps.memory import Memory
from kbmaps.pairs import checked_pairs, stored_pairs, with_units


class KeptPairs:
    """Last pairs, with the predictions of the learner's prior model for them.

    Attributes:
        q, x, sigma, behind: configurations (n, d), positions (n, 3), their 1-sigma (n,), NaN where unknown, and the
            prior model's positions (n, 3).
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
        """Return checked pairs for `add`. Raises ShapeError, NonFiniteError, SettingError."""
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

    def replace_model(self, model: Predictor) -> None:
        """Replace the prior model behind the same pairs."""
        self.behind = model.predict(self.q)

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
