"""Refinement of a marker board's corners to hundredths of a pixel.

At a corner two edges cross. Every gradient on them is perpendicular to the line to the corner, which gives the corner
as a least-squares solution (Förstner & Gülch 1987; OpenCV's cornerSubPix). The edges of the markers disturb this. The
pixels are therefore chosen along the board's own directions: a cross of two strips along the edges, outside the
markers. In oblique views a square window would have to be so small that half of the edges are lost.

A lens bends the edges. Both arms of an edge then leave the corner to the same side, and a straight cross is biased:
through a fisheye by some 0.03 px in the same direction for all corners off the axis. The bend of the edges is
estimated from the second differences of the neighbouring corners.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray, ImageArray

from .board import Board

IntArray = NDArray[np.int64]


class _Settings:
    """Settings of the refinement.

    Sensitivity, each at 0.3 and 3 times over 27 images of the tests: `reach` and `blurred_px`, which choose the pixels,
    move corners by 0.04 to 1.3 px; the others move them by 0.01 px at most.
    """

    reach = 0.35  # of a square: length along the edges
    bending_steps = 2  # squares to each side: neighbourhood for the bend of the edges
    iterations, converged_px = 8, 1e-3  # at most; a step that ends them
    max_moved = 0.2  # of a square: farther, another crossing was found
    min_strip_px = 1.0  # half-width along an edge on which gradients count
    blurred_px = 1.5  # width of an edge, where gradients mix
    max_reach_px = 40  # bounds the time for near boards


def refine_corners(grey: ImageArray, board: Board, numbers: IntArray, px: FloatArray) -> tuple[IntArray, FloatArray]:
    """Move the corners to the intersections of their edges, and drop those that cannot be determined.

    Args:
        grey: the image, shape (height, width).
        numbers, px: rough corners, shapes (n,) and (n, 2).
    """
    levels = np.asarray(grey, dtype=np.float64)
    gradients = [cv2.Scharr(levels, cv2.CV_64F, *axis) for axis in ((1, 0), (0, 1))]
    slopes = np.asarray(np.stack(gradients, axis=-1) / 32.0, dtype=np.float64)
    frames = _square_axes(board, numbers, px)
    usable = np.isfinite(frames).all(axis=(1, 2)) & (np.abs(np.linalg.det(np.nan_to_num(frames))) > 1.0)
    bends = _bends(board, numbers, px)[usable]
    numbers, px, frames = numbers[usable], px[usable], frames[usable]
    moved = _edge_crossings(slopes, px, frames, bends, board)
    squares = np.linalg.norm(np.linalg.solve(frames, (moved - px)[..., None])[..., 0], axis=1)
    size = np.array([levels.shape[1], levels.shape[0]])
    inside = ((moved > _Settings.blurred_px) & (moved < size - 1 - _Settings.blurred_px)).all(axis=1)
    kept = inside & (squares < _Settings.max_moved)
    return numbers[kept], moved[kept]


def _square_axes(board: Board, numbers: IntArray, px: FloatArray) -> FloatArray:
    """Return the image of one square to the right and one down at each corner, as columns, shape (n, 2, 2) [px].

    NaN where it cannot be determined.
    """
    places = board.corners_m[numbers, :2] / board.square_m
    H, _ = cv2.findHomography(places, px, 0)
    found = np.full((len(px), 2, 2), np.nan)
    for k, place in enumerate(places):
        offsets = places - place
        near = np.max(np.abs(offsets), axis=1) < 1.5  # the eight around it
        model = offsets[near] - offsets[near].mean(axis=0)
        if np.linalg.matrix_rank(model) < 2:
            if H is None:
                continue
            steps = place + 0.5 * np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]])
            seen = cv2.perspectiveTransform(steps[:, None], H)[:, 0]
            found[k] = np.column_stack([seen[1] - seen[0], seen[3] - seen[2]])
            continue
        found[k] = np.linalg.lstsq(model, px[near] - px[near].mean(axis=0), rcond=None)[0].T
    return found


def _bends(board: Board, numbers: IntArray, px: FloatArray) -> FloatArray:
    """Return the deviation of the edges across and down from their tangents one square from each corner, as columns.

    Shape (n, 2, 2) [px]; 0 where fewer than three corners of an edge are known.
    """
    steps = np.arange(-_Settings.bending_steps, _Settings.bending_steps + 1)
    powers = np.stack([np.ones(len(steps)), steps, steps**2], axis=-1)
    # With a margin, neighbours beyond the board become unknown corners.
    places = np.rint(board.corners_m[numbers, :2] / board.square_m).astype(int) + _Settings.bending_steps
    grid = np.full((board.columns + 2 * _Settings.bending_steps, board.rows + 2 * _Settings.bending_steps, 2), np.nan)
    grid[places[:, 0], places[:, 1]] = px
    bends = np.zeros((len(px), 2, 2))
    for axis in range(2):
        offsets = np.outer(steps, np.eye(2, dtype=int)[axis])
        near = places[:, None] + offsets
        seen = grid[near[..., 0], near[..., 1]]
        known = np.isfinite(seen[..., 0])
        determined = known.sum(axis=1) >= 3
        weighted = powers * known[determined, :, None]
        normal = np.einsum("nki,kj->nij", weighted, powers)
        # Relative to the corner itself, to keep the digits.
        moments = np.einsum("nki,nkj->nij", weighted, np.nan_to_num(seen[determined] - px[determined, None]))
        bends[determined, :, axis] = np.linalg.solve(normal, moments)[:, 2]
    return bends


def _edge_crossings(
    slopes: FloatArray, start: FloatArray, frames: FloatArray, bends: FloatArray, board: Board
) -> FloatArray:
    """Return the intersections of the edges near `start`, shape (n, 2) [px]; NaN if undetermined."""
    into_squares = np.linalg.inv(frames)
    # Width of the white strip between a square's edge and its marker.
    strip = 0.5 * (1.0 - board.marker_side_m / board.square_m)
    squares_a_px = np.linalg.norm(into_squares, axis=2)
    strip_px = strip / squares_a_px
    half_widths = (
        np.maximum(strip_px - _Settings.blurred_px, np.minimum(strip_px, _Settings.min_strip_px)) * squares_a_px
    )
    half_widths = np.minimum(half_widths, _Settings.reach)  # a plain square may be truncated a little farther out
    reach = min(int(np.ceil(_Settings.reach * np.abs(frames).sum(axis=2).max(initial=0.0))) + 1, _Settings.max_reach_px)
    window = np.stack(np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1)), axis=-1).reshape(-1, 2)
    padded = np.pad(slopes, ((reach, reach), (reach, reach), (0, 0)))
    limits = np.array([slopes.shape[1], slopes.shape[0]]) - 1
    positions = start
    for _ in range(_Settings.iterations):
        middle = np.clip(np.nan_to_num(np.rint(positions)), 0, limits).astype(int)
        p = (middle[:, None] + window) - positions[:, None]
        pixels = middle[:, None] + window + reach
        g = padded[pixels[..., 1], pixels[..., 0]]
        squares = p @ into_squares.mT
        weights = _cross(np.abs(squares), half_widths[:, None])
        weighted = g * weights[..., None]
        G = weighted.mT @ g
        # Edges of a single direction do not determine an intersection.
        determined = np.linalg.cond(G) < 1.0 / np.finfo(np.float64).eps
        # The tangent of an edge that has deviated by b passes the corner at -b.
        tangents = p + squares**2 @ bends.mT
        h = weighted.mT @ np.einsum("nki,nki->nk", g, tangents)[..., None]
        step = np.full_like(positions, np.nan)
        step[determined] = np.linalg.solve(G[determined], h[determined])[..., 0]
        positions = positions + step
        if np.nanmax(np.abs(step), initial=0.0) < _Settings.converged_px:
            break
    return positions


def _cross(squares: FloatArray, half_widths: FloatArray) -> FloatArray:
    """Return weights for offsets (..., 2) [squares] from the corner: a strip along each edge with fading borders."""
    fade = np.clip((_Settings.reach - squares) / 0.12, 0.0, 1.0)
    within = np.clip((half_widths - squares) / (0.4 * half_widths), 0.0, 1.0)
    return np.maximum(within[..., 1] * fade[..., 0], within[..., 0] * fade[..., 1])
