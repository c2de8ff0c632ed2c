"""Requirements on views and on a calibration, with messages for those not met."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bodyschema.interfaces.records import FloatArray
from bodyschema.vision.rig.rectified import Rectification
from bodyschema.vision.rig.stereo_rig import CalibrationError, Rig, StereoRig

from .guidance import Coverage, cell_name
from .settings import ViewSettings as _Settings
from .view import image_of


def unmet_requirements(coverage: Coverage) -> list[str]:
    """Return the requirements that the views do not meet, before a fit."""
    reasons = []
    who = "both eyes saw" if len(coverage.eyes) > 1 else "the camera saw"
    if coverage.whole_views < _Settings.min_views:
        reasons.append(
            f"too few views: {who} the board in {coverage.whole_views}, at least {_Settings.min_views} are needed, "
            f"{_Settings.wanted_views} are good"
        )
    tilted = np.count_nonzero(coverage.largest_tilts_deg > _Settings.tilted_deg)
    if coverage.whole_views and tilted < _Settings.min_tilted:
        reasons.append(
            f"the board faces the cameras in all views{f' but {tilted}' if tilted else ''}: focal length and distance "
            "cannot be told apart. Tilt it by 20° to 40°, each way"
        )
    for eye in coverage.eyes:
        covered = coverage.covered(eye)
        if np.count_nonzero(covered) < _Settings.min_cells:
            empty = ", ".join(cell_name(r, c) for r, c in np.argwhere(~covered).tolist())
            reasons.append(f"the board was hardly ever in these parts of the {image_of(eye, coverage.eyes)}: {empty}")
    return reasons


def misplacement(R_right_left: FloatArray, translation_m: FloatArray) -> str | None:
    """Return a message if the eyes are exchanged, upside down or one above the other, otherwise None.

    Args:
        R_right_left, translation_m: a point x of the left eye's frame is at R x + t in the right one's.
    """
    about_sight = abs(np.arctan2(R_right_left[1, 0], R_right_left[0, 0]))
    if about_sight > np.pi - _Settings.max_turned_rad:
        return (
            "one camera is upside down: the images are turned by "
            f"{np.degrees(about_sight):.0f}° against each other. Turn that camera, or its images where it is configured"
        )
    if about_sight > _Settings.max_turned_rad:
        return f"one camera lies on its side: the images are turned by {np.degrees(about_sight):.0f}°. Turn it upright"
    right_eye = -R_right_left.T @ translation_m
    if abs(right_eye[0]) < np.max(np.abs(right_eye[1:])):
        where = ", ".join(f"{1e3 * each:.0f}" for each in right_eye)
        return f"the eyes are not side by side: the right one is at {where} mm (right, down, ahead) of the left one"
    if right_eye[0] < 0.0:
        return (
            f"the cameras are swapped: the right one is {-1e3 * right_eye[0]:.0f} mm to the left of the left one. "
            "Exchange left and right; or, if both stand upside down, turn both"
        )
    return None


def undetermined(rig: Rig) -> list[str]:
    """Return messages for the parameters that are not determined precisely enough."""
    reasons = []
    width = rig.image_size_px[0]
    if rig.provenance.held_out_px > (most_px := _Settings.max_held_out * width):
        reasons.append(
            f"views that were not fitted are off by {rig.provenance.held_out_px:.2f} px, {most_px:.2f} px is "
            "the most. Is the board flat and held still, the right lens model chosen, focus fixed?"
        )
    sigma = dict(zip(rig.names, rig.sigma.tolist(), strict=True))
    value = dict(zip(rig.names, rig.vector.tolist(), strict=True))
    for eye in ("left", "right")[: len(rig.serials)]:
        whose = f"{eye} " if len(rig.serials) > 1 else ""
        focal = max(sigma[f"{eye}.f{axis}_px"] / value[f"{eye}.f{axis}_px"] for axis in "xy")
        if focal > _Settings.max_sigma:
            reasons.append(
                f"the {whose}focal length is known to {focal:.1%} only. Take views with the board tilted more"
            )
        centre = max(sigma[f"{eye}.c{axis}_px"] for axis in "xy")
        if centre > _Settings.max_centre_sigma * width:
            reasons.append(
                f"the {whose}principal point is known to {centre:.1f} px only. Take tilted views near corners"
            )
    try:
        _ = Rectification(rig).calibration
    except CalibrationError as error:
        reasons.append(str(error))
    if not isinstance(rig, StereoRig):
        return reasons
    share = rig.baseline_sigma_m / rig.baseline_m
    if share > _Settings.max_sigma:
        reasons.append(
            f"the baseline is known to {share:.1%} only. Take more views that both eyes see, near and tilted"
        )
    return reasons


def baseline_contradiction(rig: StereoRig, baseline_m: float) -> str | None:
    """Return a message if the baseline measured by hand contradicts the calibrated one, otherwise None."""
    allowed = np.hypot(3.0 * rig.baseline_sigma_m, _Settings.max_hand_error_m)
    ratio = baseline_m / rig.baseline_m
    if abs(baseline_m - rig.baseline_m) <= allowed:
        return None
    return (
        f"the baseline is {1e3 * rig.baseline_m:.2f} ± {2e3 * rig.baseline_sigma_m:.2f} mm if a square is what was "
        f"said; by hand it is {1e3 * baseline_m:.2f} mm, which would make the squares {ratio:.1%} of their size. Was "
        "the board scaled in printing? Measure the ruler on it and give --ruler-mm"
    )


def join_reasons(reasons: Sequence[str]) -> str:
    """Join the reasons into one message."""
    return reasons[0] if len(reasons) == 1 else "".join(f"\n- {reason}" for reason in reasons)
