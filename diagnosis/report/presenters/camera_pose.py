"""Present a wrong camera pose."""

from __future__ import annotations

from .presenter import FoundCause, Presenter, Workshop, pose, toml_pose


class CameraPose(Presenter):
    """Presenter of a wrong camera pose."""

    effect = "camera_pose"
    noun = "a wrong place of the {seen_by}"

    def finding(self, found: FoundCause) -> str:
        return f"the {found.seen_by} stands {found.moved} off"

    def remedy(self, workshop: Workshop, found: FoundCause) -> str:
        return f"In [camera] of robot.toml: {toml_pose(workshop.robot.camera.pose @ pose(found.numbers))}."
