"""The models that learn side by side: the prior, the instant learner and the exact solver's last solution."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from interfaces.records import FloatArray
from kbmaps import NLMS, KBMap, NonFiniteError

PRIOR, INSTANT, EXACT = "prior", "nlms", "exact"
SMALLEST_STEP = 0.01


class Members:
    """All in the bases of the prior. `maps` is by model, the most trusted first.

    The exact solution is some pairs old when it comes, and grows older: instant steps keep it fresh in between.
    """

    def __init__(self, prior: KBMap, step_size: float) -> None:
        self._step_size = step_size
        self._maps = {PRIOR: prior, INSTANT: prior}
        self._learners = {INSTANT: NLMS(prior, step_size)}

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

    def learn(self, q: FloatArray, errors: Mapping[str, FloatArray], limit_m: float) -> None:
        """One step for the pair at q (d,) with these errors, as if none were longer than `limit_m`."""
        for name, learner in self._learners.items():
            error = errors[name] * min(1.0, limit_m / max(float(np.linalg.norm(errors[name])), 1e-300))
            learner.learn(q, self._maps[name].predict(q) + error)
            self._renew(name)

    def replay(self, q: FloatArray, x: FloatArray) -> None:
        """Steps of the instant learner for q (n, d), x (n, 3), in their order."""
        self._learners[INSTANT].replay(q, x)
        self._renew(INSTANT)

    def take(self, solution: KBMap, q: FloatArray, x: FloatArray, share: float) -> None:
        """A new solution of the exact solver, and the pairs q (n, d), x (n, 3) that it does not know yet.

        Args:
            share: of each error that steps shall mend until the next solution; more would follow the noise.
        """
        learner = NLMS(solution, min(max(share, SMALLEST_STEP), self._step_size))
        learner.replay(q, x)
        self._learners[EXACT] = learner
        self._renew(EXACT)

    def start_again(self, prior: KBMap, q: FloatArray, x: FloatArray) -> None:
        """Another prior for the same pairs, q (n, d) and x (n, 3): the instant learner learns them on top of it.

        The exact solution stays: it fits the pairs, and the solver's next one will have the new prior.
        """
        self._maps[PRIOR] = prior
        self._learners[INSTANT] = NLMS(prior, self._step_size)
        self.replay(q, x)

    def restore(self, nets: Mapping[str, FloatArray]) -> None:
        """The models that `nets` names."""
        for name, net in nets.items():
            self._maps[name] = KBMap(self.prior.bases, net)
            if name != PRIOR:
                self._learners[name] = NLMS(self._maps[name], self._step_size)

    def _renew(self, name: str) -> None:
        try:
            self._maps[name] = self._learners[name].map
        except NonFiniteError:  # overflow on absurd numbers: begin again rather than answer NaN
            self._learners[name] = NLMS(self.prior, self._step_size)
            self._maps[name] = self.prior
