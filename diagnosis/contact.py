"""Find rows at which the state of a joint is unknown: its side of the backlash, or its distance from rest."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from bodyschema.effects import Effect

from .fit import Fit


def doubtful(fit: Fit, effects: Iterable[Effect] | None = None) -> NDArray[np.bool_]:
    """Return rows (n,) whose history is not known well enough for the effects of a fit, or for some of them."""
    rows = np.zeros(len(fit.observations.motion), dtype=np.bool_)
    for effect in fit.simulation.effects if effects is None else effects:
        rows |= effect.kind.unknown_state(fit.run, effect)
    return rows
