"""One frame of each eye: the robot by TinyRenderer, the marker by ray casting, the room behind, the sensor's noise."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from colorsys import rgb_to_hsv

import cv2
import msgspec
import numpy as np

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray, ImageArray
from bodyschema.robot.rpy import rotation_of
from bodyschema.sim_backend.config import CameraConfig, SimTag
from bodyschema.sim_backend.randomness import Stream, generator
from bodyschema.sim_backend.rendering.raster import EmptyWorld, Grid, Raster


class _Settings:
    ball_ambient: float = 0.55
    ball_diffuse: float = 0.4
    specular: float = 0.12
    shininess: int = 20
    width: int = 2048
    height: int = 1024
    black: float = 0.06
    white: float = 0.86
    ambient: float = 0.6
    diffuse: float = 0.4
    # Squares across a tag: black border, data, black border.
    squares: int = 8
    # Free pixels around the marker in its finely sampled rectangle, and the most samples across it.
    margin_px: int = 4
    max_samples: int = 480
    # The arm is rendered at half resolution, except around the marker: at 1 it takes four times as long.
    scene_step: int = 2
    supersampling: int = 3  # samples across one pixel around the marker
    noise_fields: int = 8
    noise_shift_px: int = 64
    # Portraits: radius of the marker [px], and how far a tag is turned away [deg]. Several, as chance may spoil one.
    ball_portraits = ((40.0, 30.0), (60.0, 40.0), (30.0, 10.0), (60.0, 20.0))


def cast_ball(
    directions: FloatArray,
    centre: FloatArray,
    radius: float,
    depth: FloatArray,
    bgr: FloatArray,
    to_light: FloatArray | None,
) -> tuple[np.ndarray, FloatArray]:
    """Return the mask of the rays that hit the ball before anything else, and its colour there.

    Args:
        directions: rays (n, m, 3) in the eye's optical frame with z = 1.
        centre: centre of the ball in that frame (3,) [m].
        depth: distance along z of everything else (n, m) [m].
        bgr: the ball's colour (3,), 0 to 1.
        to_light: unit vector to the light (3,) in that frame; None if the ball glows by itself.

    Returns:
        The mask (n, m) and the colours (k, 3), 0 to 255, of the rays in the mask.
    """
    along = directions @ centre
    length2 = np.einsum("ijk,ijk->ij", directions, directions)
    discriminant = along**2 - length2 * (centre @ centre - radius**2)
    near = (along - np.sqrt(np.maximum(discriminant, 0.0))) / length2
    mask = (discriminant > 0) & (near > 0) & (near < depth)
    if to_light is None:
        return mask, np.tile(255.0 * bgr, (int(mask.sum()), 1))
    rays = directions[mask]
    normals = (near[mask][:, None] * rays - centre) / radius
    facing = np.maximum(normals @ to_light, 0.0)
    mirrored = 2 * facing[:, None] * normals - to_light
    to_eye = -rays / np.linalg.norm(rays, axis=1, keepdims=True)
    shine = np.maximum(np.einsum("ij,ij->i", mirrored, to_eye), 0.0) ** _Settings.shininess
    lit = (_Settings.ball_ambient + _Settings.ball_diffuse * facing)[:, None] * bgr
    return mask, np.minimum(lit + (_Settings.specular * shine)[:, None], 1.0) * 255.0


def cluttered_room(
    objects: int, rng: np.random.Generator, *, ball_hue_deg: float = 0.0, gap_deg: float = 36.0
) -> ImageArray:
    """Return a picture (1024, 2048, 3), BGR, of a wall with coloured objects: rectangles, discs and bars.

    Args:
        gap_deg: smallest difference between the hue of an object and that of the ball [deg].
    """
    rows = (np.linspace(205, 120, _Settings.height)[:, None, None] * [0.93, 0.97, 1.0]).astype(np.uint8)
    picture = np.repeat(rows, _Settings.width, axis=1)
    for _ in range(objects):
        colour = _colour(rng, round(ball_hue_deg / 2), round(gap_deg / 2))
        x, y = int(rng.integers(_Settings.width)), int(rng.integers(_Settings.height))
        w, h = (int(size) for size in rng.integers(15, 160, 2))
        shape = rng.integers(3)
        if shape == 0:
            cv2.rectangle(picture, (x, y), (x + w, y + h), colour, -1)
        elif shape == 1:
            cv2.circle(picture, (x, y), w // 2, colour, -1)
        else:
            cv2.line(picture, (x, y), (x + 2 * w - 160, y + h), colour, 2 + w // 12)
    return cv2.GaussianBlur(picture, (5, 5), 0).astype(np.uint8)


def background(room: ImageArray, directions: FloatArray, R_world_camera: FloatArray) -> ImageArray:
    """Return the room's image as seen by a camera with this orientation (3, 3).

    Args:
        directions: viewing direction of each pixel in the camera, shape (height, width, 3), any length.
    """
    x, y, z = np.moveaxis(directions.astype(np.float32) @ R_world_camera.T.astype(np.float32), -1, 0)
    across = np.sqrt(x * x + y * y)
    columns = (0.5 - cv2.phase(x, y) / (2 * np.pi)) % 1.0 * (_Settings.width - 1)
    rows = np.arctan2(across, z) / np.pi * (_Settings.height - 1)
    seen = cv2.remap(room, columns.astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR, None, cv2.BORDER_WRAP)
    return seen.astype(np.uint8, copy=False)


def _colour(rng: np.random.Generator, ball: int, gap: int) -> tuple[int, int, int]:
    """Return a random BGR colour whose hue is not near the ball's; OpenCV's hue circle has 180 steps, red at 0."""
    # Hues mix at an edge: leave a wider gap on the side of the shorter wavelengths.
    hue = (ball + rng.integers(gap, 168 - gap)) % 180
    hsv = np.array([[[hue, rng.integers(20, 230), rng.integers(40, 240)]]], dtype=np.uint8)
    blue, green, red = cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)[0, 0]
    return int(blue), int(green), int(red)


class TagSheets:
    """Tags on a rigid body, each on a separate sheet that is visible from the front only."""

    def __init__(self, tags: Sequence[SimTag], dictionary: int) -> None:
        patterns = cv2.aruco.getPredefinedDictionary(dictionary)
        self._tags = tuple(tags)
        self._turns = [rotation_of(np.array(tag.rpy)) for tag in tags]
        # One pixel a square, from the top left; True where it is black.
        self._black = [
            np.indices(tag.squares[::-1]).sum(axis=0) % 2 == 0
            if tag.squares
            else patterns.generateImageMarker(tag.id, _Settings.squares, borderBits=1) < 128
            for tag in tags
        ]

    def cast(
        self, directions: FloatArray, x: FloatArray, R: FloatArray, depth: FloatArray, to_light: FloatArray
    ) -> tuple[np.ndarray, FloatArray]:
        """Return the mask of the rays that hit a sheet before anything else, and its colour there.

        Args:
            directions: rays (n, m, 3) in the eye's optical frame with z = 1.
            x, R: the marker's pose in that frame, (3,) [m] and (3, 3).
            depth: distance along z of everything else (n, m) [m].
            to_light: unit vector to the light (3,) in that frame.

        Returns:
            The mask (n, m) and the colours (k, 3), 0 to 255, of the rays in the mask.
        """
        nearest, level = depth.copy(), np.full(depth.shape, np.nan)
        for tag, turn, black in zip(self._tags, self._turns, self._black, strict=True):
            axes, centre = R @ turn, x + R @ np.array(tag.xyz)
            facing = directions @ axes[:, 2]
            seen = facing < 0.0
            z = np.divide(centre @ axes[:, 2], facing, out=np.full(depth.shape, np.inf), where=seen)
            seen &= (z > 0.0) & (z < nearest)
            place = (directions[seen] * z[seen][:, None] - centre) @ axes[:, :2]
            on_sheet = (np.abs(place) < tag.half_sheet_m).all(axis=1)
            seen[seen] = on_sheet
            lit = _Settings.ambient + _Settings.diffuse * max(float(axes[:, 2] @ to_light), 0.0)
            square_m = tag.side_m if tag.squares else tag.side_m / _Settings.squares
            dark = _is_black(place[on_sheet] / square_m, black)
            level[seen] = lit * np.where(dark, _Settings.black, _Settings.white)
            nearest[seen] = z[seen]
        mask = np.isfinite(level)
        return mask, np.repeat(255.0 * level[mask][:, None], 3, axis=1)


def _is_black(place: FloatArray, black: np.ndarray) -> np.ndarray:
    """Return a mask (k,) of the points (k, 2) [squares] that are black on a pattern, x right, y up from its middle."""
    rows, columns = black.shape
    column = np.floor(place[:, 0] + 0.5 * columns).astype(np.intp)
    row = np.floor(0.5 * rows - place[:, 1]).astype(np.intp)
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    return inside & black[row.clip(0, rows - 1), column.clip(0, columns - 1)]


TO_LIGHT = np.array([0.35, 0.45, 0.82]) / np.linalg.norm([0.35, 0.45, 0.82])


class StereoRenderer:
    """Painter of stereo frames.

    Args:
        seed: seed of the background and the image noise; the noise also depends on the frame number.
    """

    def __init__(
        self, raster: Raster | EmptyWorld, calibration: StereoCalibration, config: CameraConfig, seed: int
    ) -> None:
        self._raster, self._calibration, self._config, self._seed = raster, calibration, config, seed
        width, height = calibration.image_size_px
        step = _Settings.scene_step
        self._scene = Grid(0, 0, -(-width // step), -(-height // step), 1 / step)
        self._directions = self._scene.directions(calibration)
        self._room = cluttered_room(
            config.clutter,
            generator(seed, Stream.BACKGROUND),
            ball_hue_deg=360.0 * rgb_to_hsv(*config.rgb)[0],
            gap_deg=config.clutter_gap_deg,
        )
        self._noise = self._noise_fields(width, height)
        self._bgr = np.array(config.rgb[::-1])
        self._sheets = TagSheets(config.tags, config.tag_dictionary) if config.tags else None

    def paint(
        self,
        number: int,
        T_world_camera: FloatArray,
        x_eyes: FloatArray,
        R_camera_marker: FloatArray,
        images: tuple[ImageArray, ...],
    ) -> None:
        """Paint frame `number` into each eye's image (height, width, 3), BGR, the left one's first.

        Args:
            x_eyes: apparent position of the marker's centre in each eye's optical frame (eyes, 3) [m].
            R_camera_marker: orientation of the marker in the left eye's optical frame (3, 3).
        """
        far = background(self._room, self._directions, T_world_camera[:3, :3])
        rng = generator(self._seed, Stream.IMAGE_NOISE, number)
        T_world_eye = T_world_camera.copy()
        for image, x_eye in zip(images, x_eyes, strict=True):
            self._paint_scene(image, T_world_eye, far)
            self._paint_marker(image, T_world_eye, x_eye, R_camera_marker, rng)
            self._add_noise(image, rng)
            T_world_eye[:3, 3] += T_world_camera[:3, 0] * self._calibration.baseline_m

    def _paint_scene(self, image: ImageArray, T_world_eye: FloatArray, far: ImageArray) -> None:
        bgr, depth = self._raster.render(T_world_eye, self._scene)
        scene = self._lit(np.where(np.isinf(depth)[..., None], far, bgr))
        height, width = image.shape[:2]
        step = _Settings.scene_step
        if step > 1:
            scene = cv2.resize(scene, (self._scene.columns * step, self._scene.rows * step))
        image[:] = scene[:height, :width]

    def _paint_marker(
        self,
        image: ImageArray,
        T_world_eye: FloatArray,
        x_eye: FloatArray,
        R_eye_marker: FloatArray,
        rng: np.random.Generator,
    ) -> None:
        window = self._window(x_eye)
        if window is None:
            return
        left, top, width, height = window
        fine = max(1, min(_Settings.supersampling, _Settings.max_samples // max(width, height)))
        grid = Grid(left, top, width * fine, height * fine, fine)
        bgr, depth = self._raster.render(T_world_eye, grid)
        patch = image[top : top + height, left : left + width]
        samples = np.where(np.isinf(depth)[..., None], patch.repeat(fine, 0).repeat(fine, 1), self._lit(bgr))
        samples = samples.astype(np.float32)
        directions, to_light = grid.directions(self._calibration), T_world_eye[:3, :3].T @ TO_LIGHT
        if self._sheets is None:
            light = to_light if self._config.light == 1.0 else None
            mask, colours = cast_ball(directions, x_eye, self._config.marker_radius_m, depth, self._bgr, light)
        else:
            # Jitter: with rays in exact rows, a whole row would miss a straight edge parallel to it at once.
            directions[..., :2] += (rng.random((*depth.shape, 2)) - 0.5) / (fine * self._calibration.focal_px)
            mask, colours = self._sheets.cast(directions, x_eye, R_eye_marker, depth, to_light)
        samples[mask] = colours
        patch[:] = np.round(cv2.resize(samples, (width, height), interpolation=cv2.INTER_AREA))

    def _lit(self, image: ImageArray) -> ImageArray:
        """Return the image, without the marker, scaled by the configured light."""
        light = self._config.light
        return image if light == 1.0 else (light * image).astype(np.uint8)

    def _window(self, x_eye: FloatArray) -> tuple[int, int, int, int] | None:
        """Return the rectangle (left, top, width, height) [px] around the marker, clipped to the image.

        None if the marker is outside the image or too near to the eye.
        """
        radius = self._config.marker_radius_m
        if x_eye[2] < 2 * radius:
            return None
        calibration = self._calibration
        centre = calibration.project(x_eye)[:2]
        # The outline of a sphere off the axis reaches farther than f·r/z.
        reach = calibration.focal_px * radius / (x_eye[2] - radius)
        reach = reach * np.linalg.norm(x_eye) / x_eye[2] + _Settings.margin_px
        low = np.maximum(np.floor(centre - reach).astype(int), 0)
        high = np.minimum(np.ceil(centre + reach).astype(int) + 1, calibration.image_size_px)
        if (high <= low).any():
            return None
        return int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])

    def _noise_fields(self, width: int, height: int) -> np.ndarray:
        """Return a stock of noise images; a new one for every frame would cost as much as rendering it."""
        if self._config.noise == 0:
            return np.zeros(0, dtype=np.int16)
        shape = (_Settings.noise_fields, height + _Settings.noise_shift_px, width + _Settings.noise_shift_px, 3)
        rng = generator(self._seed, Stream.IMAGE_NOISE)
        fields = rng.standard_normal(shape, dtype=np.float32)
        fields *= self._config.noise
        return np.rint(fields, out=fields).astype(np.int16)

    def _add_noise(self, image: ImageArray, rng: np.random.Generator) -> None:
        if self._config.noise == 0:
            return
        field = int(rng.integers(_Settings.noise_fields))
        dy, dx = (int(d) for d in rng.integers(_Settings.noise_shift_px, size=2))
        height, width = image.shape[:2]
        cv2.add(image, self._noise[field, dy : dy + height, dx : dx + width], dst=image, dtype=cv2.CV_8U)


def ball_portraits(calibration: StereoCalibration, config: CameraConfig) -> Iterator[tuple[ImageArray, ...]]:
    """Yield the marker alone in front of a plain wall in each eye's image (height, width, 3), BGR, without noise.

    The marker is centred between the images and near enough to be measured well; a tag is turned a little away.
    """
    eyes = StereoRenderer(EmptyWorld(), calibration, msgspec.structs.replace(config, clutter=0, noise=0.0), seed=0)
    width, height = calibration.image_size_px
    middle_px = np.array([width - 1, height - 1]) / 2 - calibration.principal_point_px
    faced = rotation_of(np.array(config.tags[0].rpy)).T if config.tags else np.eye(3)
    for radius_px, turn_deg in _Settings.ball_portraits:
        # Limit the size so that the marker stays inside both images.
        z = calibration.focal_px * max(config.marker_radius_m / radius_px, 2.0 * calibration.baseline_m / width)
        x, y = middle_px * z / calibration.focal_px
        left = np.array([x + calibration.baseline_m / 2, y, z])
        turn = rotation_of(np.array([np.radians(180.0 - turn_deg), 0.0, 0.0])) @ faced
        x_eyes = left - calibration.eyes_m
        images = tuple(np.zeros((height, width, 3), np.uint8) for _ in x_eyes)
        eyes.paint(0, np.eye(4), x_eyes, turn, images)
        yield images
