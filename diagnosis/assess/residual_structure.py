"""Describe residual structure that no effect fits: the joints it depends on, and a smooth model of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtrc

from bodyschema.diagnosis.fit.fit import Fit
from bodyschema.diagnosis.search.held_out import Blocks
from bodyschema.diagnosis.unnamed.families import joints_of
from bodyschema.diagnosis.unnamed.family_fits import FitWithDiscrepancy, UnnamedFamilies, basis_of
from bodyschema.diagnosis.unnamed.rattle import LooseMarker
from bodyschema.diagnosis.unnamed.smooth import SmoothModel, smooth_model

from .explanation import Explanation

_AUTOCORRELATED = "an error that neighbouring rows share and nothing that was tested predicts"


@dataclass(frozen=True, eq=False)
class ResidualStructure:
    """Residual structure after all causes have been named."""

    what: tuple[str, ...]  # descriptions of the erring part and of what the error depends on
    joints: tuple[int, ...]  # indices in q of the joints at which it acts or on which it depends
    with_time: bool  # True if it depends on time
    p_value: float  # p-value of this structure arising by chance
    model: SmoothModel | None = None  # the causes beside a smooth model of it; None where no structure is left
    not_storable: tuple[str, ...] = ()  # descriptions of time-dependent parts, which no stored model can contain
    rattle: LooseMarker | None = None  # play of a loose marker; None for one that is fixed
    autocorrelated_rms_m: float = 0.0  # RMS of the error that neighbouring rows share and nothing predicts [m]

    @property
    def is_present(self) -> bool:
        """True if there is any structure."""
        return bool(self.what)

    @property
    def unnamed(self) -> tuple[str, ...]:
        """The descriptions, except for a loose marker."""
        return self.what if self.rattle is None else self.what[:-1]


def residual_structure(
    explanation: Explanation, unnamed: UnnamedFamilies, blocks: Blocks, loose: LooseMarker | None
) -> ResidualStructure:
    """Return the residual structure that the families of an explanation describe, and the play of a loose marker."""
    left = _of_families(explanation, unnamed, blocks, is_loose=loose is not None)
    if loose is None:
        return left
    # Also check the joint that carries the marker.
    carrier = len(explanation.fit.simulation.robot.joints) - 1
    joints = tuple(sorted({*left.joints, carrier}))
    return replace(left, what=(*left.what, loose.what), joints=joints, rattle=loose)


def _of_families(
    explanation: Explanation, unnamed: UnnamedFamilies, blocks: Blocks, *, is_loose: bool
) -> ResidualStructure:
    fit, discrepancy_fit = explanation.fit, explanation.discrepancy_fit
    if fit.is_exact:
        return ResidualStructure((), (), False, 1.0)
    if discrepancy_fit is None:
        nearest_fit = unnamed.discrepancy_fit(fit, (unnamed.nearest(fit)[0][0],))
        left = ResidualStructure((), (), False, min(1.0, _chance(fit, nearest_fit, unnamed) * unnamed.count))
        # Neighbouring rows have the marker on the same side of its play.
        if is_loose or not explanation.is_autocorrelated:
            return left
        squares = np.square(fit.observations.x - fit.predicted).sum(axis=1)
        shared = float(np.sqrt(fit.correlation * np.average(squares, weights=fit.noise.weights)))
        return replace(
            left, what=(_AUTOCORRELATED,), with_time=True, not_storable=(_AUTOCORRELATED,), autocorrelated_rms_m=shared
        )
    families = [prepared.family for prepared in discrepancy_fit.chosen]
    joints = [joints_of(family, own, fit.run) for family, own in zip(families, discrepancy_fit.numbers, strict=True)]
    return ResidualStructure(
        what=tuple(family.what for family in families),
        joints=tuple(sorted(frozenset[int]().union(*joints))),
        with_time=any(family.over_time for family in families),
        p_value=_chance(fit, discrepancy_fit, unnamed),
        model=smooth_model(fit, discrepancy_fit, families, blocks),
        not_storable=tuple(family.what for family in families if family.over_time),
    )


def _chance(fit: Fit, discrepancy_fit: FitWithDiscrepancy, unnamed: UnnamedFamilies) -> float:
    """Return the p-value of this structure by an F-test, since few rows do not determine the noise."""
    count = max(unnamed.identifiable_directions(discrepancy_fit).shape[2] + discrepancy_fit.choice, 1)
    coordinates = 3.0 * float(fit.noise.weights.sum())
    free = coordinates - basis_of(fit).shape[1] - count
    if free <= 0.0:
        return 1.0
    gain = 2.0 * max(discrepancy_fit.fit.log_likelihood - fit.log_likelihood, 0.0) / coordinates
    return float(fdtrc(count, free, np.expm1(gain) * free / count))
