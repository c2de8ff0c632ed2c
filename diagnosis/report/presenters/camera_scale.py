"""Present a wrong scale of the measurements."""

from __future__ import annotations

from .evidence import by_distance
from .presenter import FoundCause, Presenter, Workshop


class CameraScale(Presenter):
    """Presenter of a wrong scale of the measurements."""

    effect = "camera_scale"
    noun = "a wrong scale of all that is measured"
    plot = staticmethod(by_distance)

    def finding(self, found: FoundCause) -> str:
        error = found.numbers["scale_error"]
        description = f"all that is measured is {100 * abs(error):.3g} % too {'large' if error > 0.0 else 'small'}"
        return (
            description
            if found.seen_by != "camera"
            else f"{description}: a tag, ball or board has another size than stated"
        )

    def remedy(self, workshop: Workshop, found: FoundCause) -> str:
        factor, calibration = 1.0 + found.numbers["scale_error"], workshop.robot.calibration
        if calibration is None:
            return (
                f"Divide what is measured by {factor:.5f}: the instrument's scale is off, or all links of the URDF are."
            )
        if not calibration.is_stereo:
            return (
                f"Measure the marker again: its side_m (or radius_m) in robot.toml seems to be {factor:.5f} times what "
                "it is."
            )
        return (
            f"Measure the squares of the calibration board and calibrate the stereo pair again; or set baseline_m = "
            f"{calibration.baseline_m / factor:.6g} in robot.toml."
        )
