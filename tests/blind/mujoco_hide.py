"""Recordings of public arms simulated by MuJoCo, with one or several causes hidden in each."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from .arrays import FloatArray, vector
from .files import write_recording
from .mujoco_urdf import FLOOR, MARKER, MODELS, Model, Urdf
from .mujoco_world import STEP_S, Hinge, World

Style = Literal["walk", "static"]
STYLES: tuple[Style, ...] = ("walk", "static")
MOUNTS = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (math.pi, 0.0, 0.0), (0.5 * math.pi, 0.0, 0.0), (0.6, 0.3, 0.0))
MARKER_XYZ = np.array([0.06, 0.04, 0.12])
# Largest part of its limits [rad] over which a joint is moved, to either side of their middle.
FARTHEST = 1.4
NOISE_M = (0.1e-3, 0.5e-3)
TIMES_NOISE = (4.0, 14.0)  # RMS of a cause's effect on the marker over that of the noise
PAYLOADS = (0.07, 0.3)  # shares of the arm's mass
LENGTH_M, ANGLE_RAD = 0.3e-3, math.radians(0.06)
DENSE_SCALES = (0.3, 3.0)
FRESH_ROWS = 120
CONFIG = """\
[robot]
name = "{name}"
urdf = "arm.urdf"
joints = [{joints}]
marker_link = "{marker}"
marker_xyz = {marker_xyz}
marker_known = {marker_known}
hold = "held"

[camera]
parent_link = "{floor}"
xyz = {xyz}
rpy = {rpy}
pose_known = {pose_known}
"""


@dataclass(frozen=True)
class Truth:
    """One hidden cause.

    Attributes:
        name: `effect@joint` as in diagnosis.json; "" where no effect describes it.
        same: other names for the same.
        joints: with an empty name, the joints of which one has to be named.
        cycles: a turn, of a strain wave.
        says: in words, with sizes.
    """

    name: str
    says: str
    same: tuple[str, ...] = ()
    joints: tuple[str, ...] = ()
    cycles: float | None = None


@dataclass
class Drawn:
    """An arm while causes are hidden in it.

    Attributes:
        changed: the URDF with what is not in the nominal one.
        errors: for each joint, functions from readings (m,) [rad] to what the motor's angle is more than the reading.
        also: names that are no mistakes although they are not looked for.
        slip, bump: of marker [m] (3,), and of the camera [m, rad] (6,); None for none.
        latency: seconds at the beginning of a recording, and by how many it grows until its end.
    """

    urdf: Urdf
    changed: Urdf
    rng: np.random.Generator
    postures: FloatArray
    levers: FloatArray
    loads: FloatArray
    noise_m: float
    dense: float
    hinges: dict[str, Hinge] = field(default_factory=dict)
    errors: dict[str, list[Callable[[FloatArray], FloatArray]]] = field(default_factory=dict)
    truth: list[Truth] = field(default_factory=list)
    also: list[str] = field(default_factory=list)
    slip: FloatArray | None = None
    bump: FloatArray | None = None
    latency: tuple[float, float] = (0.0, 0.0)

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints that are read."""
        return self.urdf.model.joints

    def joint(self, *, bears: float = 0.0) -> int:
        """Draw a joint in the middle of the arm with a long lever; `bears` is the least share of the largest load."""
        peak = np.abs(self.loads).max(axis=0)
        middle = [
            k
            for k in range(1, len(self.joints) - 1)
            if self.levers[k] > 0.25 * self.levers[1:-1].max() and peak[k] >= bears * peak.max()
        ]
        free = [k for k in middle if f"{self.joints[k]}_give" not in self.hinges and self.joints[k] not in self.errors]
        return int(self.rng.choice(free or middle))

    def angle(self, joint: int, lowest: float, highest: float) -> float:
        """Draw an angle [rad] that shows well in the noise, inside bounds [deg]."""
        shows = self.rng.uniform(*TIMES_NOISE) * math.sqrt(3.0) * self.noise_m / self.levers[joint]
        return float(np.clip(shows, math.radians(lowest), math.radians(highest)))

    def sign(self) -> float:
        return float(self.rng.choice([-1.0, 1.0]))

    def errs(self, joint: int, error: Callable[[FloatArray], FloatArray]) -> None:
        """Add an error of a joint's reading."""
        self.errors.setdefault(self.joints[joint], []).append(error)

    def give(self, joint: int) -> str:
        """Add a passive hinge behind a joint's motor."""
        return self.changed.add_give(self.joints[joint])


def _zero(drawn: Drawn) -> None:
    joint = drawn.joint()
    least = 8.0 * math.degrees(ANGLE_RAD) * drawn.dense
    offset = drawn.sign() * drawn.angle(joint, max(0.3, least), max(3.0, 2.0 * least))
    drawn.errs(joint, lambda reading: np.full_like(reading, offset))
    name = drawn.joints[joint]
    drawn.truth.append(Truth(f"joint_offset@{name}", f"zero of {name} off by {math.degrees(offset):.2f} deg"))


def _zeros(drawn: Drawn) -> None:
    for _ in range(int(drawn.rng.integers(2, 4))):
        _zero(drawn)


def _ratio(drawn: Drawn) -> None:
    joint = drawn.joint()
    scale = drawn.sign() * float(drawn.rng.uniform(0.006, 0.02))
    drawn.errs(joint, lambda reading: scale * reading)
    name = drawn.joints[joint]
    drawn.truth.append(Truth(f"joint_scale@{name}", f"ratio of {name} off by {100 * scale:.2f} %"))


def _eccentric(drawn: Drawn) -> None:
    joint = drawn.joint()
    size = drawn.angle(joint, 0.5, 1.5)
    phase = float(drawn.rng.uniform(0.0, 2.0 * math.pi))
    drawn.errs(joint, lambda reading: size * np.sin(reading + phase))
    name = drawn.joints[joint]
    drawn.truth.append(
        Truth(f"joint_eccentricity@{name}", f"encoder of {name} eccentric by {math.degrees(size):.2f} deg")
    )


def _wave(drawn: Drawn) -> None:
    joint = drawn.joint()
    size, cycles = drawn.angle(joint, 0.06, 0.3), float(2 * drawn.rng.integers(50, 101))
    phase = float(drawn.rng.uniform(0.0, 2.0 * math.pi))
    drawn.errs(joint, lambda reading: size * np.sin(cycles * reading + phase))
    name = drawn.joints[joint]
    says = f"strain wave of {name}, {math.degrees(size):.2f} deg, {cycles:.0f} a turn"
    drawn.truth.append(Truth(f"joint_ripple@{name}", says, cycles=cycles))


def _play_by_friction(drawn: Drawn) -> None:
    joint = drawn.joint()
    width, name = 2.0 * drawn.angle(joint, 0.15, 0.8), drawn.joints[joint]
    friction = 2.0 * float(np.abs(drawn.loads[:, joint]).max()) + 1.0
    drawn.hinges[drawn.give(joint)] = Hinge(half_width=0.5 * width, bearing_friction=friction, motor=name)
    drawn.truth.append(Truth(f"backlash@{name}", f"play of {name}, {math.degrees(width):.2f} deg, held by friction"))


def _play_by_gravity(drawn: Drawn) -> None:
    joint = drawn.joint(bears=0.15)
    width, name = 2.0 * drawn.angle(joint, 0.15, 0.8), drawn.joints[joint]
    load = float(np.abs(drawn.loads[:, joint]).max())
    friction = load * float(drawn.rng.uniform(0.0, 0.1))
    drawn.hinges[drawn.give(joint)] = Hinge(half_width=0.5 * width, friction=friction)
    says = f"play of {name}, {math.degrees(width):.2f} deg, the arm hangs on one flank, friction {friction:.2f} N m"
    drawn.truth.append(Truth(f"gravity_backlash@{name}", says))


def _spring(drawn: Drawn, payload: float = 0.0) -> None:
    """Put a spring at a joint that bears weight, and perhaps more by a payload [N m]."""
    joint = drawn.joint(bears=0.15)
    name, load = drawn.joints[joint], float(drawn.loads[:, joint].std()) + payload
    stiffness = load / drawn.angle(joint, 0.1, 0.8)
    drawn.hinges[drawn.give(joint)] = Hinge(stiffness=stiffness)
    drawn.truth.append(Truth(f"joint_compliance@{name}", f"spring at {name}, {stiffness:.0f} N m/rad"))


def _payload(drawn: Drawn) -> None:
    kilograms = float(drawn.rng.uniform(*PAYLOADS)) * drawn.urdf.kilograms
    at = drawn.rng.uniform([-0.05, -0.05, 0.03], [0.05, 0.05, 0.15])
    drawn.truth.append(Truth("payload", f"{kilograms:.2f} kg at the hand, {np.round(at, 3).tolist()} m"))
    for _ in range(2):
        _spring(drawn, payload=0.3 * kilograms * 9.81)
    drawn.changed.add_payload(kilograms, at)


def _hysteresis(drawn: Drawn, *, damped: bool) -> None:
    joint = drawn.joint()
    lag, name = drawn.angle(joint, 0.15, 0.8), drawn.joints[joint]
    length = math.radians(float(drawn.rng.uniform(0.5, 3.0)))
    sag = lag * float(drawn.rng.uniform(0.1, 0.5))
    stiffness = max(float(np.abs(drawn.loads[:, joint]).max()), 2.0) / sag
    hinge = Hinge(stiffness, None, 0.0, stiffness * lag, stiffness * lag / length, damped, name)
    drawn.hinges[drawn.give(joint)] = hinge
    says = f"{'LuGre' if damped else 'Dahl'} friction at {name}: lags by {math.degrees(lag):.2f} deg, presliding over "
    drawn.truth.append(Truth(f"hysteresis@{name}", f"{says}{math.degrees(length):.2f} deg"))
    drawn.also.append(f"joint_compliance@{name}")


def _dahl(drawn: Drawn) -> None:
    _hysteresis(drawn, damped=False)


def _lugre(drawn: Drawn) -> None:
    _hysteresis(drawn, damped=True)


def _base_tilts(drawn: Drawn) -> None:
    names = drawn.changed.add_tilt()
    probe = World(drawn.changed.text_for_mujoco, drawn.joints, {}, MARKER)
    loads = probe.loads(drawn.postures)[:, [probe.address(name) for name in names]]
    tilt = math.radians(float(drawn.rng.uniform(0.1, 0.35)))
    stiffness = float(loads.std(axis=0).max()) / tilt
    for name in names:
        drawn.hinges[name] = Hinge(stiffness=stiffness)
    says = f"base tilts by {math.degrees(tilt):.2f} deg (rms) under the arm"
    drawn.truth.append(Truth("", says, joints=drawn.joints[:-1]))


def _link_bends(drawn: Drawn) -> None:
    peak = np.abs(drawn.loads).max(axis=0)
    long = [k for k in range(1, len(drawn.joints) - 3) if peak[k + 1] > 0.02 * peak.max()]
    joint = int(drawn.rng.choice(long))
    name, following = drawn.joints[joint : joint + 2]
    hinges = drawn.changed.add_bend(name, following)
    probe = World(drawn.changed.text_for_mujoco, drawn.joints, {}, MARKER)
    loads = probe.loads(drawn.postures)[:, [probe.address(hinge) for hinge in hinges]]
    bend = drawn.angle(joint + 1, 0.1, 0.5)
    stiffness = float(loads.std(axis=0).max()) / bend
    for hinge in hinges:
        drawn.hinges[hinge] = Hinge(stiffness=stiffness)
    says = f"link after {name} bends by {math.degrees(bend):.2f} deg (rms) in its middle"
    drawn.truth.append(Truth("", says, joints=drawn.joints[: joint + 3]))


def _marker_slips(drawn: Drawn) -> None:
    slip = drawn.rng.normal(size=3)
    drawn.slip = slip / np.linalg.norm(slip) * float(drawn.rng.uniform(3e-3, 12e-3))
    drawn.truth.append(Truth("tool_slip", f"marker slips by {1e3 * np.linalg.norm(drawn.slip):.1f} mm"))


def _marker_loose(drawn: Drawn) -> None:
    axis = np.append(drawn.rng.normal(size=2), 0.0)
    half = math.radians(float(drawn.rng.uniform(0.6, 2.0)))
    name = drawn.changed.loosen_marker(axis / np.linalg.norm(axis), 0.05, MARKER_XYZ)
    drawn.hinges[name] = Hinge(half_width=half, friction=0.002, inertia=0.001)
    drawn.truth.append(Truth("", f"marker wobbles by +-{math.degrees(half):.2f} deg", joints=drawn.joints[1:]))


def _late(drawn: Drawn) -> None:
    drawn.latency = (float(drawn.rng.uniform(0.03, 0.12)), 0.0)
    drawn.truth.append(Truth("camera_latency", f"images {1e3 * drawn.latency[0]:.0f} ms late"))


def _skewed(drawn: Drawn) -> None:
    drawn.latency = (float(drawn.rng.uniform(0.0, 0.05)), float(drawn.rng.uniform(0.06, 0.2)))
    says = f"images {1e3 * drawn.latency[0]:.0f} ms late, and {1e3 * drawn.latency[1]:.0f} ms more at the end"
    drawn.truth.append(Truth("camera_latency", says, joints=("time",)))


def _bump(drawn: Drawn) -> None:
    shift, turn = drawn.rng.normal(size=(2, 3))
    shift *= float(drawn.rng.uniform(3e-3, 15e-3)) / np.linalg.norm(shift)
    turn *= math.radians(float(drawn.rng.uniform(0.3, 1.5))) / np.linalg.norm(turn)
    drawn.bump = np.concatenate([shift, turn])
    drawn.truth.append(Truth("camera_moved", f"camera bumped by {1e3 * np.linalg.norm(shift):.1f} mm"))


def _both(*hide: Callable[[Drawn], None]) -> Callable[[Drawn], None]:
    def all_of_them(drawn: Drawn) -> None:
        for one in hide:
            one(drawn)

    return all_of_them


KINDS: dict[str, Callable[[Drawn], None]] = {
    "none": lambda drawn: None,
    "zeros": _zeros,
    "ratio": _ratio,
    "play_by_friction": _play_by_friction,
    "play_by_gravity": _play_by_gravity,
    "spring": _spring,
    "payload": _payload,
    "dahl": _dahl,
    "lugre": _lugre,
    "wave": _wave,
    "eccentric": _eccentric,
    "base_tilts": _base_tilts,
    "link_bends": _link_bends,
    "marker_slips": _marker_slips,
    "marker_loose": _marker_loose,
    "late": _late,
    "skewed": _skewed,
    "bump": _bump,
    "zero_and_play": _both(_zero, _play_by_friction),
    "zero_and_wave": _both(_zero, _wave),
    "spring_and_zero": _both(_spring, _zero),
}
IN_MOTION_ALONE = ("camera_latency",)


@dataclass(frozen=True, eq=False)
class Taken:
    """A recording: stamps (n,) [s], readings (n, d) [rad], positions measured and free of noise (n, 3) [m]."""

    t: FloatArray
    q: FloatArray
    x: FloatArray
    x_true: FloatArray


@dataclass(frozen=True, eq=False)
class Case:
    """A case: robot.toml, arm.urdf, recording.csv and fresh.csv in `folder`, and what is hidden.

    Attributes:
        taken, fresh: the recording, and a later one of the same arm.
        noise_m: along each axis.
        dense: scale of the tolerances; 0 for none.
        nominal: places (n, 3) and orientations (n, 3, 3) of the nominal hand in both recordings.
    """

    seed: int
    style: Style
    kind: str
    model: str
    folder: Path
    truth: tuple[Truth, ...]
    also: tuple[str, ...]
    taken: Taken
    fresh: Taken
    noise_m: float
    dense: float
    camera: tuple[FloatArray, FloatArray]
    marker: FloatArray
    pose_known: bool
    marker_known: bool
    nominal: tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]


def hide(
    seed: int,
    style: Style,
    folder: Path,
    *,
    rows: int | None = None,
    kind: str | None = None,
    dense: float | None = None,
    models: Sequence[Model] = MODELS,
) -> Case:
    """Draw an arm by its seed, hide causes in it, and record it.

    Args:
        rows: of the recording; random by default.
        kind: kind of causes; `seed` modulo the number of kinds by default.
        dense: scale of the tolerances; random by default.
        models: of which one is drawn.
    """
    rng = np.random.default_rng([seed, 7])
    model = models[int(rng.integers(len(models)))]
    urdf = Urdf(model, MOUNTS[int(rng.integers(len(MOUNTS)))])
    nominal = World(urdf.text_for_mujoco, model.joints, {}, MARKER)
    middle, half = _range(urdf)
    postures = middle + half * rng.uniform(-1.0, 1.0, (200, len(half)))
    loads = nominal.loads(postures)[:, [nominal.address(name) for name in model.joints]]
    drawn_dense = float(np.exp(rng.uniform(*np.log(DENSE_SCALES)))) if rng.random() < 0.5 else 0.0
    dense = drawn_dense if dense is None else dense
    levers, noise_m = _levers(nominal, postures), float(np.exp(rng.uniform(*np.log(NOISE_M))))
    drawn = Drawn(urdf, urdf.copy(), rng, postures, levers, loads, noise_m, dense)
    pose_known, marker_known = (bool(known) for known in rng.random(2) < 0.5)
    kind = list(KINDS)[seed % len(KINDS)] if kind is None else kind
    KINDS[kind](drawn)
    if dense:
        _make_dense(drawn)
    world = World(drawn.changed.text_for_mujoco, model.joints, drawn.hinges, MARKER)
    camera = Rotation.from_euler("xyz", rng.uniform(-math.pi, math.pi, 3) * [1.0, 0.45, 1.0]), rng.uniform(-1.5, 1.5, 3)
    taking = np.random.default_rng([seed, STYLES.index(style)])
    count = rows or int(taking.integers(*((300, 700) if style == "walk" else (60, 200))))
    moment = int(count * taking.uniform(0.25, 0.75))
    taken = _record(drawn, world, camera, style, count, moment, taking, (middle, half))
    told = [_beside_one_flank(one, world) for one in drawn.truth]
    fresh = _record(
        drawn, world, camera, style, FRESH_ROWS, 0, taking, (middle, half), begins=float(taken.t[-1]) + 60.0
    )
    off = Rotation.from_rotvec(rng.normal(0.0, 0.02, 3)), rng.normal(0.0, 0.02, 3)
    stated = camera if pose_known else (camera[0] * off[0], camera[1] + off[1])
    marker = MARKER_XYZ + (0.0 if marker_known else rng.normal(0.0, 0.004, 3))
    truth = [one for one in told if style == "walk" or one.name not in IN_MOTION_ALONE]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "arm.urdf").write_text(urdf.text, encoding="utf-8")
    (folder / "robot.toml").write_text(_config(model, marker, marker_known, stated, pose_known), encoding="utf-8")
    for file, one in (("recording.csv", taken), ("fresh.csv", fresh)):
        write_recording(folder / file, model.joints, one.t, None, one.q, one.x, None)
    return Case(
        seed,
        style,
        kind,
        model.name,
        folder,
        tuple(truth),
        tuple(drawn.also),
        taken,
        fresh,
        drawn.noise_m,
        dense,
        (stated[0].as_matrix(), stated[1]),
        marker,
        pose_known,
        marker_known,
        (nominal.poses(taken.q), nominal.poses(fresh.q)),
    )


def _beside_one_flank(truth: Truth, world: World) -> Truth:
    """Return a cause with all its names: play that hangs on one flank throughout the last run is an offset."""
    effect, _, joint = truth.name.partition("@")
    sides = np.sign(world.angles.get(f"{joint}_give", ()))
    stays = effect == "gravity_backlash" and len(sides) > 0 and abs(sides.sum()) == len(sides)
    return replace(truth, same=(*truth.same, f"joint_offset@{joint}")) if stays else truth


def _config(
    model: Model, marker: FloatArray, marker_known: bool, pose: tuple[Rotation, FloatArray], pose_known: bool
) -> str:
    return CONFIG.format(
        name=model.name,
        joints=", ".join(f'"{name}"' for name in model.joints),
        marker=MARKER,
        marker_xyz=list(vector(marker)),
        marker_known=str(marker_known).lower(),
        floor=FLOOR,
        xyz=list(vector(pose[1])),
        rpy=list(vector(pose[0].as_euler("xyz"))),
        pose_known=str(pose_known).lower(),
    )


def _range(urdf: Urdf) -> tuple[FloatArray, FloatArray]:
    """Return middle and half width of the range over which each joint is moved [rad] (d,)."""
    lower, upper = urdf.limits().T
    half = np.minimum(0.4 * (upper - lower), FARTHEST)
    return 0.5 * (lower + upper), half


def _levers(world: World, postures: FloatArray) -> FloatArray:
    """Return the marker's RMS displacement per joint (d,) [m/rad] over postures (n, d)."""

    def marker(q: FloatArray) -> FloatArray:
        places, turns = world.poses(q)
        return places + turns @ MARKER_XYZ

    step = 1e-4
    moved = [marker(postures + step * row) - marker(postures - step * row) for row in np.eye(postures.shape[1])]
    return np.array([np.sqrt(np.square(one).sum(axis=1).mean()) / (2.0 * step) for one in moved])


def _make_dense(drawn: Drawn) -> None:
    """Move every joint's frame by its tolerance, and give every drive small periodic errors."""
    for joint in range(len(drawn.joints)):
        shift, turn = drawn.rng.normal(size=(2, 3)) * drawn.dense
        drawn.changed.displace(drawn.joints[joint], LENGTH_M * shift, ANGLE_RAD * turn)
        size = math.radians(float(drawn.rng.uniform(0.003, 0.02)))
        once, twice = size * drawn.rng.normal(size=(2, 2))
        drawn.errs(joint, lambda r, once=once, twice=twice: _waves(r, once) + 0.6 * _waves(2.0 * r, twice))


def _waves(phase: FloatArray, sizes: FloatArray) -> FloatArray:
    return sizes[0] * np.sin(phase) + sizes[1] * np.cos(phase)


def _record(
    drawn: Drawn,
    world: World,
    camera: tuple[Rotation, FloatArray],
    style: Style,
    count: int,
    moment: int,
    rng: np.random.Generator,
    moved_over: tuple[FloatArray, FloatArray],
    begins: float = 0.0,
) -> Taken:
    """Record `count` rows; what happens at a moment happens before row `moment`."""
    middle, half = moved_over
    if style == "walk":
        every, leg = (round(float(rng.uniform(*span)) / STEP_S) for span in ((0.1, 0.2), (3.0, 6.0)))
        rest = 0
    else:
        leg, rest = round(1.5 / STEP_S), round(0.6 / STEP_S)
        every = leg + rest
    before = round(0.5 / STEP_S)
    legs = (before + count * every) // (leg + rest) + 2
    targets = middle + half * rng.uniform(-1.0, 1.0, (legs + 1, len(half)))
    s = np.linspace(0.0, 1.0, leg, endpoint=False)
    rise = np.append(s**3 * (10.0 - 15.0 * s + 6.0 * s * s), np.ones(rest))
    readings = np.concatenate([a + rise[:, None] * (b - a) for a, b in pairwise(targets)])
    rows = before + np.arange(count) * every if style == "walk" else (1 + np.arange(count)) * every - 5
    path = readings.copy()
    for name, errors in drawn.errors.items():
        column = drawn.joints.index(name)
        path[:, column] += sum(error(readings[:, column]) for error in errors)
    t = rows * STEP_S
    late = drawn.latency[0] + drawn.latency[1] * (t - t[0]) / (t[-1] - t[0])
    places, turns = world.run(path, np.maximum(rows - np.round(late / STEP_S).astype(int), 0))
    slip = np.zeros((count, 3)) if drawn.slip is None else (np.arange(count) >= moment)[:, None] * drawn.slip
    x_world = places + np.einsum("nij,nj->ni", turns, MARKER_XYZ + slip)
    x = (x_world - camera[1]) @ camera[0].as_matrix()
    if drawn.bump is not None:
        x[moment:] = Rotation.from_rotvec(drawn.bump[3:]).inv().apply(x[moment:] - drawn.bump[:3])
    measured = x + rng.normal(0.0, drawn.noise_m, x.shape)
    return Taken(t + begins, readings[rows], measured, x)
