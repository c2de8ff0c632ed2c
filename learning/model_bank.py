"""Models that learn side by side: the prior, the instant learner and the solver's last solutions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from bodyschema.interfaces.records import FloatArray
from kbmaps import NLMS, KBMap, NonFiniteError, PositionModel


class LearntModel(PositionModel, Protocol):
    """Map from joint angles to positions that later learning does not change."""

    @property
    def digest(self) -> str: ...

    def to_bytes(self) -> bytes: ...


PRIOR, INSTANT, RIGID, RESIDUAL, EXACT = "prior", "nlms", "rigid", "residual", "exact"
# Stored net of the instant learner at the time when the current solutions were requested.
_DELAYED = "delayed"
SOLVED = (RIGID, RESIDUAL, EXACT)
# Order of trust while errors do not decide. Pairs come along guided paths, where errors are known on the path only: a
# model with fewer parameters is better away from it.
TRUSTED = (RIGID, RESIDUAL, EXACT, PRIOR, INSTANT)


class ModelBank:
    """KB-Maps in the bases of the prior, and a chain with residual.

    Between two solutions, the solved models do not change. Instant steps on top of them would follow the newest pairs
    and spoil them away from their path: the error a few degrees away was measured to grow from 7 to 10 mm within 20
    pairs.
    """

    def __init__(self, prior: KBMap) -> None:
        self._solved_maps = {PRIOR: prior}
        self._residual: LearntModel | None = None
        self._instant = NLMS(prior)
        self._instant_map: KBMap | None = prior
        self._requested_map: KBMap | None = None
        # map of the instant learner when the current solutions were requested; None before any
        self.delayed: KBMap | None = None

    @property
    def names(self) -> tuple[str, ...]:
        return (*self._solved_maps, INSTANT) if self._residual is None else (*self._solved_maps, INSTANT, RESIDUAL)

    @property
    def maps(self) -> Mapping[str, KBMap]:
        """Current models that are KB-Maps; later learning does not change them."""
        return {name: self.map(name) for name in self.names if name != RESIDUAL}

    @property
    def prior(self) -> KBMap:
        return self._solved_maps[PRIOR]

    def model(self, name: str) -> LearntModel:
        """Return one of the current models; later learning does not change it."""
        return self._residual if name == RESIDUAL and self._residual is not None else self.map(name)

    def map(self, name: str) -> KBMap:
        """Return one of the KB-Maps. The instant learner's is copied on demand, not with each pair."""
        if name != INSTANT:
            return self._solved_maps[name]
        if self._instant_map is None:
            try:
                self._instant_map = self._instant.map
            except NonFiniteError:  # overflow on absurd numbers: restart from the prior instead of answering NaN
                return self._restart_instant()
        return self._instant_map

    def predict(self, name: str, q: FloatArray) -> FloatArray:
        """Return the prediction of one of the models at q (d,) or (n, d) [rad]: (3,) or (n, 3) [m]."""
        if name != INSTANT or self._instant_map is not None:
            return self.model(name).predict(q)
        predicted = self._instant.predict(q)
        return predicted if np.isfinite(predicted).all() else self._restart_instant().predict(q)

    def predictions(self, q: FloatArray, instant: FloatArray) -> dict[str, FloatArray]:
        """Return positions (n, 3) [m] at q (n, d) [rad] by model; those of the instant learner are given."""
        return {name: instant if name == INSTANT else self.predict(name, q) for name in self.names}

    def learn(self, q: FloatArray, error: FloatArray, limit_m: float) -> None:
        """Take one step of the instant learner for the pair at q (d,); its error (3,) [m] is clipped to `limit_m`."""
        clipped = error * min(1.0, limit_m / max(float(np.linalg.norm(error)), 1e-300))
        self._instant.learn(q, self.predict(INSTANT, q) + clipped)
        self._instant_map = None

    def replay(self, q: FloatArray, x: FloatArray) -> None:
        """Take steps of the instant learner for q (n, d), x (n, 3), in their order."""
        self._instant.replay(q, x)
        self._instant_map = None

    def request_solution(self) -> None:
        self._requested_map = self.map(INSTANT)

    def take(self, name: str, solution: LearntModel) -> None:
        if isinstance(solution, KBMap):
            self._solved_maps[name] = solution
        else:
            self._residual = solution
        self.delayed = self._requested_map

    def replace_prior(self, prior: KBMap, q: FloatArray, x: FloatArray) -> None:
        """Use another prior for the same pairs, q (n, d) and x (n, 3): the instant learner learns them on top of it.

        The solutions stay: they fit the pairs.
        """
        self._solved_maps[PRIOR] = prior
        self._restart_instant()
        self.replay(q, x)

    def nets(self) -> dict[str, FloatArray]:
        """Return the nets for `restore`, without the chain with residual."""
        nets = {name: kbmap.net for name, kbmap in self.maps.items()}
        return nets if self.delayed is None else nets | {_DELAYED: self.delayed.net}

    def restore(self, nets: Mapping[str, FloatArray], residual: LearntModel | None) -> None:
        """Resume from `nets` and the chain with residual."""
        maps = {name: KBMap(self.prior.bases, net) for name, net in nets.items()}
        self._residual, self.delayed, self._instant_map = residual, maps.pop(_DELAYED, None), maps.pop(INSTANT)
        self._solved_maps |= maps
        self._instant = NLMS(self._instant_map)

    def _restart_instant(self) -> KBMap:
        """Return the map of an instant learner restarted from the prior."""
        self._instant, self._instant_map = NLMS(self.prior), self.prior
        return self._instant_map
