"""What has no name in the place of a cause, as rivals with names are: a mount or a link that gives."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from bodyschema.effects import Effect, Motion
from bodyschema.interfaces.records import FloatArray

from .explanation import cost_of_names
from .fit import Fit, amount_columns
from .search import Search
from .unknown import SPECIFIC, Apart, Unknowns

# How much less probable than a cause with a name it is beforehand [nats]. To be taken for one it needs `SPECIFIC`, so
# that a cause is not given up for what does as well by chance.
_LESS_USUAL = 1.5


@dataclass(frozen=True, eq=False)
class Nameless:
    """Causes beside something that has no name, but is as specific as what has one.

    Attributes:
        apart: the other causes, with it taken away.
        behind: how much more probable it is than the cause in whose place it stands [nats].
    """

    apart: Apart
    behind: float

    @classmethod
    def in_place_of(
        cls, cause: Effect, fit: Fit, tried: Iterable[Apart], unknowns: Unknowns, search: Search
    ) -> Nameless | None:
        """The most probable one; None where none is tried.

        Args:
            fit: with the cause.
            tried: fits without it, beside what has no name.
        """
        allowance = cost_of_names([cause], search) + SPECIFIC - _LESS_USUAL
        found = [
            cls(apart, apart.fit.log_likelihood - fit.log_likelihood + allowance - unknowns.cost(apart))
            for apart in tried
        ]
        return max(found, key=lambda one: one.behind, default=None)

    @property
    def kind(self) -> str:
        """What errs: a joint, a body, or the place in the image."""
        return self.apart.chosen[0].family.kind

    @property
    def what(self) -> str:
        """In words."""
        return self.apart.chosen[0].family.what

    @property
    def predicted(self) -> FloatArray:
        """What is measured (n, 3) [m]."""
        return self.apart.predicted

    def positions(self, motion: Motion) -> FloatArray:
        """What would be measured (n, 3) [m] on another motion."""
        run = self.apart.fit.simulation.run(motion)
        (way,), (numbers,) = self.apart.chosen, self.apart.numbers
        return run.measured + way.family.columns(run) @ numbers

    def columns(self, motion: Motion) -> FloatArray:
        """Derivatives (n, 3, p) [m] of it by the amounts of the causes and by its own numbers."""
        run, (way,) = self.apart.fit.simulation.run(motion), self.apart.chosen
        return np.concatenate([amount_columns(run, self.apart.fit.simulation.effects), way.family.columns(run)], axis=2)
