"""Present a marker at another position on the hand."""

from __future__ import annotations

import numpy as np

from .presenter import FoundCause, Presenter, Workshop, listed, pose


class ToolOffset(Presenter):
    """Presenter of a marker at another position on the hand."""

    effect = "tool_offset"
    noun = "a wrong place of the marker"

    def finding(self, found: FoundCause) -> str:
        return f"the marker sits {found.shift} beside its place on the hand"

    def remedy(self, workshop: Workshop, found: FoundCause) -> str:
        marker = listed(np.array(workshop.robot.robot.marker_xyz) + pose(found.numbers)[:3, 3])
        return f"In robot.toml: marker_xyz = {marker}, or put the marker back to where it was."
