"""Present a marker that slipped on the hand."""

from __future__ import annotations

import numpy as np

from bodyschema.diagnosis.report.panels import Panel
from bodyschema.diagnosis.report.residuals import Residuals
from bodyschema.effects import Effect

from .evidence import over_time_since
from .presenter import FoundCause, Presenter, Workshop, listed, pose


class ToolSlip(Presenter):
    """Present a marker that slipped on the hand."""

    effect = "tool_slip"
    noun = "a marker that slipped"

    def finding(self, found: FoundCause) -> str:
        return f"the marker slipped by {found.shift}{found.when}"

    def remedy(self, workshop: Workshop, found: FoundCause) -> str:
        robot = workshop.robot.robot
        if not robot.marker_known:
            return "Fasten the marker: it slipped on the hand."
        shift = pose(found.numbers)[:3, 3] + workshop.pose_of("tool_offset")[:3, 3]
        marker = listed(np.array(robot.marker_xyz) + shift)
        return f"Fasten the marker: it slipped on the hand. What was measured since needs marker_xyz = {marker}."

    def panel(self, residuals: Residuals, effect: Effect) -> Panel:
        return over_time_since(residuals, effect)
