"""robot.toml as a whole: one file, a table for each package, unknown keys refused.

Precedence: the command line, then the environment (`BODYSCHEMA_<TABLE>_<KEY>`, a TOML value or a bare word), then the
file.
"""

from __future__ import annotations

import logging
import math
import os
import tomllib
from collections.abc import Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from bodyschema.drivers.config import MARKER_SOURCE, AnySource, DriversConfig, source_tables
from bodyschema.interfaces.errors import ConfigError
from bodyschema.learning.config import LearnerConfig
from bodyschema.robot.calibrated_files import EXTENSIONS
from bodyschema.robot.description import CameraSection, RobotDescription, RobotSection
from bodyschema.robot.suggest import did_you_mean, hint_at, with_choices
from bodyschema.robot.toml_file import Positive, convert, line_of, line_of_endless_key, read_toml
from bodyschema.sim_backend.config import SimConfig
from bodyschema.vision.config import VisionConfig

from .transport.identity import Route
from .transport.zenoh_config import ZenohConfig

if TYPE_CHECKING:
    from bodyschema.effects import Simulation

log = logging.getLogger(__name__)

ENVIRONMENT = "BODYSCHEMA_"


class _Settings:
    # Control points of a map that the learner keeps up with: 12 joints that turn. Learning and replaying a sample take
    # 25 ms there, with 13 joints 57 ms, and from a camera samples come every 33 ms.
    largest_map: int = 3**12
    largest_ball_m: float = 0.5  # a larger radius is one of another unit [m]


class DaemonConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The table [daemon]: the sampler's rules, and where state is kept."""

    # where store and checkpoint live, relative to robot.toml; by default $XDG_STATE_HOME/bodyschema/<robot name>
    state_dir: str | None = None
    # min_step_deg, max_step_deg: Euclidean norm over all joints of the step between neighbouring samples. Nearer: wait.
    # Farther: a new segment. Prismatic joints count with `metres_per_degree`.
    min_step_deg: Positive = 1.0
    max_step_deg: Positive = 3.0
    metres_per_degree: Positive = 0.005  # how far a prismatic joint moves for what counts as one degree
    # accept every sample whatever its step (recordings of static poses far apart); each starts a segment of its own
    # where the step is larger than `max_step_deg`
    any_step: bool = False
    max_reading_gap_s: Positive = 0.1  # encoder readings around a frame may be this far apart
    max_marker_speed_m_s: Positive = 3.0  # a marker that moved faster since its last fix is not believed
    # samples older than this are deleted, but never the newest 20,000; without it, age does not matter
    keep_days: Positive | None = None
    # maximum size of the store in 10^6 bytes; the oldest samples beyond it are deleted, but never the newest 20,000.
    # Without it, the disk is the limit.
    keep_mb: Positive | None = None


# Keys of earlier versions by their tables, whose values are fixed now. The next release knows them no more.
RETIRED = {
    ("daemon",): {"max_time_error_deg", "segment_gap_s", "keep_newest"},
    ("drivers", "dynamixel"): {"max_speed_deg_s", "max_move_deg"},
    ("drivers", "dynamixel", "zero_force"): {"doubtful_cycles", "ramp_s", "overcurrent_s"},
    ("drivers", "dynamixel", "gaze"): {"doubtful_cycles", "stale_s", "blocked_s", "blocked_deg"},
    ("drivers", "feetech"): {"max_speed_deg_s", "max_move_deg"},
    ("drivers", "serial_lines"): {"max_speed_deg_s", "max_move_deg"},
    ("drivers", "ros2"): {"max_gap_s", "max_speed_deg_s", "max_speed_m_s"},
    ("drivers", "ros2", "marker"): {"rate_hz"},
    ("vision",): {
        *("min_pixels", "border_margin_px", "min_visible", "max_centre_sigma_px", "max_candidates"),
        *("epipolar_px", "epipolar_sigmas", "eye_size_ratio", "depth_size_ratio", "max_speed_m_s"),
    },
    ("vision", "tag"): {
        *("min_side_px", "min_contrast", "min_visible", "max_corner_sigma", "epipolar_px", "epipolar_sigmas"),
        *("size_tolerance", "max_reprojection"),
    },
    ("vision", "cameras", "two"): {"max_apart_s"},
    ("vision", "further_cameras", "two"): {"max_apart_s"},
    ("learner",): {"step_size", "seed"},
    ("sim", "camera"): {"scene_step", "supersampling"},
    ("sim", "guide"): {"force_limit_n", "torque_limit_nm", "gaze_speed_rad_s"},
}


class Tables(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All tables of robot.toml.

    `RobotDescription` checks [robot] and [camera]; `effects` checks [effects], [background] and [unexplained].
    """

    robot: dict[str, Any]
    camera: dict[str, Any]
    zenoh: ZenohConfig = ZenohConfig()
    daemon: DaemonConfig = DaemonConfig()
    drivers: DriversConfig = DriversConfig()
    vision: VisionConfig = VisionConfig()
    learner: LearnerConfig = LearnerConfig()
    sim: SimConfig = SimConfig()
    marker_source: tuple[AnySource, ...] = ()
    effects: tuple[dict[str, Any], ...] = ()
    background: tuple[dict[str, Any], ...] = ()
    unexplained: dict[str, Any] | None = None


@dataclass(frozen=True)
class Config:
    """The checked contents of robot.toml."""

    file: Path
    robot: RobotDescription
    tables: Tables
    extended: Simulation | None = None  # the robot with the effects that the file adds to it, if it adds any
    given_state_dir: Path | None = None  # the place for store and checkpoint that the command line gave, if it gave one

    @classmethod
    def load(cls, file: Path, environment: Mapping[str, str] = os.environ) -> Config:
        """Read robot.toml, its URDF and the environment.

        Raises:
            ConfigError: one is wrong; the message has file, line, key and remedy.
        """
        raw, text = read_toml(file)
        known = [field.encode_name for field in msgspec.structs.fields(Tables)]
        for name in raw:
            if name not in known:
                line = line_of(text, (name,))
                raise ConfigError(f"unknown table [{name}]", file=file, line=line, remedy=did_you_mean(name, known))
        raw = _without_retired(raw, file, text)
        overridden = _override(raw, [name for name in known if name not in (*EXTENSIONS, MARKER_SOURCE)], environment)
        robot = RobotDescription.from_tables(overridden, text, file)
        extended = None
        if overridden.keys() & set(EXTENSIONS):
            from bodyschema.effects import simulation_of

            extended = simulation_of(robot, overridden, text)
        if MARKER_SOURCE in raw:
            overridden[MARKER_SOURCE] = source_tables(raw[MARKER_SOURCE], file, text)
        tables = convert(overridden, Tables, file=file, text=text)
        if tables.daemon.min_step_deg >= tables.daemon.max_step_deg:
            line = line_of(text, ("daemon", "min_step_deg"))
            raise ConfigError("min_step_deg is not below max_step_deg", file=file, line=line)
        tables.zenoh.check(file, text)
        tables.drivers.check(robot.joints, file, text)
        _check_router(tables, file, text)
        if tables.vision.cameras is not None:
            tables.vision.cameras.check(file, text)
            _require_colour(tables, file, text)
        _check_further_cameras(tables, file, text)
        if tables.vision.radius_m > _Settings.largest_ball_m:
            raise ConfigError(
                f"vision.radius_m = {tables.vision.radius_m:g}: this looks like millimetres",
                file=file,
                line=line_of(text, ("vision", "radius_m")),
                remedy="Give metres",
            )
        _require_size(robot, tables, overridden.get("vision", {}), file, text)
        return cls(file, robot, tables, extended)

    @cached_property
    def simulation(self) -> Simulation:
        """The robot with the effects that the file adds to it, imported late because few commands need them."""
        from bodyschema.effects import Simulation

        return self.extended or Simulation(self.robot)

    def require_learnable(self) -> None:
        """Raise ConfigError if there are more joints than the learner can keep up with."""
        joints, slides = self.robot.robot.joints, self.robot.chain.prismatic
        size = math.prod(2 if sliding else 3 for sliding in slides.tolist())
        if size <= _Settings.largest_map:
            return
        most = round(math.log(_Settings.largest_map, 3))
        raise ConfigError(
            f"{len(joints)} joints are too many for the learner: their map has {size:,} control points, and with more "
            f"than {_Settings.largest_map:,} ({most} joints that turn) it would not keep up",
            file=self.file,
            line=line_of(read_toml(self.file)[1], ("robot", "joints")),
            remedy=(
                f"Name at most {most} in joints, the others stand still (held_at); or learn all of them with "
                "kbmaps.RigidLearner or kbmaps.TensorLearner, as in examples/5_twenty_joints.py"
            ),
        )

    def with_state_dir(self, folder: Path) -> Config:
        """Return a copy with another folder for store and checkpoint, relative to the working directory.

        Raises:
            ConfigError: `folder` is a file.
        """
        if os.path.exists(folder) and not os.path.isdir(folder):
            raise ConfigError("is a file, and store and checkpoint need a folder", file=folder, remedy=_STATE_REMEDY)
        daemon = msgspec.structs.replace(self.tables.daemon, state_dir=str(folder.absolute()))
        return replace(self.with_tables(msgspec.structs.replace(self.tables, daemon=daemon)), given_state_dir=folder)

    def with_tables(self, tables: Tables) -> Config:
        """Return a copy with other settings."""
        return replace(self, tables=tables)

    def route(self, process: str) -> Route:
        """Return the endpoint and identity with which a client connects to `sampler` or `learner`."""
        return self.tables.zenoh.route(process, self.file.parent)

    def zenoh_settings(self, process: str) -> dict[str, Any]:
        """Return the zenoh settings of `sampler` or `learner`: endpoints, TLS identity, access control."""
        return self.tables.zenoh.settings_of(process, self.robot.name, self.file.parent)

    @property
    def state_dir(self) -> Path:
        """Folder of store and checkpoint."""
        if self.tables.daemon.state_dir is not None:
            return (self.file.parent / self.tables.daemon.state_dir).resolve()
        return state_home() / self.robot.name

    @property
    def store_file(self) -> Path:
        """The sampler's pairs."""
        return self.state_dir / "pairs.sqlite"

    @property
    def checkpoint_file(self) -> Path:
        """The learner's state."""
        return self.state_dir / "learner.ckpt"


_STATE_REMEDY = "Give a folder with --state-dir; one that is not there yet is made"


def state_home() -> Path:
    """Return the folder that holds the state of every robot."""
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "bodyschema"


def _check_router(tables: Tables, file: Path, text: str) -> None:
    """Raise ConfigError if another router, usually on port 7447 too, uses an endpoint of one of our processes."""
    ros2 = tables.drivers.ros2
    routers = {} if ros2 is None else {("drivers", "ros2"): ros2.router}
    routers |= {(MARKER_SOURCE, table.label): table.endpoint for table in tables.marker_source}
    for keys, router in routers.items():
        if router in (tables.zenoh.sampler, tables.zenoh.learner):
            whose = "ROS 2" if keys[0] == "drivers" else "marker source's"
            raise ConfigError(
                f"the {whose} router and a process of ours have the same endpoint {router}",
                file=file,
                line=line_of(text, keys),
                remedy='Write in [zenoh]: sampler = "tcp/127.0.0.1:7457" and learner = "tcp/127.0.0.1:7458"',
            )


def _check_further_cameras(tables: Tables, file: Path, text: str) -> None:
    """Raise ConfigError if further cameras are incomplete, uncalibrated, or the only ones."""
    names = ["cameras", *(source.label for source in tables.marker_source)]
    for cameras in tables.vision.further_cameras:
        cameras.check(file, text, ("vision", "further_cameras"))
        what = remedy = ""
        if tables.vision.cameras is None:
            what, remedy = "there are no first ones", "Name one of them as [vision.cameras]"
        elif cameras.calibration is None and cameras.realsense is None:
            what, remedy = "nothing says how they see", "Name the file of `bodyschema calibrate cameras` as calibration"
        elif cameras.name in names:
            what, remedy = f"the name {cameras.name!r} is taken", "Give each its own name"
        if what:
            line = line_of(text, ("vision", "further_cameras"))
            raise ConfigError(f"vision.further_cameras: {what}", file=file, line=line, remedy=remedy)
        names.append(cameras.name)


def _require_colour(tables: Tables, file: Path, text: str) -> None:
    """Raise ConfigError if infra-red eyes would have to look for a colour."""
    cameras = tables.vision.cameras
    if cameras is not None and cameras.realsense is not None and tables.vision.marker == "ball":
        raise ConfigError(
            "the infra-red eyes of a RealSense see no colours, and the marker is a coloured ball",
            file=file,
            line=line_of(text, ("vision", "cameras", "realsense")),
            remedy='Write marker = "tag", "cluster", "chessboard" or "bright_ball" in [vision]',
        )


def _require_size(robot: RobotDescription, tables: Tables, vision: Mapping[str, Any], file: Path, text: str) -> None:
    """Raise ConfigError if a single camera would have to measure the depth of a marker of unknown size."""
    cameras = tables.vision.cameras
    if robot.camera.eyes == 2 and (cameras is None or cameras.eyes == 2):
        return
    match tables.vision.marker:
        case "ball" | "bright_ball":
            place, what = ("vision", "radius_m"), "the ball's radius [m]"
            message = "radius_m" in vision
        case "tag":
            place, what = ("vision", "tag", "side_m"), "the side of the tag's black square [m]"
            message = "side_m" in vision.get("tag", {})
        case "cluster":
            place, what = ("vision", "tag", "side_m"), "the side of the tags' black squares [m]"
            message = "side_m" in vision.get("tag", {}) or all(tag.side_m for tag in tables.vision.cluster.tags)
        case "chessboard" | "plugin":
            return
    if not message:
        raise ConfigError(
            f"{'.'.join(place)} is missing: one camera alone takes the depth from the marker's size",
            file=file,
            line=line_of(text, place[:-1]),
            remedy=f"Measure it with a caliper, and give {what}",
        )


def _without_retired(raw: dict[str, Any], file: Path, text: str) -> dict[str, Any]:
    """Return the tables without the keys of earlier versions; the log says of each that its value is not used."""
    tables = deepcopy(raw)
    for path, keys in RETIRED.items():
        for table in _tables_at(tables, path):
            for key in sorted(keys & table.keys()):
                del table[key]
                where = f"{file}:{line_of(text, (*path, key))}: [{'.'.join(path)}] {key}"
                log.warning("%s is no key any more, and its value is not used. Delete the line", where)
    return tables


def _tables_at(value: Any, path: tuple[str, ...]) -> Iterator[dict[str, Any]]:
    """Yield the table at a path of keys, or each if one of them is an array of tables."""
    if isinstance(value, list):
        for each in value:
            yield from _tables_at(each, path)
    elif isinstance(value, dict) and path:
        yield from _tables_at(value.get(path[0]), path[1:])
    elif isinstance(value, dict):
        yield value


def _override(raw: dict[str, Any], known: list[str], environment: Mapping[str, str]) -> dict[str, Any]:
    merged = {name: dict(table) if isinstance(table, dict) else table for name, table in raw.items()}
    for variable, value in environment.items():
        table, _, key = variable.removeprefix(ENVIRONMENT).lower().partition("_")
        if not (variable.startswith(ENVIRONMENT) and table in known and key):
            continue
        if key in RETIRED.get((table,), ()):
            log.warning("%s is no key any more, and its value is not used", variable)
        else:
            merged.setdefault(table, {})[key] = _checked(variable, table, key, _toml_value(value))
    return merged


def _checked(variable: str, table: str, key: str, value: Any) -> Any:
    """Return the value; raise ConfigError naming the environment variable if key or value is invalid in the table."""
    kind = {"robot": RobotSection, "camera": CameraSection}.get(table) or hint_at(Tables, (table,))
    fields = {field.encode_name: field.type for field in msgspec.structs.fields(kind)}
    if key not in fields:
        remedy = did_you_mean(key, fields)
        raise ConfigError(f"the environment variable {variable}: unknown key {key!r} in [{table}]", remedy=remedy)
    try:
        msgspec.convert(value, fields[key])
    except msgspec.ValidationError as error:
        message = with_choices(str(error), fields[key])
        raise ConfigError(f"the environment variable {variable}: {message[:1].lower()}{message[1:]}") from error
    return value


def _toml_value(text: str) -> Any:
    try:
        return text if line_of_endless_key(text) else tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text
