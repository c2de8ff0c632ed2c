"""Test unnamed causes as rivals of named ones: a mount or a link that deflects."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from bodyschema.diagnosis.fit.fit import Fit, amount_columns
from bodyschema.diagnosis.search.search import Search
from bodyschema.diagnosis.unnamed.family_fits import Apart, FamilySettings, UnnamedFamilies
from bodyschema.effects import Effect, Motion
from bodyschema.interfaces.records import FloatArray

from .explanation import cost_of_names

# Prior penalty against a named cause [nats]. Accepting one in place of a cause takes `specific_nats` instead, so that a
# cause is not given up for something that fits as well by chance.
_LESS_USUAL = 1.5


@dataclass(frozen=True, eq=False)
class UnnamedAlternative:
    """Alternative to a named cause: an unnamed one that is as specific, together with the other causes."""

    apart: Apart  # the other causes, with the unnamed one removed from the data
    behind: float  # its log-evidence relative to the cause that it replaces [nats]

    @classmethod
    def in_place_of(
        cls, cause: Effect, fit: Fit, tried: Iterable[Apart], unnamed: UnnamedFamilies, search: Search
    ) -> UnnamedAlternative | None:
        """Return the most probable one; None if there is none to test.

        Args:
            fit: the fit with the cause.
            tried: fits without the cause, beside unnamed causes.
        """
        allowance = cost_of_names([cause], search) + FamilySettings.specific_nats - _LESS_USUAL
        found = [
            cls(apart, apart.fit.log_likelihood - fit.log_likelihood + allowance - unnamed.cost(apart))
            for apart in tried
        ]
        return max(found, key=lambda one: one.behind, default=None)

    @property
    def kind(self) -> str:
        """Source of the error: a joint, a body, or the place in the image."""
        return self.apart.chosen[0].family.kind

    @property
    def what(self) -> str:
        return self.apart.chosen[0].family.what

    @property
    def predicted(self) -> FloatArray:
        """Predicted measurements (n, 3) [m]."""
        return self.apart.predicted

    def positions(self, motion: Motion) -> FloatArray:
        """Return the predicted measurements (n, 3) [m] on another motion."""
        run = self.apart.fit.simulation.run(motion)
        (way,), (numbers,) = self.apart.chosen, self.apart.numbers
        return run.measured + way.family.columns(run) @ numbers

    def columns(self, motion: Motion) -> FloatArray:
        """Return derivatives (n, 3, p) [m] by the amounts of the causes and by its own parameters."""
        run, (way,) = self.apart.fit.simulation.run(motion), self.apart.chosen
        return np.concatenate([amount_columns(run, self.apart.fit.simulation.effects), way.family.columns(run)], axis=2)
