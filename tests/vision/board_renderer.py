"""A ray caster for a board seen by two distorting cameras, which shares no code with the product.

The ray through each pixel's middle is found by inverting the lens with Newton steps, at every fourth pixel, and by a
cubic spline between (good to 1e-8); where it meets the board's plane, the square or the marker's cell is looked up.
A pixel that differs from its neighbours sends 34 rays from all over it, not arranged in rows: rows would make an edge
along them jump by their spacing. No picture is warped or interpolated: edges are smooth because a pixel has many rays.
Uneven light, lens blur, exposure, noise and JPEG are added afterwards.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.spatial.transform import Rotation

from bodyschema.interfaces.records import FloatArray, ImageArray, StereoFrame

# A Fibonacci lattice on a pixel about its middle: evenly spread along every direction.
LATTICE = (np.column_stack([np.arange(34) + 0.5, (np.arange(34) * 21 + 0.5) % 34]) / 34 - 0.5).astype(np.float32)


@dataclass(frozen=True)
class TrueLens:
    """Radial-tangential (k1 k2 p1 p2 k3) or, with `fisheye`, equidistant (k1 k2 k3 k4)."""

    focal_px: tuple[float, float]
    principal_point_px: tuple[float, float]
    distortion: tuple[float, ...]
    fisheye: bool = False

    def image(self, x: FloatArray) -> FloatArray:
        """Return image coordinates (n, 2) of points (n, 3) in the camera's frame."""
        a, b = x[:, 0] / x[:, 2], x[:, 1] / x[:, 2]
        distorted = self._equidistant(a, b) if self.fisheye else self._radial_tangential(a, b)
        return np.column_stack(distorted) * self.focal_px + self.principal_point_px

    def rays(self, px: FloatArray) -> FloatArray:
        """Return directions (n, 2) with z = 1, by Newton's method: on the angle of a fisheye lens, else on `image`."""
        goal = px
        at = (px - self.principal_point_px) / np.array(self.focal_px)
        if self.fisheye:
            bent = np.maximum(np.hypot(*at.T), 1e-12)
            return at * (np.tan(self._angle(bent)) / bent)[:, None]
        for _ in range(12):
            here = self.image(np.column_stack([at, np.ones(len(at))]))
            slopes = []
            for axis in range(2):
                moved = np.column_stack([at, np.ones(len(at))])
                moved[:, axis] += 1e-6
                slopes.append((self.image(moved) - here) / 1e-6)
            (a, c), (b, d) = slopes[0].T, slopes[1].T
            e = goal - here
            at = at + np.column_stack([d * e[:, 0] - b * e[:, 1], a * e[:, 1] - c * e[:, 0]]) / (a * d - b * c)[:, None]
            if np.abs(e).max() < 1e-9:
                break
        return at

    def _angle(self, bent: FloatArray) -> FloatArray:
        """Return the angle off the axis that is imaged at this distance from the centre, in focal lengths."""
        k = np.array(self.distortion)
        t = bent
        for _ in range(12):
            powers = [t ** (2 * n) for n in range(1, 5)]
            value = t * (1 + sum(c * p for c, p in zip(k, powers, strict=True)))
            slope = 1 + sum((2 * n + 1) * k[n - 1] * powers[n - 1] for n in range(1, 5))
            t = t - (value - bent) / slope
        return t

    def _radial_tangential(self, a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
        k1, k2, p1, p2, k3 = self.distortion
        s = a * a + b * b
        radial = 1 + s * (k1 + s * (k2 + s * k3))
        return a * radial + 2 * p1 * a * b + p2 * (s + 2 * a * a), b * radial + p1 * (s + 2 * b * b) + 2 * p2 * a * b

    def _equidistant(self, a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
        r = np.hypot(a, b)
        t = np.arctan(r)
        k1, k2, k3, k4 = self.distortion
        bent = t * (1 + t**2 * (k1 + t**2 * (k2 + t**2 * (k3 + t**2 * k4))))
        scale = np.where(r > 1e-9, bent / np.maximum(r, 1e-9), 1.0)
        return a * scale, b * scale


@dataclass(frozen=True)
class TrueRig:
    """Two cameras; a point x of the left camera's frame is at R x + t in the right one's."""

    left: TrueLens
    right: TrueLens
    R: FloatArray
    t_m: FloatArray
    size_px: tuple[int, int] = (640, 480)

    @property
    def baseline_m(self) -> float:
        return float(np.linalg.norm(self.t_m))


@dataclass(frozen=True)
class Printed:
    """A printed board on the table.

    Attributes:
        columns, rows: squares.
        square_m: side, as printed.
        dictionary: OpenCV's name without DICT_; None: no markers.
        marker_share: side of a marker in squares.
    """

    columns: int = 8
    rows: int = 6
    square_m: float = 0.030
    dictionary: str | None = "4X4_50"
    marker_share: float = 0.75

    @cached_property
    def cells(self) -> tuple[ImageArray, int]:
        """White (1) and black (0) of all cells that markers and squares are made of, and how many a square has."""
        if self.dictionary is None:
            black = np.add.outer(np.arange(self.rows), np.arange(self.columns)) % 2 == 0
            return np.where(black, 0, 1).astype(np.uint8), 1
        words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))
        inner = words.markerSize + 2
        n = round(inner / self.marker_share)
        assert abs(n * self.marker_share - inner) < 1e-9
        assert (n - inner) % 2 == 0
        picture = np.ones((self.rows * n, self.columns * n), np.uint8)
        number = 0
        for r in range(self.rows):
            for c in range(self.columns):
                square = picture[r * n : (r + 1) * n, c * n : (c + 1) * n]
                if (r + c) % 2 == 0:
                    square[:] = 0
                    continue
                inset = (n - inner) // 2
                marker = cv2.aruco.generateImageMarker(words, number, inner) > 127
                square[inset : inset + inner, inset : inset + inner] = marker
                number += 1
        return picture, n


@dataclass(frozen=True)
class Taken:
    """Exposure of an image; levels are those of an 8-bit image."""

    blur_px: float = 0.7
    motion_px: float = 0.0
    noise_sd: float = 2.0
    black: float = 30.0
    white: float = 210.0
    exposure: float = 1.0
    jpeg: int | None = 92
    shading: float = 0.25


@dataclass
class Photographer:
    """Photographer of stereo images of a board, which caches the rays of each camera."""

    rig: TrueRig
    board: Printed
    taken: Taken
    rng: np.random.Generator
    _rays: dict[int, FloatArray] = field(default_factory=dict)

    def pair(self, R: FloatArray, t_m: FloatArray, time: float = 0.0) -> StereoFrame:
        """Return both images of the board at a pose in the left camera's frame (R board -> camera, t its origin)."""
        left = self.left(R, t_m)
        right = self._image(1, self.rig.right, self.rig.R @ R, self.rig.R @ t_m + self.rig.t_m)
        return StereoFrame(time, left, right)

    def left(self, R: FloatArray, t_m: FloatArray) -> ImageArray:
        """Return the left image alone."""
        return self._image(0, self.rig.left, R, t_m)

    def corners(self, R: FloatArray, t_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the exact image positions of the board's inner corners in both cameras, shape (n, 2) each [px]."""
        c, r = np.meshgrid(np.arange(1, self.board.columns), np.arange(1, self.board.rows))
        x = self.board.square_m * np.column_stack([c.ravel(), r.ravel(), np.zeros(c.size)]) @ R.T + t_m
        return self.rig.left.image(x), self.rig.right.image(x @ self.rig.R.T + self.rig.t_m)

    def _image(self, eye: int, lens: TrueLens, R: FloatArray, t_m: FloatArray) -> ImageArray:
        width, height = self.rig.size_px
        rays = self._rays.get(eye)
        if rays is None:
            rays = self._rays[eye] = ray_field(lens, np.arange(width), np.arange(height)).astype(np.float32)
        # A point of the board at (x, y) is at R[:, :2] (x, y) + t; the ray (a, b, 1) meets it there.
        M = np.linalg.inv(np.column_stack([R[:, 0], R[:, 1], t_m])).astype(np.float32)
        picture = self._met(rays.reshape(-1, 2), M).reshape(height, width)
        around = np.ones((3, 3), np.uint8)
        v, u = np.nonzero(cv2.dilate(picture, around) != cv2.erode(picture, around))
        across, down = (_difference(rays, v, u, axis)[:, None] for axis in (1, 0))
        within = rays[v, u][:, None] + across * LATTICE[:, :1] + down * LATTICE[:, 1:]
        picture[v, u] = self._met(within.reshape(-1, 2), M).reshape(len(v), -1).mean(axis=1)
        return self._photograph(picture)

    def _met(self, rays: FloatArray, M: FloatArray) -> FloatArray:
        """Return the grey levels where rays (n, 2) meet the board."""
        x, y, w = (rays[:, 0] * M[k, 0] + rays[:, 1] * M[k, 1] + M[k, 2] for k in range(3))
        with np.errstate(divide="ignore", invalid="ignore"):
            return self._levels(x / w, y / w, w > 0)

    def _levels(self, x: FloatArray, y: FloatArray, before: FloatArray) -> FloatArray:
        cells, n = self.board.cells
        side = self.board.square_m
        paper = np.full(x.shape, 0.45, np.float32)
        edge = 0.4 * side
        wide, high = self.board.columns * side, self.board.rows * side
        paper[before & (x > -edge) & (y > -edge) & (x < wide + edge) & (y < high + edge)] = 1.0
        on = before & (x >= 0) & (y >= 0) & (x < wide) & (y < high)
        column = np.minimum((x[on] / side * n).astype(np.int32), cells.shape[1] - 1)
        row = np.minimum((y[on] / side * n).astype(np.int32), cells.shape[0] - 1)
        paper[on] = cells[row, column]
        return paper

    def _photograph(self, picture: FloatArray) -> ImageArray:
        taken = self.taken
        height, width = picture.shape
        lit = taken.black + (taken.white - taken.black) * picture
        direction = self.rng.uniform(0, 2 * np.pi)
        across = (
            np.cos(direction) * np.linspace(-0.5, 0.5, width)
            + np.sin(direction) * np.linspace(-0.5, 0.5, height)[:, None]
        )
        lit = taken.exposure * lit * (1 + taken.shading * across)
        if taken.motion_px > 0:
            length = int(np.ceil(taken.motion_px)) | 1
            lit = cv2.blur(lit, (length, 1))
        if taken.blur_px > 0:
            lit = cv2.GaussianBlur(lit, (0, 0), taken.blur_px)
        noisy = lit + self.rng.standard_normal(lit.shape) * taken.noise_sd
        grey = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
        image = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
        if taken.jpeg is not None:
            image = cv2.imdecode(
                cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, taken.jpeg])[1], cv2.IMREAD_COLOR
            )
        return image


def _difference(field: FloatArray, v: FloatArray, u: FloatArray, axis: int) -> FloatArray:
    """Return the change of the rays at rows v and columns u from one place to the next along an axis, shape (n, 2)."""
    at = (v, u)[axis]
    low, high = np.maximum(at - 1, 0), np.minimum(at + 1, field.shape[axis] - 1)
    ends = [field[each, u] if axis == 0 else field[v, each] for each in (low, high)]
    return (ends[1] - ends[0]) / (high - low)[:, None].astype(np.float32)


def ray_field(lens: TrueLens, u: FloatArray, v: FloatArray) -> FloatArray:
    """Return directions of the rays through all columns u and rows v, shape (len(v), len(u), 2)."""
    nodes_u, nodes_v = (np.arange(axis[0] - 8, axis[-1] + 9, 4.0) for axis in (u, v))
    grid = np.stack(np.meshgrid(nodes_u, nodes_v), axis=-1)
    known = lens.rays(grid.reshape(-1, 2)).reshape(grid.shape)
    between = [RectBivariateSpline(nodes_v, nodes_u, known[..., k])(v, u) for k in range(2)]
    return np.stack(between, axis=-1)


def webcams(rng: np.random.Generator, *, fisheye: bool = False, size_px: tuple[int, int] = (640, 480)) -> TrueRig:
    """Return two webcams on a bar, mounted by hand: toed in or out, a little rolled."""
    width, height = size_px

    def lens() -> TrueLens:
        centre = (width / 2 - 0.5 + rng.normal(0, 6), height / 2 - 0.5 + rng.normal(0, 6))
        if fisheye:
            focal = rng.uniform(0.42, 0.50) * width
            k = (rng.normal(-0.02, 0.01), rng.normal(0.005, 0.003), rng.normal(0, 0.002), rng.normal(0, 0.001))
        else:
            focal = rng.uniform(0.85, 1.05) * width
            k = (rng.normal(-0.08, 0.08), rng.normal(0.05, 0.05), rng.normal(0, 5e-4), rng.normal(0, 5e-4), 0.0)
        return TrueLens((focal, focal * (1 + rng.normal(0, 0.002))), centre, k, fisheye)

    turned = Rotation.from_rotvec(rng.normal(0, np.radians([1.0, 2.0, 1.0]))).as_matrix()
    baseline = rng.uniform(0.06, 0.15)
    t = -turned @ (baseline * np.array([1.0, rng.normal(0, 0.01), rng.normal(0, 0.01)]))
    return TrueRig(lens(), lens(), turned, t, size_px)


def poses(
    rng: np.random.Generator, rig: TrueRig, board: Printed, count: int = 20
) -> list[tuple[FloatArray, FloatArray]]:
    """Return poses of a board shown with care: all over both images, tilted each way, near and far."""
    found: list[tuple[FloatArray, FloatArray]] = []
    width, height = rig.size_px
    middle = 0.5 * board.square_m * np.array([board.columns, board.rows, 0.0])
    wanted = tries = 0
    while len(found) < count:
        tilt = rng.uniform(np.radians(5), np.radians(40))
        axis = rng.uniform(0, 2 * np.pi)
        R = Rotation.from_rotvec(tilt * np.array([np.cos(axis), np.sin(axis), 0])) * Rotation.from_euler(
            "z", rng.normal(0, 0.3)
        )
        share = rng.uniform(0.35, 0.75)
        nearest = 2.0 * rig.baseline_m  # below that the cameras hardly share a view
        z = max(rig.left.focal_px[0] * board.square_m * board.columns / (share * width), nearest)
        cell = np.array([wanted % 3, wanted // 3 % 3])
        at = (cell + rng.uniform(0.1, 0.9, 2)) / 3 * (0.5 + 0.5 * (1 - share)) + 0.25 * share
        middle_eye = (
            np.array([(at[0] - 0.5) * width, (at[1] - 0.5) * height, rig.left.focal_px[0]]) * z / rig.left.focal_px[0]
        )
        middle_eye[0] += 0.5 * rig.baseline_m
        pose = R.as_matrix(), middle_eye - R.as_matrix() @ middle
        tries += 1
        is_seen = _seen(rig, board, *pose) > 0.75
        if is_seen:
            found.append(pose)
        if tries > 50 or is_seen:
            wanted, tries = wanted + 1, 0
    return found


def _seen(rig: TrueRig, board: Printed, R: FloatArray, t_m: FloatArray) -> float:
    """Return the share of the board's corners in the image that shows fewer of them."""
    c, r = np.meshgrid(np.arange(1, board.columns), np.arange(1, board.rows))
    x = board.square_m * np.column_stack([c.ravel(), r.ravel(), np.zeros(c.size)]) @ R.T + t_m
    eyes = rig.left.image(x), rig.right.image(x @ rig.R.T + rig.t_m)
    size = np.array(rig.size_px)
    return min(float(np.mean(((px > 4) & (px < size - 5)).all(axis=1))) for px in eyes)
