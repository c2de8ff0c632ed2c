"""Recordings of arms with tolerances at every link, and causes that stand out from these."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from .arms import Arm
from .arrays import BoolArray, FloatArray, IntArray
from .dense_arms import Made, described, made
from .dense_causes import Cause, Way, all_causes, columns, conflicts
from .dense_chain import Built, Posture
from .dense_observer import Observer, whitened
from .files import write_recording, write_robot
from .hidden import direction
from .joints import biased_poles, off_centre_ring, play
from .motion import Motion, move

DECIDABLE = 7.5  # nats
A_CAUSE = 3.0  # nats that a cause of the usual weight costs
TRIES = 80
HARD_SHARE, HARD = 0.12, 1.0  # share of cases that need only this evidence [nats], which excludes gauges
COUNTS, SHARES = (0, 1, 2, 3, 5), (0.2, 0.25, 0.2, 0.2, 0.15)
ZEROS = 0.5  # share of the cases with several causes that have several zeros
WEIGHTS = {
    "joint_offset": 4.0,
    "link_geometry": 1.5,
    "backlash": 1.2,
    "joint_compliance": 1.0,
    "joint_eccentricity": 1.0,
    "joint_ripple": 0.7,
    "joint_scale": 0.8,
    "joint_coupling": 0.7,
    "tool_slip": 0.5,
    "encoder_jump": 0.7,
    "camera_moved": 0.5,
    "camera_pose": 0.5,
    "tool_offset": 1.5,
}
LOADED = 0.1  # share of the largest load: a joint with less is not given a compliance
STUDENT = 4.0  # degrees of freedom


@dataclass(frozen=True)
class Noise:
    """Measurement noise of the instrument.

    Attributes:
        sigma_m: along each axis, false fixes left out.
        kind: gauss, student, outliers or slow.
        share: of false fixes.
        correlation: of neighbouring rows.
    """

    sigma_m: float
    kind: str
    share: float
    correlation: float

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Noise:
        sigma = float(np.exp(rng.uniform(math.log(15e-6), math.log(0.4e-3))))
        kind = str(rng.choice(["gauss", "student", "outliers", "slow"], p=[0.5, 0.2, 0.15, 0.15]))
        share = float(rng.uniform(0.01, 0.02)) if kind == "outliers" else 0.0
        return cls(sigma, kind, share, 0.7 if kind == "slow" else 0.0)

    @property
    def told_sigma_m(self) -> float:
        """1 sigma of Gaussian noise with the same Fisher information."""
        if self.kind != "student":
            return self.sigma_m
        return self.sigma_m * math.sqrt((STUDENT - 2.0) / STUDENT * (STUDENT + 3.0) / (STUDENT + 1.0))

    def of(self, begins: BoolArray, rng: np.random.Generator) -> tuple[FloatArray, BoolArray]:
        """Return noise (n, 3) [m] of rows, given the first row of each run, and a mask of the outliers."""
        n = len(begins)
        noise = rng.normal(0.0, self.sigma_m, (n, 3))
        if self.kind == "student":
            noise = self.sigma_m * math.sqrt((STUDENT - 2.0) / STUDENT) * rng.standard_t(STUDENT, (n, 3))
        if self.correlation:
            fresh = math.sqrt(1.0 - self.correlation**2)
            for row in np.flatnonzero(~begins):
                noise[row] = self.correlation * noise[row - 1] + fresh * noise[row]
        false = rng.random(n) < self.share
        far = rng.uniform(5e-3, 50e-3, (int(false.sum()), 1)) * _directions(int(false.sum()), rng)
        noise[false] += far
        return noise, false


@dataclass(frozen=True, eq=False)
class Taken:
    """One recording.

    Attributes:
        t: stamps [s], or None; segment: runs, or None where each pose stands alone.
        q: readings (n, d); x, x_true: positions as measured and free of noise (n, 3) [m].
        false: fixes that are not the marker (n,).
    """

    t: FloatArray
    segment: IntArray
    q: FloatArray
    x: FloatArray
    x_true: FloatArray
    false: BoolArray


@dataclass(frozen=True, eq=False)
class DenseCase:
    """A case: `folder`/case is the input of the diagnosis; truth and a second recording are beside it.

    Attributes:
        truth: the hidden causes.
        nats: of each, by how much an observer who knows the scale of tolerances and noise prefers the truth to the
            best set without it.
        rivals: keys of the causes that replace it in that set.
        same: keys of causes equivalent to it in any motion, with as few numbers.
        spare_nats: margin of the truth over the best set with one cause more.
        rounding_m: effect of the encoders' rounding on a position, along each axis.
        nominal: the arm as described, with its instrument and marker as robot.toml puts them.
    """

    folder: Path
    seed: int
    arm: Arm
    made: Made
    noise: Noise
    style: str
    hold: str
    timed: bool
    marker_known: bool
    pose_known: bool
    truth: tuple[Cause, ...]
    nats: tuple[float, ...]
    rivals: tuple[tuple[str, ...], ...]
    same: tuple[tuple[str, ...], ...]
    spare_nats: float
    rounding_m: float
    nominal: Built
    measured: Taken
    fresh: Taken

    @property
    def is_decidable(self) -> bool:
        """True if a perfect observer would name all causes and no other."""
        return min((*self.nats, math.inf)) >= DECIDABLE and self.spare_nats > 0.0

    @property
    def recording(self) -> Path:
        """measured.csv; robot.toml is beside it."""
        return self.folder / "case" / "measured.csv"


def hide_dense(
    seed: int, folder: Path, *, rows: int | None = None, count: int | None = None, fresh_rows: int = 300
) -> DenseCase:
    """Write a case into `folder`; everything comes from `seed`.

    Args:
        rows: most rows of the recording; any number from 46 to 10,000 when None.
        count: of causes; any when None.
    """
    streams = [np.random.default_rng(child) for child in np.random.SeedSequence([0xDE45E, seed]).spawn(7)]
    setting, building, making, moving, choosing, noising, freshly = streams
    walks = bool(setting.random() < 0.4)
    with_masses = bool(setting.random() < 0.8)
    pose_known, marker_known = bool(setting.random() < 0.3), bool(setting.random() < 0.3)
    hold = str(setting.choice(["torque_free", "zero_force"], p=[0.7, 0.3])) if walks else "held"
    timed = walks or bool(setting.random() < 0.5)
    arm = described(building, with_masses=with_masses)
    as_made, noise = made(arm, making), Noise.drawn(setting)
    motion = move(moving, "walk" if walks else "held", arm.ranges, _rows(setting, walks, rows), _always)
    plain = Built(arm, as_made.frames, np.array(arm.marker_xyz), _eye_R(arm), np.array(arm.camera_xyz), _rigid(arm))

    way = _way(arm, motion, plain, timed)
    candidates = all_causes(
        arm,
        float(way.clock[-1]),
        choosing,
        loaded=_loaded(way) if with_masses and hold != "torque_free" else (),
        marker_known=marker_known,
        pose_known=pose_known,
        longest=float(np.linalg.norm(plain.measured(way.shaft[:1])[0])),
    )
    observer = _observer(candidates, way, as_made, noise, motion, marker_known=marker_known, pose_known=pose_known)
    wanted = int(choosing.choice(COUNTS, p=SHARES)) if count is None else count
    chosen = _chosen(candidates, observer, wanted, arm, choosing)
    evidence, spare = observer.evidence(chosen)
    truth = tuple(candidates[k] for k in chosen)

    robot = _Robot(arm, as_made, plain, truth)
    measured = _taken(robot, motion, timed, noise, noising)
    again = move(freshly, motion.style, arm.ranges, min(fresh_rows, len(motion.stamps)), _always)
    fresh = _taken(robot, again, timed, noise, freshly)
    told = _told(arm, setting, marker_known=marker_known, pose_known=pose_known)
    case = DenseCase(
        folder=folder,
        seed=seed,
        arm=told,
        made=as_made,
        noise=noise,
        style=motion.style,
        hold=hold,
        timed=timed,
        marker_known=marker_known,
        pose_known=pose_known,
        truth=truth,
        nats=tuple(e.nats for e in evidence),
        rivals=tuple(tuple(written(candidates[k]) for k in e.rival) for e in evidence),
        same=tuple(tuple(written(candidates[j]) for j in observer.same(k, chosen)) for k in chosen),
        spare_nats=spare,
        rounding_m=_rounding_m(arm, way.posture.by_joints()),
        nominal=Built(
            told, np.zeros_like(as_made.frames), np.array(told.marker_xyz), _eye_R(told), np.array(told.camera_xyz)
        ),
        measured=measured,
        fresh=fresh,
    )
    _write(case, tells_noise=bool(setting.random() < 0.25))
    return case


def written(cause: Cause) -> str:
    """Return the cause as `effect@where:source`."""
    effect, where, source = cause.key
    return effect + (f"@{where}" if where else "") + (f":{source}" if source else "")


def sealed(case: DenseCase) -> dict[str, Any]:
    """Return the ground truth for a file."""
    return {
        "seed": case.seed,
        "joints": list(case.arm.read),
        "slides": [name for name in case.arm.read if case.arm.joint(name).kind == "prismatic"],
        "rows": len(case.measured.q),
        "style": case.style,
        "hold": case.hold,
        "timed": case.timed,
        "has_masses": bool(case.arm.masses),
        "marker_known": case.marker_known,
        "pose_known": case.pose_known,
        "noise": asdict(case.noise),
        "rounding_m": case.rounding_m,
        "false_fixes": int(case.measured.false.sum()),
        "tolerances": {name: getattr(case.made, name) for name in ("length_m", "angle_rad", "drive_rad", "drive_m")},
        "truth": [
            {
                "cause": written(cause),
                "amounts": cause.amounts.tolist(),
                "shape": cause.shape,
                "nats": nats,
                "rival": list(rival),
                "same": list(same),
            }
            for cause, nats, rival, same in zip(case.truth, case.nats, case.rivals, case.same, strict=True)
        ],
        "spare_nats": case.spare_nats,
        "decidable": case.is_decidable,
    }


@dataclass(frozen=True, eq=False)
class _Robot:
    """The arm with its tolerances and causes."""

    arm: Arm
    made: Made
    plain: Built
    causes: Sequence[Cause]

    def readings(self, shaft: FloatArray, clock: FloatArray) -> FloatArray:
        """Return encoder readings (n, d), in whole ticks."""
        read = shaft.copy()
        for index, name in enumerate(self.arm.read):
            column = read[:, index]
            for cause in self._at(name):
                column = _misread(column, cause, clock)
            tick = self.arm.quantum(name)
            read[:, index] = np.rint(column / tick) * tick
        return read

    def outputs(self, motion: Motion) -> FloatArray:
        """Return the joints' true positions (n, d) when the rows are read, before their compliance."""
        rows = np.searchsorted(motion.t, motion.stamps)
        shaft = motion.shaft[rows]
        out = np.empty_like(shaft)
        for index, name in enumerate(self.arm.read):
            there = shaft[:, index]
            for cause in self._at(name):
                if cause.effect == "backlash":
                    there = play(motion.shaft[:, index], cause.amounts[0])[rows]
            out[:, index] = there + self.made.drive_error(index, shaft[:, index])
            for cause in self._at(name):
                if cause.effect == "joint_coupling":
                    out[:, index] += cause.amounts[0] * shaft[:, self.arm.read.index(str(cause.source))]
        return out

    def positions(self, motion: Motion, clock: FloatArray) -> FloatArray:
        """Return positions of the marker in the measurement frame (n, 3) [m], free of noise."""
        frames, soft = self.made.frames.copy(), np.zeros(len(self.arm.read))
        marker = np.tile(self.plain.marker, (len(clock), 1))
        out = self.outputs(motion)
        for cause in self.causes:
            match cause.effect:
                case "link_geometry":
                    frames[self.arm.read.index(str(cause.where))] += cause.amounts
                case "tool_offset":
                    marker = marker + cause.amounts
                case "tool_slip":
                    marker = marker + _after(cause, clock)[:, None] * cause.amounts
        built = replace(self.plain, frames=frames, marker=marker)
        for cause in self.causes:
            if cause.effect == "joint_compliance":
                index = self.arm.read.index(str(cause.where))
                load = np.abs(Posture.of(self.plain, out).torques()[:, index]).max()
                soft[index] = cause.amounts[0] / max(float(load), 1e-9)
        built = replace(built, soft=soft)
        x = built.measured(built.balanced(out))
        for cause in self.causes:
            if cause.effect in ("camera_pose", "camera_moved"):
                turn = Rotation.from_rotvec(cause.amounts[3:]).as_matrix()
                x = np.where(_after(cause, clock)[:, None] > 0.0, (x - cause.amounts[:3]) @ turn, x)
        return x

    def _at(self, name: str) -> list[Cause]:
        return [cause for cause in self.causes if cause.where == name]


def _misread(shaft: FloatArray, cause: Cause, clock: FloatArray) -> FloatArray:
    """Return the readings (n,) of an encoder with this cause."""
    a = cause.amounts
    match cause.effect:
        case "joint_offset":
            return shaft + a[0]
        case "joint_scale":
            return shaft * (1.0 + a[0])
        case "joint_eccentricity":
            return off_centre_ring(shaft, a[0], a[1])
        case "joint_ripple":
            ratio = 2.0 * math.pi / cause.shape["turn"]
            return biased_poles(shaft * ratio, cause.shape["poles"], a[0], a[1]) / ratio
        case "encoder_jump":
            return shaft + a[0] * _after(cause, clock)
    return shaft


def _after(cause: Cause, clock: FloatArray) -> FloatArray:
    return np.asarray(clock >= cause.shape.get("moment", -math.inf), dtype=float)


def _rows(rng: np.random.Generator, walks: bool, most: int | None) -> int:
    low, high = (300, 10_000 if rng.random() < 0.08 else 1600) if walks else (46, 1000)
    high = high if most is None else min(high, most)
    return int(np.rint(np.exp(rng.uniform(math.log(min(low, high)), math.log(high)))))


def _way(arm: Arm, motion: Motion, built: Built, timed: bool) -> Way:
    rows = np.searchsorted(motion.t, motion.stamps)
    return Way(arm, motion.shaft, rows, _clock(motion, timed), Posture.of(built, motion.shaft[rows]))


def _loaded(way: Way) -> list[str]:
    """Return the joints that bear a load by design, not only by their tolerances."""
    loads = np.abs(way.posture.torques()).max(axis=0)
    slides = np.array([way.arm.joint(name).kind == "prismatic" for name in way.arm.read])
    torque = loads.max(where=~slides, initial=1e-6)
    force = max(loads.max(where=slides, initial=1e-6), torque)  # a slide that lies flat bears less than torque over 1 m
    enough = loads > LOADED * np.where(slides, force, torque)
    return [name for name, loaded in zip(way.arm.read, enough, strict=True) if loaded]


def _clock(motion: Motion, timed: bool) -> FloatArray:
    """Return times in seconds, or row numbers if no times are written."""
    return motion.stamps if timed else np.arange(len(motion.stamps), dtype=float)


def _observer(
    causes: Sequence[Cause],
    way: Way,
    as_made: Made,
    noise: Noise,
    motion: Motion,
    *,
    marker_known: bool,
    pose_known: bool,
) -> Observer:
    """Return an observer that knows the scales of `as_made` and of the noise."""
    by_joints, by_frames = way.posture.by_joints(), way.posture.by_frames()
    begins = _begins(motion)
    sigma_m = math.hypot(noise.told_sigma_m, _rounding_m(way.arm, by_joints))

    def white(block: FloatArray) -> FloatArray:
        return whitened(block, sigma_m, noise.correlation, begins)

    flat = [
        *([] if pose_known else [white(way.posture.by_eye())]),
        *([] if marker_known else [white(way.posture.by_marker())]),
        np.empty((3 * len(way.rows), 0)),
    ]
    sigma = np.repeat([as_made.length_m, as_made.angle_rad], 3)
    background = [white(by_frames[:, :, k] * sigma) for k in range(len(way.arm.read))]
    drawn = [as_made.frames[k] / sigma for k in range(len(way.arm.read))]
    for k, name in enumerate(way.arm.read):
        rows = as_made.harmonics[k]
        usual = as_made.drive_m if way.arm.joint(name).kind == "prismatic" else as_made.drive_rad
        sizes = usual * np.array([1.0, 0.6, 0.4])[: len(rows)] / math.sqrt(2.0)
        phase = np.multiply.outer(way.shaft[:, k], rows[:, 0])
        signals = np.concatenate([np.sin(phase) * sizes, np.cos(phase) * sizes], axis=1)
        background.append(white(by_joints[:, :, k, None] * signals[:, None, :]))
        drawn.append(np.concatenate([rows[:, 1] / sizes, rows[:, 2] / sizes]))
    return Observer.of(
        np.column_stack(flat),
        np.column_stack(background),
        np.concatenate(drawn),
        [white(columns(cause, way, by_joints, by_frames) * cause.usual) for cause in causes],
        [cause.amounts / cause.usual for cause in causes],
        A_CAUSE - np.log(_weights(causes)),
    )


def _rounding_m(arm: Arm, by_joints: FloatArray) -> float:
    """Return the RMS of encoder quantisation at the marker, along each axis [m]."""
    rounding = np.array([arm.quantum(name) for name in arm.read]) / math.sqrt(12.0)
    return float(np.sqrt(np.square(by_joints * rounding).sum(axis=2).mean()))


def _weights(causes: Sequence[Cause]) -> FloatArray:
    """Return the relative frequency of each cause at its place (K,), mean 1."""
    kinds = [cause.effect for cause in causes]
    weights = np.array([WEIGHTS[kind] / kinds.count(kind) for kind in kinds])
    return weights / weights.mean()


def _chosen(causes: Sequence[Cause], observer: Observer, count: int, arm: Arm, rng: np.random.Generator) -> list[int]:
    """Choose causes to hide, each decidable beside the others if possible."""
    weights = _weights(causes)
    zeros = np.array([cause.effect == "joint_offset" for cause in causes])
    of_zeros = int(rng.integers(2, max(count, 2) + 1)) if count > 1 and rng.random() < ZEROS else 0
    least = HARD if rng.random() < HARD_SHARE else DECIDABLE
    chosen: list[int] = []
    best: tuple[float, list[int]] = (-math.inf, [])
    for trial in range(TRIES if count else 0):
        if trial == TRIES // 2:  # the tolerances may be too wide for zeros
            of_zeros = 0
        if len(chosen) == count:
            evidence, _ = observer.evidence(chosen)
            nats = [e.nats for e in evidence]
            best = max(best, (min(nats, default=math.inf), list(chosen)))
            if best[0] >= least:
                break
            chosen = [k for k, value in zip(chosen, nats, strict=True) if value >= least]
        while len(chosen) < count:
            only_zeros = sum(zeros[k] for k in chosen) < of_zeros
            allowed = weights * (zeros if only_zeros else 1.0)
            allowed = allowed * [not conflicts(cause, [causes[k] for k in chosen], arm) for cause in causes]
            if not allowed.any():
                of_zeros = 0
                continue
            chosen.append(int(rng.choice(len(causes), p=allowed / allowed.sum())))
    return best[1]


def _taken(robot: _Robot, motion: Motion, timed: bool, noise: Noise, rng: np.random.Generator) -> Taken:
    clock = _clock(motion, timed)
    x_true = robot.positions(motion, clock)
    added, false = noise.of(_begins(motion), rng)
    shaft = motion.shaft[np.searchsorted(motion.t, motion.stamps)]
    return Taken(motion.stamps, motion.segment, robot.readings(shaft, clock), x_true + added, x_true, false)


def _begins(motion: Motion) -> BoolArray:
    """Return a mask of the first rows of runs; static poses are one sequence."""
    if motion.style == "held":
        return np.arange(len(motion.stamps)) == 0
    return np.append(True, np.diff(motion.segment) > 0)


def _told(arm: Arm, rng: np.random.Generator, *, marker_known: bool, pose_known: bool) -> Arm:
    """Return the arm with instrument and marker as robot.toml describes them."""
    if not pose_known and rng.random() < 0.5:  # arbitrary pose of the instrument
        arm = replace(arm, camera_xyz=(0.0, 0.0, 0.0), camera_rpy=(0.0, 0.0, 0.0))
    elif not pose_known:
        xyz = np.array(arm.camera_xyz) + 0.03 * direction(rng)
        turn = Rotation.from_euler("xyz", arm.camera_rpy) * Rotation.from_rotvec(0.04 * direction(rng))
        x, y, z = turn.as_euler("xyz").tolist()
        arm = replace(arm, camera_xyz=tuple(xyz.tolist()), camera_rpy=(x, y, z))
    if not marker_known:
        xyz = np.array(arm.marker_xyz) + 0.015 * direction(rng)
        arm = replace(arm, marker_xyz=tuple(xyz.tolist()))
    return arm


def _write(case: DenseCase, *, tells_noise: bool) -> None:
    folder, arm = case.folder / "case", case.arm
    robot = write_robot(folder, arm, case.hold, marker_known=case.marker_known, pose_known=case.pose_known)
    text = robot.read_text(encoding="utf-8")
    robot.write_text(text[: text.index("focal_px")], encoding="utf-8")
    if not arm.masses:
        urdf = folder / "arm.urdf"
        bare = re.sub(r"<inertial>.*?</inertial>", "", urdf.read_text(encoding="utf-8"))
        urdf.write_text(bare, encoding="utf-8")
    for file, taken in ((case.recording, case.measured), (case.folder / "fresh.csv", case.fresh)):
        told = np.tile(np.eye(3) * case.noise.sigma_m**2, (len(taken.q), 1, 1)) if tells_noise else None
        segment = taken.segment if case.style != "held" else None
        write_recording(file, arm.read, taken.t if case.timed else None, segment, taken.q, taken.x, told)
    np.save(case.folder / "fresh_true.npy", case.fresh.x_true)
    (case.folder / "sealed.json").write_text(json.dumps(sealed(case), indent=1), encoding="utf-8")


def _eye_R(arm: Arm) -> FloatArray:
    return Rotation.from_euler("xyz", arm.camera_rpy).as_matrix()


def _rigid(arm: Arm) -> FloatArray:
    return np.zeros(len(arm.read))


def _always(q: FloatArray) -> BoolArray:
    return np.ones(len(q), dtype=bool)


def _directions(count: int, rng: np.random.Generator) -> FloatArray:
    v = rng.normal(size=(count, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)
