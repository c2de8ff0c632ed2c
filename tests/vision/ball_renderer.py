"""A small ray tracer for one ball in front of a picture: rays against a sphere, without the geometry of ellipses.

Every sub-pixel sends a ray from the eye through the image plane; where it meets the sphere, the surface is lit
(ambient, diffuse, specular); elsewhere the picture behind shows. Blur, exposure and noise come after.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray, ImageArray, StereoFrame

VGA = StereoCalibration(
    focal_px=600.0, principal_point_px=(319.5, 239.5), baseline_m=0.12, image_size_px=(640, 480), pixel_sigma=1e-6
)
# The same cameras with a smaller image: quicker to render.
SMALL = StereoCalibration(
    focal_px=600.0, principal_point_px=(159.5, 119.5), baseline_m=0.06, image_size_px=(320, 240), pixel_sigma=1e-6
)

# Places of a moving ball that make up its blurred image.
_INSTANTS = 9


@dataclass(frozen=True)
class Look:
    """Lighting and exposure of a scene; levels are fractions of white.

    Attributes:
        ball_rgb: reflectance of the ball.
        light: direction to the light in the eye's frame (x right, y down, z forward), any length.
        samples: rays per pixel and direction; 1 gives hard, aliased edges.
        blur_px: 1-sigma of the lens blur [px].
        noise_sd: 1-sigma of each channel [grey levels] in the dark ...
        shot: ... and the variance that each grey level of light adds [grey levels].
        jpeg: quality of the compression that the camera applies, 4:2:0 as most do; None for none.
        moved_m: motion of the ball while the shutter is open, (x, y, z) [m]; it is at its place half-way.
        distortion: lens distortion that rectification left over: radial, relative at the image's corner.
        wall: an even grey behind the ball instead of clutter.
        light_slope: uneven light: relative change over 100 px to the right and down.
        tone: exponent of the camera's tone curve; 1 is linear, 1/2.2 about sRGB.
        bayer: one colour per pixel, interpolated, as on a sensor behind a colour mosaic.
        denoise: noise that the camera's bilateral filter takes away (1-sigma) [grey levels]; 0 for none.
        sharpen: strength of the camera's unsharp mask, whose radius is 1 px: halos along edges.
    """

    ball_rgb: tuple[float, float, float] = (0.85, 0.08, 0.08)
    light: tuple[float, float, float] = (-0.5, -1.0, -1.2)
    ambient: float = 0.35
    diffuse: float = 0.6
    specular: float = 0.35
    shininess: float = 30.0
    exposure: float = 1.0
    samples: int = 4
    blur_px: float = 0.7
    noise_sd: float = 3.0
    shot: float = 0.0
    jpeg: int | None = None
    moved_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    distortion: float = 0.0
    wall: float | None = None
    light_slope: tuple[float, float] = (0.0, 0.0)
    tone: float = 1.0
    bayer: bool = False
    denoise: float = 0.0
    sharpen: float = 0.0


def backdrop(rng: np.random.Generator, size_px: tuple[int, int], wall: float | None) -> FloatArray:
    """Return a picture (height, width, 3) RGB of 0..1: an even wall, or clutter when `wall` is None."""
    return clutter(rng, size_px) if wall is None else np.full((size_px[1], size_px[0], 3), wall)


def clutter(rng: np.random.Generator, size_px: tuple[int, int]) -> FloatArray:
    """Return a picture (height, width, 3) RGB of 0..1: smooth wall, boxes (some brown or brick red) and lines."""
    width, height = size_px
    coarse = rng.uniform(0.25, 0.7, (6, 8, 1)) * np.array([1.0, 0.98, 0.94])
    picture = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    brown, brick = (0.42, 0.26, 0.17), (0.55, 0.24, 0.17)
    for number in range(14):
        corner = rng.integers((-60, -60), (width, height))
        extent = rng.integers(30, 160, 2)
        colour = brown if number % 4 == 0 else brick if number % 7 == 1 else tuple(rng.uniform(0.1, 0.8, 3))
        if number % 4 and number % 7 != 1:
            colour = tuple(0.7 * np.mean(colour) + 0.3 * np.array(colour))
        cv2.rectangle(picture, corner.tolist(), (corner + extent).tolist(), colour, -1, cv2.LINE_AA)
    for _ in range(6):
        ends = rng.integers((0, 0), (width, height), (2, 2))
        cv2.line(picture, ends[0].tolist(), ends[1].tolist(), (0.1, 0.1, 0.12), int(rng.integers(1, 6)), cv2.LINE_AA)
    return np.asarray(picture, dtype=np.float64)


def render_pair(
    x: FloatArray,
    radius_m: float,
    look: Look,
    pictures: tuple[FloatArray, FloatArray],
    rng: np.random.Generator,
    calibration: StereoCalibration,
    t: float = 0.0,
) -> StereoFrame:
    """Render both images of a ball around `x` (3,) [m] in the left optical frame, on the two backgrounds."""
    left, right = (
        take(paint_ball(picture, x_eye, radius_m, look, calibration), look, rng)
        for picture, x_eye in zip(pictures, in_eyes(x, calibration), strict=True)
    )
    return StereoFrame(t, left, right)


def in_eyes(x: FloatArray, calibration: StereoCalibration) -> tuple[FloatArray, FloatArray]:
    """Return a point (3,) [m] of the left optical frame in the left frame and in the right one."""
    return x, x - np.array([calibration.baseline_m, 0.0, 0.0])


class Room:
    """Two backgrounds, rendered once; only a ball's neighbourhood is rendered again for each frame."""

    def __init__(self, calibration: StereoCalibration, look: Look, rng: np.random.Generator) -> None:
        """Draw the pictures and an exposure; `look` says how they are taken."""
        self._calibration, self._rng = calibration, rng
        self._look = replace(look, exposure=float(rng.uniform(0.6, 1.2)))
        self._pictures = [backdrop(rng, calibration.image_size_px, look.wall) for _ in range(2)]
        self._images = [take(picture, self._look, rng) for picture in self._pictures]

    def photograph(self, x: FloatArray, radius_m: float, t: float) -> StereoFrame:
        """Photograph a ball around `x` (3,) [m] in the left optical frame with both cameras, in a random light."""
        look = random_light(self._rng, self._look)
        eyes = zip(self._pictures, self._images, in_eyes(x, self._calibration), strict=True)
        return StereoFrame(t, *(self._eye(*eye, radius_m, look) for eye in eyes))

    def _eye(
        self, picture: FloatArray, image: ImageArray, x_eye: FloatArray, radius_m: float, look: Look
    ) -> ImageArray:
        # Blur reaches four sigmas; the tracker looks at a few pixels around the ball.
        rows, columns = _neighbourhood(x_eye, radius_m, self._calibration, 14.0 + 8.0 * look.blur_px)
        shown = image.copy()
        painted = paint_ball(picture, x_eye, radius_m, look, self._calibration)
        shown[rows, columns] = take(painted[rows, columns], look, self._rng)
        return shown


def paint_ball(
    picture: FloatArray, x_eye: FloatArray, radius_m: float, look: Look, calibration: StereoCalibration
) -> FloatArray:
    """Return `picture` with the ball in front; both RGB of 0..1, shape (height, width, 3)."""
    moved = np.array(look.moved_m)
    instants = np.linspace(-0.5, 0.5, _INSTANTS) if moved.any() else np.zeros(1)
    rows, columns = _neighbourhood(x_eye, radius_m, calibration, 2.0 + _reach_px(x_eye, moved, look, calibration))
    painted = picture.copy()
    window = painted[rows, columns]
    if window.size:
        n = look.samples
        sub = (np.arange(n) + 0.5) / n - 0.5
        u = (np.arange(columns.start, columns.stop)[:, None] + sub).ravel()
        v = (np.arange(rows.start, rows.stop)[:, None] + sub).ravel()
        rays = _rays(u, v, calibration, look.distortion)
        lit = sum(_lit(rays, x_eye + at * moved, radius_m, look) for at in instants) / len(instants)
        ball = pixel_means(lit, n)
        window *= 1.0 - ball[..., 3:]
        window += ball[..., :3]
    return painted


def pixel_means(samples: FloatArray, per_pixel: int) -> FloatArray:
    """Return the means over squares of `per_pixel` by `per_pixel` samples, several times as fast as numpy's."""
    size = samples.shape[1] // per_pixel, samples.shape[0] // per_pixel
    return np.asarray(cv2.resize(samples, size, interpolation=cv2.INTER_AREA)).reshape(*size[::-1], *samples.shape[2:])


def _reach_px(x_eye: FloatArray, moved: FloatArray, look: Look, calibration: StereoCalibration) -> float:
    """Return the largest distance at which the ball may show from its undistorted, resting image [px]."""
    return float(np.abs(moved).max() * calibration.focal_px / x_eye[2]) + abs(look.distortion) * max(
        calibration.image_size_px
    )


def _neighbourhood(
    x_eye: FloatArray, radius_m: float, calibration: StereoCalibration, margin_px: float
) -> tuple[slice, slice]:
    """Return rows and columns of the image that contain the ball and a margin."""
    size = np.array(calibration.image_size_px)
    centre = calibration.project(x_eye)[:2]
    reach = 1.3 * calibration.focal_px * radius_m / x_eye[2] + margin_px
    first = np.clip(np.floor(centre - reach), 0, size).astype(int)
    last = np.clip(np.ceil(centre + reach) + 1, 0, size).astype(int)
    return slice(first[1], last[1]), slice(first[0], last[0])


def take(picture: FloatArray, look: Look, rng: np.random.Generator) -> ImageArray:
    """Expose a picture: uneven light, lens blur, shot and sensor noise, the camera's processing, JPEG; BGR."""
    grey_levels = np.multiply(picture[..., ::-1], 255.0 * look.exposure, dtype=np.float32)
    if any(look.light_slope):
        rows, columns = (np.arange(size) - 0.5 * size for size in picture.shape[:2])
        slope_u, slope_v = look.light_slope
        slope = 1.0 + 0.01 * (slope_u * columns + slope_v * rows[:, None])
        grey_levels *= slope[..., None].astype(np.float32)
    if look.blur_px > 0:
        grey_levels = cv2.GaussianBlur(grey_levels, (0, 0), look.blur_px)
    sigma = np.sqrt(look.noise_sd**2 + look.shot * grey_levels) if look.shot else look.noise_sd
    noise = rng.standard_normal(grey_levels.shape, dtype=np.float32) * sigma
    image = processed(grey_levels + noise, look)
    if look.jpeg is None:
        return image
    settings = [
        cv2.IMWRITE_JPEG_QUALITY,
        look.jpeg,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420,
    ]
    return np.asarray(cv2.imdecode(cv2.imencode(".jpg", image, settings)[1], cv2.IMREAD_COLOR), dtype=np.uint8)


def processed(grey_levels: FloatArray, look: Look) -> ImageArray:
    """Return a sensor's linear levels (height, width, 3) as its camera gives them, in eight bits."""
    levels = np.clip(grey_levels, 0.0, 255.0)
    curved = levels if look.tone == 1.0 else 255.0 * (levels / 255.0) ** look.tone
    image = np.rint(curved).astype(np.uint8)
    if look.bayer:
        mosaic = image[..., 1].copy()
        mosaic[::2, ::2], mosaic[1::2, 1::2] = image[::2, ::2, 2], image[1::2, 1::2, 0]
        image = np.asarray(cv2.cvtColor(mosaic, cv2.COLOR_BayerRGGB2BGR), np.uint8)
    if look.denoise:
        image = np.asarray(cv2.bilateralFilter(image, 5, 3.0 * look.denoise, 1.5), np.uint8)
    if look.sharpen:
        levels = image.astype(np.float32)
        halo = look.sharpen * (levels - cv2.GaussianBlur(levels, (0, 0), 1.0))
        image = np.clip(np.rint(levels + halo), 0, 255).astype(np.uint8)
    return image


def random_light(rng: np.random.Generator, look: Look) -> Look:
    """Return `look` with a random light and gloss."""
    light = (float(rng.uniform(-1.5, 1.5)), float(rng.uniform(-1.5, 0.3)), -1.0)
    return replace(
        look,
        light=light,
        ambient=float(rng.uniform(0.3, 0.5)),
        diffuse=float(rng.uniform(0.4, 0.7)),
        specular=float(rng.uniform(0.0, 0.5)),
    )


def _rays(u: FloatArray, v: FloatArray, calibration: StereoCalibration, distortion: float) -> FloatArray:
    cx, cy = calibration.principal_point_px
    grid_u, grid_v = np.meshgrid((u - cx) / calibration.focal_px, (v - cy) / calibration.focal_px)
    corner = (cx**2 + cy**2) / calibration.focal_px**2
    bent = 1.0 + distortion * (grid_u**2 + grid_v**2) / corner
    rays = np.stack([grid_u * bent, grid_v * bent, np.ones_like(grid_u)], axis=-1)
    return rays / np.sqrt(np.einsum("vuc,vuc->vu", rays, rays))[..., None]


def _lit(rays: FloatArray, x_eye: FloatArray, radius_m: float, look: Look) -> FloatArray:
    """Return the ball's RGB and 1 where rays meet it, and zeros elsewhere."""
    along = rays @ x_eye
    discriminant = along**2 - (x_eye @ x_eye - radius_m**2)
    hit = (discriminant > 0) & (along > 0)
    depth = along[hit] - np.sqrt(discriminant[hit])
    points = depth[:, None] * rays[hit]
    normals = (points - x_eye) / radius_m
    light = np.array(look.light) / np.linalg.norm(look.light)
    facing = normals @ light
    mirrored = 2.0 * facing[:, None] * normals - light
    gloss = np.clip(-np.einsum("nc,nc->n", mirrored, rays[hit]), 0.0, None) ** look.shininess * (facing > 0)
    diffuse = look.ambient + look.diffuse * np.clip(facing, 0.0, None)
    shown = np.zeros((*hit.shape, 4))
    shown[hit] = np.column_stack(
        [diffuse[:, None] * np.array(look.ball_rgb) + (look.specular * gloss)[:, None], np.ones(len(diffuse))]
    )
    return shown
