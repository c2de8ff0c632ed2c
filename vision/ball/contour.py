"""Measure a ball's edge along rays to a hundredth of a pixel, by matched filters adapted to the background.

The filters are those of `contour_filters`. Each ray uses the background texture that is most likely given its samples.
Colours are rotated so that the first channel is the ball's own colour. Its shading is unknown there, while the other
two channels show only the ball's gloss.

Each channel gives its own estimate of the edge. A narrow object along the limb, such as a bar or the rest of a box that
the ball hides, mixes its light into each channel differently, so the estimates differ. The residuals of the fit do not
show this, because whole arcs are shifted together. Rays whose channels disagree therefore get low weight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray

from .colour import Float32Array, Gate
from .contour_filters import Filters, edge_filters, sample_offsets
from .polar import ball_colour, mean_of_three, median, rays_round, sample
from .settings import ContourSettings as _Settings

_MIN_INFORMATION = np.finfo(np.float64).tiny  # keeps from dividing by information that is 0


@dataclass(frozen=True, slots=True)
class BallContour:
    """The ball's edge, ray by ray."""

    rays: FloatArray  # cosine and sine of their directions, and 1, shape (n, 3)
    offset_px: FloatArray  # distance of the edge outside the assumed outline, shape (n,) [px]
    weight: FloatArray  # inverse variances of `offset_px`, shape (n,) [1/px²]; 0 where a ray gives no estimate
    blur_px: float  # blur of lens and interpolation (1-sigma), estimated from the edge [px]
    excess: float  # variance of the channels' disagreement relative to that from pixel noise; 1 or more

    @property
    def evenness(self) -> float:
        """Evenness of the weights: 1 if all rays have equal weight, k/n if k of n rays do and the others have none."""
        return float(self.weight.sum()) ** 2 / (len(self.weight) * float(self.weight @ self.weight))

    @property
    def noise_share(self) -> float:
        """Share of pixel noise in the variances of `offset_px`, averaged over the rays with weight."""
        return 1.0 - _Settings.best_sigma_px**2 * float(self.weight[self.weight > 0].mean())


def find_contour(
    image: Float32Array, gate: Gate, centre_px: FloatArray, radius_px: float, shape: FloatArray, blur_px: float
) -> BallContour | None:
    """Measure the edge near an outline that is accurate to a few tenths of a pixel; return None if no ball is visible.

    Args:
        image: BGR, shape (height, width, 3), grey levels.
        centre_px, radius_px, shape: the outline, see `sphere.Ellipse`.
        blur_px: assumed blur of the edge, accurate to about a third [px].
    """
    rays = rays_round(radius_px)
    offsets_px = sample_offsets(radius_px, blur_px)
    first_px, last_px = _Settings.inner_part * radius_px, max(radius_px + float(offsets_px[0]), 0.5 * radius_px)
    inner = first_px + (last_px - first_px) * _Settings.inner
    samples = sample(image, centre_px, rays, np.concatenate([inner, radius_px + offsets_px]), shape)
    colour = ball_colour(samples[:, : len(_Settings.inner)], gate)
    if colour is None:
        return None
    rotated = cv2.transform(samples, _colour_basis(colour))
    channels = np.stack(cast("list[Float32Array]", cv2.split(rotated)))
    edge_samples = channels[..., len(_Settings.inner) :]
    noise = _noise(
        channels[1:, :, : len(_Settings.inner)], edge_samples[..., offsets_px > _Settings.beyond_blurs * blur_px]
    )
    return _apply_filters(rays, edge_samples / np.float32(noise), edge_filters(radius_px, blur_px), blur_px)


def _apply_filters(
    rays: FloatArray, channels: Float32Array, filter_pair: tuple[Filters, Filters], blur_px: float
) -> BallContour:
    """Apply the filters to the samples (3, n, m) of n rays, in units of the noise, the ball's own colour first."""
    own_filters, across_filters = filter_pair
    _, count, columns = channels.shape
    likelihood, filtered = (
        np.concatenate(parts)
        for parts in zip(
            own_filters.apply(channels[0]), across_filters.apply(channels[1:].reshape(-1, columns)), strict=True
        )
    )
    # Each ray's most likely texture, averaged over three neighbours, per channel (n, 3).
    texture = np.argmax(mean_of_three(likelihood.reshape(3, count, -1).swapaxes(0, 1)), axis=2)
    filtered = filtered[np.arange(len(filtered)), :, texture.T.ravel()].astype(np.float64)
    shift, widening, contrast = filtered.T.reshape(3, 3, count).swapaxes(1, 2)
    contrast = mean_of_three(contrast)
    known = np.stack([own_filters.information, across_filters.information, across_filters.information])[
        np.arange(3), :, texture
    ]
    informations = np.square(contrast) * known[..., 0]
    shifts = contrast * shift
    widening_information = _MIN_INFORMATION + float((np.square(contrast) * known[..., 1])[:, 1:].sum())
    wider_px = float((contrast * widening)[:, 1:].sum()) / widening_information
    information, weighted_shift = informations.sum(axis=1), shifts.sum(axis=1)
    mean = weighted_shift / np.maximum(information, _MIN_INFORMATION)
    min_information = (_Settings.worst_sigma_blurs * blur_px) ** -2
    variance_factor, excess = _disagreement_factors(informations, shifts, mean, information > min_information)
    information /= variance_factor
    measured = information > min_information
    information[~measured] = 1.0
    return BallContour(
        rays,
        np.where(measured, mean, 0.0),
        measured / (1.0 / information + _Settings.best_sigma_px**2),
        blur_px * min(max(1.0 + wider_px / blur_px, 1 / _Settings.largest_widening), _Settings.largest_widening),
        excess,
    )


def _disagreement_factors(
    informations: FloatArray, shifts: FloatArray, mean: FloatArray, measured: NDArray[np.bool_]
) -> tuple[FloatArray, float]:
    """Return the factor on each ray's variance due to disagreeing channels, shape (n,), and `BallContour.excess`.

    Args:
        informations: inverse variances of each channel's estimate, shape (n, 3) [1/px²].
        shifts: the estimates times these, shape (n, 3) [1/px].
        mean: the combined estimate, shape (n,) [px].
        measured: mask of the rays with an estimate, shape (n,).
    """
    deviation = shifts - informations * mean[:, None]
    disagreement = mean_of_three((deviation * deviation / np.maximum(informations, _MIN_INFORMATION)).sum(axis=1))
    median_disagreement = median(disagreement[measured]) if measured.any() else 0.0
    usual = max(_Settings.min_disagreement, _Settings.usual_disagreement * median_disagreement)
    return np.maximum(1.0, disagreement / usual) ** _Settings.disagreement_power, max(
        1.0, median_disagreement / _Settings.of_noise
    )


def _colour_basis(colour: FloatArray) -> FloatArray:
    """Return an orthonormal basis of colours as rows: the ball's own, grey's part orthogonal to it, the third."""
    b, g, r = (colour / math.hypot(*colour)).tolist()
    across = [1.0 - (b + g + r) * part for part in (b, g, r)]
    if math.hypot(*across) < 0.1:
        across = [1.0 - b * b, -b * g, -b * r]
    u, v, w = (part / math.hypot(*across) for part in across)
    return np.array([[b, g, r], [u, v, w], [g * w - r * v, r * u - b * w, b * v - g * u]])


def _noise(inside: Float32Array, beyond: Float32Array) -> float:
    """Estimate the noise of a sample (1-sigma) [grey levels].

    It is the larger of two estimates, because brighter pixels have more noise: from neighbouring samples inside the
    ball, orthogonal to its colour, shape (2, n, columns); and along the rays with the most even background beyond the
    ball, shape (3, n, columns).
    """
    on_ball = 1.4826 * median(np.abs(inside[:, 1:] - inside[:, :-1]).ravel()) / math.sqrt(2.0)
    lag = round(1.0 / _Settings.step_px)
    change = beyond[..., lag:] - beyond[..., :-lag]
    variances = mean_of_three(np.einsum("cnm,cnm->n", change, change)) / (3 * change.shape[2])
    rank = int(_Settings.even_rays * (len(variances) - 1))
    return max(_Settings.min_noise, on_ball, math.sqrt(0.5 * float(np.partition(variances, rank)[rank])))
