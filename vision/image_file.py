"""Read image files; shrink and encode images for a page."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from bodyschema.interfaces.records import ImageArray
from bodyschema.robot.limited import read_at_most

# The largest camera images, uncompressed, have half of it.
MAX_BYTES = 2**28


def read_image(file: Path, flags: int = cv2.IMREAD_COLOR) -> ImageArray | None:
    """Return the image (height, width, 3) in `file`; None if it is not a readable image.

    Args:
        flags: flags of `cv2.imdecode`; by default those of a colour image.
    """
    try:
        data = np.frombuffer(read_at_most(file, MAX_BYTES), np.uint8)
        image = cv2.imdecode(data, flags) if len(data) else None
    except (OSError, cv2.error):  # raised by OpenCV for more pixels than it allows
        return None
    return None if image is None else np.asarray(image, np.uint8)


def shrunk(image: ImageArray, widest_px: int) -> ImageArray:
    """Return an image no wider than this."""
    scale = min(1.0, widest_px / image.shape[1])
    return np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)


def jpeg(image: ImageArray, quality: int = 80) -> bytes:
    """Return an image as JPEG, for a page: about 100 kB."""
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
