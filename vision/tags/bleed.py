"""Estimate how far white bleeds into black in the image of a tag.

A tone curve, overexposure, a glowing screen, and ink that spreads all move every edge of black against white the same
way, the tag's own four edges too. Those would then say that the tag is smaller or larger than it is, and farther or
nearer. The modules inside the tag show it: their edges are on a grid that is known, and white cells come out wider than
black ones.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from scipy.special import ndtr

from bodyschema.interfaces.records import FloatArray, ImageArray

from .edge import SQUARE, leave, sampled

# Most samples along a row of modules; else one a pixel.
_MOST = 80
# Share of the samples that the pattern has to explain; the usual bleeding, in parts of the blur, where it does not.
_FITS, _UNSEEN = 0.9, 0.3
# Relative error on nine photographed grids (RMS): modules inside are not drawn and lit exactly as the edges are.
_DIFFERENT = 0.25


def bleed(grey: ImageArray, corners_px: FloatArray, blur_px: float, modules: FloatArray) -> tuple[float, float]:
    """Return how far white bleeds over the edges of black [px] and its variance [px²]; 0 where the pattern hides it.

    The levels of the tag are fitted by those of black and white, with a gradient each, and by two derivatives of the
    blurred pattern: by its edges' shift, and by its blur.

    Args:
        grey: the image.
        corners_px: the square's corners (4, 2) [px] as its own edges show them: each edge has bled by as much.
        blur_px: 1-sigma.
        modules: the tag's modules with its black border (n, n), 1 white and 0 black.
    """
    unseen = 0.0, (_UNSEEN * blur_px) ** 2
    length = float(len(modules))
    to_px = cv2.getPerspectiveTransform(length * SQUARE, corners_px.astype(np.float32))
    sides = np.linalg.norm(np.roll(corners_px, -1, axis=0) - corners_px, axis=1) / length
    width, height = float(sides[::2].mean()), float(sides[1::2].mean())
    # From the middle of one black border to that of the other.
    counts = [int(min(round((length - 1.0) * module), _MOST)) for module in (width, height)]
    x, y = (0.5 + (np.arange(count) + 0.5) * (length - 1.0) / count for count in counts)
    across, down = np.meshgrid(x, y)
    there = np.asarray(to_px, np.float64) @ np.stack([across.ravel(), down.ravel(), np.ones(across.size)])
    spots = there[:2] / there[2]
    if leave(grey, spots):
        return unseen
    levels = sampled(grey, spots)
    printed = np.pad(modules, 1, constant_values=1.0)
    white, by_x, by_xx = _blurred(x + 1.0, width, blur_px, len(printed))
    white_y, by_y, by_yy = _blurred(y + 1.0, height, blur_px, len(printed))
    pattern = white_y @ printed @ white.T
    slope_x, slope_y = white_y @ printed @ by_x.T, by_y @ printed @ white.T
    wider = white_y @ printed @ by_xx.T + by_yy @ printed @ white.T
    half = 0.5 * length
    right, below = across / half - 1.0, down / half - 1.0
    # The grid itself comes from edges that have bled towards the tag's middle.
    bled = np.hypot(slope_x, slope_y) - right * slope_x - below * slope_y
    lit = np.stack([np.ones_like(right), right, below])
    design = np.concatenate([lit, lit * pattern, [wider, bled]]).reshape(8, -1)
    try:
        found = np.linalg.solve(design @ design.T, design @ levels)
        kept = np.abs(levels - found @ design) < 0.5 * found[3]  # the rest show the other colour
        if not found[3] >= 1.0 or kept.mean() < _FITS:  # white is not one grey level brighter than black, or hidden
            return unseen
        cov = np.linalg.inv((design * kept) @ design.T)
    except np.linalg.LinAlgError:  # too few modules, or too sharp, to tell shift and blur apart
        return unseen
    found = cov @ (design @ (levels * kept))
    moved = float(found[7] / found[3])
    # What a module pulls at the shift: its samples share pixels, and print and light.
    pulls = (cov[7] @ design * kept * (levels - found @ design)).reshape(across.shape)
    rows, columns = (np.flatnonzero(np.diff(np.floor(at), prepend=-1.0)) for at in (y, x))
    pulls = np.add.reduceat(np.add.reduceat(pulls, rows, axis=0), columns, axis=1)
    by_chance = float(np.square(pulls).sum() / found[3] ** 2) * pulls.size / (pulls.size - len(design))
    if not math.isfinite(moved) or not by_chance > 0.0:
        return unseen
    # Many cameras do not bleed at all. How likely that is follows from two densities of what was found: by chance
    # alone, and by chance and the usual bleeding.
    usual = unseen[1] + by_chance
    odds = math.sqrt(by_chance / usual) * math.exp(min(0.5 * moved * moved * (1.0 / by_chance - 1.0 / usual), 500.0))
    bleeds = odds / (1.0 + odds)
    share = unseen[1] / usual
    moved *= share
    variance = bleeds * (share * by_chance + (_DIFFERENT * moved) ** 2) + bleeds * (1.0 - bleeds) * moved * moved
    return bleeds * moved, variance


def _blurred(
    places: FloatArray, module_px: float, blur_px: float, count: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the shares (n, count) of modules in a row at `places` (n,) in modules, and derivatives by 1 and 2 px."""
    t = (places[:, None] - np.arange(count + 1)) * (module_px / blur_px)
    density = np.exp(-0.5 * t * t) / (blur_px * math.sqrt(2.0 * math.pi))
    first, *derivatives = (step[:, :-1] - step[:, 1:] for step in (ndtr(t), density, -t * density / blur_px))
    return first, derivatives[0], derivatives[1]
