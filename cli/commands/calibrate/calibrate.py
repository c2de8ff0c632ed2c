"""`bodyschema calibrate`."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import cyclopts
from cyclopts import Parameter
from cyclopts.validators import Number
from rich.console import Console

from bodyschema.cli.commands.calibrate.calibrate_cameras import cameras
from bodyschema.cli.commands.calibrate.latency import latency
from bodyschema.cli.commands.options import (
    AS_THEY_ARE,
    WITHOUT_LEROBOT,
    LeRobotOptions,
    SourceOptions,
    SourceRobotFile,
    flag,
    print_json,
    robot_file,
    say,
)
from bodyschema.interfaces.errors import BodyschemaError, RequestError

if TYPE_CHECKING:
    from collections.abc import Callable

    from bodyschema.calibration.plausibility.verdict import Plausibility
    from bodyschema.calibration.report import CalibrationReport
    from bodyschema.calibration.rigid_chain import Calibration, Trusted
    from bodyschema.daemon.config import Config
    from bodyschema.interfaces.records import FloatArray
    from bodyschema.recordings.recording import Recording
    from bodyschema.robot.description import RobotDescription

    CommonErrors = Callable[[FloatArray], FloatArray]

CAMERA_FRAME = "calibrated_camera"


@Parameter(name="*")
@dataclass(frozen=True)
class FitOptions:
    """Settings of the fit, and prior knowledge."""

    sigma_mm: Annotated[
        float | None,
        Parameter(
            help="1-sigma of a measured coordinate where the source has none [mm]; else estimated.",
            validator=Number(gt=0, lte=1000),
        ),
    ] = None
    zeros_deg: Annotated[
        float, Parameter(help="How far joint zeros may be off, 1-sigma [°].", validator=Number(gt=0, lte=60))
    ] = 3.0
    trust_urdf: Annotated[
        bool, flag("Camera and tool alone: links and joint zeros are right as the URDF has them.")
    ] = False
    only: Annotated[
        Literal["offsets"] | None,
        Parameter(help="offsets: joint offsets, camera and tool; the links are right as the URDF has them."),
    ] = None

    @property
    def sigma_m(self) -> float | None:
        """1-sigma of a measured coordinate [m]; None to estimate it."""
        return None if self.sigma_mm is None else 1e-3 * self.sigma_mm

    def trusted(self) -> Trusted:
        """Return the parts of the URDF to be trusted."""
        if self.trust_urdf and self.only is not None:
            raise RequestError("--trust-urdf has no offsets to find. Give it, or --only offsets")
        return "urdf" if self.trust_urdf else "nothing" if self.only is None else "links"

    def fitted(
        self, robot: RobotDescription, recording: Recording, common: CommonErrors | None
    ) -> tuple[Calibration, Calibration | None]:
        """Return the calibration, and one with everything free if the URDF is trusted and the samples suffice.

        Args:
            common: returns the errors that all positions share, as for `Calibration.of`; None if none are known.
        """
        from bodyschema.calibration.rigid_chain import Calibration, min_pairs

        def of(trusted: Trusted) -> Calibration:
            zeros_rad = math.radians(self.zeros_deg)
            return Calibration.of(
                robot, recording, sigma_m=self.sigma_m, zeros_rad=zeros_rad, trusted=trusted, common=common
            )

        trusted = self.trusted()
        enough = len(recording) >= min_pairs(len(robot.joints), "nothing")
        return of(trusted), of("nothing") if trusted != "nothing" and enough else None


AS_USUAL = FitOptions()


@Parameter(name="*")
@dataclass(frozen=True)
class PlanOptions:
    """Poses to measure next."""

    next_poses: Annotated[
        Path | None,
        Parameter(help="Write the poses to visit next into this file (.json, .csv), the most informative first."),
    ] = None
    poses: Annotated[int, Parameter(help="How many poses of --next-poses.", validator=Number(gte=1, lte=200))] = 20

    def written(self, found: Calibration) -> list[str]:
        """Write the poses, if requested; return their expected gain as text."""
        from bodyschema.calibration.next_poses import NextPoses

        if self.next_poses is None:
            return []
        plan = NextPoses.of(found, self.poses)
        plan.write(self.next_poses, replace=True)
        return [
            f"{self.poses} poses written to {self.next_poses}. Model error over the range, without noise: "
            f"{1e3 * plan.expected_m:.2g} mm expected now, {1e3 * plan.expected_after_m:.2g} mm with them."
        ]


NO_PLAN = PlanOptions()


@Parameter(name="*")
@dataclass(frozen=True)
class RowNumbers:
    """The rows to learn."""

    first: Annotated[
        int | None,
        Parameter(
            help="Number of the first row to learn; of a store, else the first with the present tool.",
            validator=Number(gte=1),
        ),
    ] = None
    last: Annotated[int | None, Parameter(help="Number of the last row to learn.", validator=Number(gte=1))] = None


ALL_ROWS = RowNumbers()

# Without a help of its own its page shows what `arm` says, beside the commands.
calibrate = cyclopts.App(name="calibrate")
calibrate.command(cameras, sort_key=1)
calibrate.command(latency, sort_key=2)


@calibrate.default
def arm(
    source: Annotated[
        Path | None,
        Parameter(
            help="A recording (.csv, .parquet), a ROS bag, a LeRobotDataset or a sample store (.sqlite); else the "
            "robot's own store."
        ),
    ] = None,
    /,
    *,
    robot: SourceRobotFile = None,
    fit: FitOptions = AS_USUAL,
    numbers: RowNumbers = ALL_ROWS,
    out: Annotated[
        Path | None, Parameter(help="Write the calibrated robot into this folder: a URDF and a robot.toml.")
    ] = None,
    plan: PlanOptions = NO_PLAN,
    camera_frame: Annotated[str, Parameter(help="What ROS calls the measurement frame, for TF.")] = CAMERA_FRAME,
    taken: SourceOptions = AS_THEY_ARE,
    servos: LeRobotOptions = WITHOUT_LEROBOT,
    as_json: Annotated[bool, flag("Print the figures as JSON.", name="--json")] = False,
    force: Annotated[
        bool,
        flag(
            "Go on, and write, although the samples do not seem to be of this robot, or its zeros are far off; replace "
            "files in OUT."
        ),
    ] = False,
) -> None:
    """Calibrate camera, tool and joint offsets, with 95 % intervals; writes a calibrated URDF.

    Learns a rigid chain from all samples, around the nominal one. Outliers are left out. All samples have to be of one
    tool: from a store, only the samples since the learner's last tool change are used. If residuals jump as with
    another tool, the row is reported, and nothing is written.

    Samples are refused if their columns are exchanged, reversed, or have another zero or unit, or if they are of
    another robot. Joint offsets larger than five times --zeros-deg, and links worse than those of any arm, are
    printed and not written. --force overrules both.

    The URDF opens in pybullet, Pinocchio and ROS. It has the camera and the marker as links, and its positions agree
    with the learnt chain's to rounding. Meshes, masses and limits stay.

    Needs: a recording or a store, and its robot.toml; no hardware. The daemon may be running: its store is read. Poses
    that robot.toml declares unknown (`pose_known`, `marker_known`) are taken from the samples alone, the rest is
    trusted to 1° and 10 mm.

    Next: `bodyschema run --robot OUT/robot.toml` starts from the calibrated robot. With --lerobot the joint offsets go
    into the servos instead, by LeRobot's own calibration file.
    """
    from bodyschema.calibration.next_poses import check_target
    from bodyschema.daemon.config import Config

    if servos.write and (servos.lerobot is None or out is not None):
        raise RequestError(
            "--write is for --lerobot FILE, and without --out: offsets belong into the servos or into a URDF, not both"
        )
    fit.trusted()
    if plan.next_poses is not None:
        check_target(plan.next_poses, replace=force)
    config = Config.load(robot_file(robot, source))
    servos.require(config)
    rows = _Rows.of(config, source or config.store_file, numbers, taken, servos.lerobot)
    common, unknown = _common_errors(config, rows.source, taken)
    found, report = rows.calibrated(fit, common, camera_frame, force=force)
    if out is not None or servos.write:
        _require_writable(report, force=force)
    written_lines = [] if out is None else _written(config, found, report, out, replace=force)
    of_cameras, lines = [*unknown, *_contained(found)], plan.written(found)
    offsets = {zero.joint: math.radians(zero.zero) for zero in report.zeros if zero.half_width is not None}
    changed = servos.lines(config, offsets, rows.source)
    if as_json:
        print_json(report)
        sys.stderr.writelines(f"{line}\n" for line in [*of_cameras, *changed])
    else:
        _show(report, [*of_cameras, *lines, *changed], written_lines)


@dataclass(frozen=True)
class _Rows:
    robot: RobotDescription
    source: Path
    recording: Recording
    first: int  # number of the first of them in the source

    @classmethod
    def of(cls, config: Config, source: Path, numbers: RowNumbers, taken: SourceOptions, lerobot: Path | None) -> _Rows:
        """Read the rows; of a store, those with the present tool."""
        from bodyschema.cli.recordings.foreign import opened
        from bodyschema.daemon.learner.checkpoint import first_pair
        from bodyschema.recordings import files as recordings

        first = numbers.first
        if source.suffix.lower() in recordings.STORE_ENDINGS:
            stored = recordings.stored_pairs(source)
            recording = recordings.of_robot(stored.recording, config.robot.joints, source)
            first = first or first_pair(stored, source.with_name(config.checkpoint_file.name), config.robot.name)
        else:
            recording = opened(config, source, taken, lerobot)
        first = first or 1
        return cls(config.robot, source, recordings.between(recording, first, numbers.last, source), first)

    def calibrated(
        self, fit: FitOptions, common: CommonErrors | None, frame: str, *, force: bool
    ) -> tuple[Calibration, CalibrationReport]:
        """Return the calibration with its report; refuse rows that are not of this robot."""
        from bodyschema.calibration.report import CalibrationReport

        seen = self._checked(fit.sigma_m)
        if seen.misread:
            seen.require(self.source, force=force)
        found, free = fit.fitted(self.robot, self.recording, common)
        report = CalibrationReport.of(found, seen, self.source.name, self.first, frame, free)
        if report.other_tool_from is None:
            seen.require(self.source, force=force)
        return found, report

    def _checked(self, sigma_m: float | None) -> Plausibility:
        """Check that the recording can be of this robot; refuse units that no arm has."""
        from bodyschema.calibration.plausibility.check import plausibility, recorded_sigma
        from bodyschema.calibration.plausibility.limits import require_units

        rows = self.recording
        require_units(self.robot, rows, self.source)
        sigma_m = recorded_sigma(rows) or sigma_m
        return plausibility(self.robot, rows.q, rows.x, t=rows.t, sigma_m=sigma_m, orientation=rows.orientation)


def _common_errors(config: Config, source: Path, taken: SourceOptions) -> tuple[CommonErrors | None, list[str]]:
    """Return the errors that all positions share, and why they are left out although robot.toml names a calibration."""
    from bodyschema.cli.recordings.foreign import seen_elsewhere

    if config.tables.vision.cameras is None or seen_elsewhere(source, taken):
        return None, []
    from bodyschema.daemon.wiring.cameras import common_error

    try:
        cameras = common_error(config)
    except BodyschemaError as fault:
        return None, [f"The intervals leave out how well the cameras are calibrated: {fault}"]
    return None if cameras is None else cameras.errors, []


def _contained(found: Calibration) -> list[str]:
    """Return text on the cameras' error in the intervals, and on how to leave it out."""
    if found.common is None:
        return []
    rms_m = math.sqrt(float((found.common**2).sum(axis=(1, 2)).mean()))
    return [
        f"The intervals contain the cameras' calibration, which leaves {1e3 * rms_m:.2g} mm (1-sigma) in all positions "
        "alike; distances and expected errors are without its estimated part. Where another instrument measured the "
        "positions, give a robot.toml without `calibration` in [vision.cameras]."
    ]


def _require_writable(report: CalibrationReport, *, force: bool) -> None:
    from bodyschema.calibration.rigid_chain import CalibrationError
    from bodyschema.cli.terminal.calibration_view import two_tools

    if report.other_tool_from is not None:
        raise CalibrationError(f"nothing was written. {two_tools(report)}")
    if report.beyond is not None and not force:
        raise CalibrationError(f"nothing was written. {report.doubt} Or write it as it is with --force")


def _written(config: Config, found: Calibration, report: CalibrationReport, out: Path, *, replace: bool) -> list[str]:
    """Write the calibrated robot into `out`; return messages about it."""
    from bodyschema.robot.calibrated_files import write_calibrated
    from bodyschema.robot.hand_eye import write_launch_file

    heading = f"Calibrated by bodyschema from {report.pairs} samples of {report.source}"
    written = write_calibrated(config.robot, found.figures.geometry, out, heading, replace=replace)
    launch = write_launch_file(report.hand_eye, out)
    return [
        f"{launch} written, which publishes the same.",
        f"\n{written} written. Next: stop what runs with {config.file.name} (the new one has its ports), then "
        f"`bodyschema run --robot {written}`",
    ]


def _show(report: CalibrationReport, lines: list[str], written: list[str]) -> None:
    from bodyschema.cli.terminal.calibration_view import view
    from bodyschema.robot.hand_eye import in_shell_lines

    Console(highlight=False).print(view(report))
    trusted = written or (report.beyond is None and report.other_tool_from is None)
    for_ros = [f"\nIn ROS 2:\n{in_shell_lines(report.hand_eye)}"] if trusted else []
    say(*(["", *lines] if lines else []), *for_ros, *written)
