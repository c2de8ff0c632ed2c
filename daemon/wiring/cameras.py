"""The wiring of real cameras: open those of robot.toml, check them, and list the connected ones."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic

import msgspec

from bodyschema.daemon.config import Config
from bodyschema.drivers.checks import Check, holders
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import BodyschemaError, ConfigError
from bodyschema.interfaces.extras import require_extra
from bodyschema.interfaces.protocols import Clock, StereoCamera
from bodyschema.robot.toml_file import line_of, read_toml
from bodyschema.vision.cameras.config import CamerasConfig, ImagesConfig, RealsenseConfig, UvcSettings, VideosConfig
from bodyschema.vision.cameras.ideal import IdealCamera
from bodyschema.vision.cameras.live import CameraFigures, LiveEyes
from bodyschema.vision.cameras.opened import eyes_of
from bodyschema.vision.cameras.realsense import RealsenseCamera
from bodyschema.vision.cameras.recorded_eyes import RecordedEyes
from bodyschema.vision.cameras.v4l2.controls import left_to_the_camera
from bodyschema.vision.cameras.v4l2.serials import connected
from bodyschema.vision.cameras.watched import PlainEyes, WatchedCamera
from bodyschema.vision.rig.common_error import CommonError
from bodyschema.vision.rig.rectified import RectifiedCamera
from bodyschema.vision.rig.rig_file import read_rig
from bodyschema.vision.rig.stereo_rig import OneEyeRig, Rig
from bodyschema.vision.tracked_camera import TrackedCamera
from bodyschema.vision.trackers import tracker_of


class _Settings:
    look_s: float = 2.0  # `doctor` looks at the images
    read_s: float = 0.5  # how long a frame is waited for


PAGE = "docs/cameras.md"

Eyes = LiveEyes | RealsenseCamera | RecordedEyes


def require_cameras(config: Config) -> CamerasConfig:
    """Return the cameras configured in robot.toml; raise ConfigError if it has none."""
    cameras = config.tables.vision.cameras
    if cameras is None:
        raise ConfigError(
            "no cameras are configured", file=config.file, remedy=f"Add the table [vision.cameras]: {PAGE}"
        )
    return cameras


def open_eyes(config: Config, clock: Clock) -> Eyes:
    """Return the cameras of robot.toml with unprocessed images, not opened yet.

    Raises:
        ConfigError: no cameras are configured.
    """
    return eyes_of(require_cameras(config), config.file.parent, clock)


def focus_complaints(eyes: Eyes) -> tuple[str, ...]:
    """Return the reports of live cameras on lenses that moved or may move."""
    return eyes.focus_complaints if isinstance(eyes, LiveEyes) else ()


def calibration_file(config: Config) -> Path:
    """Return the calibration file named in robot.toml; by default cameras.toml beside it."""
    cameras = require_cameras(config)
    return config.file.parent / (cameras.calibration or "cameras.toml")


def common_error(config: Config) -> CommonError | None:
    """Return the error of the cameras' calibration that all positions share.

    Return None if robot.toml names no calibration, or if positions of several sources are fused.

    Raises:
        ConfigError: the file cannot be read. A learner may run on another machine than the cameras.
        CalibrationError: the eyes share no view, or a lens folds over within its image.
    """
    vision = config.tables.vision
    if vision.cameras is None or vision.cameras.calibration is None:
        return None
    if vision.further_cameras or config.tables.marker_source:
        return None
    rig = read_rig(calibration_file(config))
    # A fix of a ball has its radius's error.
    sized = isinstance(rig, OneEyeRig) and vision.marker in ("tag", "cluster", "chessboard")
    error = CommonError(rig, vision.size_sigma if sized else 0.0)
    error.require_usable()
    return error


def camera_of(config: Config, eyes: Eyes) -> StereoCamera:
    """Return `eyes` with rectified images, not opened yet: by the calibration file, otherwise by [camera].

    Raises:
        ConfigError: there is no calibration, or the file cannot be read.
    """
    cameras = require_cameras(config)
    if cameras.calibration is not None:
        rig = read_rig(calibration_file(config))
        return RectifiedCamera(eyes, _of_files(rig, cameras) if isinstance(eyes, RecordedEyes) else rig)
    if isinstance(eyes, RealsenseCamera):
        return eyes
    if config.robot.calibration is None:
        raise ConfigError(
            "nothing says how the cameras see",
            file=config.file,
            line=line_of(read_toml(config.file)[1], ("vision", "cameras")),
            remedy="Type `bodyschema calibrate cameras`; or, where the images are rectified already, describe the "
            "stereo pair in [camera]",
        )
    return IdealCamera(eyes, config.robot.calibration)


def _of_files(rig: Rig, cameras: CamerasConfig) -> Rig:
    """Return the rig without serials unless it names these files, since files do not identify their cameras."""
    layout = cameras.layout
    names = {layout.left, layout.right} if isinstance(layout, ImagesConfig | VideosConfig) else set[str | None]()
    if names & set(rig.serials):
        return rig
    return replace(rig, serials=("",)) if isinstance(rig, OneEyeRig) else replace(rig, serials=("", ""))


def tracked_video(config: Config, file: Path) -> TrackedCamera:
    """Return a video of one camera with its tracker, not opened yet; lens and marker are those of robot.toml.

    Raises:
        ConfigError: there is no calibration of the camera, or the marker is impossible.
    """
    return _tracked(config, videos=VideosConfig(left=str(file.absolute()), speed=0.0))


def tracked_images(config: Config, folder: Path) -> TrackedCamera:
    """Return the images *.jpg in `folder`, at the times in its times.txt, as `tracked_video` does."""
    files, times = folder.absolute() / "*.jpg", folder.absolute() / "times.txt"
    return _tracked(config, images=ImagesConfig(left=str(files), times=str(times), speed=0.0))


def _tracked(config: Config, **layout: VideosConfig | ImagesConfig) -> TrackedCamera:
    given = config.tables.vision.cameras
    calibration, readout_s = (None, None) if given is None else (given.calibration, given.readout_s)
    cameras = CamerasConfig(calibration=calibration, readout_s=readout_s, **layout)  # pyright: ignore[reportArgumentType]
    seen = seen_through(config, cameras)
    camera = camera_of(seen, open_eyes(seen, SystemClock()))
    return TrackedCamera(camera, tracker_of(camera.calibration, seen.tables.vision), None, *cameras.readout)


def seen_through(config: Config, cameras: CamerasConfig) -> Config:
    """Return the configuration with `cameras` as the only ones."""
    vision = msgspec.structs.replace(config.tables.vision, cameras=cameras, further_cameras=())
    return config.with_tables(msgspec.structs.replace(config.tables, vision=vision))


def require_usable(config: Config) -> None:
    """Raise ConfigError if the cameras' images and the encoders' readings cannot be combined to pairs."""
    cameras = require_cameras(config)
    if cameras.realsense is not None:
        require_extra("realsense", "a RealSense camera")
    camera_of(config, open_eyes(config, SystemClock()))
    layout = require_cameras(config).layout
    if isinstance(layout, ImagesConfig | VideosConfig) and not layout.speed:
        raise ConfigError(
            "images at speed 0 are not on the encoders' clock",
            file=config.file,
            line=line_of(read_toml(config.file)[1], ("vision", "cameras")),
            remedy="Give a speed above 0",
        )


@dataclass(frozen=True, slots=True)
class Watched:
    """Cameras for live display."""

    camera: WatchedCamera | PlainEyes  # gives the pictures, not opened yet. eyes: tells how the cameras are.
    eyes: Eyes
    is_calibrated: bool  # whether the marker is looked for


def open_watched(config: Config) -> Watched:
    """Return the cameras of robot.toml, not opened yet; if calibrated, detections are drawn into their images."""
    eyes = open_eyes(config, SystemClock())
    is_described = config.robot.calibration is not None or isinstance(eyes, RealsenseCamera)
    is_calibrated = require_cameras(config).calibration is not None or is_described
    if not is_calibrated:
        return Watched(PlainEyes(eyes), eyes, is_calibrated)
    return Watched(WatchedCamera(camera_of(config, eyes), config.tables.vision), eyes, is_calibrated)


# --- what `doctor` says


def camera_checks(config: Config) -> Iterator[Check]:
    """Yield checks that the cameras of robot.toml are present and send images if both are open at once."""
    yield from _checks_of(require_cameras(config), config.file.parent)
    for further in config.tables.vision.further_cameras:
        for check in _checks_of(further, config.file.parent):
            yield replace(check, subject=f"{further.name}: {check.subject}")


def _checks_of(cameras: CamerasConfig, folder: Path) -> Iterator[Check]:
    missing = False
    for name, device in cameras.devices.items():
        for check in _device_checks(name, device):
            missing |= check.state == "wrong"
            yield check
    if missing:
        return
    eyes = eyes_of(cameras, folder, SystemClock())
    try:
        yield from _open_checks(eyes, cameras)
    except BodyschemaError as error:
        yield Check("cameras", "wrong", str(error))


def _device_checks(name: str, device: str) -> Iterator[Check]:
    if not os.path.exists(device):
        yield Check(name, "wrong", f"{device} is not there", _where(device))
    elif not os.access(device, os.R_OK | os.W_OK):
        said = f"{device} may not be opened: you are not in the group video"
        yield Check(name, "wrong", said, "sudo usermod -aG video $USER    # then log in again")
    elif others := holders(device):
        said = f"{device} is open in process {others[0].pid}: {others[0].command}"
        yield Check(name, "warning", said, f"kill {others[0].pid}    # cameras can be opened once")


def _where(device: str) -> str:
    found = [name for name in connected() if name != device]
    known = f"this machine has {', '.join(found)}" if found else "this machine has no camera"
    return f"plug it in; {known}"


def _open_checks(eyes: Eyes, cameras: CamerasConfig) -> Iterator[Check]:
    """Open the cameras together for a while and yield checks of their images."""
    with ExitStack() as stack:
        stack.enter_context(eyes)
        serials = eyes.serials
        frames, until = 0, monotonic() + _Settings.look_s
        sigma_s = 0.0
        while monotonic() < until:
            frame = eyes.read(_Settings.read_s)
            if frame is not None:
                frames, sigma_s = frames + 1, frame.t_sigma
            if isinstance(eyes, RecordedEyes):
                break
        width, height = eyes.image_size_px
        said = f"{' and '.join(serials)}: {width}x{height} pixels, time known to {1e3 * sigma_s:.0f} ms"
        yield Check("cameras", "ok" if frames else "warning", said if frames else f"{said}; no pair of images came")
        if isinstance(eyes, LiveEyes):
            yield from _live_checks(eyes, cameras)


def _live_checks(eyes: LiveEyes, cameras: CamerasConfig) -> Iterator[Check]:
    for figures in eyes.figures:
        yield Check(figures.name, "ok", _stream_sentences(figures))
    for complaint in eyes.health:
        what, _, remedy = complaint.partition(": ")
        yield Check("cameras", "warning", what, remedy)
    layout = cameras.layout
    free = left_to_the_camera(layout) if isinstance(layout, UvcSettings) else []
    if free:
        said = f"{', '.join(free)} not fixed: brightness, colour or focus may wander"
        yield Check("cameras", "warning", said, f"set {free[0]} in [vision.cameras.…]: {PAGE}")
    if cameras.latency_sigma_s is None:
        said = f"the latency is not known, only that it is about {1e3 * cameras.sigma_s:.0f} ms at most"
        yield Check("cameras", "warning", said, "bodyschema calibrate latency")


def _stream_sentences(figures: CameraFigures) -> str:
    rate = "" if figures.fps is None else f", {figures.fps:.1f} frames/s"
    stamps = "" if figures.stamps is None else f", dated by the {'kernel' if figures.stamps == 'kernel' else 'arrival'}"
    torn = f", {figures.damaged} damaged" if figures.damaged else ""
    return f"{figures.frames} frames{rate}{stamps}{torn}"


def camera_lines(config: Config) -> Iterator[str]:
    """Yield lines on the source of the images; raise ConfigError if the calibration cannot be read."""
    yield from _lines_of(require_cameras(config), config.file.parent)
    for further in config.tables.vision.further_cameras:
        for line in _lines_of(further, config.file.parent):
            yield f"{further.name}: {line}"


def _lines_of(cameras: CamerasConfig, folder: Path) -> Iterator[str]:
    match cameras.layout:
        case UvcSettings() as layout:
            for name, device in cameras.devices.items():
                yield f"{name} {device}"
            width, height = layout.image_size_px
            each = " for each eye" if cameras.eyes > 1 else ""
            yield f"images of {width}x{height} pixels{each}, {layout.fps:g} a second, as {layout.fourcc}"
        case RealsenseConfig(image_size_px=(width, height), serial=serial) as layout:
            which = "the only RealSense" if serial is None else f"RealSense {serial}"
            yield f"{which}: infra-red images of {width}x{height} pixels, {layout.fps:g} a second"
        case ImagesConfig(left=left, right=right) as images:
            yield f"images {left if right is None else f'{left} and {right}'}, {_speed(images.speed)}"
        case VideosConfig() as films:
            names = " and ".join(name for name in (films.left, films.right, films.side_by_side) if name)
            yield f"films {names}, {_speed(films.speed)}"
    known = "" if cameras.latency_sigma_s is not None or not cameras.devices else ", not measured"
    yield f"taken {1e3 * cameras.latency_s:.1f} ms before their time stamp ± {1e3 * cameras.sigma_s:.1f} ms{known}"
    if cameras.calibration is not None:
        yield _calibrated_by(cameras.calibration, folder / cameras.calibration)


def _calibrated_by(name: str, file: Path) -> str:
    if not file.exists():
        return f"calibrated by {name}, which is not there yet: `bodyschema calibrate cameras`"
    rig = read_rig(file)
    if isinstance(rig, OneEyeRig):
        return f"calibrated by {name}: one {rig.model} lens"
    return f"calibrated by {name}: {rig.model} lenses, baseline {1e3 * rig.baseline_m:.1f} mm"


def _speed(speed: float) -> str:
    return f"at {speed:g} times their speed" if speed else "as fast as they are read"
