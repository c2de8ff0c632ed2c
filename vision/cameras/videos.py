"""Play films in place of cameras."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from bodyschema.interfaces.errors import ConfigError, SourceError
from bodyschema.interfaces.extras import install_command
from bodyschema.interfaces.records import FloatArray, ImageArray, frozen_array

from .config import VideosConfig
from .recorded_eyes import read_times

_AV1 = int.from_bytes(b"AV01", "little")
_CONVERT = "`ffmpeg -i OLD.mp4 -c:v libx264 -crf 18 NEW.mp4`"


class _VideoDecoder(Protocol):
    """The subset of cv2.VideoCapture in use."""

    def grab(self) -> bool: ...

    def read(self) -> tuple[bool, Any]: ...

    def get(self, prop: int, /) -> float: ...

    def release(self) -> None: ...


class _Av1Decoder:
    """An AV1 film decoded by PyAV, since OpenCV's wheels cannot decode it."""

    def __init__(self, file: Path) -> None:
        try:
            av = importlib.import_module("av")
        except ImportError as error:
            remedy = f"Type: {install_command('av1')}. Or convert it: {_CONVERT}"
            raise ConfigError("is in AV1, which OpenCV cannot decode", file=file, remedy=remedy) from error
        self._container = av.open(str(file))
        stream = self._container.streams.video[0]
        stream.thread_type = "AUTO"
        self._frames = self._container.decode(stream)
        self._told = {
            cv2.CAP_PROP_FRAME_WIDTH: float(stream.width),
            cv2.CAP_PROP_FRAME_HEIGHT: float(stream.height),
            cv2.CAP_PROP_FPS: float(stream.average_rate or 0.0),
        }

    def grab(self) -> bool:
        return next(self._frames, None) is not None

    def read(self) -> tuple[bool, ImageArray | None]:
        frame = next(self._frames, None)
        return (False, None) if frame is None else (True, frame.to_ndarray(format="bgr24"))

    def get(self, prop: int, /) -> float:
        return self._told[prop]

    def release(self) -> None:
        self._container.close()


def _video_capture(file: Path) -> _VideoDecoder:
    capture = cv2.VideoCapture(str(file))
    if round(capture.get(cv2.CAP_PROP_FOURCC)) != _AV1:
        return capture
    capture.release()
    return _Av1Decoder(file)


class VideoReader:
    """Two films, the film of a single camera, or a film whose frames contain both eyes' images.

    Attributes:
        t: times [s] (n,). t_sigma: zeros (n,).
        image_size_px: size of each eye's image. serials: the file of each eye.
    """

    def __init__(self, config: VideosConfig, folder: Path) -> None:
        """Read the sizes of the files, and count their frames.

        Raises:
            ConfigError: a file is missing or not a readable video, or the two differ in size.
        """
        both = config.side_by_side
        self._files = [folder / name for name in ((both,) if both else (config.left, config.right)) if name]
        eyes = [str(name) for name in (config.left, config.right) if name is not None]
        self.serials = (f"{both}/left", f"{both}/right") if both else tuple(eyes)
        self._captures: list[_VideoDecoder] = []
        sizes, counts, rates = zip(*(_measured(file) for file in self._files), strict=True)
        if len(set(sizes)) > 1:
            said = " and ".join(f"{width}x{height}" for width, height in sizes)
            raise ConfigError(
                f"the two films are of different sizes: {said} pixels",
                file=self._files[1],
                remedy="Set both cameras to one resolution",
            )
        width, height = sizes[0]
        if both and width % 2:
            raise ConfigError(f"{width} pixels cannot be two images side by side", file=self._files[0])
        self._is_split = both is not None
        self.image_size_px = (width // 2, height) if both else (width, height)
        count = min(counts)
        self.t = self._times(config, folder, count, rates[0])
        self.t_sigma = frozen_array(np.zeros(count))

    def _times(self, config: VideosConfig, folder: Path, count: int, rate_hz: float) -> FloatArray:
        if config.times is not None:
            return read_times(folder / config.times, count)
        fps = config.fps or rate_hz
        if not fps > 0:
            raise ConfigError("the film does not say how fast it was taken", file=self._files[0], remedy="Give fps")
        return frozen_array(np.arange(count) / fps)

    def open(self, place: int) -> None:
        """Prepare to read the pair at `place`."""
        self._captures = [_video_capture(file) for file in self._files]
        for _ in range(place):  # seeking is not exact in every film
            for capture in self._captures:
                capture.grab()

    def close(self) -> None:
        """Close the files."""
        for capture in self._captures:
            capture.release()
        self._captures = []

    def next(self) -> tuple[ImageArray, ...]:
        """Return the next image of each eye; raise SourceError if the film is damaged."""
        images: list[ImageArray] = []
        for file, capture in zip(self._files, self._captures, strict=True):
            is_there, image = capture.read()
            if not is_there:
                raise SourceError(f"{file} is damaged, or shorter than it says")
            images.append(np.asarray(image, np.uint8))
        if not self._is_split:
            return tuple(images)
        width = self.image_size_px[0]
        return np.ascontiguousarray(images[0][:, :width]), np.ascontiguousarray(images[0][:, width:])


def _measured(file: Path) -> tuple[tuple[int, int], int, float]:
    """Return the size of the frames, the number that can be read, and their rate [1/s]."""
    if not file.is_file():
        raise ConfigError("there is no such film", file=file, remedy="Files are named relative to robot.toml")
    capture = _video_capture(file)
    try:
        count = 0
        while capture.grab():  # the file's own metadata is often wrong
            count += 1
        size = round(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), round(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        rate_hz = capture.get(cv2.CAP_PROP_FPS)
    finally:
        capture.release()
    if not count:
        raise ConfigError("is not a readable video", file=file, remedy=f"Convert it: {_CONVERT}")
    return size, count, rate_hz
