"""Find ripples that a recording confuses with finer or coarser ones because a joint was read at regular angles."""

from __future__ import annotations

import numpy as np

from bodyschema.effects import Effect
from bodyschema.interfaces.records import FloatArray

from .fit import Fit
from .scan import FINEST

# Waves whose phases agree this well over all readings are the same wave.
_SAME = 0.97
_FEWEST_CYCLES = 2


def alias_sentences(fit: Fit) -> list[str]:
    """Return a sentence for each ripple of a fit that has an alias."""
    told = []
    for cause in fit.causes:
        others = aliases(fit, cause) if cause.kind.is_periodic and not cause.prismatic else []
        if others:
            listed = ", ".join(f"{cycles:.0f}" for cycles in others[:3])
            told.append(
                f"{cause.where} was read at such regular angles that a ripple of {cause.values[-1]:.0f} cycles a turn "
                f"looks like one of {listed}{' and more' if len(others) > 3 else ''}. Read it at uneven angles."
            )
    return told


def aliases(fit: Fit, ripple: Effect) -> list[float]:
    """Return the other numbers of cycles per turn that look the same as a ripple's own at all readings."""
    q = fit.observations.motion.q[:, fit.simulation.place(ripple).joint]
    own = float(ripple.values[-1])
    cycles = np.arange(_FEWEST_CYCLES, FINEST + 1.0)
    # Compare waves of the same and of opposite phase; close neighbours of a ripple are not aliases.
    same = np.maximum(_agreement(cycles - own, q), _agreement(cycles + own, q)) > _SAME
    apart = np.abs(cycles - own) > 2.0 * np.pi / max(float(np.ptp(q)), 1e-6)
    return [float(one) for one in cycles[same & apart]]


def _agreement(cycles: FloatArray, q: FloatArray) -> FloatArray:
    """Return the agreement of waves of frequencies (m,) over readings (n,): 1 if all have the same phase."""
    return np.abs(np.exp(1j * np.multiply.outer(cycles, q)).mean(axis=1))
