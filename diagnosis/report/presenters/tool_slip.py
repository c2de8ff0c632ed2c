"""Present a marker that slipped on the hand."""

from __future__ import annotations

import numpy as np

from .evidence import over_time_since
from .presenter import FoundCause, Presenter, Workshop, listed, pose


class ToolSlip(Presenter):
    """Presenter of a marker that slipped on the hand."""

    effect = "tool_slip"
    noun = "a marker that slipped"
    plot = staticmethod(over_time_since)

    def finding(self, found: FoundCause) -> str:
        return f"the marker slipped by {found.shift}{found.when}"

    def remedy(self, workshop: Workshop, found: FoundCause) -> str:
        robot = workshop.robot.robot
        if not robot.marker_known:
            return "Fasten the marker: it slipped on the hand."
        shift = pose(found.numbers)[:3, 3] + workshop.pose_of("tool_offset")[:3, 3]
        marker = listed(np.array(robot.marker_xyz) + shift)
        return f"Fasten the marker: it slipped on the hand. What was measured since needs marker_xyz = {marker}."
