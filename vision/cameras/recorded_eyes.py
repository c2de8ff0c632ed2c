"""Playback of recorded images of one eye or two."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

import numpy as np

from bodyschema.interfaces.errors import ConfigError, SourceEnded, SourceError
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.records import FloatArray, ImageArray, StereoFrame, frozen_array
from bodyschema.robot.limited import read_at_most

from .image_monitor import exposure_fault

MAX_QUOTED_CHARS = 200  # characters of a message that quotes a line of a file


class FrameReader(Protocol):
    """Recorded images of one eye or two, in order."""

    @property
    def t(self) -> FloatArray:
        """Times [s], strictly increasing, shape (n,)."""
        ...

    @property
    def t_sigma(self) -> FloatArray:
        """Time between the two eyes' images [s], shape (n,)."""
        ...

    @property
    def image_size_px(self) -> tuple[int, int]: ...
    @property
    def serials(self) -> tuple[str, ...]: ...

    def open(self, place: int) -> None:
        """Prepare to read the pair at `place`."""

    def close(self) -> None: ...

    def next(self) -> tuple[ImageArray, ...]:
        """Return the next pair; raise SourceError if it cannot be read."""
        ...


class RecordedEyes:
    """`StereoEyes` that plays recorded images. Closing and reopening continues after the last image read.

    At a speed above 0 the times are the clock's, the first pair is due when the film is opened, and pairs not read in
    time are skipped, as with a camera. At speed 0 the times are those of the recording, pairs are returned as fast as
    they are read, and none is skipped.
    """

    def __init__(
        self,
        # creates the roll on first use; ConfigError or SourceError if files are missing or wrong
        reader: Callable[[], FrameReader],
        clock: Clock,
        *,
        speed: float,
        # latency_s, sigma_s: subtracted from the times [s], and 1-sigma added to theirs
        latency_s: float = 0.0,
        sigma_s: float = 0.0,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Prepare the playback without opening files."""
        self._create_reader, self._clock, self._sleep = reader, clock, sleep
        self._speed, self._latency_s, self._sigma_s = speed, latency_s, sigma_s
        self._reader: FrameReader | None = None
        self._is_open = False
        self._next, self._start_s = 0, 0.0
        self._shown: tuple[ImageArray, ...] = ()
        self.dropped = 0  # number of skipped pairs

    @property
    def image_size_px(self) -> tuple[int, int]:
        """Width and height of each eye's image."""
        return self._opened_reader.image_size_px

    @property
    def serials(self) -> tuple[str, ...]:
        """Files of each eye."""
        return self._opened_reader.serials

    @property
    def health(self) -> tuple[str, ...]:
        """Exposure problems of the last pair; all other problems with files are errors."""
        names = ("left eye", "right eye") if len(self._shown) > 1 else ("camera",)
        light = (exposure_fault(image, name) for name, image in zip(names, self._shown, strict=False))
        return tuple(text for text in light if text is not None)

    @property
    def _opened_reader(self) -> FrameReader:
        if self._reader is None:
            self._reader = self._create_reader()
        return self._reader

    def __enter__(self) -> Self:
        reader = self._opened_reader
        reader.open(self._next)
        self._is_open = True
        if self._speed and self._next < len(reader.t):
            self._start_s = self._clock.now() - float(reader.t[self._next] - reader.t[0]) / self._speed
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._is_open:
            self._is_open = False
            self._opened_reader.close()

    def read(self, timeout_s: float) -> StereoFrame | None:
        """Return the next pair of images, or None if none was due within `timeout_s`.

        Raises:
            SourceEnded: there are no more images.
        """
        if not self._is_open:
            raise SourceError("the images are not open")
        reader = self._opened_reader
        if self._next >= len(reader.t):
            raise SourceEnded("the images are through")
        if self._speed and not self._is_due(timeout_s):
            return None
        images = reader.next()
        if self._speed:
            images = self._skip_to_due(images)
        place, self._next, self._shown = self._next, self._next + 1, images
        t = self._due_s(place) if self._speed else float(reader.t[place])
        sigma = float(np.hypot(reader.t_sigma[place], self._sigma_s))
        return StereoFrame(t - self._latency_s, images[0], images[1] if len(images) > 1 else None, sigma)

    def _due_s(self, place: int) -> float:
        return self._start_s + float(self._opened_reader.t[place] - self._opened_reader.t[0]) / self._speed

    def _is_due(self, timeout_s: float) -> bool:
        wait_s = self._due_s(self._next) - self._clock.now()
        if wait_s > 0:
            self._sleep(min(wait_s, timeout_s))
        return wait_s <= timeout_s

    def _skip_to_due(self, images: tuple[ImageArray, ...]) -> tuple[ImageArray, ...]:
        """Return the newest pair that is due."""
        now = self._clock.now()
        while self._next + 1 < len(self._opened_reader.t) and self._due_s(self._next + 1) <= now:
            self._next += 1
            self.dropped += 1
            images = self._opened_reader.next()
        return images


def read_times(file: Path, count: int) -> FloatArray:
    """Read the times in a text file [s], the first number of each line; # begins a comment.

    Raises:
        ConfigError: the file cannot be read, does not have `count` times, or they do not increase.
    """
    try:
        lines = [line.split("#")[0].replace(",", " ").split() for line in read_at_most(file).decode().splitlines()]
        times = np.array([float(words[0]) for words in lines if words])
    except (OSError, ValueError) as error:
        remedy = "Write one time in seconds a line"
        raise ConfigError(
            f"the times cannot be read: {str(error)[:MAX_QUOTED_CHARS]}", file=file, remedy=remedy
        ) from error
    if len(times) != count:
        raise ConfigError(f"has {len(times)} times for {count} pairs of images", file=file, remedy="Give one for each")
    return require_increasing(times, file)


def require_increasing(times: FloatArray, file: Path) -> FloatArray:
    """Return `times`; raise ConfigError with the first one that is not later than its predecessor."""
    wrong = np.flatnonzero(~(np.diff(times) > 0))
    if len(wrong) or not np.isfinite(times).all():
        place = int(wrong[0]) + 2 if len(wrong) else int(np.argmin(np.isfinite(times))) + 1
        raise ConfigError(f"time {place} is not later than the one before", file=file, remedy="Put them in order")
    return frozen_array(times)
