"""Cameras for `shim.c`: files that OpenCV opens like devices if the shim is preloaded."""

from __future__ import annotations

import math
import mmap
import os
import shutil
import struct
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

import cv2
import numpy as np

HERE = Path(__file__).parent
FRAMES_AT = 4096
HEADER = struct.Struct("<8s4I3d6I")
FIELDS = (
    *("magic", "width", "height", "fourcc", "count", "fps", "told_fps", "phase"),
    *("unplugged", "stamps", "torn_every", "silent", "served", "controls"),
)
CONTROL = struct.Struct("<2I4i")
PLACE = struct.Struct("<2Q")
MONOTONIC, ZERO, WALL_CLOCK = range(3)

# Their numbers in linux/v4l2-controls.h, with least and most and the value at the start.
CONTROLS: dict[str, tuple[int, int, int, int]] = {
    "gain": (0x00980913, 0, 255, 64),
    "auto_wb": (0x0098090C, 0, 1, 1),
    "wb_temperature": (0x0098091A, 2800, 6500, 4000),
    "auto_exposure": (0x009A0901, 0, 3, 3),
    "exposure": (0x009A0902, 3, 2047, 250),
    "focus": (0x009A090A, 0, 250, 0),
    "autofocus": (0x009A090C, 0, 1, 1),
}


def compiled(folder: Path) -> Path | None:
    """Compile the shim into `folder`; return None if there is no compiler or no V4L2 header."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None or not Path("/usr/include/linux/videodev2.h").exists():
        return None
    library = folder / "shim.so"
    flags = ["-shared", "-fPIC", "-O1", "-Wall", "-Wextra", "-Wno-switch", "-Werror"]
    subprocess.run([compiler, *flags, HERE / "shim.c", "-o", library, "-ldl", "-lpthread", "-lm"], check=True)
    return library


def preloaded(library: Path) -> dict[str, str]:
    """Return the environment of a process that sees the cameras."""
    return {**os.environ, "LD_PRELOAD": str(library)}


class ShimCamera:
    """One camera: its file and its faults, which may change while it is read.

    At a time t of CLOCK_MONOTONIC it shows image floor(t·fps − phase) modulo their number.
    """

    def __init__(
        self,
        file: Path,
        images: Sequence[np.ndarray],
        *,
        fps: float = 30.0,
        told_fps: float | None = None,
        phase: float = 0.0,
        fourcc: str = "MJPG",
        without: Sequence[str] = (),
    ) -> None:
        """Write the file.

        Args:
            told_fps: frame rate that it reports. without: controls that it does not have.
        """
        self.file = file
        height, width = images[0].shape[:2]
        frames = [_encoded(image, fourcc) for image in images]
        controls = {name: control for name, control in CONTROLS.items() if name not in without}
        self._places = {name: place for place, name in enumerate(controls)}
        code = cv2.VideoWriter.fourcc(*fourcc)
        told = fps if told_fps is None else told_fps
        values = (b"V4L2SHIM", width, height, code, len(frames), fps, told, phase, 0, 0, 0, 0, 0, len(controls))
        header = HEADER.pack(*values)
        for id, least, most, value in controls.values():
            header += CONTROL.pack(id, 0, least, most, value, 0)
        at = FRAMES_AT + PLACE.size * len(frames)
        places = b""
        for frame in frames:
            places += PLACE.pack(at, len(frame))
            at += len(frame)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(header.ljust(FRAMES_AT, b"\0") + places + b"".join(frames))

    def __enter__(self) -> Self:
        with self.file.open("r+b") as stream:
            self._memory = mmap.mmap(stream.fileno(), 0)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._memory.close()

    def set(self, **fields: float) -> None:
        """Change fields of the header: unplugged, stamps, torn_every, silent, fps."""
        values = dict(zip(FIELDS, HEADER.unpack_from(self._memory), strict=True)) | fields
        HEADER.pack_into(self._memory, 0, *values.values())

    @property
    def served(self) -> int:
        """Number of frames taken."""
        return HEADER.unpack_from(self._memory)[FIELDS.index("served")]

    def control(self, name: str) -> int:
        """Return the value of a control."""
        return CONTROL.unpack_from(self._memory, self._place(name))[4]

    def make_deaf(self, name: str) -> None:
        """Make the control keep its value whatever is written to it."""
        id, _, *rest = CONTROL.unpack_from(self._memory, self._place(name))
        CONTROL.pack_into(self._memory, self._place(name), id, 1, *rest)

    def _place(self, name: str) -> int:
        return HEADER.size + CONTROL.size * self._places[name]


class LiveCamera(ShimCamera):
    """A camera whose images are rendered while it runs, each `latency_s` before its time stamp.

    An image that is not rendered in time is shown empty, as at the beginning.

    Attributes:
        drawn: number of images that were in time.
    """

    SLOTS = 8

    def __init__(
        self,
        file: Path,
        blank: np.ndarray,
        draw: Callable[[float], np.ndarray],
        *,
        fps: float,
        latency_s: float,
        settled_s: float = 0.02,
    ) -> None:
        """Write the file.

        Args:
            draw: returns the image at a time of CLOCK_MONOTONIC.
            latency_s: shorter than SLOTS / 2 frames.
            settled_s: delay from an image's time to its rendering, by which all data of that time are known.
        """
        super().__init__(file, [blank] * self.SLOTS, fps=fps, fourcc="YUYV")
        self._blank, self._draw, self._fps = _encoded(blank, "YUYV"), draw, fps
        self._latency_s, self._settled_s = latency_s, settled_s
        self.drawn = 0
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="live camera")

    def __enter__(self) -> Self:
        super().__enter__()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ending.set()
        self._thread.join()
        super().__exit__(kind, error, trace)

    def _run(self) -> None:
        number = math.ceil((time.monotonic() + self._latency_s) * self._fps)
        while not self._ending.is_set():
            taken_s = number / self._fps - self._latency_s
            if self._ending.wait(max(taken_s + self._settled_s - time.monotonic(), 0.0)):
                return
            self._put(number + self.SLOTS // 2, self._blank)
            if time.monotonic() < number / self._fps:
                frame = _encoded(self._draw(taken_s), "YUYV")
                if time.monotonic() < number / self._fps:
                    self._put(number, frame)
                    self.drawn += 1
            number += 1

    def _put(self, number: int, frame: bytes) -> None:
        at, _ = PLACE.unpack_from(self._memory, FRAMES_AT + PLACE.size * (number % self.SLOTS))
        self._memory[at : at + len(frame)] = frame


def _encoded(image: np.ndarray, fourcc: str) -> bytes:
    if fourcc == "MJPG":
        return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
    return cv2.cvtColor(image, cv2.COLOR_BGR2YUV_YUYV).tobytes()
