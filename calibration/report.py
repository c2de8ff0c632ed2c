"""Report of a calibration in degrees and millimetres."""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec
import numpy as np

from bodyschema.calibration.plausibility.verdict import Plausibility
from bodyschema.calibration.rigid_chain import Calibration, Trusted
from bodyschema.interfaces.records import FloatArray
from bodyschema.learning.solvers.tolerance_selection import ToleranceSettings
from bodyschema.recordings.recording import Recording
from bodyschema.robot.calibrated_files import CAMERA_LINK
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.hand_eye import HandEye
from kbmaps import ChainBelief, ChainParameters, RigidLearner


class _Settings:
    # Minimum number of pairs on either side of a change, and the share of all squared residuals that it must explain.
    fewest: int = 6
    explained: float = 0.5
    # With fewer rows than the first a change must explain the second: 0.55 came out of 20 rows of one real tool.
    few: int = 40
    explained_of_few: float = 0.8
    # Residuals beyond this multiple of the median get less weight, so that single outliers are no change.
    far: float = 5.0
    ridge: float = 1e-9  # Excludes splits that the data cannot determine, e.g. where all poses are alike.
    # Time stamps are late if the marker's velocity explains this share of the squared residuals: what they shift is
    # then a third of the scatter. In four simulated recordings at 0.2 m/s it is below 0.001 with stamps in time; 0.03
    # to 0.3 find delays from 1.5 to 4 ms on.
    late: float = 0.1
    # No real arm is as good as its URDF to this [m]: the best of 18 measured ones is 0.08 mm off, and positions that a
    # robot publishes about itself are exact to the rounding of its joints.
    computed_m: float = 3e-5
    still_rad, still_m = math.radians(10.0), 0.02  # a joint that moved less is named [rad, m]
    # Multiples of its tolerance beyond which a joint offset is reported, and beyond which it is not written. One in 370
    # exceeds the first if the tolerance is right; the second allows for a tolerance guessed at half its true value.
    far_off, too_far_off = 3.0, 5.0
    # Share of outliers above which they are mentioned: trackers and tags get less wrong.
    max_outliers: float = 0.1


@dataclass(frozen=True, slots=True)
class ToolJump:
    row: int  # the first row with the other tool, counted from 1
    distance_m: float  # distance between the marker positions of the two tools


def tool_jump(learner: RigidLearner, recording: Recording) -> ToolJump | None:
    """Return the first row with another marker position on the hand; None if there seems to be one tool.

    This is a change point test (Page 1955): two marker positions instead of one, with all other chain parameters fitted
    along, to first order. The chain was fitted to both tools and is therefore distorted, so distance and row are
    approximate.
    """
    if len(recording) < 2 * _Settings.fewest:
        return None
    explained, shifts = _splits(learner, recording)
    allowed = slice(_Settings.fewest - 1, len(recording) - _Settings.fewest)
    best = _Settings.fewest - 1 + int(explained[allowed].argmax())
    if explained[best] < (_Settings.explained_of_few if len(recording) < _Settings.few else _Settings.explained):
        return None
    return ToolJump(best + 2, float(np.linalg.norm(shifts[best])))


def _splits(learner: RigidLearner, recording: Recording) -> tuple[FloatArray, FloatArray]:
    """Return the share of squared residuals (n - 1,) explained by a tool change after each row but the last.

    Also return the displacement of the marker by that change (n - 1, 3) [m].
    """
    parameters = ChainParameters(learner.nominal)
    x, jacobian = parameters.linearised(learner.change, recording.q)
    residuals, tools = recording.x - x, jacobian[:, :, parameters.tool]
    squares = np.square(residuals).sum(axis=1)
    far = _Settings.far**2 * max(float(np.median(squares)), np.finfo(float).tiny)
    roots = np.sqrt(far / (far + squares))[:, None]
    prior = ChainBelief.from_tolerances(parameters, learner.tolerances)
    noise = np.sqrt(np.square(roots * residuals).mean())
    free = (roots[:, :, None] * jacobian).reshape(-1, parameters.size) @ prior.root / noise
    basis = np.linalg.qr(np.concatenate([free, np.eye(parameters.size)]))[0][: len(free)]
    target = (roots * residuals).ravel()
    target = (target - basis @ (basis.T @ target)).reshape(residuals.shape)
    columns = roots[:, :, None] * tools
    # Sums over all rows after each split, of the part of the columns that the other parameters do not explain.
    in_basis = _after(np.einsum("nip,nij->npj", basis.reshape(*residuals.shape, -1), columns))
    square = _after(columns.swapaxes(1, 2) @ columns) - in_basis.swapaxes(1, 2) @ in_basis
    product = _after(np.einsum("nij,ni->nj", columns, target))
    shifts: FloatArray = np.linalg.solve(square + _Settings.ridge * np.eye(3), product[..., None])[..., 0].astype(
        np.float64
    )
    return np.einsum("nj,nj->n", shifts, product) / np.square(target).sum(), shifts


def _after(values: FloatArray) -> FloatArray:
    """Return the sums of all values (n, ...) after each but the last: (n - 1, ...)."""
    return np.cumsum(values[::-1], axis=0)[::-1][1:]


_DEG = math.degrees(1.0)
_UNITS = (1e3, 1e3, 1e3, _DEG, _DEG, _DEG, 1e3, 1e3, 1e3)


class Figure(msgspec.Struct, frozen=True):
    """Nominal and calibrated value of a parameter, with the half width of its 95 % interval."""

    drawn: float
    learnt: float
    half_width: float


class Zero(msgspec.Struct, frozen=True):
    """Joint offset to add to the joint's reading, in `unit` (° or mm).

    `half_width` of its 95 % interval is null if the offset is not identifiable and kept at nominal; the other figures
    are conditional on that.
    """

    joint: str
    unit: str
    zero: float
    half_width: float | None


class CalibrationReport(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of a calibration, with messages."""

    robot: str
    source: str
    pairs: int  # learnt pairs, `outliers` of them left out
    outliers: int
    # camera_link, camera_xyz_mm, camera_rpy_deg: pose of the measurement frame in this link (URDF convention)
    camera_link: str
    camera_xyz_mm: list[Figure]
    camera_rpy_deg: list[Figure]
    marker_link: str
    marker_xyz_mm: list[Figure]
    zeros: list[Zero]  # of the joints, in the order of q
    noise_mm: float  # 1-sigma of a measured coordinate, from the scatter of the pairs around the learnt arm
    # the noise stated with the pairs (RMS), or null; if stated, the intervals rest on it
    told_noise_mm: float | None
    misfit: float  # ratio of the residuals to the stated noise; 1 if it explains them, or was not stated
    drawn_error_mm: float  # mean distance from the pairs to the nominal arm, with the unknowns of robot.toml fitted
    learnt_error_mm: float  # mean distance from the same pairs to the learnt arm, which was fitted to them
    # axes_deg, points_mm: estimated tolerances of the arm, 1-sigma of an axis' tilt and shift; null if the pairs do not
    # determine them
    axes_deg: float | None
    points_mm: float | None
    # number of identifiable parameters that the pairs determined (to a third of their prior uncertainty), out of
    # `showable` that positions can determine
    shown: int
    showable: int
    still: list[str]  # joints that hardly moved
    first: int  # number of the first row (of a store: pair) that was learnt
    # number of the first row with another marker position on the hand, or null: the figures are then valid for neither
    # tool
    other_tool_from: int | None
    other_tool_mm: float | None  # distance between the two, or null
    # reason to distrust all figures, or null: columns read wrongly, another robot, late timestamps, large offsets
    doubt: str | None
    # reason why no arm of the stated quality has these figures, or null: part of `doubt`; nothing is written then
    beyond: str | None = None
    undirected: list[str] = []  # joints whose sign the pairs do not determine
    # expected_mm, expected_p95_mm: mean distance on held-out poses, and its 95th percentile, from blocks of rows; null
    # if there are too few rows
    expected_mm: float | None
    expected_p95_mm: float | None
    hand_eye: HandEye  # the camera's pose in SI, for ROS
    tool_xyz_m: list[float]  # the marker in its link, with the covariance (3 x 3, row by row) in `tool_covariance` [m²]
    tool_covariance: list[float]
    trusted: Trusted  # the parts held at the URDF's values
    free_expected_mm: float | None = None  # `expected_mm` with nothing held, if anything is; otherwise null
    schema: int = 1

    @classmethod
    def of(
        cls,
        calibration: Calibration,
        seen: Plausibility,
        source: str,
        first: int = 1,
        frame: str = CAMERA_LINK,
        free: Calibration | None = None,
    ) -> CalibrationReport:
        """Build the report of `calibration`.

        Args:
            seen: plausibility of its recording.
            first: number of its first row.
            frame: ROS name of the measurement frame.
            free: the same calibration with nothing fixed to the URDF, for comparison.
        """
        jump = tool_jump(calibration.learner, calibration.recording)
        robot, recording, learner = calibration.robot, calibration.recording, calibration.learner
        report, made, slides = learner.report(), calibration.estimated_tolerances, robot.chain.prismatic
        named, expected = calibration.figures, calibration.expected
        zeros = _zeros(calibration, named.values[9:], named.half_widths[9:])
        made_badly = _large_tolerances(calibration)
        beyond = [*_improbable_zeros(calibration, zeros, _Settings.too_far_off), *made_badly]
        drawn_error_m = _mean_error(calibration.placed.chain.positions(recording.q), recording)
        doubts = [*seen.sentences, *_looks_simulated(drawn_error_m), *_stamped_late(calibration)]
        doubts += _many_left_out(calibration, first)
        if jump is None:  # figures of two tools mixed belong to neither
            doubts += [*_improbable_zeros(calibration, zeros, _Settings.far_off), *made_badly]
        values, halves = named.values, named.half_widths
        figures = [
            Figure(*(float(unit * number) for number in numbers))
            for unit, *numbers in zip(_UNITS, named.drawn[:9], values[:9], halves[:9], strict=True)
        ]
        return cls(
            robot=robot.name,
            source=source,
            pairs=len(recording),
            outliers=report.outliers,
            camera_link=robot.camera.parent_link,
            camera_xyz_mm=figures[:3],
            camera_rpy_deg=figures[3:6],
            marker_link=robot.robot.marker_link,
            marker_xyz_mm=figures[6:],
            zeros=zeros,
            noise_mm=1e3 * calibration.noise_m,
            told_noise_mm=1e3 * report.noise if calibration.noise_given else None,
            misfit=report.misfit,
            drawn_error_mm=1e3 * drawn_error_m,
            learnt_error_mm=1e3 * float(np.linalg.norm(calibration.residuals, axis=1).mean()),
            axes_deg=None if made is None else _DEG * made.axes,
            points_mm=None if made is None else 1e3 * made.points,
            shown=calibration.shown,
            # Everett and Hsu 1988: four for each revolute joint, two for each prismatic one, six for the ends of the
            # chain, minus the three rotations of the marker that its position does not determine.
            showable=4 * int((~slides).sum()) + 2 * int(slides.sum()) + 3,
            still=_still(robot, recording),
            first=first,
            other_tool_from=None if jump is None else first + jump.row - 1,
            other_tool_mm=None if jump is None else 1e3 * jump.distance_m,
            doubt=" ".join(doubts) or None,
            beyond=" ".join(beyond) or None,
            undirected=list(seen.undirected),
            expected_mm=None if expected is None else 1e3 * expected.mean_m,
            expected_p95_mm=None if expected is None else 1e3 * expected.p95_m,
            hand_eye=named.hand_eye(frame),
            tool_xyz_m=named.values[6:9].tolist(),
            tool_covariance=named.covariance[6:9, 6:9].ravel().tolist(),
            trusted=calibration.trusted,
            free_expected_mm=None if free is None or free.expected is None else 1e3 * free.expected.mean_m,
        )


def _zeros(calibration: Calibration, values: FloatArray, halves: FloatArray) -> list[Zero]:
    robot = calibration.robot
    units = np.where(robot.chain.prismatic, 1e3, _DEG)
    return [
        Zero(name, "mm" if slides else "°", float(unit * value), float(unit * half) if shown else None)
        for name, slides, unit, value, half, shown in zip(
            robot.joints, robot.chain.prismatic, units, values, halves, calibration.figures.shown, strict=True
        )
    ]


def _improbable_zeros(calibration: Calibration, zeros: list[Zero], times: float) -> list[str]:
    """Return messages about joint offsets larger than `times` their tolerance."""
    told = calibration.learner.tolerances
    said: list[str] = []
    for zero, slides in zip(zeros, calibration.robot.chain.prismatic, strict=True):
        tolerance = 1e3 * told.slide_zeros if slides else _DEG * told.zeros
        if abs(zero.zero) > times * tolerance:
            more = "" if slides else f" Where it is that far off, say so with --zeros-deg {math.ceil(abs(zero.zero))}."
            said.append(
                f"The zero of {zero.joint} comes out {zero.zero:+.1f} {zero.unit}, where {tolerance:.3g} {zero.unit} "
                f"(1-sigma) were allowed for: its zero is wrong, or the URDF is of another arm.{more}"
            )
    return said


def _looks_simulated(drawn_error_m: float) -> list[str]:
    """Return a message if the nominal arm, only placed, fits the positions better than any real one."""
    if drawn_error_m > _Settings.computed_m:
        return []
    return [
        f"The URDF fits these positions to {1e3 * drawn_error_m:.2g} mm, better than any real arm: they seem to be "
        "computed from the joints (the robot's own TF, /tcp_pose), not measured, and say nothing about the arm."
    ]


def _stamped_late(calibration: Calibration) -> list[str]:
    """Return a message if the residuals follow the marker's velocity, otherwise an empty list."""
    recording, residuals = calibration.recording, calibration.residuals
    if recording.t is None or len(recording) < _Settings.few:
        return []
    segment = np.zeros(len(recording)) if recording.segment is None else recording.segment
    rows = 1 + np.flatnonzero((segment[2:] == segment[:-2]) & calibration.learner.inliers[1:-1])
    x, t, off = recording.x - residuals, recording.t, residuals[rows]
    velocity = (x[rows + 1] - x[rows - 1]) / (t[rows + 1] - t[rows - 1])[:, None]
    along, moved = float((off * velocity).sum()), float(np.square(velocity).sum())
    if along**2 <= _Settings.late * moved * float(np.square(off).sum()):
        return []
    late_ms = -1e3 * along / moved
    return [
        "The residuals follow the motion, as if the positions were stamped too "
        f"{'late' if late_ms > 0 else 'early'}, by {abs(late_ms):.0f} ms or more: `bodyschema diagnose` measures it, "
        "and tells it from a joint that settles or has backlash. Of a bag or a dataset, add what it finds to "
        "--marker-delay-ms; of cameras, type `bodyschema calibrate latency --write` and record again."
    ]


def _many_left_out(calibration: Calibration, first: int) -> list[str]:
    """Return a message, if any, on more outliers than an instrument has, or on consecutive outliers."""
    off = np.flatnonzero(~calibration.learner.inliers)
    if len(off) <= _Settings.max_outliers * len(calibration.recording):
        return []
    runs = np.split(off, np.flatnonzero(np.diff(off) > 1) + 1)
    longest = max(runs, key=len) + first
    distance_mm = 1e3 * float(np.median(np.linalg.norm(calibration.residuals[off], axis=1)))
    where = "" if len(longest) == 1 else f" (the longest run: number {longest[0]} to {longest[-1]})"
    return [
        f"{100.0 * len(off) / len(calibration.recording):.0f} % of the samples do not fit and were left out: they are "
        f"off by {distance_mm:.3g} mm (median){where}. So many are seldom errors of the instrument: ask what was "
        "different there, such as a joint that carries another one along, or a marker or an instrument that was moved."
    ]


def _large_tolerances(calibration: Calibration) -> list[str]:
    """Return a message if the geometric errors reach the largest that are considered, otherwise an empty list."""
    made, (axes, points) = calibration.estimated_tolerances, ToleranceSettings.candidates[-1]
    if made is None or made.axes < axes:
        return []
    return [
        f"The links would be off by {_DEG * axes:.2g}° and {1e3 * points:.0f} mm or more, the worst that is "
        "considered. "
        "The URDF or the recording is of another arm."
    ]


def _still(robot: RobotDescription, recording: Recording) -> list[str]:
    """Return the joints that hardly moved."""
    least = np.where(robot.chain.prismatic, _Settings.still_m, _Settings.still_rad)
    moved = np.ptp(recording.q, axis=0)
    return [name for name, still in zip(robot.joints, moved < least, strict=True) if still]


def _mean_error(predicted: FloatArray, recording: Recording) -> float:
    return float(np.linalg.norm(predicted - recording.x, axis=1).mean())
