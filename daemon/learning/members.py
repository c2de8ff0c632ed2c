"""The models that learn side by side: the prior, the instant learner and the exact solver's last solution."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from interfaces.records import FloatArray
from kbmaps import NLMS, KBMap, NonFiniteError

PRIOR, INSTANT, EXACT = "prior", "nlms", "exact"


class Members:
    """All in the bases of the prior. `maps` is by model, the most trusted first."""

    def __init__(self, prior: KBMap, step_size: float) -> None:
        self._step_size = step_size
        self._nlms = NLMS(prior, step_size)
        self._maps = {PRIOR: prior, INSTANT: prior}

    @property
    def maps(self) -> Mapping[str, KBMap]:
        """The present models; none of them is touched by later learning."""
        return self._maps

    @property
    def prior(self) -> KBMap:
        """Where learning started."""
        return self._maps[PRIOR]

    def errors(self, q: FloatArray, x: FloatArray) -> dict[str, FloatArray]:
        """Measured minus predicted position (3,) [m] by model, for one pair."""
        return {name: x - model.predict(q) for name, model in self._maps.items()}

    def learn(self, q: FloatArray, x: FloatArray, limit_m: float) -> None:
        """One step of the instant learner towards x (3,), as if it were at most `limit_m` from the prediction."""
        error = x - self._maps[INSTANT].predict(q)
        distance = float(np.linalg.norm(error))
        self._nlms.learn(q, x if distance <= limit_m else x - error * (1.0 - limit_m / distance))
        self._renew()

    def replay(self, q: FloatArray, x: FloatArray) -> None:
        """Steps of the instant learner for q (n, d), x (n, 3), in their order."""
        self._nlms.replay(q, x)
        self._renew()

    def take(self, solution: KBMap) -> None:
        """A new solution of the exact solver."""
        self._maps[EXACT] = solution

    def move_prior(self, prior: KBMap) -> None:
        """Another prior: everything learnt on top of the old one moves along."""
        change = prior.net - self.prior.net
        for name in list(self._maps):
            self._maps[name] = KBMap(prior.bases, self._maps[name].net + change)
        self._nlms = NLMS(self._maps[INSTANT], self._step_size)

    def restore(self, nets: Mapping[str, FloatArray]) -> None:
        """The models that `nets` names."""
        for name, net in nets.items():
            self._maps[name] = KBMap(self.prior.bases, net)
        self._nlms = NLMS(self._maps[INSTANT], self._step_size)

    def _renew(self) -> None:
        try:
            self._maps[INSTANT] = self._nlms.map
        except NonFiniteError:  # overflow on absurd numbers: begin again rather than answer NaN
            self._nlms = NLMS(self.prior, self._step_size)
            self._maps[INSTANT] = self.prior
