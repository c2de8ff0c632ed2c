"""Learn a marker from images, as tables of robot.toml: a ball's colour, or the poses of a cluster's tags."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import msgspec
import numpy as np

from bodyschema.daemon.sampler.reconnect import ReconnectingSource
from bodyschema.interfaces.errors import ConfigError, SourceEnded
from bodyschema.interfaces.protocols import Clock, StereoEyes
from bodyschema.interfaces.records import ImageArray, Reason
from bodyschema.interfaces.waits import Waits
from bodyschema.robot.hand_eye import HandEye
from bodyschema.robot.rpy import pose_of
from bodyschema.vision.calibration.image_pairs import Images, read_pairs
from bodyschema.vision.cluster.measure import ClusterView, MeasuredCluster, measure_cluster
from bodyschema.vision.cluster.tables import cluster_tables
from bodyschema.vision.rig.rectified import Rectification
from bodyschema.vision.rig.rig_file import read_rig
from bodyschema.vision.rig.stereo_rig import CalibrationError
from bodyschema.vision.tags.config import Dictionary, TagConfig
from bodyschema.vision.tags.dictionary import tags_of
from bodyschema.vision.tags.finder import Seen, TagFinder
from bodyschema.vision.tags.image import TagImage


class _Settings:
    images: int = 20  # images during the observation
    # Largest difference of the printed size from the one given: a share, and sigmas on top of it.
    max_grown, grown_sigmas = 0.01, 4.0


def learnt_colour_table(images: Sequence[Path], at: tuple[float, float] | None) -> str:
    """Return the table [vision.colour] of the ball at pixel `at` of the first image, or of the moving one.

    Raises:
        ColourUnlearnt: there is no such ball; the message gives the reason.
    """
    from bodyschema.vision.ball.colour_model import colour_at, colour_of_the_moving, colour_table, read_images

    shown = read_images(images)
    return colour_table(colour_of_the_moving(shown) if at is None else colour_at(shown[0], *at))


def moving_colour_table(eyes: StereoEyes, clock: Clock, seconds: float, tell: Callable[[str], None]) -> str:
    """Return the table [vision.colour] of the ball that moves in the left image during `seconds` [s].

    Args:
        eyes: closed cameras; they are closed again afterwards.
        tell: called with instructions and with problems of the cameras.

    Raises:
        ColourUnlearnt: nothing colourful moved.
        SourceError: the cameras cannot be opened.
    """
    from bodyschema.vision.ball.colour_model import colour_of_the_moving, colour_table

    shown: list[ImageArray] = []
    source = ReconnectingSource(eyes, "the cameras", clock)
    with source, suppress(SourceEnded):
        began, next_t = clock.now(), -float("inf")
        tell(f"move the ball across the view for {seconds:g} s; keep the cameras still")
        while clock.now() - began < seconds:
            frame = source.read(Waits.read_s)
            if frame is not None and frame.t >= next_t:
                next_t = frame.t + seconds / _Settings.images
                shown.append(frame.left)
            elif source.trouble is not None:
                tell(source.trouble)
    return colour_table(colour_of_the_moving(shown))


_SIDE = re.compile(r"(\d{1,9})=(\d{1,9}\.?\d*)")


@dataclass(frozen=True)
class TagSelection:
    """Tags of a cluster: dictionary, IDs (None: all) and sides of the black squares [m], exceptions by ID."""

    dictionary: Dictionary
    side_m: float
    ids: tuple[int, ...] | None = None
    other_sides_m: Mapping[int, float] = field(default_factory=dict[int, float])


class TagFigures(msgspec.Struct):
    """A tag, 1-sigma of its position [mm] and rotation [°], and the number of views that show it.

    `pose` is the same in SI, in the frame of the cluster.
    """

    id: int
    xyz_mm: tuple[float, float, float]
    rpy_deg: tuple[float, float, float]
    xyz_sigma_mm: tuple[float, float, float]
    turn_sigma_deg: tuple[float, float, float]
    views: int
    pose: HandEye


class ClusterFile(msgspec.Struct):
    """Output of `bodyschema marker learn --json`."""

    views: int
    misfit: float
    grown_percent: float
    grown_sigma_percent: float
    left_out: list[tuple[str, int]]
    unused: list[str]
    tags: list[TagFigures]


def measured(images: Images, calibration: Path, wanted: TagSelection, tell: Callable[[str], None]) -> MeasuredCluster:
    """Measure the poses of the tags in images of calibrated cameras.

    Raises:
        ConfigError: the calibration is damaged.
        CalibrationError: images or tags are unsuitable, or the squares have another side.
    """
    rig, files = read_rig(calibration), images.files()
    if len(rig.serials) < 2:
        raise CalibrationError(f"{calibration} is of one camera, and a cluster is measured by two. Calibrate both")
    rectification = Rectification(rig)
    maps = rectification.maps(0), rectification.maps(1)
    config = TagConfig(dictionary=wanted.dictionary, side_m=wanted.side_m)
    finder = TagFinder(config, wanted.ids or range(len(tags_of(wanted.dictionary).bytesList)))
    tell(f"looking for tags in {len(files)} pairs of images")
    views: list[ClusterView] = []
    twice: dict[int, list[str]] = {}
    for pair in read_pairs(files, side_by_side=images.side_by_side):
        rig.require(pair.size_px, rig.serials)
        seen = [_seen(finder, image, maps[eye]) for eye, image in enumerate(pair.images)]
        for id in sorted({id for tags in seen for id, tag in tags.items() if tag is Reason.AMBIGUOUS}):
            twice.setdefault(id, []).append(pair.name)
        left, right = ({id: tag for id, tag in tags.items() if isinstance(tag, TagImage)} for tags in seen)
        views.append(ClusterView(pair.name, left, right))
    _require_tags(views, twice, wanted)
    found = measure_cluster(views, rectification.calibration, wanted.side_m, wanted.other_sides_m)
    if abs(found.grown) > _Settings.max_grown + _Settings.grown_sigmas * found.grown_sigma:
        raise CalibrationError(
            f"the black squares seem to be {1e3 * wanted.side_m * (1.0 + found.grown):.2f} mm wide, not "
            f"{1e3 * wanted.side_m:g}. Measure one and give --side-mm; or is this the calibration of other cameras?"
        )
    return found


def sides_of(text: str) -> dict[int, float]:
    """Parse sides [m] of tags by ID from a text like 7=25,8=25 [mm]; raise ConfigError if it is invalid."""
    found: dict[int, float] = {}
    for part in text.split(","):
        told = _SIDE.fullmatch(part.strip())
        if told is None or not float(told[2]) > 0:
            raise ConfigError(f"--other-sides-mm {text} is not as in 7=25,8=25", remedy="Give tags' numbers and mm")
        found[int(told[1])] = 1e-3 * float(told[2])
    return found


def _seen(finder: TagFinder, image: ImageArray, maps: tuple[ImageArray, ImageArray]) -> Seen:
    rectified = cv2.remap(image, *maps, cv2.INTER_LINEAR)
    return finder.find(np.asarray(cv2.cvtColor(rectified, cv2.COLOR_BGR2GRAY), dtype=np.uint8))


def _require_tags(views: Sequence[ClusterView], twice: Mapping[int, Sequence[str]], wanted: TagSelection) -> None:
    """Raise CalibrationError if several images show one ID twice, no tag is found, or a wanted one is missing."""
    for id, names in twice.items():
        if len(names) > 1:
            raise CalibrationError(
                f"tag {id} is there twice in one image ({', '.join(names)}): each number may be there once. Print "
                "another number, or cover one of them"
            )
    seen = set[int]().union(*(view.ids for view in views))
    missing = [id for id in wanted.ids or () if id not in seen]
    if not seen or missing:
        which = "no tag" if not seen else f"not tag {', '.join(map(str, missing))}"
        there = f"; there are {', '.join(map(str, sorted(seen)))}" if seen else ""
        raise CalibrationError(
            f"{which} of {wanted.dictionary} is in the {len(views)} pairs of images{there}. Are --family and --ids "
            "right, and are the tags sharp, with sides of 20 pixels and more, and a white margin?"
        )


def tables(found: MeasuredCluster, wanted: TagSelection) -> str:
    """Return the tables for robot.toml, with the uncertainty of each tag in a comment."""
    notes = [
        "the marker's frame"
        if k == 0
        else f"1 sigma {1e3 * float(tag.xyz_sigma_m.max()):.3f} mm, {np.degrees(float(tag.turn_sigma_rad.max())):.3f}°"
        for k, tag in enumerate(found.tags)
    ]
    return cluster_tables(wanted.dictionary, wanted.side_m, [tag.placed for tag in found.tags], notes)


def figures(found: MeasuredCluster) -> ClusterFile:
    return ClusterFile(
        views=found.views,
        misfit=found.misfit,
        grown_percent=100.0 * found.grown,
        grown_sigma_percent=100.0 * found.grown_sigma,
        left_out=list(found.left_out),
        unused=list(found.unused),
        tags=[
            TagFigures(
                id=tag.placed.id,
                xyz_mm=_scaled(tag.placed.xyz, 1e3),
                rpy_deg=_scaled(tag.placed.rpy, np.degrees(1.0)),
                xyz_sigma_mm=_scaled(tag.xyz_sigma_m, 1e3),
                turn_sigma_deg=_scaled(tag.turn_sigma_rad, np.degrees(1.0)),
                views=tag.views,
                pose=HandEye.of(
                    "marker",
                    f"tag_{tag.placed.id}",
                    pose_of(np.array(tag.placed.xyz), np.array(tag.placed.rpy)),
                    np.diag(np.square(np.concatenate([tag.xyz_sigma_m, tag.turn_sigma_rad]))),
                ),
            )
            for tag in found.tags
        ],
    )


def _scaled(values: object, by: float) -> tuple[float, float, float]:
    x, y, z = (by * np.asarray(values, dtype=np.float64)).tolist()
    return x, y, z


def said(found: MeasuredCluster) -> str:
    """Summarise the fit in a few sentences."""
    text = (
        f"{len(found.tags)} tags in {found.views} pairs of images that show two or more to both eyes; what "
        f"is left is {found.misfit:.2f} times what the "
        f"corners claim. Squares are {100.0 * found.grown:+.2f} ± {100.0 * found.grown_sigma:.2f} % larger."
    )
    if found.left_out:
        text += f" Left out: {', '.join(f'tag {id} in {name}' for name, id in found.left_out)}."
    if found.unused:
        text += f" Not used, as they do not show two tags to both eyes: {', '.join(found.unused)}."
    return text
