"""Present a wrong focal length."""

from __future__ import annotations

from .evidence import by_distance
from .presenter import FoundCause, Presenter, Workshop


class CameraFocal(Presenter):
    """Presenter of a wrong focal length."""

    effect = "camera_focal"
    noun = "a wrong focal length"
    plot = staticmethod(by_distance)

    def finding(self, found: FoundCause) -> str:
        return f"the focal length is {100 * found.numbers['focal_error']:+.3g} % off: depth is scaled"

    def remedy(self, workshop: Workshop, found: FoundCause) -> str:
        assert workshop.robot.calibration is not None
        focal = workshop.robot.calibration.focal_px * (1.0 + found.numbers["focal_error"])
        return f"Calibrate the cameras again; or set focal_px = {focal:.6g} in robot.toml."
