"""Pairs of image files, or those of one camera: match them by name, read and write them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2

from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.records import ImageArray
from bodyschema.interfaces.whole_files import write_atomically
from bodyschema.vision.image_file import read_image
from bodyschema.vision.rig.stereo_rig import CalibrationError

_ENDINGS = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp"}
_EYE = re.compile(r"(?<![a-z])(left|right|l|r)(?![a-z])", re.IGNORECASE)
_NUMBER = re.compile(r"(\d+)")
_WILDCARD = re.compile(r"(\*|\?|\[[^\]]*\])")


@dataclass(frozen=True)
class PairFiles:
    """Files of one view: the same file twice for side-by-side images, one file for a single camera."""

    name: str
    left: Path
    right: Path | None


@dataclass(frozen=True, eq=False)
class ImagePair:
    """Both eyes' images of one instant, or that of a single camera, shape (height, width, 3) BGR each."""

    name: str
    left: ImageArray
    right: ImageArray | None

    @property
    def images(self) -> tuple[ImageArray, ...]:
        """One image for each eye, the left one first."""
        return (self.left,) if self.right is None else (self.left, self.right)

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of each image."""
        return self.left.shape[1], self.left.shape[0]


def pair_files(
    folder: Path, left: str | None, right: str | None, *, side_by_side: bool, one: bool = False
) -> list[PairFiles]:
    """Match the files of a folder into pairs, sorted by name.

    Without patterns, left and right are recognised by `left`, `right`, `l` or `r` in the names of files or of their
    folders; the rest of the name identifies the view. Numbers in names sort as numbers.

    Args:
        left, right: patterns of the eyes' files, such as left*.png; files with equal text for the star belong together.
        one: True if all images are of a single camera.

    Raises:
        CalibrationError: the folder does not exist, or has no pairs.
    """
    if not folder.is_dir():
        raise CalibrationError(f"{folder}: there is no such folder")
    if side_by_side or one:
        files = sorted(_images(folder, left or "*"), key=_in_order)
        pairs = [PairFiles(file.stem, file, None if one else file) for file in files]
    elif left is not None and right is not None:
        pairs = _matched(*({_varied(file, each): file for file in _images(folder, each)} for each in (left, right)))
    else:
        pairs = _matched(*_by_eye(folder))
    if not pairs and one:
        raise CalibrationError(f"{folder}: no images")
    if not pairs:
        raise CalibrationError(
            f"{folder}: no pairs of images. Name them left01.png and right01.png, or put them into folders left and "
            "right; else give --left and --right, --side-by-side, or --one of one camera alone"
        )
    return pairs


def read_pairs(pairs: list[PairFiles], *, side_by_side: bool) -> Iterator[ImagePair]:
    """Yield the images pair by pair; raise CalibrationError if a file is not an image, or the sizes differ."""
    first: tuple[str, tuple[int, int]] | None = None
    for files in pairs:
        left = _read(files.left)
        right = left if side_by_side or files.right is None else _read(files.right)
        if side_by_side:
            half = left.shape[1] // 2
            left, right = left[:, :half], left[:, half : 2 * half]
        require_equal_sizes(files.name, left, right)
        size = (left.shape[1], left.shape[0])
        first = first or (files.name, size)
        if size != first[1]:
            raise CalibrationError(
                f"{files.name} has {_size(size)}, {first[0]} has {_size(first[1])}: all images have to be of one size"
            )
        yield ImagePair(files.name, left, None if files.right is None else right)


def require_equal_sizes(name: str, left: ImageArray, right: ImageArray) -> None:
    """Raise CalibrationError if the two eyes' images are of different sizes."""
    if left.shape[:2] != right.shape[:2]:
        sizes = [_size((image.shape[1], image.shape[0])) for image in (left, right)]
        raise CalibrationError(
            f"{name}: the left image has {sizes[0]}, the right one {sizes[1]}. Set both cameras to one resolution"
        )


def _size(size_px: tuple[int, int]) -> str:
    return f"{size_px[0]}x{size_px[1]} pixels"


def _images(folder: Path, pattern: str) -> list[Path]:
    return sorted(file for file in folder.glob(pattern) if file.suffix.lower() in _ENDINGS)


def _varied(file: Path, pattern: str) -> str:
    """Return the text of a file's name that matches the wildcards of its pattern."""
    parts = _WILDCARD.split(Path(pattern).name)
    words = {"*": "(.*)", "?": "(.)"}
    wild = "".join(words.get(part, f"({part})") if k % 2 else re.escape(part) for k, part in enumerate(parts))
    found = re.fullmatch(wild, file.name)
    return file.stem if found is None else "".join(found.groups())


def _by_eye(folder: Path) -> tuple[dict[str, Path], dict[str, Path]]:
    eyes: tuple[dict[str, Path], dict[str, Path]] = ({}, {})
    for file in [*_images(folder, "*"), *_images(folder, "*/*")]:
        name = file.relative_to(folder).as_posix()
        found = _EYE.search(re.sub(r"[_\d]", " ", name))
        if found is not None:
            which = 0 if found[1].lower().startswith("l") else 1
            eyes[which][name[: found.start()] + name[found.end() :]] = file
    return eyes


def _matched(left: dict[str, Path], right: dict[str, Path]) -> list[PairFiles]:
    keys = sorted(left.keys() & right.keys(), key=lambda key: _in_order(left[key]))
    names = [Path(key).stem.strip("_-. ") or left[key].stem for key in keys]
    if len(set(names)) < len(names):
        names = keys
    return [PairFiles(name, left[key], right[key]) for name, key in zip(names, keys, strict=True)]


def _in_order(file: Path) -> tuple[list[tuple[float, str]], str]:
    """Return a sort key by name, with numbers as numbers."""
    parts = _NUMBER.split(file.as_posix())
    return [(float(part), "") if k % 2 else (0.0, part) for k, part in enumerate(parts)], file.as_posix()


def _read(file: Path) -> ImageArray:
    image = read_image(file)
    if image is None:
        raise CalibrationError(f"{file}: no image that can be read. Remove the file, or take it anew")
    return image


def write_pair(pair: ImagePair, folder: Path, number: int) -> None:
    """Write a pair as left01.png and right01.png, as `pair_files` reads them, or the image of a single camera.

    Raises:
        CalibrationError: a file cannot be written.
    """
    names = ("left", "right") if len(pair.images) > 1 else ("image",)
    for name, image in zip(names, pair.images, strict=True):
        file = folder / f"{name}{number:02d}.png"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            write_atomically({file: cv2.imencode(file.suffix, image)[1].tobytes()})
        except OSError as error:
            raise CalibrationError(f"{file} cannot be written: {error.strerror}") from error


@dataclass(frozen=True)
class Images:
    """Location of the images."""

    folder: Path  # the folder
    # left, right: patterns of the eyes' files
    left: str | None = None
    right: str | None = None
    side_by_side: bool = False  # each image shows both eyes
    one: bool = False  # all images are of one camera

    def files(self) -> list[PairFiles]:
        """Return the files that belong together; raise CalibrationError if there are none."""
        if self.one and (self.right is not None or self.side_by_side):
            raise ConfigError("--one is of one camera alone", remedy="Leave --right and --side-by-side away")
        if (self.left is None) != (self.right is None) and not self.one:
            raise ConfigError("--left and --right belong together", remedy="Give both patterns, or none")
        return pair_files(self.folder, self.left, self.right, side_by_side=self.side_by_side, one=self.one)
