"""Arms that deviate from nominal within their tolerances, for the tests of the rigid learners."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from planted_chains import random_chain, random_q

from kbmaps import ChainParameters, ChainTolerances, RigidChain

ROUGH = ChainTolerances(axes=np.radians(3.0), points=0.015, tool=0.03)
REACH_DEG = 80.0


@dataclass(frozen=True, eq=False)
class Arm:
    nominal: RigidChain
    real: RigidChain
    change: np.ndarray
    kinds: str

    def pairs(
        self, rng: np.random.Generator, n: int, sigma: float = 0.0, reach_deg: float = REACH_DEG
    ) -> tuple[np.ndarray, np.ndarray]:
        q = random_q(rng, self.kinds, n, reach_deg)
        return q, self.real.positions(q) + sigma * rng.normal(size=(n, 3))

    def error(self, model, rng: np.random.Generator) -> float:
        """Return the mean distance [m] to the truth."""
        q = random_q(rng, self.kinds, 300, REACH_DEG)
        return float(np.linalg.norm(model.predict(q) - self.real.positions(q), axis=1).mean())


def rough_arm(rng: np.random.Generator, kinds: str = "RRRRRR", tolerances: ChainTolerances = ROUGH) -> Arm:
    nominal = random_chain(rng, kinds)
    parameters = ChainParameters(nominal)
    change = parameters.standard_deviations(tolerances) * rng.normal(size=parameters.size)
    return Arm(nominal, parameters.chain(change), change, kinds)
