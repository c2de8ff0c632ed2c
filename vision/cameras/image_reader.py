"""Play image files in place of cameras."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np

from bodyschema.interfaces.errors import ConfigError, SourceError
from bodyschema.interfaces.records import FloatArray, ImageArray, frozen_array
from bodyschema.vision.image_file import read_image

from .config import ImagesConfig
from .recorded_eyes import read_times, require_increasing

NUMBER = re.compile(r"\d+(?:\.\d+)?")


class ImageReader:
    """The images that match a pattern for each eye, sorted by name; numbers in names sort as numbers.

    Attributes:
        t: times [s] (n,).
        t_sigma: time between the two eyes' images [s] (n,).
        image_size_px: width and height of each eye's image.
        serials: pattern of each eye's files, instead of a serial number.
    """

    def __init__(self, config: ImagesConfig, folder: Path) -> None:
        """Read the names and the first pair.

        Raises:
            ConfigError: there are no files, the eyes have different numbers of files, or the requested times are
                missing.
            SourceError: a file is not an image, or the two eyes' images differ in size.
        """
        patterns = (config.left,) if config.right is None else (config.left, config.right)
        self._eyes = [_files(folder, pattern) for pattern in patterns]
        if len({len(files) for files in self._eyes}) > 1:
            raise ConfigError(
                f"{config.left} are {len(self._eyes[0])} images, {config.right} are {len(self._eyes[1])}",
                file=folder,
                remedy="Give as many of each eye",
            )
        self.serials = patterns
        self.t, self.t_sigma = self._times(config, folder)
        first = [_image(files[0]) for files in self._eyes]
        if first[0].shape != first[-1].shape:
            raise SourceError(
                f"the eyes' images are of different sizes: {_size(first[0])} in {self._eyes[0][0]}, {_size(first[1])} "
                f"in {self._eyes[1][0]}. Set both cameras to one resolution"
            )
        self.image_size_px = (first[0].shape[1], first[0].shape[0])
        self._next = 0

    def _times(self, config: ImagesConfig, folder: Path) -> tuple[FloatArray, FloatArray]:
        count = len(self._eyes[0])
        together = frozen_array(np.zeros(count))
        if config.times is not None:
            return read_times(folder / config.times, count), together
        if config.name_ticks_per_s is not None:
            since = int(_ticks(self._eyes[0][0], 0))
            eyes = [[_ticks(file, since) / config.name_ticks_per_s for file in files] for files in self._eyes]
            left, right = frozen_array(eyes[0]), frozen_array(eyes[-1])
            return require_increasing(0.5 * (left + right), folder), frozen_array(np.abs(left - right))
        return frozen_array(np.arange(count) / (config.fps or 1.0)), together

    def open(self, place: int) -> None:
        """Prepare to read the pair at `place`."""
        self._next = place

    def close(self) -> None:
        """Do nothing: no file is held open."""

    def next(self) -> tuple[ImageArray, ...]:
        """Return the next image of each eye; raise SourceError if a file is not an image, or has another size."""
        files = [each[self._next] for each in self._eyes]
        images = tuple(_image(file) for file in files)
        for file, image in zip(files, images, strict=True):
            if (image.shape[1], image.shape[0]) != self.image_size_px:
                raise SourceError(f"{file} is {_size(image)}, the first image is {_words(self.image_size_px)}")
        self._next += 1
        return images


def _files(folder: Path, pattern: str) -> list[Path]:
    if Path(pattern).is_absolute():
        folder, pattern = Path("/"), str(Path(pattern).relative_to("/"))
    found = sorted(folder.glob(pattern), key=lambda file: _natural(file.name))
    if not found:
        raise ConfigError(f"no image is called {pattern}", file=folder, remedy='Give patterns like "left/*.png"')
    return found


def _natural(name: str) -> list[tuple[int, float, str]]:
    """Return a sort key that puts img_2 before img_10."""
    words = re.split(r"(\d+(?:\.\d+)?)", name)
    return [(0, float(word), "") if NUMBER.fullmatch(word) else (1, 0.0, word) for word in words if word]


def _ticks(file: Path, since: int) -> float:
    """Return the last number in a name minus `since`, as integers, so that nanoseconds since 1970 keep their digits."""
    numbers = NUMBER.findall(file.stem)
    if not numbers:
        remedy = "Give fps or times in the place of name_ticks_per_s"
        raise ConfigError("there is no number in this name", file=file, remedy=remedy)
    whole, _, fraction = numbers[-1].partition(".")
    return (int(whole) - since) + (float(f"0.{fraction}") if fraction else 0.0)


def _image(file: Path) -> ImageArray:
    image = read_image(file, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise SourceError(f"{file} is no image that can be read")
    return image


def _size(image: ImageArray) -> str:
    return _words((image.shape[1], image.shape[0]))


def _words(size_px: tuple[int, int]) -> str:
    return f"{size_px[0]}x{size_px[1]} pixels"
