"""Tags on the tip of the tool, as tables of robot.toml: a single tag, or a cube of six."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from bodyschema.interfaces.records import FloatArray

# Side of the cube [m], and of its black squares as a fraction: the white margin of a tag is an eighth of its side.
CUBE_M, SQUARE = 0.07, 0.8
# Side of a single tag's black square, and its distance in front of the tool's centre line [m], clear of the stick.
TAG_M, BEFORE_M = 0.06, 0.007
FORWARD = np.array([1.0, 0.0, 0.0])


def tag_tables(towards_hand: FloatArray) -> str:
    """Return the tables [vision] for one tag along the tool's end, facing forward when the arm hangs.

    The tool is behind the tag; in front it would cover it.

    Args:
        towards_hand: direction of the tool from the marker (3,), in the marker's frame, any length, not forward.
    """
    up = towards_hand / np.linalg.norm(towards_hand)
    ahead = FORWARD - (FORWARD @ up) * up
    ahead = ahead / np.linalg.norm(ahead)
    rpy = Rotation.from_matrix(np.column_stack([np.cross(up, ahead), up, ahead])).as_euler("xyz")
    return "\n".join([*_head(TAG_M), *_tag(0, BEFORE_M * ahead, rpy)]) + "\n"


def cube_tables(towards_hand: FloatArray) -> str:
    """Return the tables [vision] for a cube that stands on one of its corners, with six tags.

    The tool ends in that corner and covers no face, so that three faces point back to the hand.

    Args:
        towards_hand: direction of the tool from the marker (3,), in the marker's frame, any length.
    """
    lines = _head(SQUARE * CUBE_M)
    on_corner = Rotation.align_vectors(towards_hand[None] / np.linalg.norm(towards_hand), np.ones((1, 3)) / np.sqrt(3))[
        0
    ]
    for id, normal in enumerate(np.vstack([np.eye(3), -np.eye(3)])):
        face = on_corner * _outward(normal)
        lines += _tag(id, on_corner.apply(normal * CUBE_M / 2), face.as_euler("xyz"))
    return "\n".join(lines) + "\n"


def _head(side_m: float) -> list[str]:
    return ["", "[vision]", 'marker = "cluster"', "", "[vision.tag]", f"side_m = {side_m:.6f}"]


def _tag(id: int, xyz: FloatArray, rpy: FloatArray) -> list[str]:
    return ["", "[[vision.cluster.tags]]", f"id = {id}", f"xyz = {_list(xyz)}", f"rpy = {_list(rpy)}"]


def _outward(normal: FloatArray) -> Rotation:
    """Return a rotation that turns z into `normal` (3,)."""
    side = np.roll(normal, 1)
    return Rotation.from_matrix(np.column_stack([side, np.cross(normal, side), normal]))


def _list(values: FloatArray) -> str:
    return "[" + ", ".join(f"{value:.9f}" for value in values) + "]"
