"""Views of a board with ground truth: rendered images, or the corners alone, which is quick."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
from board_renderer import Photographer, Printed, Taken, TrueRig, poses, webcams
from scipy.spatial.transform import Rotation

from bodyschema.interfaces.errors import SourceEnded
from bodyschema.interfaces.records import FloatArray, ImageArray, StereoFrame
from bodyschema.vision.board import Board, Corners, NotFound
from bodyschema.vision.calibration.image_pairs import ImagePair
from bodyschema.vision.calibration.view import View
from bodyschema.vision.rig.lens import Model
from bodyschema.vision.rig.stereo_rig import CalibrationProvenance, StereoRig, parameter_names, split

SIZE = (640, 480)
BOARD = Board()
NOISE_PX = 0.04


def true_vector(rig: TrueRig) -> FloatArray:
    """Return the rig's parameters in the order of `StereoRig.vector`."""
    lenses = ([*lens.focal_px, *lens.principal_point_px, *lens.distortion] for lens in (rig.left, rig.right))
    return np.concatenate([*lenses, Rotation.from_matrix(rig.R).as_rotvec(), rig.t_m])


def known_rig(rig: TrueRig, serials: tuple[str, str] = ("A1", "B2")) -> StereoRig:
    """Return the true rig as a calibration with negligible uncertainty."""
    model: Model = "fisheye" if rig.left.fisheye else "pinhole"
    n = len(parameter_names(model))
    made = CalibrationProvenance("2026-01-01T00:00:00Z", BOARD.name, 20, 0, 0.03, 0.03, 0.0)
    return StereoRig(*split(model, true_vector(rig)), rig.size_px, serials, 1e-10 * np.eye(n), made)


def corner_views(rig: TrueRig, rng: np.random.Generator, count: int = 20, noise_px: float = NOISE_PX) -> list[View]:
    """Return views with the exact corners plus noise."""
    photographer = Photographer(rig, Printed(), Taken(), rng)
    return [
        view_of(f"{k:02d}", photographer, pose, rng, noise_px)
        for k, pose in enumerate(poses(rng, rig, Printed(), count))
    ]


def view_of(
    name: str,
    photographer: Photographer,
    pose: tuple[FloatArray, FloatArray],
    rng: np.random.Generator,
    noise_px: float = NOISE_PX,
) -> View:
    """Return the exact corners of a pose that are in the images, with noise."""
    eyes = []
    for px in photographer.corners(*pose):
        inside = ((px > 2) & (px < np.array(photographer.rig.size_px) - 3)).all(axis=1)
        eyes.append(Corners(np.flatnonzero(inside), px[inside] + rng.normal(0, noise_px, (inside.sum(), 2))))
    return View(name, *eyes)


@cache
def photographed(
    seed: int = 7, count: int = 12
) -> tuple[TrueRig, tuple[ImagePair, ...], tuple[tuple[FloatArray, FloatArray], ...]]:
    """Return a rig, its images of the board, and the board's poses in them."""
    rng = np.random.default_rng(seed)
    rig = webcams(rng)
    photographer = Photographer(rig, Printed(), Taken(), rng)
    shown = tuple(poses(rng, rig, Printed(), count))
    frames = [photographer.pair(*pose) for pose in shown]
    return rig, tuple(ImagePair(f"{k:02d}", f.left, f.right) for k, f in enumerate(frames)), shown


def shot(number: int, t: float | None = None) -> StereoFrame:
    """Return images that show only their own number: `KnownCorners` knows the corners in them."""
    marked = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    marked[0, 0, :2] = divmod(number, 256)
    right = marked.copy()
    right[0, 0, 2] = 1
    return StereoFrame(0.1 * number if t is None else t, marked, right)


class KnownCorners:
    """A detector that returns known corners, by the numbers of `shot`."""

    def __init__(self, views: Sequence[View]) -> None:
        self._views = views

    def find(self, image: ImageArray) -> Corners | NotFound:
        high, low, right = image[0, 0].tolist()
        view = self._views[256 * high + low]
        return (view.right if right else view.left) or NotFound("not_found", "no board")


class Eyes:
    """Cameras that return given frames."""

    def __init__(self, frames: list[StereoFrame], serials: tuple[str, str] = ("A1", "B2")) -> None:
        self.frames, self.serials = iter(frames), serials
        self.image_size_px = (frames[0].left.shape[1], frames[0].left.shape[0])
        self.is_open = False
        self.health = ()

    def __enter__(self):
        self.is_open = True
        return self

    def __exit__(self, *_) -> None:
        self.is_open = False

    def read(self, timeout_s: float) -> StereoFrame | None:
        try:
            return next(self.frames)
        except StopIteration:
            raise SourceEnded("through") from None
