"""Corners of tags on photographs of flat grids, compared with OpenCV's and AprilTag's refined corners.

Run `python -m benchmarks.tag_grids FOLDER [--columns 6] [--pitch 1.3] [--dictionary APRILTAG_36H11] [--border 1]
[--lens 5] [--pupil PYTHON]`. FOLDER holds photographs of one grid (larger ones are shrunk to 2048 px), tags numbered
from 0 row by row, `--pitch` sides apart. For each detector a plane and a lens with `--lens` coefficients are fitted to
its corners as ground truth, which no other detector shares. The error of a corner is its distance from the plane
through all *other* tags. Each detector gets the same tags.

Kalibr's grids have a border of two modules (`--border 2`). With `--pupil PYTHON`, an interpreter that has the package
pupil_apriltags, AprilTag's own detector is included.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
from scipy.optimize import least_squares

from benchmarks.tables import Column, Table, tables_option
from bodyschema.interfaces.records import FloatArray, ImageArray
from bodyschema.vision.tags import image
from bodyschema.vision.tags.config import TagConfig

FEWEST, LONGEST_PX = 6, 2048
OPENCV = ("SUBPIX", "CONTOUR", "APRILTAG")
DETECTORS = (
    "tracker",
    "tracker, bleeding not corrected",
    "pupil_apriltags",
    *(f"cv2.aruco, {name}" for name in OPENCV),
)
# Script run by the interpreter that has pupil_apriltags: an image in, the tags' numbers and corners out.
ASKED = """
import json, os, sys
import numpy as np
from pupil_apriltags import Detector
border, height, width = json.loads(sys.stdin.buffer.readline())
grey = np.frombuffer(sys.stdin.buffer.read(), np.uint8).reshape(height, width)
detector = Detector("tag36h11", quad_decimate=1.0)
family = detector.tag_families["tag36h11"].contents
for place in range(family.nbits):
    family.bit_x[place] += border - 1
    family.bit_y[place] += border - 1
family.width_at_border, family.total_width = 6 + 2 * border, 8 + 2 * border
print(json.dumps([(tag.tag_id, tag.corners.tolist()) for tag in detector.detect(grey) if tag.hamming <= 1]), flush=True)
os._exit(0)  # destroying the changed family may crash
"""
Corners = dict[int, FloatArray]


@dataclass(frozen=True)
class Grid:
    """Layout of a printed grid.

    Attributes:
        dictionary: OpenCV's name of a dictionary of six by six modules.
        columns: tags in a row.
        pitch: distance from one tag to the next, in sides.
        border: black modules around the data.
    """

    dictionary: str
    columns: int
    pitch: float
    border: int

    def corners(self, ids: list[int], *, upwards: bool) -> FloatArray:
        """Return the printed corners (n, 4, 2) of tags in sides, x right and y down."""
        rows, columns = np.divmod(np.array(ids), self.columns)
        places = self.pitch * np.stack([columns, -rows if upwards else rows], axis=1)
        return places[:, None] + np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])

    def modules(self, _name: str, id: int) -> FloatArray:
        """Return a tag's modules with its border, 1 white and 0 black."""
        bits = 6 + 2 * self.border
        return np.asarray(cv2.aruco.generateImageMarker(self._tags, id, bits, borderBits=self.border) > 127, np.float64)

    def opencv(self, grey: ImageArray, refinement: int) -> Corners:
        """Return the tags that OpenCV finds, with its own refinement of the corners."""
        parameters = cv2.aruco.DetectorParameters()
        parameters.markerBorderBits, parameters.cornerRefinementMethod = self.border, refinement
        parameters.relativeCornerRefinmentWinSize = 0.8  # with 0.3, the window of small tags is one pixel
        parameters.minMarkerDistanceRate, parameters.perspectiveRemovePixelPerCell = 0.03, 8
        corners, ids, _ = cv2.aruco.ArucoDetector(self._tags, parameters).detectMarkers(grey)
        numbers = [] if ids is None else np.ravel(np.asarray(ids)).tolist()
        return {int(id): np.asarray(quad, np.float64).reshape(4, 2) for id, quad in zip(numbers, corners, strict=True)}

    @property
    def _tags(self) -> Any:
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))


def april_tag(python: str, grey: ImageArray, border: int) -> Corners:
    """Return the tags that AprilTag's own detector finds, integer coordinates in the pixels' centres."""
    head = json.dumps([border, *grey.shape]).encode() + b"\n"
    ran = subprocess.run([python, "-c", ASKED], input=head + grey.tobytes(), capture_output=True, check=True)
    return {id: np.array(corners) - 0.5 for id, corners in json.loads(ran.stdout)}


def ours(grey: ImageArray, grid: Grid, rough: Corners, *, bleeding: bool) -> tuple[Corners, dict[int, FloatArray]]:
    """Return corners and covariances (8, 8) of the tags that could be measured."""
    with mock.patch.object(image, "tag_modules", grid.modules):
        if bleeding:
            found = [image.measure_tag(grey, id, quad, TagConfig()) for id, quad in rough.items()]
        else:
            with mock.patch.object(image, "bleed", return_value=(0.0, 0.0)):
                found = [image.measure_tag(grey, id, quad, TagConfig()) for id, quad in rough.items()]
    tags = [tag for tag in found if isinstance(tag, image.TagImage)]
    return {tag.id: tag.corners_px for tag in tags}, {tag.id: tag.cov_px for tag in tags}


def plane(numbers: FloatArray, printed: FloatArray) -> FloatArray:
    """Project printed points (n, 2) into the image, whose half width is 1, by a homography and then a lens."""
    flat = np.concatenate([printed, np.ones((len(printed), 1))], axis=1) @ np.append(numbers[:8], 1.0).reshape(3, 3).T
    x = flat[:, :2] / flat[:, 2:]
    k1, k2, p1, p2, k3 = np.pad(numbers[8:], (0, 13 - len(numbers)))
    square, product = (x**2).sum(axis=1), x.prod(axis=1)
    radial = x * (1.0 + k1 * square + k2 * square**2 + k3 * square**3)[:, None]
    u, v = x.T
    tangential = [2.0 * p1 * product + p2 * (square + 2.0 * u * u), p1 * (square + 2.0 * v * v) + 2.0 * p2 * product]
    return radial + np.stack(tangential, axis=1)


def left_out(printed: FloatArray, corners_px: FloatArray, size_px: tuple[int, int], lens: int) -> FloatArray:
    """Return leave-one-out distances [px] of the corners (n, 4, 2) from the plane through all other tags."""
    half = max(size_px) / 2.0
    middle = (np.array(size_px) - 1.0) / 2.0
    seen = (corners_px.reshape(-1, 2) - middle) / half
    flat = printed.reshape(-1, 2) - printed.mean(axis=(0, 1))
    start = np.asarray(cv2.findHomography(flat, seen, cv2.RANSAC, 0.02)[0], np.float64)
    start = np.append((start / start[2, 2]).ravel()[:8], np.zeros(lens))
    fit = least_squares(lambda numbers: half * (plane(numbers, flat) - seen).ravel(), start, x_scale="jac", method="lm")
    hat = fit.jac @ np.linalg.pinv(fit.jac)
    apart = np.empty_like(fit.fun)
    for tag in range(len(printed)):
        own = slice(8 * tag, 8 * tag + 8)
        apart[own] = np.linalg.solve(np.eye(8) - hat[own, own], fit.fun[own])
    return -apart.reshape(-1, 4, 2)


def arrangement(grid: Grid, corners: Corners) -> FloatArray:
    """Return the printed corners of these tags in the arrangement that a plane fits best."""
    seen = np.array(list(corners.values()))
    likely: list[tuple[float, FloatArray]] = []
    for upwards in (False, True):
        printed = grid.corners(list(corners), upwards=upwards)
        for turn in range(4):
            turned = np.roll(printed, turn, axis=1)
            home = cv2.findHomography(turned.reshape(-1, 2), seen.reshape(-1, 2), cv2.RANSAC, 5.0)[0]
            if home is not None:
                there = cv2.perspectiveTransform(turned.reshape(-1, 1, 2), home).reshape(-1, 4, 2)
                likely.append((float(np.median(np.abs(there - seen))), turned))
    return min(likely, key=lambda each: each[0])[1]


def photograph(path: Path, grid: Grid, lens: int, pupil: str | None) -> dict[str, Any] | None:
    """Measure one photograph; return None if too few tags are on it."""
    grey = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)
    shrink = min(1.0, LONGEST_PX / max(grey.shape))
    grey = np.asarray(cv2.resize(grey, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA), np.uint8)
    rough = grid.opencv(grey, cv2.aruco.CORNER_REFINE_NONE)
    corrected, covariances = ours(grey, grid, rough, bleeding=True)
    answers = {"tracker": corrected, "tracker, bleeding not corrected": ours(grey, grid, rough, bleeding=False)[0]}
    for name in OPENCV:
        answers[f"cv2.aruco, {name}"] = grid.opencv(grey, getattr(cv2.aruco, f"CORNER_REFINE_{name}"))
    if pupil is not None:
        answers["pupil_apriltags"] = april_tag(pupil, grey, grid.border)
    answers = {name: corners for name, corners in answers.items() if len(corners) >= FEWEST}
    if "tracker" not in answers:
        return None
    shared = sorted(set.intersection(*(set(corners) for corners in answers.values())))
    if len(shared) < FEWEST:
        return None
    first = {id: corrected[id] for id in shared}
    printed = arrangement(grid, first)
    row: dict[str, Any] = {"photograph": path.name, "tags": [len(shared), len(rough)]}
    for name, corners in answers.items():
        measured = np.array([in_order(corners[id], first[id]) for id in shared])
        size_px = (grey.shape[1], grey.shape[0])
        apart = left_out(printed, measured, size_px, lens)
        outward = measured - measured.mean(axis=1, keepdims=True)
        outward /= np.linalg.norm(outward, axis=2, keepdims=True)
        row[name] = {
            "rms_px": float(np.sqrt(np.square(apart).sum(axis=2).mean())),
            "median_px": float(np.median(np.linalg.norm(apart, axis=2))),
            "edge_outward_px": float((apart * outward).sum(axis=2).mean() / np.sqrt(2.0)),
        }
        if name == "tracker":
            sigmas = np.sqrt([np.diag(covariances[id]) for id in shared]).reshape(-1, 4, 2)
            row["within"] = [float((np.abs(apart) < number * sigmas).mean()) for number in (1.0, 2.0)]
    return row


def in_order(corners: FloatArray, order: FloatArray) -> FloatArray:
    """Return a tag's corners in the order in which they are nearest to the corners `order`."""
    orders = [np.roll(way, turn, axis=0) for way in (corners, corners[::-1]) for turn in range(4)]
    return min(orders, key=lambda each: float(np.abs(each - order).sum()))


def main() -> None:
    """Measure all photographs of a folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--dictionary", default="APRILTAG_36H11")
    parser.add_argument("--columns", type=int, default=6)
    parser.add_argument("--pitch", type=float, default=1.3)
    parser.add_argument("--border", type=int, default=1)
    parser.add_argument("--pupil")
    parser.add_argument("--lens", type=int, default=5, choices=range(6))
    tables_option(parser)
    asked = parser.parse_args()
    cv2.setNumThreads(1)
    grid = Grid(asked.dictionary, asked.columns, asked.pitch, asked.border)
    rows = map(partial(photograph, grid=grid, lens=asked.lens, pupil=asked.pupil), sorted(asked.folder.iterdir()))
    each = [Column(name, "px", "{:.2f}, {:+.2f}") for name in DETECTORS]
    within = Column("within 1 sigma, 2 sigma, tracker", "%", "{:.0f}, {:.0f}")
    table = Table("tag_grids", [Column("photograph"), Column("tags", "", "{} of {}"), *each, within])
    for row in filter(None, rows):
        figures = [(row[name]["rms_px"], row[name]["edge_outward_px"]) if name in row else None for name in DETECTORS]
        table.add(row["photograph"], row["tags"], *figures, [100.0 * share for share in row["within"]])
    table.save(asked.tables)


if __name__ == "__main__":
    main()
