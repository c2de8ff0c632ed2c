"""Present a link that differs from the URDF."""

from __future__ import annotations

from collections.abc import Mapping

from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.rpy import rpy_of

from .presenter import FoundCause, Presenter, Workshop, pose, short


class LinkGeometry(Presenter):
    """Presenter of a link that differs from the URDF."""

    effect = "link_geometry"
    noun = "a wrong link before joint {joint}"

    def finding(self, found: FoundCause) -> str:
        shifts = {axis: found.numbers[f"{axis}_m"] for axis in found.shifts}
        turns = {axis: found.numbers[f"r{axis}_rad"] for axis in found.turns}
        parts = ((found.shift, "in", shifts), (found.turn, "about", turns))
        said = [f"{amount}{_axes(how, axes)}" for amount, how, axes in parts if axes]
        between = ", and " if "," in said[0] else " and "
        return f"the link before {found.at} is off by {between.join(said)}"

    def remedy(self, workshop: Workshop, found: FoundCause) -> str:
        origin = workshop.robot.tree.joint(found.where or "").T_parent_joint @ pose(found.numbers)
        return f"In the URDF, give joint {found.where} the {_origin(origin)}{workshop.in_urdf}."


def _axes(how: str, amounts: Mapping[str, float]) -> str:
    """Return the axes of its frame along or about which a link is off; empty for all three."""
    # A smaller one is left out: it changes the size of all by less than 2 %.
    least = 0.2 * max(map(abs, amounts.values()))
    axes = [axis for axis, amount in amounts.items() if abs(amount) >= least]
    if len(axes) == len("xyz"):
        return ""
    return f"{', mainly' if len(axes) < len(amounts) else ''} {how} {' and '.join(axes)}"


def _origin(T: FloatArray) -> str:
    xyz, rpy = (" ".join(short(v, 6) for v in part.tolist()) for part in (T[:3, 3], rpy_of(T[:3, :3])))
    return f'origin xyz="{xyz}" rpy="{rpy}"'
