"""Pictures of the report: images with their corners, and plots over the image area."""

from __future__ import annotations

import base64

import cv2
import numpy as np

from bodyschema.interfaces.records import FloatArray, ImageArray
from bodyschema.vision.board import Corners
from bodyschema.vision.calibration.guidance import GRID
from bodyschema.vision.calibration.view import Eye
from bodyschema.vision.image_file import jpeg, shrunk

_GREEN = (60, 210, 60)
_FIRST = (30, 60, 240)


def photograph(image: ImageArray, corners: Corners | None, alt: str, widest_px: int = 400) -> str:
    """Return a small image with the detected corners; the first one is red, to reveal a rotated board."""
    scale = min(1.0, widest_px / image.shape[1])
    small = shrunk(image, widest_px)
    if small.ndim == 2:
        small = np.asarray(cv2.cvtColor(small, cv2.COLOR_GRAY2BGR), np.uint8)
    if corners is not None:
        for k, at in enumerate((corners.px + 0.5) * scale - 0.5):
            centre = (round(float(at[0]) * 8), round(float(at[1]) * 8))
            cv2.circle(small, centre, 24, _GREEN if k else _FIRST, 1 if k else 2, cv2.LINE_AA, shift=3)
    return f'<img alt="{alt}" src="data:image/jpeg;base64,{base64.b64encode(jpeg(small)).decode()}">'


def coverage(px: FloatArray, covered: np.ndarray, size_px: tuple[int, int], eye: Eye) -> str:
    """Plot all corners over an eye's image; cells with too few are red."""
    width, height = size_px
    cells = [
        f'<rect class="empty" x="{c * width / GRID[1]:.1f}" y="{r * height / GRID[0]:.1f}" '
        f'width="{width / GRID[1]:.1f}" height="{height / GRID[0]:.1f}"/>'
        for r, c in np.argwhere(~covered).tolist()
    ]
    points = "".join(f"M{u:.1f} {v:.1f}h0" for u, v in px)
    dots = f'<path class="dots" stroke-width="{width / 130:.1f}" d="{points}"/>'
    return _over(size_px, f"corners in the {eye} image", "".join(cells) + _lines(size_px) + dots)


def residuals(px: FloatArray, off_px: FloatArray, stretch: float, size_px: tuple[int, int], eye: Eye) -> str:
    """Plot the residuals as arrows from the predicted corners, magnified by `stretch`."""
    path = "".join(
        f"M{u:.1f} {v:.1f}l{du:.1f} {dv:.1f}" for (u, v), (du, dv) in zip(px - off_px, stretch * off_px, strict=True)
    )
    arrows = f'<path class="arrows" stroke-width="{size_px[0] / 500:.1f}" d="{path}"/>'
    return _over(size_px, f"residuals in the {eye} image", _lines(size_px) + arrows)


def _over(size_px: tuple[int, int], label: str, inside: str) -> str:
    return f'<svg viewBox="0 0 {size_px[0]} {size_px[1]}" role="img" aria-label="{label}">{inside}</svg>'


def _lines(size_px: tuple[int, int]) -> str:
    width, height = size_px
    upright = "".join(f"M{k * width / GRID[1]:.1f} 0V{height}" for k in range(1, GRID[1]))
    level = "".join(f"M0 {k * height / GRID[0]:.1f}H{width}" for k in range(1, GRID[0]))
    return f'<path class="grid" stroke-width="{width / 500:.1f}" d="{upright}{level}"/>'
