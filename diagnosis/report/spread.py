"""Plot the size of the errors before and after, and their directions."""

from __future__ import annotations

import numpy as np

from bodyschema.interfaces.records import FloatArray

from .panels import Panel
from .plot import Plot, round_up
from .residuals import ARROWS, Residuals

_MOST_COLUMNS, _FEWEST_COLUMNS, _PAIRS_A_COLUMN = 48, 12, 12
# Quantile of the errors at which the histogram ends, and noise samples per row.
_SHOWN, _DRAWN = 0.99, 20
_SIDE, _MARGIN = 300, 26
# Arrow length as a share of the largest span, for the given quantile of the errors before.
_LONG, _SHORTER = 0.1, 0.9
_VIEWS_OF_CAMERA = (("as the camera sees it", 0, 1, 1), ("from above the camera", 0, 2, -1), ("from its side", 2, 1, 1))
_VIEWS = (("x and y", 0, 1, -1), ("x and z", 0, 2, -1), ("y and z", 1, 2, -1))


def histogram(residuals: Residuals) -> Panel:
    """Plot lengths of the errors before and after, beside those of noise alone."""
    before, after = (1e3 * np.linalg.norm(e[residuals.rows], axis=1) for e in (residuals.before, residuals.after))
    noise = 1e3 * _noise(residuals)
    end = float(np.quantile(np.concatenate([before, after]), _SHOWN)) or 1.0
    columns = int(np.clip(len(before) // _PAIRS_A_COLUMN, _FEWEST_COLUMNS, _MOST_COLUMNS))
    edges = np.linspace(0.0, end, columns + 1)
    middle = 0.5 * (edges[1:] + edges[:-1])
    shares = {
        look: 100.0 * np.histogram(lengths, edges)[0] / len(lengths)
        for look, lengths in (("before", before), ("after", after), ("noise", noise))
    }
    top = max(float(share.max()) for share in shares.values())
    plot = Plot("error [mm]", "share of the pairs [%]", (0.0, end), (0.0, 1.06 * top))
    marks = [plot.area(middle, shares[look], look) for look in ("before", "after")]
    return Panel(
        "How large the errors are: before, after, and what noise alone would be (line)",
        plot.svg(*marks, plot.line(middle, shares["noise"], "noise")),
    )


def _noise(residuals: Residuals) -> FloatArray:
    """Return lengths of errors due to noise alone."""
    fit = residuals.diagnosis.extended
    spread = np.linalg.inv(fit.observations.whitening[residuals.rows])
    rng = np.random.default_rng(residuals.diagnosis.seed)
    drawn = rng.normal(size=(_DRAWN, len(spread), 3))
    return fit.noise.sigma * np.linalg.norm(np.einsum("nij,knj->kni", spread, drawn), axis=2).ravel()


def arrows(residuals: Residuals) -> tuple[list[Panel], float]:
    """Return three projections before and three after at the same scale, and the stretch of the arrows."""
    rows = residuals.some(ARROWS)
    at = residuals.diagnosis.extended.observations.x[rows]
    extent = float(np.ptp(at, axis=0).max()) or 1.0
    usual = float(np.quantile(np.linalg.norm(residuals.before[rows], axis=1), _SHORTER)) or 1e-6
    stretch = max(round_up(_LONG * extent / usual), 1.0)
    views = _VIEWS_OF_CAMERA if residuals.calibration is not None else _VIEWS
    panels = [
        Panel(f"{when}: {name}", _projection(at, errors[rows], stretch, (across, down), sign, extent, look))
        for when, look, errors in (("Before", "before", residuals.before), ("After", "after", residuals.after))
        for name, across, down, sign in views
    ]
    return panels, stretch


def _projection(
    at: FloatArray, errors: FloatArray, stretch: float, axes: tuple[int, int], sign: int, extent: float, look: str
) -> str:
    """Draw arrows from the predicted to the measured marker position, stretched."""
    flip = np.array([1.0, sign])
    middle = 0.5 * (at.min(axis=0) + at.max(axis=0))
    scale = (_SIDE - 2 * _MARGIN) / extent
    feet = (at - errors - middle)[:, axes] * flip * scale + 0.5 * _SIDE
    ends = stretch * errors[:, axes] * flip * scale
    path = "".join(f"M{x:.1f} {y:.1f}l{dx:.1f} {dy:.1f}" for (x, y), (dx, dy) in zip(feet, ends, strict=True))
    dots = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in feet)
    bar = round_up(0.2 * extent)
    return (
        f'<svg viewBox="0 0 {_SIDE} {_SIDE}" role="img" aria-label="error arrows">'
        f'<path class="arrows {look}" d="{path}"/><path class="feet {look}" d="{dots}"/>'
        f'<path class="scale" d="M8 {_SIDE - 8}h{bar * scale:.1f}"/>'
        f'<text x="{14 + bar * scale:.1f}" y="{_SIDE - 4}">{100 * bar:.3g} cm</text></svg>'
    )
