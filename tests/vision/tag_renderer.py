"""A small ray tracer for printed tags: rays against planes, and squares of black and white on them.

Every sub-pixel sends a ray; where it meets the nearest sheet of paper, the square of the tag's pattern that it hits
says black or white. Light, blur, exposure and noise come after. Nothing here projects a corner.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from ball_renderer import Look, backdrop, pixel_means, take

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray, StereoFrame

BLACK, WHITE = 0.07, 0.85


def pattern(id: int, dictionary: int = cv2.aruco.DICT_APRILTAG_36h11) -> np.ndarray:
    """Return a tag's 8 by 8 squares (rows from the top), True where it is black."""
    found = cv2.aruco.getPredefinedDictionary(dictionary)
    return cv2.aruco.generateImageMarker(found, id, 8, borderBits=1) < 128


@dataclass(frozen=True)
class Sheet:
    """A tag printed on a square sheet of paper.

    Attributes:
        id: number of the tag.
        rotation, x: pose of the tag's middle (x right, y up, z out of the paper) in the left optical frame, [m].
        side_m: side of the black square.
        margin: width of the white margin, in squares of the pattern.
        curl: curvature of the paper across its width, towards the camera [1/m].
        squares: columns and rows of a chessboard in the place of a tag; `side_m` is then that of a square.
        moved_m, turned_rad: motion, and rotation about the axes of the left optical frame, while a rolling shutter
            reads the image from its first row to its last; `rotation` and `x` are the pose at the middle row.
        exposed: exposure of each row, as a share of the time that reading the image takes.
        screen: pixels of a display across a square, each of a red, a green and a blue stripe on black; 0 is paper.
        channel: the colour that is painted, 0 is red.
    """

    id: int
    rotation: FloatArray
    x: FloatArray
    side_m: float
    margin: float = 1.0
    dictionary: int = cv2.aruco.DICT_APRILTAG_36h11
    curl: float = 0.0
    squares: tuple[int, int] | None = None
    moved_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turned_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    exposed: float = 0.0
    screen: int = 0
    channel: int = 1

    @property
    def halves_m(self) -> tuple[float, float]:
        if self.squares is None:
            half_m = self.side_m * (0.5 + self.margin / 8.0)
            return half_m, half_m
        columns, rows = self.squares
        return self.side_m * (0.5 * columns + self.margin), self.side_m * (0.5 * rows + self.margin)

    @property
    def half_m(self) -> float:
        return max(self.halves_m)

    @property
    def black(self) -> np.ndarray:
        """The pattern (rows from the top), True where it is black."""
        if self.squares is None:
            return pattern(self.id, self.dictionary)
        return np.indices(self.squares[::-1]).sum(axis=0) % 2 == 0


@dataclass(frozen=True)
class Card:
    """A plain card, such as a finger before the tag: as a sheet without a tag, of `half_m` by `half_m`."""

    rotation: FloatArray
    x: FloatArray
    half_m: float
    grey: float = 0.5

    @property
    def halves_m(self) -> tuple[float, float]:
        return self.half_m, self.half_m


def photograph(
    things: Sequence[Sheet | Card],
    calibration: StereoCalibration,
    look: Look,
    rng: np.random.Generator,
    *,
    t: float = 0.0,
    pictures: Sequence[FloatArray] | None = None,
) -> StereoFrame:
    """Photograph sheets with both cameras on clutter, or on an even wall if the look has one."""
    behind = pictures or [backdrop(rng, calibration.image_size_px, look.wall) for _ in range(2)]
    images = []
    for eye, picture in enumerate(behind):
        shift = np.array([calibration.baseline_m * eye, 0.0, 0.0])
        painted = _painted(picture, things, shift, calibration, look, rng)
        if any(isinstance(thing, Sheet) and thing.screen for thing in things):
            for channel in (0, 2):
                lit = [replace(thing, channel=channel) if isinstance(thing, Sheet) else thing for thing in things]
                painted[..., channel] = _painted(picture, lit, shift, calibration, look, rng)[..., channel]
        images.append(take(painted, look, rng))
    return StereoFrame(t, images[0], images[1])


def _painted(
    picture: FloatArray,
    things: Sequence[Sheet | Card],
    eye: FloatArray,
    calibration: StereoCalibration,
    look: Look,
    rng: np.random.Generator,
) -> FloatArray:
    painted = picture.copy()
    rows, columns = _window(things, eye, calibration)
    n = look.samples
    shape = n * (rows.stop - rows.start), n * (columns.stop - columns.start)
    if min(shape) <= 0:
        return painted
    # One ray at a random place of each sub-pixel: rays in rows would all miss an edge along the row at once.
    places = rng.random((*shape, 2))
    cx, cy = calibration.principal_point_px
    rays = np.ones((3, *shape), np.float32)
    rays[0] = ((np.arange(shape[1]) + places[..., 0]) / n - 0.5 + columns.start - cx) / calibration.focal_px
    rays[1] = ((np.arange(shape[0])[:, None] + places[..., 1]) / n - 0.5 + rows.start - cy) / calibration.focal_px
    # When each ray is exposed, from half a readout before the middle row to half a readout after it.
    times = (rays[1] * calibration.focal_px + cy) / calibration.image_size_px[1] - 0.5
    before = painted[rows, columns]
    shown: Any = before.mean(axis=2, dtype=np.float32).repeat(n, axis=0).repeat(n, axis=1)
    nearest: np.ndarray = np.full(shape, np.inf, np.float32)
    for thing in things:
        _cover(thing, rays, times, eye, look, shown, nearest, rng)
    hit = pixel_means(np.isfinite(nearest).astype(np.float64), n)[..., None]
    painted[rows, columns] = np.where(hit > 0.0, pixel_means(shown, n)[..., None], before)
    return painted


def _window(things: Sequence[Sheet | Card], eye: FloatArray, calibration: StereoCalibration) -> tuple[slice, slice]:
    """Return rows and columns that contain all of the things."""
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for thing in things:
        x = thing.x - eye
        centre = calibration.project(x)[:2]
        reach = 1.6 * calibration.focal_px * thing.half_m / max(x[2] - 1.5 * thing.half_m, 0.02) + 2.0
        low, high = np.minimum(low, centre - reach), np.maximum(high, centre + reach)
    size = np.array(calibration.image_size_px)
    first, last = np.clip(np.floor(low), 0, size).astype(int), np.clip(np.ceil(high), 0, size).astype(int)
    return slice(first[1], last[1]), slice(first[0], last[0])


def _seen_from(
    thing: Sheet | Card, rays: np.ndarray, times: np.ndarray, eye: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return the rays (3, ...) and the thing's middle (3, ...) in the axes of the thing, each at the ray's time."""
    into, middle = thing.rotation.T.astype(np.float32), (thing.x - eye).astype(np.float32)[:, None, None]
    if isinstance(thing, Card) or not any((*thing.moved_m, *thing.turned_rad)):
        return np.tensordot(into, rays, axes=1), np.tensordot(into, middle, axes=1)
    when = times + thing.exposed * (rng.random(times.shape, np.float32) - 0.5)
    middle = middle + np.multiply.outer(thing.moved_m, when)
    turn = np.multiply.outer(thing.turned_rad, when)

    def back(v: np.ndarray) -> np.ndarray:
        once = np.cross(turn, v, axis=0)  # second order: the third is below 1e-6 for turns of a degree
        return v - once + 0.5 * np.cross(turn, once, axis=0)

    return np.tensordot(into, back(rays), axes=1), np.tensordot(into, back(middle), axes=1)


def _cover(
    thing: Sheet | Card,
    rays: np.ndarray,
    times: np.ndarray,
    eye: np.ndarray,
    look: Look,
    shown: np.ndarray,
    nearest: np.ndarray,
    rng: np.random.Generator,
) -> None:
    normal = thing.rotation[:, 2]
    (to_right, to_top, facing), (right, top, away) = _seen_from(thing, rays, times, eye, rng)
    curl = np.float32(thing.curl if isinstance(thing, Sheet) else 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = away / facing
        for _ in range(3 if curl else 0):  # the parabola meets each ray after three steps, to a micrometre
            depth = (away + curl * (depth * to_right - right) ** 2 / 2) / facing
        across, up = depth * to_right - right, depth * to_top - top
    hit = (facing < 0.0) & (depth > 0.0) & (depth < nearest)
    hit &= (abs(across) < thing.halves_m[0]) & (abs(up) < thing.halves_m[1])
    light = np.array(look.light) / np.linalg.norm(look.light)
    level = look.ambient + look.diffuse * max(float(normal @ light), 0.0)
    if isinstance(thing, Sheet):
        squares = thing.black
        rows, columns = squares.shape
        square_m = thing.side_m / (1.0 if thing.squares else 8.0)
        column = np.floor(across[hit] / square_m + 0.5 * columns).astype(int)
        row = np.floor(0.5 * rows - up[hit] / square_m).astype(int)
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        black = inside & squares[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]
        lit = np.where(black, BLACK, WHITE)
        if thing.screen:
            at = np.stack([across[hit], up[hit]]) / square_m * thing.screen % 1.0 - [
                [(thing.channel + 0.5) / 3.0],
                [0.5],
            ]
            stripe = (abs(at[0]) < 0.42 / 3.0) & (abs(at[1]) < 0.42)
            # As bright as paper on the whole, black does not glow.
            lit = np.where(stripe & ~black, WHITE / (0.84 * 0.84 / 3.0), 0.01)
        shown[hit] = level * lit
    else:
        shown[hit] = level * thing.grey
    nearest[hit] = depth[hit]
