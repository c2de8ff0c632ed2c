"""Test unnamed causes as rivals of named ones: a mount or a link that deflects."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from bodyschema.diagnosis.fit.fit import Fit, amount_columns
from bodyschema.diagnosis.search.search import Search
from bodyschema.diagnosis.unnamed.family_fits import FamilySettings, FitWithDiscrepancy, UnnamedFamilies
from bodyschema.effects import Effect, Motion
from bodyschema.interfaces.records import FloatArray

from .explanation import naming_cost

# Prior penalty against a named cause [nats]. Accepting one in place of a cause takes `specific_nats` instead, so that a
# cause is not given up for something that fits as well by chance.
_LESS_USUAL = 1.5


@dataclass(frozen=True, eq=False)
class UnnamedAlternative:
    """Alternative to a named cause: an unnamed one that is as specific, together with the other causes."""

    discrepancy_fit: FitWithDiscrepancy  # the other causes, with the unnamed one removed from the data
    relative_evidence: float  # its log-evidence relative to the cause that it replaces [nats]

    @classmethod
    def in_place_of(
        cls, cause: Effect, fit: Fit, tried: Iterable[FitWithDiscrepancy], unnamed: UnnamedFamilies, search: Search
    ) -> UnnamedAlternative | None:
        """Return the most probable one, or None if none can be tested.

        Args:
            fit: the fit with the cause.
            tried: fits without the cause, beside unnamed causes.
        """
        allowance = naming_cost([cause], search) + FamilySettings.specific_nats - _LESS_USUAL
        found = [
            cls(
                discrepancy_fit,
                discrepancy_fit.fit.log_likelihood - fit.log_likelihood + allowance - unnamed.cost(discrepancy_fit),
            )
            for discrepancy_fit in tried
        ]
        return max(found, key=lambda one: one.relative_evidence, default=None)

    @property
    def kind(self) -> str:
        """Source of the error: a joint, a body, or the place in the image."""
        return self.discrepancy_fit.chosen[0].family.kind

    @property
    def what(self) -> str:
        return self.discrepancy_fit.chosen[0].family.what

    @property
    def predicted(self) -> FloatArray:
        """Predicted measurements (n, 3) [m]."""
        return self.discrepancy_fit.predicted

    def positions(self, motion: Motion) -> FloatArray:
        """Return the predicted measurements (n, 3) [m] on another motion."""
        run = self.discrepancy_fit.fit.simulation.run(motion)
        (prepared,), (numbers,) = self.discrepancy_fit.chosen, self.discrepancy_fit.numbers
        return run.measured + prepared.family.columns(run) @ numbers

    def columns(self, motion: Motion) -> FloatArray:
        """Return derivatives (n, 3, p) [m] by the amounts of the causes and by its own parameters."""
        run, (prepared,) = self.discrepancy_fit.fit.simulation.run(motion), self.discrepancy_fit.chosen
        return np.concatenate(
            [amount_columns(run, self.discrepancy_fit.fit.simulation.effects), prepared.family.columns(run)], axis=2
        )
