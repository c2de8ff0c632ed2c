"""Corners of single tags that are fixed in a room, compared with a truth that does not depend on a tag's own size.

Run `python -m benchmarks.tag_room FOLDER [--focal 760] [--pupil PYTHON]`. FOLDER holds photographs by one camera of
36h11 tags, all printed to one size, two or more on each. All poses of cameras and tags and the lens are fitted to the
corners of all photographs at once. Edges that are shifted by pixels shrink far tags by a larger share than near ones,
and dim tags by a different share than bright ones: no pose explains that.

`share` is the share of the correction for bleeding that the corners need, fitted with the rest: 1 if the correction is
right, 0 if the edges are not shifted. Its standard error assumes that photographs are independent; tags need not be.
With `--pupil PYTHON`, an interpreter that has the package pupil_apriltags, AprilTag's own detector is included.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.tables import Column, Table, tables_option
from bodyschema.interfaces.records import FloatArray

from .tag_grids import Corners, Grid, april_tag, in_order, ours

# A tag whose corners are off by this much is not where it was in the other photographs [px]; where the loss of a tag's
# corners turns from quadratic to linear [px]; relative spread of the focal length between photographs, and of the
# lens's middle [px].
MOVED_PX, ROBUST_PX, FOCUS, MIDDLE_PX = 5.0, 0.3, 0.03, 10.0
PRINTED = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
Indices = NDArray[np.intp]
LENS = 5  # focal length, middle, two radial coefficients


@dataclass(frozen=True)
class Seen:
    """A tag in a photograph."""

    photograph: str
    tag: int
    corners: dict[str, FloatArray]


@dataclass(frozen=True)
class Room:
    """The photograph (n,) and the tag (n,) of each detection, and the size of the photographs [px]."""

    photographs: Indices
    tags: Indices
    size_px: tuple[int, int]

    @property
    def counts(self) -> tuple[int, int]:
        """Return the numbers of photographs and of tags."""
        return int(self.photographs.max()) + 1, int(self.tags.max()) + 1

    def split(self, numbers: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return the poses of cameras and tags, the lens, and the focal lengths' relative deviations."""
        cameras, tags = self.counts
        ends = np.cumsum([6 * cameras, 6 * tags, LENS])
        poses, placed, lens, focus = np.split(numbers[: ends[-1] + cameras], ends)
        return poses.reshape(-1, 6), placed.reshape(-1, 6), lens, focus

    def seen(self, poses: FloatArray, placed: FloatArray, lens: FloatArray, focus: FloatArray) -> FloatArray:
        """Return the corners (n, 4, 2) [px] of detections, each with its own pose, tag and focal length."""
        there = PRINTED @ Rotation.from_rotvec(placed[:, :3]).as_matrix().mT + placed[:, None, 3:]
        there = there @ Rotation.from_rotvec(poses[:, :3]).as_matrix().mT + poses[:, None, 3:]
        flat = there[..., :2] / there[..., 2:]
        square = np.square(flat).sum(axis=2, keepdims=True)
        bent = flat * (1.0 + lens[3] * square + lens[4] * square**2)
        return lens[0] * (1.0 + focus[:, None, None]) * bent + lens[1:3]

    def prediction(self, numbers: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the corners (8 n,) and their Jacobian."""
        poses, placed, lens, focus = self.split(numbers)
        own = [poses[self.photographs], placed[self.tags], lens, focus[self.photographs]]
        at = self.seen(*own).ravel()
        jacobian = np.zeros((at.size, len(numbers)))
        detections = np.repeat(np.arange(len(self.tags)), 8)
        begins = np.cumsum([0, poses.size, placed.size, LENS])
        columns = [begins[0] + 6 * self.photographs, begins[1] + 6 * self.tags, None, begins[3] + self.photographs]
        for part, width in enumerate((6, 6, LENS, 1)):
            for number in range(width):
                moved = [each.copy() for each in own]
                step = 1e-6 * (lens[0] if part == 2 and number < 3 else 1.0)
                moved[part][(..., number) if part < 3 else ...] += step
                slope = (self.seen(*moved).ravel() - at) / step
                column = begins[2] + number if columns[part] is None else (columns[part] + number)[detections]
                jacobian[np.arange(at.size), column] = slope
        return at, jacobian


@dataclass(frozen=True)
class Fitted:
    """A fit: its parameters, the residuals (n, 4, 2) [px], and the standard errors of the parameters."""

    numbers: FloatArray
    residuals: FloatArray
    sigmas: FloatArray

    @property
    def per_tag_px(self) -> FloatArray:
        """Return the RMS residual of each detection's corners [px]."""
        return np.sqrt(np.square(self.residuals).sum(axis=2).mean(axis=1))


def fitted(room: Room, corners: FloatArray, start: FloatArray, correction: FloatArray | None = None) -> Fitted:
    """Fit all poses and the lens to corners (n, 4, 2) by Levenberg's method, and the share of a correction if given."""
    cameras, tags = room.counts
    numbers: FloatArray = np.append(start, np.zeros(int(correction is not None)))
    weak = np.zeros((cameras + 8, len(numbers)))
    lens = 6 * (cameras + tags)
    weak[np.arange(cameras), lens + LENS + np.arange(cameras)] = 1.0 / FOCUS
    weak[cameras + np.arange(2), lens + 1 + np.arange(2)] = 1.0 / MIDDLE_PX
    weak[cameras + 2 + np.arange(6), 6 * cameras + np.arange(6)] = 1e4  # the first tag defines the frame

    def off(numbers: FloatArray) -> tuple[FloatArray, FloatArray]:
        at, jacobian = room.prediction(numbers)
        rest = at - corners.ravel()
        if correction is not None:
            rest -= numbers[-1] * correction.ravel()
            jacobian[:, -1] = -correction.ravel()
        held = weak[:, : len(start)] @ (numbers[: len(start)] - start)
        return np.append(rest, held), np.concatenate([jacobian, weak])

    def loss(rest: FloatArray) -> tuple[float, FloatArray]:
        each = np.sqrt(1.0 + np.square(rest[: corners.size].reshape(-1, 8)).mean(axis=1) / ROBUST_PX**2)
        held = rest[corners.size :]
        return float(16.0 * ROBUST_PX**2 * each.sum() + held @ held), np.append(np.repeat(1.0 / each, 8), held**0)

    damping = 1e-3
    rest, jacobian = off(numbers)
    now, weights = loss(rest)
    while damping < 1e8:
        normal = (jacobian.T * weights) @ jacobian
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), -jacobian.T @ (weights * rest))
        tried = off(numbers + step)
        then, reweighted = loss(tried[0])
        if not then < now:
            damping *= 5.0
            continue
        gained, numbers, now, weights = now - then, numbers + step, then, reweighted
        rest, jacobian = tried
        damping = max(damping / 5.0, 1e-9)
        if gained < 1e-8 * now:
            break
    pulls = (jacobian.T * (weights * rest))[:, : corners.size].reshape(len(numbers), -1, 8).sum(axis=2)
    alike = np.eye(cameras)[room.photographs]
    spread = np.linalg.solve((jacobian.T * weights) @ jacobian, pulls @ alike)
    free = corners.size / (corners.size - len(numbers))
    sigmas = np.sqrt(np.square(spread).sum(axis=1) * free)
    return Fitted(numbers, rest[: corners.size].reshape(corners.shape), sigmas)


def placed(found: list[Seen], focal_px: float, size_px: tuple[int, int]) -> tuple[list[Seen], Room, FloatArray]:
    """Return the detections that are connected, and initial poses and lens; large tags come first."""
    middle = (np.array(size_px) - 1.0) / 2.0
    camera = np.array([[focal_px, 0.0, middle[0]], [0.0, focal_px, middle[1]], [0.0, 0.0, 1.0]])
    found = sorted(found, key=lambda seen: -cv2.contourArea(seen.corners["tracker"].astype(np.float32)))
    shown = []
    for seen in found:
        pose = np.eye(4)
        _, turn, pose[:3, 3:] = cv2.solvePnP(
            PRINTED, seen.corners["tracker"], camera, np.zeros(0), flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
        pose[:3, :3] = Rotation.from_rotvec(np.ravel(turn)).as_matrix()
        shown.append(pose)
    tags: dict[int, Any] = {found[0].tag: np.eye(4)}
    cameras: dict[str, Any] = {}
    while True:
        for seen, pose in zip(found, shown, strict=True):
            if seen.tag in tags and seen.photograph not in cameras:
                cameras[seen.photograph] = pose @ np.linalg.inv(tags[seen.tag])
                break
            if seen.photograph in cameras and seen.tag not in tags:
                tags[seen.tag] = np.linalg.inv(cameras[seen.photograph]) @ pose
                break
        else:
            break
    kept = [seen for seen in found if seen.photograph in cameras and seen.tag in tags]
    numbers = [{name: number for number, name in enumerate(each)} for each in (cameras, tags)]
    indices = np.array([[numbers[0][seen.photograph], numbers[1][seen.tag]] for seen in kept]).T
    poses = [
        np.append(Rotation.from_matrix(pose[:3, :3]).as_rotvec(), pose[:3, 3])
        for pose in (*cameras.values(), *tags.values())
    ]
    lens = [focal_px, *middle, 0.0, 0.0]
    return kept, Room(indices[0], indices[1], size_px), np.concatenate([*poses, lens, np.zeros(len(cameras))])


def detections(folder: Path, pupil: str | None) -> tuple[list[Seen], tuple[int, int]]:
    """Return the tags that all detectors find on the photographs of the most common size, and that size."""
    grid = Grid("APRILTAG_36H11", columns=1, pitch=1.0, border=1)
    images = {path.name: cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted(folder.iterdir())}
    shapes = [grey.shape for grey in images.values() if grey is not None]
    common = max(set(shapes), key=shapes.count)
    found: list[Seen] = []
    for name, grey in images.items():
        if grey is None or grey.shape != common:
            continue
        grey = np.asarray(grey, np.uint8)
        rough = grid.opencv(grey, cv2.aruco.CORNER_REFINE_NONE)
        answers: dict[str, Corners] = {
            "tracker": ours(grey, grid, rough, bleeding=True)[0],
            "tracker, bleeding not corrected": ours(grey, grid, rough, bleeding=False)[0],
            "cv2.aruco, SUBPIX": grid.opencv(grey, cv2.aruco.CORNER_REFINE_SUBPIX),
        }
        if pupil is not None:
            answers["pupil_apriltags"] = april_tag(pupil, grey, 1)
        shared = set.intersection(*map(set, answers.values()))
        if len(shared) >= 2:
            found += [
                Seen(name, tag, {who: in_order(each[tag], rough[tag]) for who, each in answers.items()})
                for tag in sorted(shared)
            ]
    return found, (common[1], common[0])


def main() -> None:
    """Fit the room to each detector's corners."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--focal", type=float, default=760.0, help="about the focal length [px]")
    parser.add_argument("--pupil")
    tables_option(parser)
    asked = parser.parse_args()
    cv2.setNumThreads(1)
    found, size_px = detections(asked.folder, asked.pupil)
    all_found = len(found)
    while True:
        found, room, start = placed(found, asked.focal, size_px)
        corners = {name: np.array([seen.corners[name] for seen in found]) for name in found[0].corners}
        fit = fitted(room, corners["tracker"], start)
        still = fit.per_tag_px < MOVED_PX
        if still.all():
            break
        found = [seen for seen, stays in zip(found, still, strict=True) if stays]
    cameras, tags = room.counts
    print(json.dumps({"photographs": cameras, "tags": tags, "detections": len(found), "of": all_found}))
    columns = Column("corners"), *(Column(name, "px", "{:.3f}") for name in ("RMS residual", "median"))
    table = Table("tag_room", columns)
    for name, measured in corners.items():
        per_tag_px = fitted(room, measured, start).per_tag_px
        table.add(name, np.sqrt(np.square(per_tag_px).mean()), np.median(per_tag_px))
    table.save(asked.tables)
    plain = corners["tracker, bleeding not corrected"]
    correction = corners["tracker"] - plain
    fit = fitted(room, plain, start, correction)
    print(json.dumps({"share": float(fit.numbers[-1]), "standard_error": float(fit.sigmas[-1])}))


if __name__ == "__main__":
    main()
