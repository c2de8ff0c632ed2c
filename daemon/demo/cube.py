"""A cube of tags on the tip of the tool, as tables of robot.toml."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from interfaces.records import FloatArray

# Side of the cube [m], and of the black squares on it as a share: the white margin of a tag is an eighth of its side.
CUBE_M, SQUARE = 0.07, 0.8


def cube_tables(towards_hand: FloatArray) -> str:
    """The tables [vision] for a cube that stands on one of its corners, six tags on it.

    The tool ends in that corner and covers none of the faces, so that three of them look back at the hand.

    Args:
        towards_hand: where the tool comes from (3,), in the marker's frame, any length.
    """
    lines = ["", "[vision]", 'marker = "cluster"', "", "[vision.tag]", f"side_m = {SQUARE * CUBE_M:.6f}"]
    on_corner = Rotation.align_vectors(towards_hand[None] / np.linalg.norm(towards_hand), np.ones((1, 3)) / np.sqrt(3))[
        0
    ]
    for id, normal in enumerate(np.vstack([np.eye(3), -np.eye(3)])):
        face = on_corner * _outward(normal)
        xyz, rpy = on_corner.apply(normal * CUBE_M / 2), face.as_euler("xyz")
        lines += ["", "[[vision.cluster.tags]]", f"id = {id}", f"xyz = {_list(xyz)}", f"rpy = {_list(rpy)}"]
    return "\n".join(lines) + "\n"


def _outward(normal: FloatArray) -> Rotation:
    """A rotation that turns z into `normal` (3,)."""
    side = np.roll(normal, 1)
    return Rotation.from_matrix(np.column_stack([side, np.cross(normal, side), normal]))


def _list(values: FloatArray) -> str:
    return "[" + ", ".join(f"{value:.9f}" for value in values) + "]"
