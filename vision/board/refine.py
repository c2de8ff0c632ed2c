"""Corners of a board with markers, to hundredths of a pixel.

At a corner two edges cross. Every gradient on them is at right angles to the line to the corner, which gives the corner
as a least-squares solution (Förstner & Gülch 1987; OpenCV's cornerSubPix). What disturbs that are the markers' edges.
So the pixels are chosen in the board's own directions: a cross of two strips along the edges, which markers leave
white. A square window has to be so small, where squares are seen aslant, that half of the edges are lost.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from interfaces.records import FloatArray, ImageArray

from .board import Board

IntArray = NDArray[np.int64]

_REACH = 0.35  # of a square: how far along the edges
_NEIGHBOURS = 1.6  # squares: what tells the board's directions at a corner
_ITERATIONS = 12
_CONVERGED_PX = 1e-3
_MOST_MOVED = 0.2  # of a square
_LEAST_STRIP_PX = 1.0
_BLURRED_PX = 1.5  # beside an edge: what gradients mix in
_BORDER_PX = 2.0


def refined(grey: ImageArray, board: Board, numbers: IntArray, px: FloatArray) -> tuple[IntArray, FloatArray]:
    """The corners, moved to where their edges cross; those are left out of which this cannot be told.

    Args:
        grey: the image, shape (height, width).
        numbers, px: the corners roughly, shapes (n,) and (n, 2).
    """
    levels = np.asarray(grey, dtype=np.float64)
    slopes = np.stack([cv2.Scharr(levels, cv2.CV_64F, 1, 0), cv2.Scharr(levels, cv2.CV_64F, 0, 1)], axis=-1) / 32.0
    frames = _frames(board, numbers, px)
    moved = [_crossing(slopes, at, frame, board) for at, frame in zip(px, frames, strict=True)]
    kept = [k for k, each in enumerate(moved) if each is not None]
    return numbers[kept], np.array([each for each in moved if each is not None]).reshape(-1, 2)


def _frames(board: Board, numbers: IntArray, px: FloatArray) -> FloatArray:
    """What one square to the right and one down are in pixels at each corner, as columns, shape (n, 2, 2)."""
    places = board.corners_m[numbers, :2] / board.square_m
    H, _ = cv2.findHomography(places, px, cv2.LMEDS)
    found = np.empty((len(px), 2, 2))
    for k, place in enumerate(places):
        offsets = places - place
        near = np.max(np.abs(offsets), axis=1) < _NEIGHBOURS
        model = offsets[near] - offsets[near].mean(axis=0)
        if np.linalg.matrix_rank(model) < 2:
            steps = np.array([place - [0.5, 0.0], place + [0.5, 0.0], place - [0.0, 0.5], place + [0.0, 0.5]])
            seen = cv2.perspectiveTransform(steps[:, None], H)[:, 0]
            found[k] = np.column_stack([seen[1] - seen[0], seen[3] - seen[2]])
            continue
        found[k] = np.linalg.lstsq(model, px[near] - px[near].mean(axis=0), rcond=None)[0].T
    return found


def _crossing(slopes: FloatArray, start: FloatArray, frame: FloatArray, board: Board) -> FloatArray | None:
    """Where the edges cross near `start`; None where that is not in the image or far away."""
    height, width = slopes.shape[:2]
    into_squares = np.linalg.inv(frame)
    # What is left white of a square beside its marker.
    strip = 0.5 * (1.0 - board.marker_side_m / board.square_m)
    strip_px = strip / np.linalg.norm(into_squares, axis=1)
    half_widths = np.maximum(strip_px - _BLURRED_PX, np.minimum(strip_px, _LEAST_STRIP_PX)) * np.linalg.norm(into_squares, axis=1)
    reach = np.abs(frame).sum(axis=1) * _REACH + 1.0
    at = start
    for _ in range(_ITERATIONS):
        if not np.all((at > _BORDER_PX) & (at < np.array([width, height]) - 1 - _BORDER_PX)):
            return None
        low = np.maximum(np.floor(at - reach).astype(int), 1)
        high = np.minimum(np.ceil(at + reach).astype(int) + 1, [width - 1, height - 1])
        u, v = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
        p = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)
        squares = np.abs((p - at) @ into_squares.T)
        weights = _cross(squares, half_widths)
        g = slopes[low[1] : high[1], low[0] : high[0]].reshape(-1, 2)
        G = (g * weights[:, None]).T @ g
        if np.linalg.cond(G) > 1e4:
            return None
        along = np.einsum("ni,ni->n", g, p - at)
        step = np.linalg.solve(G, g.T @ (weights * along))
        at = at + step
        if np.linalg.norm(step) < _CONVERGED_PX:
            break
    moved = np.linalg.norm(into_squares @ (at - start))
    return at if moved < _MOST_MOVED else None


def _cross(squares: FloatArray, half_widths: FloatArray) -> FloatArray:
    """Weights of places (n, 2) [squares from the corner]: of a strip along each edge, fading at its end and sides."""
    fade = np.clip((_REACH - squares) / 0.12, 0.0, 1.0)
    within = np.clip((half_widths - squares) / (0.4 * half_widths), 0.0, 1.0)
    return np.maximum(within[:, 1] * fade[:, 0], within[:, 0] * fade[:, 1])
