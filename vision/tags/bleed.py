"""Estimate how far white bleeds into black in the image of a tag.

A tone curve, overexposure, a glowing screen, and ink that spreads all move every edge of black against white the same
way, including the tag's own four edges. The tag would then seem smaller or larger, and farther or nearer, than it is.
The modules inside the tag show the shift: their edges are on a known grid, and white cells appear wider than black
ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from scipy.special import ndtr

from bodyschema.interfaces.records import FloatArray, ImageArray

from .edge import SQUARE, Mask, sample_levels, touches_border
from .settings import BleedSettings as _Settings
from .settings import TagSettings


def bleed(grey: ImageArray, corners_px: FloatArray, blur_px: float, modules: FloatArray) -> tuple[float, float]:
    """Return how far white bleeds over the edges of black [px] and its variance [px²]; 0 if the pattern hides it.

    The levels of the tag are fitted by those of black and white, with a gradient each, and by two derivatives of the
    blurred pattern: by its edges' shift, and by its blur. The pattern is then rendered with its edges shifted, and
    fitted again (Gauss and Newton).

    Args:
        grey: the image.
        corners_px: the square's corners (4, 2) [px] by its own edges, which have bled by the same amount.
        blur_px: 1-sigma.
        modules: the tag's modules with its black border (n, n), 1 white and 0 black.
    """
    prior = 0.0, (_Settings.usual * blur_px) ** 2
    length = float(len(modules))
    to_px = cv2.getPerspectiveTransform(length * SQUARE, corners_px.astype(np.float32))
    sides = np.linalg.norm(np.roll(corners_px, -1, axis=0) - corners_px, axis=1) / length
    width, height = float(sides[::2].mean()), float(sides[1::2].mean())
    # From the middle of one black border to that of the other.
    counts = [int(min(round((length - 1.0) * module), _Settings.max_samples)) for module in (width, height)]
    x, y = (0.5 + (np.arange(count) + 0.5) * (length - 1.0) / count for count in counts)
    across, down = np.meshgrid(x, y)
    homogeneous = np.asarray(to_px, np.float64) @ np.stack([across.ravel(), down.ravel(), np.ones(across.size)])
    positions = homogeneous[:2] / homogeneous[2]
    if touches_border(grey, positions):
        return prior
    levels = sample_levels(grey, positions)
    printed = np.pad(modules, 1, constant_values=1.0)
    half = 0.5 * length
    right, below = across / half - 1.0, down / half - 1.0
    light_basis = np.stack([np.ones_like(right), right, below])

    def pattern_at(bled_px: float) -> tuple[FloatArray, FloatArray]:
        # The grid itself comes from edges that have bled towards the tag's middle.
        shifts = bled_px / width, bled_px / height
        true = [half + (at - half) * (1.0 - shift / half) for at, shift in zip((x, y), shifts, strict=True)]
        (white, wide), (white_y, wide_y) = map(_blurred, true, shifts, (width, height), [blur_px] * 2, [length] * 2)
        rendered = _bled(printed, bled_px)
        return white_y @ rendered @ white.T, white_y @ rendered @ wide.T + wide_y @ rendered @ white.T

    fit = _fitted(levels, light_basis, pattern_at, _Settings.step_share * blur_px)
    if fit is None or not abs(fit.moved) < _Settings.widest * min(width, height):
        return prior
    moved, found, cov, design, kept = fit
    # Influence of a module on the shift: its samples share pixels, print and light.
    influences = (cov[7] @ design * kept * (levels - found @ design)).reshape(across.shape)
    rows, columns = (np.flatnonzero(np.diff(np.floor(at), prepend=-1.0)) for at in (y, x))
    influences = np.add.reduceat(np.add.reduceat(influences, rows, axis=0), columns, axis=1)
    chance_variance = (
        float(np.square(influences).sum() / found[3] ** 2) * influences.size / (influences.size - len(design))
    )
    if not chance_variance > 0.0:
        return prior
    # Many cameras do not bleed at all. The probability of bleeding follows from two densities of the estimate: by
    # chance alone, and by chance with the usual bleeding.
    total_variance = prior[1] + chance_variance
    odds = math.sqrt(chance_variance / total_variance) * math.exp(
        min(0.5 * moved * moved * (1.0 / chance_variance - 1.0 / total_variance), 500.0)
    )
    probability = odds / (1.0 + odds)
    share = prior[1] / total_variance
    moved *= share
    variance = (
        probability * (share * chance_variance + (_Settings.unlike * moved) ** 2)
        + probability * (1.0 - probability) * moved * moved
    )
    return probability * moved, variance


class _Fit(NamedTuple):
    """Shift [px], weights of the rows of a design (8, n) with covariance, the design, and the samples explained."""

    moved: float
    found: FloatArray
    cov: FloatArray
    design: FloatArray
    kept: Mask


def _fitted(
    levels: FloatArray,
    light_basis: FloatArray,
    pattern_at: Callable[[float], tuple[FloatArray, FloatArray]],
    step_px: float,
) -> _Fit | None:
    """Fit levels (n,) by the pattern at the shift that explains them best; return None if something covers it."""
    moved, kept = 0.0, np.ones(levels.shape, np.bool_)
    fit = None
    for _ in range(_Settings.rounds):
        pattern, wider = pattern_at(moved)
        bled = (pattern_at(moved + step_px)[0] - pattern) / step_px
        design = np.concatenate([light_basis, light_basis * pattern, [wider, bled]]).reshape(8, -1)
        try:
            found = np.linalg.solve((design * kept) @ design.T, design @ (levels * kept))
            kept = np.abs(levels - found @ design) < 0.5 * found[3]  # the rest show the other colour
            # White is not one grey level brighter than black, or hidden.
            if not found[3] >= 1.0 or kept.mean() < _Settings.explained:
                return None
            cov = np.linalg.inv((design * kept) @ design.T)
        except np.linalg.LinAlgError:  # too few modules, or too sharp, to separate shift and blur
            return None
        found = cov @ (design @ (levels * kept))
        change = float(found[7] / found[3])
        moved += change
        if not math.isfinite(moved):
            return None
        fit = _Fit(moved, found, cov, design, kept)
        if abs(change) < TagSettings.settled_px:
            break
    return fit


def _bled(printed: FloatArray, bled_px: float) -> FloatArray:
    """Return the colours (2 n − 1, 2 n − 1) of n by n modules and of the strips between them after bleeding."""
    taken = np.maximum if bled_px >= 0.0 else np.minimum
    rows = np.empty((2 * len(printed) - 1, len(printed)))
    rows[::2], rows[1::2] = printed, taken(printed[1:], printed[:-1])
    rendered = np.empty((len(rows), len(rows)))
    rendered[:, ::2], rendered[:, 1::2] = rows, taken(rows[:, 1:], rows[:, :-1])
    return rendered


def _blurred(
    places: FloatArray, shift: float, module_px: float, blur_px: float, length: float
) -> tuple[FloatArray, FloatArray]:
    """Return the weights (n, m) of modules and strips in a row at `places` (n,), and their second derivatives [1/px²].

    Places and shift are in modules. A strip is as wide as two edges' shift.
    """
    between = np.arange(length + 1.0)
    lines = np.column_stack([between - abs(shift), between + abs(shift)]).ravel()
    lines = np.concatenate([[-1.0], lines, [length + 1.0]])
    t = (places[:, None] - lines) * (module_px / blur_px)
    density = np.exp(-0.5 * t * t) / (blur_px * math.sqrt(2.0 * math.pi))
    share, wider = (step[:, :-1] - step[:, 1:] for step in (ndtr(t), -t * density / blur_px))
    return share, wider
