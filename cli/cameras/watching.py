"""Watch cameras: encode each picture and pass it on."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Protocol, Self

import cv2

from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import ConfigError, SourceEnded
from bodyschema.interfaces.protocols import Clock, Source
from bodyschema.interfaces.records import ImageArray

QUALITY = 85


class Pictures(Source, Protocol):
    """Pictures of cameras; see `bodyschema.vision.cameras.watched.WatchedCamera`."""

    @property
    def said(self) -> str: ...
    def read(self, timeout_s: float) -> ImageArray | None: ...


class Watching:
    """Reads pictures until a stop is requested, there are no more, or enough were shown."""

    def __init__(
        self,
        pictures: Pictures,
        show: Callable[[bytes], None],
        *,
        every_s: float = 0.0,
        count: int | None = None,
        clock: Clock | None = None,
    ) -> None:
        """Store the settings; the caller of `step` opens `pictures`.

        Args:
            show: called with each picture as JPEG.
            every_s: minimum interval between pictures [s].
            count: number of pictures to show.
        """
        self._pictures, self._show, self._every_s = pictures, show, every_s
        self._clock = SystemClock() if clock is None else clock
        self._left = math.inf if count is None else count
        self._next_s = -math.inf
        self._stopping = False

    @classmethod
    def into(cls, folder: Path, pictures: Pictures, *, every_s: float, count: int | None) -> Self:
        """Write pictures into files 000001.jpg and so on. ConfigError if the folder cannot be created."""
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"cannot be made: {error.strerror}", file=folder, remedy="Give another --out") from error
        numbers = itertools.count(1)
        return cls(
            pictures,
            lambda jpeg: _write(folder / f"{next(numbers):06}.jpg", jpeg),
            every_s=every_s,
            count=count,
        )

    def stop(self) -> None:
        """Request that `step` ends. Only sets a flag."""
        self._stopping = True

    def step(self, timeout_s: float) -> bool:
        """Show the next picture, if one arrives in time; return False if there will be no more."""
        if self._stopping or self._left <= 0:
            return False
        try:
            picture = self._pictures.read(timeout_s)
        except SourceEnded:
            return False
        now = self._clock.now()
        if picture is not None and now >= self._next_s:
            self._next_s = now + self._every_s
            self._left -= 1
            self._show(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes())
        return True

    @property
    def said(self) -> str:
        """Share of frames in which the marker was found, and the reasons in the others."""
        return self._pictures.said


def _write(file: Path, data: bytes) -> None:
    try:
        file.write_bytes(data)
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", file=file, remedy="Give another --out") from error
