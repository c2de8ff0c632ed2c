"""Settings of a camera: write them, and report those that it did not accept."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from bodyschema.interfaces.errors import SourceError
from bodyschema.vision.cameras.config import SideBySideConfig, UvcSettings
from bodyschema.vision.cameras.image_monitor import LookSettings

EXPOSURE_UNIT_S = 1e-4  # V4L2_CID_EXPOSURE_ABSOLUTE
MANUAL_EXPOSURE = 1  # V4L2_EXPOSURE_MANUAL
ROUNDING = 0.05  # cameras round to their own steps


class VideoCapture(Protocol):
    """Subset of cv2.VideoCapture in use."""

    def isOpened(self) -> bool: ...
    def set(self, propId: int, value: float, /) -> bool: ...
    def get(self, propId: int, /) -> float: ...
    def grab(self) -> bool: ...
    def retrieve(self) -> tuple[bool, np.ndarray]: ...
    def release(self) -> None: ...


@dataclass(frozen=True, slots=True)
class _Control:
    """One setting: key, automatic mode as (property, value for off), property, value, and the key's unit."""

    key: str
    automatic: tuple[int, float] | None
    property: int
    value: float | None
    unit: float = 1.0


def raw_size_px(settings: UvcSettings) -> tuple[int, int]:
    """Return width and height of the image that the device sends."""
    width, height = settings.image_size_px
    return (2 * width, height) if isinstance(settings, SideBySideConfig) else (width, height)


def apply(capture: VideoCapture, settings: UvcSettings, name: str) -> list[str]:
    """Apply `settings` to the camera and return a message for each that it did not accept.

    Raises:
        SourceError: the size of the camera's images is not that of the calibration.
    """
    width, height = raw_size_px(settings)
    capture.set(cv2.CAP_PROP_BUFFERSIZE, settings.buffers)
    # The format comes first: it determines the available sizes, and these the rates.
    capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*settings.fourcc))
    capture.set(cv2.CAP_PROP_FRAME_WIDTH, width)
    capture.set(cv2.CAP_PROP_FRAME_HEIGHT, height)
    capture.set(cv2.CAP_PROP_FPS, settings.fps)
    got = round(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), round(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
    if got != (width, height):
        raise SourceError(
            f"the {name} sends {got[0]}x{got[1]} pixels, not {width}x{height}. Set image_size_px to what it "
            "can (`v4l2-ctl --list-formats-ext`), and calibrate at that size"
        )
    return [*_format_complaints(capture, settings, name), *_control_complaints(capture, settings, name)]


def sends_jpeg(capture: VideoCapture) -> bool:
    """Return True if images arrive compressed."""
    return _fourcc(capture) == "MJPG"


def _fourcc(capture: VideoCapture) -> str:
    code = int(capture.get(cv2.CAP_PROP_FOURCC))
    return code.to_bytes(4, "little", signed=code < 0).decode("ascii", "replace")


def _format_complaints(capture: VideoCapture, settings: UvcSettings, name: str) -> Iterator[str]:
    fourcc, fps = _fourcc(capture), capture.get(cv2.CAP_PROP_FPS)
    if fourcc != settings.fourcc:
        yield f"the {name} sends {fourcc}, not {settings.fourcc}: `v4l2-ctl --list-formats-ext` shows what it can"
    if abs(fps - settings.fps) > ROUNDING * settings.fps:
        yield (
            f"the {name} offers {fps:.3g} frames/s, not {settings.fps:g}: set fps to what it can at this size "
            "(`v4l2-ctl --list-formats-ext`)"
        )


def _controls(settings: UvcSettings) -> tuple[_Control, ...]:
    exposure = (cv2.CAP_PROP_AUTO_EXPOSURE, MANUAL_EXPOSURE)
    return (
        _Control("exposure_s", exposure, cv2.CAP_PROP_EXPOSURE, settings.exposure_s, EXPOSURE_UNIT_S),
        _Control("gain", None, cv2.CAP_PROP_GAIN, settings.gain),
        _Control("white_balance_k", (cv2.CAP_PROP_AUTO_WB, 0), cv2.CAP_PROP_WB_TEMPERATURE, settings.white_balance_k),
        _Control("focus", (cv2.CAP_PROP_AUTOFOCUS, 0), cv2.CAP_PROP_FOCUS, settings.focus),
    )


def _control_complaints(capture: VideoCapture, settings: UvcSettings, name: str) -> Iterator[str]:
    for control in _controls(settings):
        if control.value is None:
            continue
        requested = control.value / control.unit
        if control.automatic is not None:
            capture.set(*control.automatic)
            if capture.get(control.automatic[0]) != control.automatic[1]:
                yield f"the {name} does not switch its automatic for {control.key} off: see `v4l2-ctl -l`"
                continue
        capture.set(control.property, requested)
        got = capture.get(control.property)
        if abs(got - requested) > max(1.0, ROUNDING * requested):
            yield (
                f"the {name} does not take {control.key} = {control.value:g}: it has {got * control.unit:g}. "
                "`v4l2-ctl -l` shows its range"
            )


class FocusWatch:
    """Monitor of a camera's focus: detects that the camera may move its lens, or has moved it.

    After replugging, a lens may be in another position, so the very first position is the reference.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._autofocus = False
        self._first: float | None = None
        self._farthest: float | None = None
        self._read_s = -np.inf

    def look(self, capture: VideoCapture, now_s: float) -> None:
        """Read the focus of the open camera, unless it was just read."""
        if now_s - self._read_s < LookSettings.every_s:
            return
        self._read_s = now_s
        # A camera without such a control answers with 0 or -1.
        self._autofocus = self._autofocus or capture.get(cv2.CAP_PROP_AUTOFOCUS) == 1
        position = capture.get(cv2.CAP_PROP_FOCUS)
        if self._first is None or self._farthest is None:
            self._first = self._farthest = position
        elif abs(position - self._first) > abs(self._farthest - self._first):
            self._farthest = position

    def complaints(self) -> Iterator[str]:
        """Yield each problem with its remedy."""
        if self._autofocus:
            yield (
                f"the {self._name}'s autofocus is on: when its lens moves, the calibration no longer holds. Set focus "
                "in [vision.cameras.…] before calibrating"
            )
        first, farthest = self._first, self._farthest
        if first is not None and farthest is not None and abs(farthest - first) > max(1.0, ROUNDING * abs(first)):
            yield (
                f"the {self._name}'s lens moved, its focus from {first:g} to {farthest:g}: the focal length changed. "
                "Set focus in [vision.cameras.…], and calibrate again"
            )


def left_to_the_camera(settings: UvcSettings) -> list[str]:
    """Return the settings left to the camera's own control."""
    return [control.key for control in _controls(settings) if control.value is None]
