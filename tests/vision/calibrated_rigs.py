"""Random rigs, calibrated from rendered images and compared with the ground truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from board_renderer import Photographer, Printed, Taken, TrueRig, poses, webcams
from scipy.spatial.transform import Rotation
from shown_board import BOARD, SIZE, true_vector

from bodyschema.interfaces.records import FloatArray
from bodyschema.vision.calibration.calibrate import Calibrated, CalibrationRequest, ModelChoice, calibrate
from bodyschema.vision.calibration.gather import gathered
from bodyschema.vision.calibration.image_pairs import ImagePair
from bodyschema.vision.rig.stereo_rig import CalibrationError, covariance_of, triangulated

VIEWS = 20
DISTANCE_M = 0.6


@dataclass(frozen=True)
class Figures:
    """Errors of one calibration; `z` are errors of all parameters and of a position ahead, in their sigmas."""

    model: str
    baseline_mm: float
    baseline_sigma_mm: float
    position_mm: float
    shape_mm: float
    z: FloatArray
    position_z: FloatArray
    held_out_px: float
    left_out: int


def places(rig: TrueRig) -> FloatArray:
    """Return points (n, 3) in the left camera's frame on the plane 0.6 m ahead, as far as both cameras see it."""
    grid = np.stack(np.meshgrid(np.linspace(-0.3, 0.4, 15), np.linspace(-0.25, 0.25, 11)), axis=-1).reshape(-1, 2)
    x = np.column_stack([grid, np.full(len(grid), DISTANCE_M)])
    eyes = rig.left.image(x), rig.right.image(x @ rig.R.T + rig.t_m)
    return x[np.all([((px > 0) & (px < np.array(SIZE) - 1)).all(axis=1) for px in eyes], axis=0)]


def aligned(x: FloatArray, to: FloatArray) -> FloatArray:
    """Return `x` moved as a rigid body to the best fit to `to`."""
    turn, _ = Rotation.align_vectors(to - to.mean(axis=0), x - x.mean(axis=0))
    return turn.apply(x - x.mean(axis=0)) + to.mean(axis=0)


def figures(truth: TrueRig, found: Calibrated) -> Figures:
    rig = found.rig
    x = places(truth)
    left, right = truth.left.image(x), truth.right.image(x @ truth.R.T + truth.t_m)
    seen = triangulated(rig, left, right)
    middle = len(x) // 2
    covariance = covariance_of(
        rig, lambda other: triangulated(other, left[middle : middle + 1], right[middle : middle + 1])[0]
    )
    is_right_model = (rig.model == "fisheye") == truth.left.fisheye
    z = (rig.vector - true_vector(truth)) / rig.sigma if is_right_model else np.zeros(0)
    return Figures(
        model=rig.model if is_right_model else f"{rig.model} (wrong)",
        baseline_mm=1e3 * (rig.baseline_m - truth.baseline_m),
        baseline_sigma_mm=1e3 * rig.baseline_sigma_m,
        position_mm=1e3 * float(np.sqrt(np.mean(np.sum((seen - x) ** 2, axis=1)))),
        shape_mm=1e3 * float(np.sqrt(np.mean(np.sum((aligned(seen, x) - x) ** 2, axis=1)))),
        z=z,
        position_z=(seen[middle] - x[middle]) / np.sqrt(np.diag(covariance)),
        held_out_px=rig.provenance.held_out_px,
        left_out=rig.provenance.left_out,
    )


def calibrated_rig(seed: int, *, fisheye: bool, model: ModelChoice = "auto") -> Figures | str:
    """Return the figures of a random rig, or the reason why its calibration was refused."""
    rng = np.random.default_rng(seed)
    truth = webcams(rng, fisheye=fisheye)
    photographer = Photographer(truth, Printed(), Taken(), rng)
    frames = [photographer.pair(*pose) for pose in poses(rng, truth, Printed(), VIEWS)]
    pairs = [ImagePair(f"{k:02d}", frame.left, frame.right) for k, frame in enumerate(frames)]
    try:
        asked = CalibrationRequest(SIZE, ("A1", "B2"), "2026", model=model, scale_sigma=0.0)
        return figures(truth, calibrate(gathered(pairs, BOARD).views, BOARD, asked))
    except CalibrationError as error:
        return str(error)
