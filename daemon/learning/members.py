"""The models that learn side by side: the prior, the instant learner and the solver's last solutions."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from interfaces.records import FloatArray
from kbmaps import NLMS, KBMap, NonFiniteError

from .learnt import LearntModel

PRIOR, INSTANT, RIGID, RESIDUAL, EXACT = "prior", "nlms", "rigid", "residual", "exact"
SOLVED = (RIGID, RESIDUAL, EXACT)
# Who is believed first when the errors do not tell. Pairs come along guided paths, where errors tell of the path only:
# what has fewer numbers says more about places beside it. (`Ladder.around` is for spread pairs, and has another order.)
TRUSTED = (RIGID, RESIDUAL, EXACT, PRIOR, INSTANT)


class Members:
    """KB-Maps in the bases of the prior, and a chain with residual.

    Between two solutions the solved ones stay as they are. Instant steps on top of them would follow the newest pairs,
    and spoil them beside their path: measured, the error a few degrees away grew from 7 to 10 mm within 20 pairs.
    """

    def __init__(self, prior: KBMap, step_size: float) -> None:
        self._step_size = step_size
        self._maps = {PRIOR: prior, INSTANT: prior}
        self._residual: LearntModel | None = None
        self._instant = NLMS(prior, step_size)
        self._asked: KBMap | None = None
        self._delayed: KBMap | None = None

    @property
    def delayed(self) -> KBMap | None:
        """The instant learner as it was when the present solutions were asked for; None before any."""
        return self._delayed

    @property
    def maps(self) -> Mapping[str, KBMap]:
        """Those of the present models that are KB-Maps; none of them is touched by later learning."""
        return self._maps

    @property
    def models(self) -> Mapping[str, LearntModel]:
        """The present models."""
        return self._maps if self._residual is None else {**self._maps, RESIDUAL: self._residual}

    @property
    def prior(self) -> KBMap:
        """Where learning started."""
        return self._maps[PRIOR]

    def errors(self, q: FloatArray, x: FloatArray) -> dict[str, FloatArray]:
        """Measured minus predicted position (3,) [m] by model, for one pair."""
        return {name: x - model.predict(q) for name, model in self.models.items()}

    def learn(self, q: FloatArray, error: FloatArray, limit_m: float) -> None:
        """One step of the instant learner for the pair at q (d,), where its error (3,) [m] counts up to `limit_m`."""
        counted = error * min(1.0, limit_m / max(float(np.linalg.norm(error)), 1e-300))
        self._instant.learn(q, self._maps[INSTANT].predict(q) + counted)
        self._renew()

    def replay(self, q: FloatArray, x: FloatArray) -> None:
        """Steps of the instant learner for q (n, d), x (n, 3), in their order."""
        self._instant.replay(q, x)
        self._renew()

    def ask(self) -> None:
        """The solver works on all pairs up to here."""
        self._asked = self._maps[INSTANT]

    def take(self, name: str, solution: LearntModel) -> None:
        """The solver's solution for one of the models of what it was asked."""
        if isinstance(solution, KBMap):
            self._maps[name] = solution
        else:
            self._residual = solution
        self._delayed = self._asked

    def start_again(self, prior: KBMap, q: FloatArray, x: FloatArray) -> None:
        """Another prior for the same pairs, q (n, d) and x (n, 3): the instant learner learns them on top of it.

        The solutions stay: they fit the pairs.
        """
        self._maps[PRIOR] = prior
        self._instant = NLMS(prior, self._step_size)
        self.replay(q, x)

    def restore(self, nets: Mapping[str, FloatArray], residual: LearntModel | None) -> None:
        """The KB-Maps that `nets` names, and the chain with residual."""
        self._residual = residual
        self._maps |= {name: KBMap(self.prior.bases, net) for name, net in nets.items()}
        self._instant = NLMS(self._maps[INSTANT], self._step_size)
        if any(name in self.models for name in SOLVED):
            self._delayed = self._maps[INSTANT]

    def _renew(self) -> None:
        try:
            self._maps[INSTANT] = self._instant.map
        except NonFiniteError:  # overflow on absurd numbers: begin again rather than answer NaN
            self._instant = NLMS(self.prior, self._step_size)
            self._maps[INSTANT] = self.prior
