"""The background: a room so far away that it has no parallax, as an equirectangular picture around the robot."""

from __future__ import annotations

import cv2
import numpy as np

from bodyschema.interfaces.records import FloatArray, ImageArray

_WIDTH, _HEIGHT = 2048, 1024


def cluttered_room(
    objects: int, rng: np.random.Generator, *, ball_hue_deg: float = 0.0, gap_deg: float = 36.0
) -> ImageArray:
    """Return a picture (1024, 2048, 3), BGR, of a wall with coloured objects: rectangles, discs and bars.

    Args:
        ball_hue_deg: hue of the ball [deg].
        gap_deg: smallest difference between the hue of an object and that of the ball [deg].
    """
    rows = np.linspace(205, 120, _HEIGHT)[:, None, None]
    picture = np.ascontiguousarray(np.broadcast_to(rows * [0.93, 0.97, 1.0], (_HEIGHT, _WIDTH, 3)).astype(np.uint8))
    for _ in range(objects):
        colour = _colour(rng, round(ball_hue_deg / 2), round(gap_deg / 2))
        x, y = int(rng.integers(_WIDTH)), int(rng.integers(_HEIGHT))
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
    columns = (0.5 - cv2.phase(x, y) / (2 * np.pi)) % 1.0 * (_WIDTH - 1)
    rows = np.arctan2(across, z) / np.pi * (_HEIGHT - 1)
    seen = cv2.remap(room, columns.astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR, None, cv2.BORDER_WRAP)
    return seen.astype(np.uint8, copy=False)


def _colour(rng: np.random.Generator, ball: int, gap: int) -> tuple[int, int, int]:
    """Return a random BGR colour whose hue is not near the ball's; OpenCV's hue circle has 180 steps, red at 0."""
    # Hues mix at an edge: leave a wider gap on the side of the shorter wavelengths.
    hue = (ball + rng.integers(gap, 168 - gap)) % 180
    hsv = np.array([[[hue, rng.integers(20, 230), rng.integers(40, 240)]]], dtype=np.uint8)
    blue, green, red = cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)[0, 0]
    return int(blue), int(green), int(red)
