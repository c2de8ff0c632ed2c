"""Present a lens that refocused."""

from __future__ import annotations

from .evidence import over_time_since
from .presenter import FoundCause, Presenter, Workshop


class CameraRefocused(Presenter):
    """Presenter of a lens that refocused."""

    effect = "camera_refocused"
    noun = "a lens that refocused"
    plot = staticmethod(over_time_since)

    def finding(self, found: FoundCause) -> str:
        return f"a lens refocused: its focal length changed by {100 * found.numbers['focal_error']:+.3g} %{found.when}"

    def remedy(self, workshop: Workshop, found: FoundCause) -> str:
        return "Switch autofocus off: set focus in [vision.cameras.…]. Then calibrate the cameras again."
