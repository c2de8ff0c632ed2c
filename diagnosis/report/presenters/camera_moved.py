"""Present a camera that was bumped."""

from __future__ import annotations

from .evidence import over_time_since
from .presenter import FoundCause, Presenter, Workshop, pose, toml_pose


class CameraMoved(Presenter):
    """Presenter of a camera that was bumped."""

    effect = "camera_moved"
    noun = "the {seen_by} having moved"
    plot = staticmethod(over_time_since)

    def finding(self, found: FoundCause) -> str:
        moved = "was bumped" if found.seen_by == "camera" else "moved"
        return f"the {found.seen_by} {moved} by {found.moved}{found.when}"

    def remedy(self, workshop: Workshop, found: FoundCause) -> str:
        camera = workshop.robot.camera
        seen_by = "instrument" if workshop.robot.calibration is None else "camera"
        advice = f"Fasten the {seen_by}, and the arm's foot: one of them moved."
        if not camera.pose_known:
            return f"{advice} Calibrate its pose again with what was measured since."
        T = camera.pose @ workshop.pose_of("camera_pose") @ pose(found.numbers)
        return f"{advice} Since then its pose in robot.toml is {toml_pose(T)}."
