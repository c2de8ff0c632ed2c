"""Divide the explained error among causes, tolerances and the smooth model of unnamed causes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyschema.diagnosis.fit.fit import Fit, amount_columns
from bodyschema.interfaces.records import FloatArray


@dataclass(frozen=True, slots=True)
class Shares:
    """Shares of the explained squared error, with a sum of 1; all 0 if nothing is explained.

    A joint offset has a share here even if large tolerances could replace it. The tolerances are those of the fit. The
    share is the error that the offset explains, not the loss without it.
    """

    causes: tuple[float, ...]  # share of each cause of the fit
    # links, drives: shares of the tolerances of links and axes, and of the small periodic errors of drives
    links: float = 0.0
    drives: float = 0.0


def shares(aligned: Fit, extended: Fit, kept: NDArray[np.bool_], unnamed: FloatArray | None) -> Shares:
    """Divide the part of the residuals of `aligned` that `extended` explains, by each part's covariance with them.

    Args:
        kept: rows that count (n,).
        unnamed: change (n, 3) [m] by the smooth model of unnamed causes; None without one.
    """
    simulation, motion = extended.simulation, extended.observations.motion
    residuals = _without_nuisances(extended, (extended.observations.x - aligned.predicted)[kept], kept)
    whole = simulation.positions(motion)
    # Initial tolerances of the simulation are not part of the findings.
    given = aligned.simulation.background
    changes = [
        whole - simulation.with_effects([one for one in simulation.effects if one is not cause]).positions(motion)
        for cause in extended.causes
    ]
    for of_drive in (False, True):
        without = [effect for effect in given if effect.kind.of_drive == of_drive]
        without += [effect for effect in simulation.background if effect.kind.of_drive != of_drive]
        changes.append(whole - simulation.with_background(without).positions(motion))
    if unnamed is not None:
        changes.append(unnamed)
    # A part that only undoes another explains nothing.
    explained = np.maximum([float((change[kept] * residuals).sum()) for change in changes], 0.0)
    parts = (explained / max(float(explained.sum()), 1e-300)).tolist()
    count = len(extended.causes)
    return Shares(tuple(parts[:count]), parts[count], parts[count + 1])


def _without_nuisances(fit: Fit, residuals: FloatArray, kept: NDArray[np.bool_]) -> FloatArray:
    """Return the part of residuals (m, 3) that parameters unknown to robot.toml cannot follow."""
    columns = amount_columns(fit.run, fit.simulation.effects[: fit.nuisances])[kept].reshape(residuals.size, -1)
    columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    basis = np.linalg.qr(columns)[0]
    flat = residuals.ravel()
    return (flat - basis @ (basis.T @ flat)).reshape(residuals.shape)
