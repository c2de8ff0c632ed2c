"""Triangulation from both eyes' unrectified images."""

from __future__ import annotations

import numpy as np

from bodyschema.interfaces.records import FloatArray

from .stereo_rig import StereoRig


def triangulated(rig: StereoRig, left_px: FloatArray, right_px: FloatArray) -> FloatArray:
    """Return points (n, 3) [m] in the left camera's own frame, seen at (n, 2) [px] by each eye.

    The middle of the shortest line between both rays.
    """
    a = np.column_stack([rig.left.directions(left_px), np.ones(len(left_px))])
    b = np.column_stack([rig.right.directions(right_px), np.ones(len(right_px))]) @ rig.R_right_left
    eye = -rig.R_right_left.T @ rig.translation_m
    aa, bb, ab = (np.einsum("ni,ni->n", *pair) for pair in ((a, a), (b, b), (a, b)))
    ae, be = a @ eye, b @ eye
    nearness = aa * bb - ab**2
    along_a = (ae * bb - ab * be) / nearness
    along_b = (ab * ae - aa * be) / nearness
    return 0.5 * (along_a[:, None] * a + eye + along_b[:, None] * b)
