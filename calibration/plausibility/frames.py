"""Check of the measurement frame and of the order of quaternions, with the columns of the joints as they are."""

from __future__ import annotations

import math

import numpy as np

from bodyschema.interfaces.records import FloatArray
from kbmaps import RigidChain, align, rotation_matrices
from kbmaps.rotations import rotation_vector

from .search import ReadingFit
from .verdict import THRESHOLDS, Plausibility, mm

# Orders of a quaternion in the columns qx, qy, qz, qw.
_AS_IT_IS = ""
_W_FIRST = "hold a quaternion with w first"
_CONJUGATE = "hold the conjugate of the marker's orientation, that of the measurement frame in the marker"
_REORDER = "name the columns qw, qx, qy, qz"
_NEGATE = "multiply qx, qy and qz by -1"
_REMEDIES = {_W_FIRST: _REORDER, _CONJUGATE: _NEGATE, f"{_W_FIRST}, and {_CONJUGATE}": f"{_REORDER}, and {_NEGATE}"}


def turned_frame(chain: RigidChain, q: FloatArray, x: FloatArray, fit: ReadingFit) -> Plausibility | None:
    """Return a refusal if the measurement frame is turned against a pose that robot.toml declares known; else None."""
    angle = float(np.linalg.norm(rotation_vector(fit.rotation)))
    if angle < THRESHOLDS.turned_rad:
        return None
    told, free = (align(chain, q, x, pose_known=known, marker_known=False).rms for known in (True, False))
    if told < THRESHOLDS.much_better * free:
        return None
    return Plausibility(
        f"it seems that the measurement frame is turned by {math.degrees(angle):.0f}° against [camera] of robot.toml"
        f"{order_of_axes(fit.rotation, mirrored=False)}: the pairs then fit to {mm(free)}, and as they are to "
        f"{mm(told)}",
        "Correct the columns x, y, z, the pose of the camera or the zero of the first joint; or set pose_known = false",
        misread=True,
    )


def order_of_axes(rotation: FloatArray, *, mirrored: bool) -> str:
    """Return the order and signs in which x, y, z are given, if they are axes of the frame in robot.toml; else ""."""
    given = np.diag([-1.0 if mirrored else 1.0, 1.0, 1.0]) @ rotation
    which = np.abs(given).argmax(axis=1)
    along = np.abs(given).max(axis=1)
    if len(set(which.tolist())) < 3 or along.min() < math.cos(THRESHOLDS.turned_rad):
        return ""
    order = ", ".join(f"{'-' if given[k, axis] < 0.0 else ''}{'xyz'[axis]}" for k, axis in enumerate(which))
    return f" (the columns x, y, z hold {order})"


def reordered_quaternions(
    chain: RigidChain, q: FloatArray, orientation: FloatArray, fit: ReadingFit
) -> Plausibility | None:
    """Return a refusal if the quaternions fit far better in another order, or inverted; else None."""
    plain, first, conjugate = orientation, np.roll(orientation, -1, axis=1), np.array([-1.0, -1.0, -1.0, 1.0])
    readings = zip((_AS_IT_IS, *_REMEDIES), (plain, first, plain * conjugate, first * conjugate), strict=True)
    hand = fit.rotation @ chain.orientation(q)
    errors = {name: _scatter(hand.swapaxes(1, 2) @ rotation_matrices("orientation", read)) for name, read in readings}
    before, best = errors.pop(_AS_IT_IS), min(errors, key=errors.__getitem__)
    after = errors[best]
    better = before / max(after, THRESHOLDS.oriented_rad)
    if better <= THRESHOLDS.much_better:
        return None
    return Plausibility(
        f"it seems that the columns qx, qy, qz, qw {best}: the orientations then fit to {math.degrees(after):.1f}°, "
        f"and as they are to {math.degrees(before):.1f}°",
        f"In the recording, {_REMEDIES[best]}",
        misread=True,
        better=better,
    )


def _scatter(turns: FloatArray) -> float:
    """Return the median angle [rad] of rotations (n, 3, 3) from the one among them that is nearest to the others."""
    cosines = (np.einsum("aij,bij->ab", turns, turns) - 1.0) / 2.0
    return math.acos(float(np.clip(np.median(cosines, axis=1).max(), -1.0, 1.0)))
