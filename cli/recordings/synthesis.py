"""Simulate the measurements at the joint angles of a recording."""

from __future__ import annotations

import numpy as np

from bodyschema.effects import EFFECT_TYPES, Motion, Simulation
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.errors import ConfigError, RecordingError
from bodyschema.interfaces.records import FloatArray
from bodyschema.recordings.recording import Recording
from kbmaps import KBMapsError


def simulated(simulation: Simulation, like: Recording) -> Recording:
    """Return a simulated recording with the times, segments and joint angles of `like`.

    Raises:
        RecordingError: the simulation gives no position at a row.
    """
    with np.errstate(all="ignore"):
        try:
            x = simulation.positions(Motion.of(like))
        except KBMapsError as error:
            raise RecordingError(f"the simulation cannot be run: {error}", file=like.file or "recording") from error
    beyond = np.flatnonzero(~np.isfinite(x).all(axis=1))
    if len(beyond):
        raise RecordingError(
            f"the simulation gives no position at row {beyond[0] + 1} ({len(beyond)} such rows): the marker lies in "
            "the plane of the cameras there",
            file=like.file or "recording",
            remedy="Is the recording of this robot, and [camera] right?",
        )
    return Recording(joints=like.joints, q=like.q, x=x, t=like.t, segment=like.segment)


def with_noise(simulation: Simulation, exact: Recording, like: Recording, rng: np.random.Generator) -> Recording:
    """Return `exact` with noise added to its positions, by the covariances of `like` or otherwise by [camera].

    Raises:
        ConfigError: neither gives the size of the noise.
    """
    calibration = simulation.robot.calibration
    if like.cov is not None:
        roots = np.linalg.cholesky(like.cov)
        x = exact.x + np.einsum("nij,nj->ni", roots, rng.standard_normal(exact.x.shape))
    elif calibration is not None and calibration.is_stereo:
        x = _seen_again(calibration, exact.x, rng)
    else:
        raise ConfigError(
            "nothing says how large the noise is: the recording has no covariances, [camera] no stereo pair",
            file=simulation.robot.file,
            remedy="Leave --noise away, or add columns sx, sy, sz to the recording",
        )
    return Recording(joints=exact.joints, q=exact.q, x=x, t=exact.t, segment=exact.segment)


def without_consequence(simulation: Simulation, like: Recording | None = None) -> list[str]:
    """Return sentences on the effects that have no influence for this robot or for a recording without times."""
    sentences = []
    for name in dict.fromkeys(effect.name for effect in simulation.effects):
        if EFFECT_TYPES[name].needs_times and like is not None and like.t is None:
            sentences.append(f"{name} changes nothing: the recording has no column t")
        if EFFECT_TYPES[name].needs_weight and not simulation.bears_weight:
            sentences.append(f'{name} changes nothing: with hold = "torque_free" the guiding hand bears the weight')
    return sentences


def _seen_again(calibration: StereoCalibration, x: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return positions (n, 3) [m] triangulated from the image points of x (n, 3) with noise in each coordinate."""
    pixels = calibration.project(x)
    u_left, v_left, u_right, v_right = (pixels + calibration.pixel_sigma * rng.standard_normal(pixels.shape)).T
    cx, cy = calibration.principal_point_px
    depth = calibration.focal_px * calibration.baseline_m / (u_left - u_right)
    scale = depth / calibration.focal_px
    return np.stack([(u_left - cx) * scale, (0.5 * (v_left + v_right) - cy) * scale, depth], axis=1)
