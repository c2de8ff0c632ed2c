"""Present a lens that refocused."""

from __future__ import annotations

from .plots import over_time_since
from .presenter import Found, Presenter, Workshop


class CameraRefocused(Presenter):
    """Present a lens that refocused."""

    effect = "camera_refocused"
    noun = "a lens that refocused"
    plot = staticmethod(over_time_since)

    def finding(self, found: Found) -> str:
        return f"a lens refocused: its focal length changed by {100 * found.numbers['focal_error']:+.3g} %{found.when}"

    def remedy(self, workshop: Workshop, found: Found) -> str:
        return "Switch autofocus off: set focus in [vision.cameras.…]. Then calibrate the cameras again."
