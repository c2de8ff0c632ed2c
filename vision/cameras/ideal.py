"""Cameras whose images are already rectified."""

from __future__ import annotations

from types import TracebackType
from typing import Self

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.protocols import StereoEyes
from bodyschema.interfaces.records import StereoFrame


class IdealCamera:
    """A `StereoCamera` of the eyes in [camera]: ideal pinholes side by side, or a single one."""

    def __init__(self, eyes: StereoEyes, calibration: StereoCalibration) -> None:
        self._eyes, self._calibration = eyes, calibration

    @property
    def calibration(self) -> StereoCalibration:
        """The calibration of the images."""
        return self._calibration

    def __enter__(self) -> Self:
        self._eyes.__enter__()
        if len(self._eyes.serials) != len(self._calibration.eyes_m):
            self._eyes.__exit__(None, None, None)
            raise ConfigError(
                f"[vision.cameras] has {_eyes(len(self._eyes.serials))}, [camera] describes "
                f"{_eyes(len(self._calibration.eyes_m))}",
                remedy="Write eyes = 1 in [camera] for one camera alone, without baseline_m; else name two cameras",
            )
        if self._eyes.image_size_px != self._calibration.image_size_px:
            self._eyes.__exit__(None, None, None)
            has, wants = (_words(eyes.image_size_px) for eyes in (self._eyes, self._calibration))
            raise ConfigError(
                f"the cameras' images have {has} pixels, but [camera] image_size_px says {wants}",
                remedy="Make both the same, or let `bodyschema calibrate cameras` write a calibration file",
            )
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._eyes.__exit__(kind, error, trace)

    def read(self, timeout_s: float) -> StereoFrame | None:
        """Return the next frame; None if none came within `timeout_s`. Raise the errors of the eyes."""
        return self._eyes.read(timeout_s)


def _eyes(count: int) -> str:
    return "one eye" if count == 1 else "two eyes"


def _words(size_px: tuple[int, int]) -> str:
    return f"{size_px[0]}x{size_px[1]}"
