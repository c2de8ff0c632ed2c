"""Present a link that differs from the URDF."""

from __future__ import annotations

from collections.abc import Sequence

from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.rpy import rpy_of

from .presenter import Found, Presenter, Workshop, pose, short


class LinkGeometry(Presenter):
    """Present a link that differs from the URDF."""

    effect = "link_geometry"
    noun = "a wrong link before joint {joint}"

    def finding(self, found: Found) -> str:
        parts = ((found.shift, "in", found.shifts), (found.turn, "about", found.turns))
        said = [f"{amount}{_axes(how, axes)}" for amount, how, axes in parts if axes]
        return f"the link before {found.at} is off by {' and '.join(said)}"

    def remedy(self, workshop: Workshop, found: Found) -> str:
        origin = workshop.robot.tree.joint(found.where or "").T_parent_joint @ pose(found.numbers)
        return f"In the URDF, give joint {found.where} the {_origin(origin)}{workshop.in_urdf}."


def _axes(how: str, axes: Sequence[str]) -> str:
    """Return along or about which axes of its frame a link is off; empty for all three."""
    return "" if len(axes) == len("xyz") else f" {how} {' and '.join(axes)}"


def _origin(T: FloatArray) -> str:
    xyz, rpy = (" ".join(short(v, 6) for v in part.tolist()) for part in (T[:3, 3], rpy_of(T[:3, :3])))
    return f'origin xyz="{xyz}" rpy="{rpy}"'
