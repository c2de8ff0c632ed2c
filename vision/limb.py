"""Where rays leave a ball, to a hundredth of a pixel: matched filters along rays, each made for its background.

The filters are those of `limb_filters`. Which texture a ray's background has is what its samples make likeliest.
Colours are turned so that the first channel is the ball's own colour: its shading is unknown there, while the other
two channels show nothing of the ball but its gloss.

Each channel tells the edge by itself. Where something narrow lies along the limb, a bar or the rest of a box that the
ball hides, each channel mixes its light into the edge differently, and they tell different edges. No residual of the
fit shows that, as whole arcs are off alike; but the channels' disagreement does, and such rays count little.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray

from .colour import Float32Array, Gate
from .limb_filters import STEP_PX, Filters, filters, places
from .polar import ball_colour, mean_of_three, median, rays_round, sample

# Samples on the ball that tell its colour and the noise, from this part of its radius on.
_INNER_COLUMNS, _INNER_PART = 4, 0.3
# A sample's noise is at least this [grey levels]; so many of the rays have a background that shows not much else.
_LEAST_NOISE, _EVEN_RAYS = 1.0, 0.3
# Beyond so many blurs the ball no longer shows.
_BEYOND_BLURS = 2.0
# No ray tells its edge better than this, and one that tells it worse tells nothing [px].
_BEST_SIGMA_PX, _WORST_SIGMA_PX = 0.03, 0.5
# The channels' disagreement (chi-squared, 2 degrees of freedom): more than this, and than this times the median of the
# ball's rays, is no noise, and makes a ray's variance larger by that power of it; what its median is of noise alone.
_LEAST_DISAGREEMENT, _USUAL_DISAGREEMENT, _DISAGREEMENT_POWER, _OF_NOISE = 2.0, 1.5, 3, 3.0
# The blur changes by this factor at most from one look to the next.
_LARGEST_WIDENING = 1.5


@dataclass(frozen=True, slots=True)
class Limb:
    """The ball's edge, ray by ray.

    Attributes:
        rays: cosine and sine of their directions, and 1, shape (n, 3).
        offset_px: how far beyond the outline that was thought of the edge is, shape (n,) [px].
        weight: inverse variances of `offset_px`, shape (n,) [1/px²]; 0 where a ray does not tell.
        blur_px: 1-sigma of lens and interpolation, as the edge shows it [px].
        excess: the variance of what the channels disagree by, over the one that the pixels' noise makes; 1 or more.
    """

    rays: FloatArray
    offset_px: FloatArray
    weight: FloatArray
    blur_px: float
    excess: float

    @property
    def evenness(self) -> float:
        """1 where all rays count alike, k/n where k of n rays do and the others tell nothing."""
        return float(self.weight.sum()) ** 2 / (len(self.weight) * float(self.weight @ self.weight))

    @property
    def noise_share(self) -> float:
        """The part of the variances of `offset_px` that is the pixels' noise, mean of the rays that tell."""
        return 1.0 - _BEST_SIGMA_PX**2 * float(self.weight[self.weight > 0].mean())


def find_limb(
    image: Float32Array, gate: Gate, centre_px: FloatArray, radius_px: float, shape: FloatArray, blur_px: float
) -> Limb | None:
    """The edge about an outline that is right to a few tenths of a pixel; None when no ball shows there.

    Args:
        image: BGR, shape (height, width, 3), grey levels.
        centre_px, radius_px, shape: the outline, see `sphere.Ellipse`.
        blur_px: how wide the edge is thought to be, to a third [px].
    """
    rays = rays_round(radius_px)
    at = places(radius_px, blur_px)
    inner = np.linspace(_INNER_PART * radius_px, max(radius_px + at[0], 0.5 * radius_px), _INNER_COLUMNS)
    samples = sample(image, centre_px, rays, np.concatenate([inner, radius_px + at]), shape)
    colour = ball_colour(samples[:, :_INNER_COLUMNS], gate)
    if colour is None:
        return None
    turned = samples @ _own_colour_first(colour).astype(np.float32)
    noise = _noise(turned[:, :_INNER_COLUMNS, 1:], turned[:, _INNER_COLUMNS:][:, at > _BEYOND_BLURS * blur_px])
    channels = np.moveaxis(turned[:, _INNER_COLUMNS:].astype(np.float64) / noise, 2, 0)
    return _filtered(rays, channels, filters(radius_px, blur_px), blur_px)


def _filtered(rays: FloatArray, channels: FloatArray, both: tuple[Filters, Filters], blur_px: float) -> Limb:
    """What the filters make of the samples (3, n, m) of n rays in units of the noise, the ball's own colour first."""
    own, across = both
    informations, shifts = np.zeros((2, len(channels), len(rays)))
    widening, widening_information = 0.0, 1e-9
    likeliest = np.concatenate([_likeliest(channels[:1], own), _likeliest(channels[1:], across)])
    for number, (channel, one, texture) in enumerate(zip(channels, (own, across, across), likeliest, strict=True)):
        contrast, shift = (np.einsum("nm,nm->n", part[texture], channel) for part in (one.contrast, one.shift))
        contrast = mean_of_three(contrast)
        inverse = 1.0 / one.shift_variance[texture]
        informations[number] = contrast**2 * inverse
        shifts[number] = contrast * shift * inverse
        if one is across:
            inverse = 1.0 / one.widening_variance[texture]
            widening += float(np.sum(contrast * inverse * np.einsum("nm,nm->n", one.widening[texture], channel)))
            widening_information += float(np.sum(contrast**2 * inverse))
    information, moved = informations.sum(axis=0), shifts.sum(axis=0)
    mean = np.divide(moved, information, out=np.zeros_like(moved), where=information > 0)
    doubt, excess = _doubt(informations, shifts, mean, information > _WORST_SIGMA_PX**-2)
    information /= doubt
    told = information > _WORST_SIGMA_PX**-2
    information[~told] = 1.0
    return Limb(
        rays,
        np.where(told, mean, 0.0),
        told / (1.0 / information + _BEST_SIGMA_PX**2),
        blur_px * min(max(1.0 + widening / widening_information / blur_px, 1 / _LARGEST_WIDENING), _LARGEST_WIDENING),
        excess,
    )


def _doubt(
    informations: FloatArray, shifts: FloatArray, mean: FloatArray, told: NDArray[np.bool_]
) -> tuple[FloatArray, float]:
    """By how much the variances of the rays are larger, shape (n,), as their channels disagree; and `Limb.excess`.

    Args:
        informations: inverse variances of what each channel tells, shape (3, n) [1/px²].
        shifts: what it tells, times those, shape (3, n) [1/px].
        mean: what they tell together, shape (n,) [px].
        told: which rays tell anything, shape (n,).
    """
    off = shifts - informations * mean
    chi_squared = np.divide(off**2, informations, out=np.zeros_like(off), where=informations > 0).sum(axis=0)
    disagreement = mean_of_three(chi_squared)
    middle = median(disagreement[told]) if told.any() else 0.0
    usual = max(_LEAST_DISAGREEMENT, _USUAL_DISAGREEMENT * middle)
    return np.maximum(1.0, disagreement / usual) ** _DISAGREEMENT_POWER, max(1.0, middle / _OF_NOISE)


def _likeliest(channels: FloatArray, one: Filters) -> NDArray[np.intp]:
    """Which texture is the likeliest of each ray (n) of some channels (c), by three neighbours: shape (c, n)."""
    _, count, columns = channels.shape
    flat = channels.reshape(-1, columns)
    whitened = (flat @ one.precisions).reshape(len(flat), -1, columns)
    square = np.einsum("nkm,nm->nk", whitened, flat).reshape(-1, count, len(one.log_determinant))
    likelihood = -0.5 * (square + one.log_determinant)
    return np.argmax([mean_of_three(channel) for channel in likelihood], axis=2)


def _own_colour_first(colour: FloatArray) -> FloatArray:
    """An orthonormal basis of colours, as columns: the ball's own, then what grey has across it, then the rest."""
    own = colour / np.linalg.norm(colour)
    grey = np.ones(3) - own.sum() * own
    if np.linalg.norm(grey) < 0.1:
        grey = np.array([1.0, 0.0, 0.0]) - own[0] * own
    grey /= np.linalg.norm(grey)
    # The cross product; NumPy's own costs more than all else here.
    rest = own[[1, 2, 0]] * grey[[2, 0, 1]] - own[[2, 0, 1]] * grey[[1, 2, 0]]
    return np.column_stack([own, grey, rest])


def _noise(inside: Float32Array, beyond: Float32Array) -> float:
    """A sample's noise (1-sigma) [grey levels].

    Of neighbours on the ball, across its colour, shape (n, columns, 2); and, as light brings noise with it, along the
    rays of the most even part of what is beyond, shape (n, columns, 3).
    """
    on_ball = 1.4826 * median(np.abs(np.diff(inside, axis=0)).ravel()) / math.sqrt(2.0)
    apart = round(1.0 / STEP_PX)
    rough = mean_of_three(((beyond[:, apart:] - beyond[:, :-apart]) ** 2).mean(axis=(1, 2)))
    even = int(_EVEN_RAYS * (len(rough) - 1))
    return max(_LEAST_NOISE, on_ball, math.sqrt(0.5 * float(np.partition(rough, even)[even])))
