"""Detection of patches of the marker's colour, and of the ball among them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray, ImageArray, Reason
from bodyschema.vision.config import VisionConfig
from bodyschema.vision.image_checks import ImageSettings

from .colour import Gate
from .outline import Outline, fit_outline, refine_outline
from .settings import ContourSettings
from .settings import PatchSettings as _Settings
from .sphere import Pinhole


@dataclass(frozen=True, slots=True)
class Region:
    """A rectangle of pixels; the last column and row are excluded."""

    left: int
    top: int
    right: int
    bottom: int

    def crop(self, image: ImageArray) -> ImageArray:
        """Return a view of this rectangle of `image` (height, width, ...)."""
        return image[self.top : self.bottom, self.left : self.right]

    def circle_mask(self, centre_px: FloatArray, radius_px: float) -> NDArray[np.bool_]:
        """Return the mask of this rectangle's pixels inside a circle, shape (bottom - top, right - left)."""
        rows, columns = np.ogrid[self.top : self.bottom, self.left : self.right]
        return (columns - centre_px[0]) ** 2 + (rows - centre_px[1]) ** 2 <= radius_px**2

    def grown(self, by: int, within: tuple[int, int]) -> Region:
        """Return the rectangle enlarged by `by` pixels on each side, clipped to an image of (width, height)."""
        return Region(
            max(self.left - by, 0),
            max(self.top - by, 0),
            min(self.right + by, within[0]),
            min(self.bottom + by, within[1]),
        )


@dataclass(frozen=True, slots=True)
class Patch:
    """Connected pixels of the marker's colour."""

    box: Region  # the pixels' bounding box in the image
    # centre_px, radius_px: the rough circle, shape (2,) and float [px]
    centre_px: FloatArray
    radius_px: float
    fill: float  # share of the enclosing circle that the patch fills

    @property
    def is_whole(self) -> bool:
        """True if the patch may be a ball alone, without a background of similar hue."""
        return self.fill >= _Settings.whole_disc_fill


@dataclass(frozen=True, slots=True)
class Disc:
    """The image of a ball."""

    centre_px: FloatArray  # centre of its ellipse, shape (2,) [px]
    radius_px: float  # radius of the circle of the same area [px]
    cov_px: FloatArray  # covariance of the centre, shape (2, 2) [px²]
    radius_sigma_px: float  # 1-sigma of the radius [px]
    level: float  # mean amount of the marker's colour on it [grey levels]
    # roughness of its contour: deviation from the ellipse in variances of its samples; 0 if not computed
    roughness: float = 0.0
    blur_px: float = ContourSettings.usual_blur_px  # blur of its contour (1-sigma) [px]

    def is_same_as(self, other: Disc) -> bool:
        """Return True if two discs from overlapping patches show the same ball."""
        return float(np.linalg.norm(self.centre_px - other.centre_px)) < max(self.radius_px, other.radius_px)


def find_patches(image: ImageArray, region: Region, gate: Gate) -> list[Patch]:
    """Return patches of the marker's colour in `region` of a BGR image, the most disc-like first."""
    patches = _patches(gate.mask(region.crop(image)), region)
    for patch in list(patches):
        if not patch.is_whole:
            for part in _brighter_parts(image, patch, gate):
                if not any(part.box == other.box for other in patches):
                    patches.append(part)
    return sorted(patches, key=lambda patch: -patch.fill)[: _Settings.max_patches]


def patch_at(image: ImageArray, centre_px: FloatArray, radius_px: float, gate: Gate) -> Patch | None:
    """Return the part of a circle in a BGR image that has the marker's colour, as a patch of that circle.

    Return None if the part is too small for a ball.
    """
    height, width = image.shape[:2]
    low, high = np.rint(centre_px - radius_px).astype(int), np.rint(centre_px + radius_px).astype(int) + 1
    low, high = np.clip(low, 0, (width, height)), np.clip(high, 0, (width, height))
    if not (high > low).all():
        return None
    box = Region(*low.tolist(), *high.tolist())
    mask = gate.mask(box.crop(image))
    fill = float(mask[box.circle_mask(centre_px, radius_px)].mean()) / 255.0
    return Patch(box, centre_px, radius_px, fill) if fill >= _Settings.min_fill else None


def measure(
    image: ImageArray,
    patch: Patch,
    eye: Pinhole,
    gate: Gate,
    config: VisionConfig,
    blur_px: float = ContourSettings.usual_blur_px,
) -> Disc | Reason:
    """Measure the ball's image at `patch`, or return the reason why it cannot be measured.

    Args:
        blur_px: rough blur of its contour (1-sigma) [px], for example from the last frame; it saves time.
    """
    height, width = image.shape[:2]
    if not _clear_of_border(patch.box, _Settings.border_px, (width, height)):
        return Reason.AT_BORDER
    if config.marker != "bright_ball" and _is_overexposed(image, patch):
        return Reason.SATURATED
    if patch.fill < _Settings.min_fill:
        return Reason.OCCLUDED
    around = patch.box.grown(_Settings.apron_px, (width, height))
    corner = np.array([around.left, around.top], dtype=np.float64)
    pixels, shape = around.crop(image).astype(np.float32), eye.shape(patch.centre_px)
    outline = fit_outline(pixels, gate, patch.centre_px - corner, patch.radius_px, shape)
    if outline is None:
        return Reason.OCCLUDED
    reason = _incompleteness(outline)
    if reason is not None:
        return reason
    outline = refine_outline(pixels, gate, outline, shape, blur_px)
    if outline is None or not _is_certain(outline):
        return Reason.NOT_ROUND
    centre_px = outline.centre_px + corner
    reach = outline.radius_px + _Settings.border_px
    if (centre_px - reach < 0).any() or (centre_px + reach > (width - 1, height - 1)).any():
        return Reason.AT_BORDER
    # Over the whole ball: the patch may be only its brighter part.
    level = _level(image, Region(0, 0, width, height), centre_px, outline.radius_px, gate)
    sigma_px, roughness, blur_px = outline.radius_sigma_px, outline.roughness, outline.blur_px
    return Disc(centre_px, outline.radius_px, outline.cov_px, sigma_px, level, roughness, blur_px)


def rough_disc(image: ImageArray, patch: Patch, gate: Gate) -> Disc | None:
    """Return a rough disc for a patch that could not be measured or that is partly out of view; None if it is not
    round.
    """
    circle = (patch.centre_px, patch.radius_px) if patch.is_whole else _cut_circle(image, patch, gate)
    if circle is None:
        return None
    centre_px, radius_px = circle
    sigma_px = _Settings.rough_share * radius_px
    level = _level(image, patch.box, centre_px, radius_px, gate)
    return Disc(centre_px, radius_px, sigma_px**2 * np.eye(2), sigma_px, level)


def _cut_circle(image: ImageArray, patch: Patch, gate: Gate) -> tuple[FloatArray, float] | None:
    """Return centre (2,) and radius [px] of a round patch cut by the image border; None for others."""
    height, width = image.shape[:2]
    if _clear_of_border(patch.box, 1, (width, height)):
        return None
    contours, _ = cv2.findContours(gate.mask(patch.box.crop(image)), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    longest = max(contours, key=len, default=None)
    if longest is None:
        return None
    points = longest.reshape(-1, 2) + np.array([patch.box.left, patch.box.top], dtype=np.float64)
    points = points[((points > 1) & (points < (width - 2, height - 2))).all(axis=1)]
    if len(points) < 3:
        return None
    # Kåsa's fit: |p|² = 2 c·p + r² − |c|² is linear in c and the rest.
    middle = points.mean(axis=0)
    design = np.column_stack([2.0 * (points - middle), np.ones(len(points))])
    solution = np.linalg.lstsq(design, ((points - middle) ** 2).sum(axis=1), rcond=None)[0]
    centre_px, radius_px = middle + solution[:2], math.sqrt(solution[2] + solution[:2] @ solution[:2])
    deviation_px = np.linalg.norm(points - centre_px, axis=1) - radius_px
    if math.sqrt(np.mean(deviation_px**2)) > _Settings.rough_share * radius_px or radius_px > math.hypot(width, height):
        return None
    return centre_px, radius_px + 0.5


def _is_certain(outline: Outline) -> bool:
    """Return True if the centre is precise enough; the limit is that of a small ball and grows with the radius."""
    limit_px = _Settings.max_sigma_px * max(1.0, outline.radius_px / _Settings.small_px)
    return math.sqrt(float(outline.cov_px.diagonal().max())) <= limit_px


def _incompleteness(outline: Outline) -> Reason | None:
    """Return the reason why an outline does not belong to a whole ball, or None."""
    if outline.visible < _Settings.min_visible or outline.outlier_share > _Settings.max_outlier_share:
        return Reason.OCCLUDED
    return Reason.LOW_CONTRAST if outline.uneven > _Settings.max_uneven else None


def _level(image: ImageArray, box: Region, centre_px: FloatArray, radius_px: float, gate: Gate) -> float:
    """Return the mean amount of the marker's colour in the square inside the disc, clipped to the patch's box."""
    first, last = (np.rint(centre_px + side * 0.6 * radius_px).astype(int) for side in (-1, 1))
    first = np.clip(first, (box.left, box.top), (box.right - 1, box.bottom - 1))
    last = np.clip(last, first, (box.right - 1, box.bottom - 1))
    return float(gate.amount(image[first[1] : last[1] + 1, first[0] : last[0] + 1]).mean())


def _is_overexposed(image: ImageArray, patch: Patch) -> bool:
    """Return True if much of the ball is white in all channels, so that neither colour nor shading is usable."""
    white = cv2.inRange(patch.box.crop(image), (ImageSettings.white,) * 3, (255,) * 3)
    if cv2.countNonZero(white) <= _Settings.max_white * np.pi / 4 * white.size:
        return False
    # The corners of the box show the background.
    return float(white[patch.box.circle_mask(patch.centre_px, patch.radius_px)].mean()) > 255.0 * _Settings.max_white


def _clear_of_border(box: Region, margin_px: float, size: tuple[int, int]) -> bool:
    return (
        min(box.left, box.top) >= margin_px and box.right <= size[0] - margin_px and box.bottom <= size[1] - margin_px
    )


def _patches(mask: ImageArray, region: Region) -> list[Patch]:
    points = cv2.findNonZero(mask)
    if points is None:
        return []
    # The boxes of OpenCV's connectedComponentsWithStats cost ten times as much as its labels.
    points = np.reshape(points, (-1, 2)).astype(np.int32, copy=False)
    label = cv2.connectedComponents(mask, connectivity=4)[1][mask > 0].astype(np.intp)
    areas = np.bincount(label)
    by_size = np.argsort(-areas, kind="stable")[: 4 * _Settings.max_patches]
    patches = (
        _patch(mask, points.compress(label == number, axis=0), region)
        for number in by_size
        if areas[number] >= _Settings.min_pixels
    )
    return [patch for patch in patches if patch is not None]


def _patch(mask: ImageArray, points: NDArray[np.int32], region: Region) -> Patch | None:
    left, top, width, height = cv2.boundingRect(points)
    box = Region(left, top, left + width, top + height)
    contours, _ = cv2.findContours(box.crop(mask).copy(), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    contour = max(contours, key=len)
    moments = cv2.moments(contour)
    (x, y), enclosing = cv2.minEnclosingCircle(contour)
    if moments["m00"] <= 0:
        return None
    # A contour runs through the centres of the border pixels, half a pixel inside the patch.
    radius = float(np.sqrt(moments["m00"] / np.pi)) + 0.5
    enclosing += 0.5
    fill = (radius / enclosing) ** 2
    if fill >= _Settings.whole_disc_fill:
        x, y = moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]
    else:
        radius = enclosing
    left, top = region.left + left, region.top + top
    whole = Region(left, top, left + width, top + height)
    return Patch(whole, np.array([left + x, top + y]), radius, fill)


def _brighter_parts(image: ImageArray, patch: Patch, gate: Gate) -> list[Patch]:
    """Return the parts of a patch that keep much of its strongest colour, such as the ball in front of a brick wall."""
    pixels = patch.box.crop(image)
    amount = gate.amount(pixels)
    own = gate.mask(pixels) > 0
    # The ball may be a small part of the patch: use the level that half of the smallest ball exceeds.
    place = -_Settings.min_pixels // 2
    strongest = float(np.partition(amount[own], place)[place])
    return [
        part
        for share in _Settings.strong_shares
        for part in _patches((own & (amount > share * strongest)).astype(np.uint8), patch.box)
    ]
