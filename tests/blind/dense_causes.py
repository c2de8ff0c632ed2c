"""Causes of error: parameters of each, and the derivative of the marker position by them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from .arms import Arm
from .arrays import FloatArray, IntArray
from .dense_chain import Posture
from .hidden import direction, sign
from .joints import play

Key = tuple[str, str | None, str | None]
DEG = math.pi / 180.0


@dataclass(frozen=True, eq=False)
class Cause:
    """One cause at one place.

    Attributes:
        effect, where, source: its name in the table of effects.
        amounts: linear numbers, as they are in this arm, shape (m,): SI units, of `usual` size.
        usual: 1 sigma of such numbers over arms, shape (m,).
        shape: numbers that say how it looks: a moment, a period, a width.
    """

    effect: str
    where: str | None
    source: str | None
    amounts: FloatArray
    usual: FloatArray
    shape: dict[str, float]

    @property
    def key(self) -> Key:
        """Effect, joint and source joint."""
        return self.effect, self.where, self.source


@dataclass(frozen=True, eq=False)
class Way:
    """The motion of a recording: joint positions, and the arm's posture at each row.

    Attributes:
        path: of the shafts at all instants (f, d) [rad or m]; `rows` of them were recorded (n,).
        clock: when each row was recorded (n,): seconds, or numbers of rows.
    """

    arm: Arm
    path: FloatArray
    rows: IntArray
    clock: FloatArray
    posture: Posture

    @property
    def shaft(self) -> FloatArray:
        """Shaft positions of the rows (n, d)."""
        return self.path[self.rows]

    def index(self, name: str | None) -> int:
        """Return the column of a joint."""
        return self.arm.read.index(str(name))


def all_causes(
    arm: Arm,
    duration: float,
    rng: np.random.Generator,
    *,
    loaded: Sequence[str],
    marker_known: bool,
    pose_known: bool,
    longest: float,
) -> list[Cause]:
    """Draw every cause at every place where it can be.

    Args:
        duration: of the recording by its clock; all causes with a moment have the same one.
        loaded: joints that bear the weight of an arm whose masses are known.
        longest: reach of the arm [m], with which link and tool errors grow.
    """
    moment = float(duration * rng.uniform(0.25, 0.75))
    causes = [
        _slip(rng, moment, longest),
        _moved(rng, moment, longest),
        *([_tool(rng)] if marker_known else []),
        *([_pose(rng)] if pose_known else []),
    ]
    for index, name in enumerate(arm.read):
        slides = arm.joint(name).kind == "prismatic"
        causes += [draw(name, slides, rng) for draw in (_offset, _play, _scale, _link)]
        causes.append(_jump(name, slides, rng, moment))
        causes.append(_ripple(name, slides, rng))
        if not slides:
            causes.append(_ring(name, rng))
        if name in loaded:
            causes.append(_spring(name, slides, rng))
        for near in (index - 1, index + 1):
            if 0 <= near < len(arm.read) and arm.joint(arm.read[near]).kind != "prismatic" and not slides:
                causes.append(_coupling(name, arm.read[near], rng))
    return causes


def _offset(name: str, slides: bool, rng: np.random.Generator) -> Cause:
    size = rng.uniform(2e-3, 15e-3) if slides else rng.uniform(0.5, 3.0) * DEG
    usual = 10e-3 if slides else 2.0 * DEG
    return Cause("joint_offset", name, None, np.array([sign(rng) * size]), np.array([usual]), {})


def _play(name: str, slides: bool, rng: np.random.Generator) -> Cause:
    width = rng.uniform(0.2e-3, 2e-3) if slides else rng.uniform(0.2, 1.5) * DEG
    usual = 1e-3 if slides else 0.8 * DEG
    return Cause("backlash", name, None, np.array([width]), np.array([usual]), {"width": width})


def _scale(name: str, slides: bool, rng: np.random.Generator) -> Cause:
    return Cause("joint_scale", name, None, sign(rng) * rng.uniform(0.004, 0.025, 1), np.array([0.015]), {})


def _link(name: str, slides: bool, rng: np.random.Generator) -> Cause:
    what = rng.integers(3)
    shift = rng.uniform(1e-3, 5e-3) * direction(rng) * (what != 0)
    tilt = rng.uniform(0.5, 2.0) * DEG * direction(rng) * (what != 1)
    return Cause("link_geometry", name, None, np.concatenate([shift, tilt]), np.repeat([2e-3, 0.8 * DEG], 3), {})


def _jump(name: str, slides: bool, rng: np.random.Generator, moment: float) -> Cause:
    size = rng.uniform(1e-3, 6e-3) if slides else rng.uniform(0.3, 2.0) * DEG
    usual = 3e-3 if slides else 1.0 * DEG
    return Cause("encoder_jump", name, None, np.array([sign(rng) * size]), np.array([usual]), {"moment": moment})


def _ripple(name: str, slides: bool, rng: np.random.Generator) -> Cause:
    """Draw a bias of the sine and cosine tracks, scaled to an angle error."""
    poles = float(rng.integers(3, 25))
    turn = float(rng.uniform(0.1, 0.3)) if slides else 2.0 * math.pi  # of shaft travel for each turn of the ring
    size = 2.0 * math.pi * (rng.uniform(0.3e-3, 1.5e-3) if slides else rng.uniform(0.06, 0.6) * DEG) / turn
    bias = np.minimum(size * poles, 0.3) * direction(rng, 2)
    usual = 0.3 * DEG * poles if not slides else 2.0 * math.pi * 0.8e-3 * poles / turn
    return Cause("joint_ripple", name, None, bias, np.repeat(usual, 2), {"poles": poles, "turn": turn})


def _ring(name: str, rng: np.random.Generator) -> Cause:
    eccentric = rng.uniform(0.3, 2.0) * DEG * direction(rng, 2)
    return Cause("joint_eccentricity", name, None, eccentric, np.repeat(1.0 * DEG, 2), {})


def _spring(name: str, slides: bool, rng: np.random.Generator) -> Cause:
    """Draw a spring; the amount is the deflection under the joint's largest load [rad or m]."""
    gives = rng.uniform(0.3e-3, 3e-3) if slides else rng.uniform(0.1, 1.0) * DEG
    usual = 2e-3 if slides else 0.6 * DEG
    return Cause("joint_compliance", name, None, np.array([gives]), np.array([usual]), {})


def _coupling(name: str, source: str, rng: np.random.Generator) -> Cause:
    return Cause("joint_coupling", name, source, sign(rng) * rng.uniform(0.006, 0.03, 1), np.array([0.02]), {})


def _slip(rng: np.random.Generator, moment: float, longest: float) -> Cause:
    size = rng.uniform(1e-3, 6e-3) * (0.5 + 0.5 * longest)
    return Cause("tool_slip", None, None, size * direction(rng), np.repeat(3e-3, 3), {"moment": moment})


def _moved(rng: np.random.Generator, moment: float, longest: float) -> Cause:
    six = np.concatenate([rng.uniform(1e-3, 6e-3) * direction(rng), rng.uniform(0.1, 0.8) * DEG * direction(rng)])
    return Cause("camera_moved", None, None, six, np.repeat([3e-3, 0.4 * DEG], 3), {"moment": moment})


def _tool(rng: np.random.Generator) -> Cause:
    return Cause("tool_offset", None, None, rng.uniform(0.01, 0.05) * direction(rng), np.repeat(0.02, 3), {})


def _pose(rng: np.random.Generator) -> Cause:
    six = np.concatenate([rng.uniform(3e-3, 30e-3) * direction(rng), rng.uniform(0.3, 2.0) * DEG * direction(rng)])
    return Cause("camera_pose", None, None, six, np.repeat([12e-3, 0.8 * DEG], 3), {})


def columns(cause: Cause, way: Way, by_joints: FloatArray, by_frames: FloatArray) -> FloatArray:
    """Return the derivative (n, 3, m) of the position at given readings by the cause's amounts.

    Args:
        by_joints, by_frames: those of `way.posture`.
    """
    step = np.asarray(way.clock >= cause.shape.get("moment", -np.inf), dtype=float)[:, None, None]
    match cause.effect:
        case "tool_slip":
            return step * way.posture.by_marker()
        case "tool_offset":
            return way.posture.by_marker()
        case "camera_pose" | "camera_moved":
            return step * way.posture.by_eye()
        case "link_geometry":
            return by_frames[:, :, way.index(cause.where)]
    signals = _SIGNALS[cause.effect](cause, way)
    return by_joints[:, :, way.index(cause.where), None] * signals[:, None, :]


def _at(cause: Cause, way: Way) -> FloatArray:
    return way.shaft[:, way.index(cause.where)]


def _play_signal(cause: Cause, way: Way) -> FloatArray:
    path = way.path[:, way.index(cause.where)]
    behind = play(path, cause.shape["width"]) - path
    return behind[way.rows, None] / cause.shape["width"]


def _ripple_signal(cause: Cause, way: Way) -> FloatArray:
    poles, turn = cause.shape["poles"], cause.shape["turn"]
    ring = 2.0 * math.pi * _at(cause, way) / turn
    return turn / (2.0 * math.pi * poles) * np.column_stack([-np.cos(poles * ring), np.sin(poles * ring)])


def _ring_signal(cause: Cause, way: Way) -> FloatArray:
    return np.column_stack([np.sin(_at(cause, way)), -np.cos(_at(cause, way))])


def _jump_signal(cause: Cause, way: Way) -> FloatArray:
    return -np.asarray(way.clock >= cause.shape["moment"], dtype=float)[:, None]


def _spring_signal(cause: Cause, way: Way) -> FloatArray:
    load = way.posture.torques()[:, way.index(cause.where)]
    return (load / max(float(np.abs(load).max()), 1e-9))[:, None]


# True position minus reading (n, m) for each unit of the amounts, to first order.
_SIGNALS: dict[str, Callable[[Cause, Way], FloatArray]] = {
    "joint_offset": lambda cause, way: -np.ones((len(way.rows), 1)),
    "joint_scale": lambda cause, way: -_at(cause, way)[:, None],
    "joint_coupling": lambda cause, way: way.shaft[:, way.index(cause.source), None],
    "backlash": _play_signal,
    "joint_ripple": _ripple_signal,
    "joint_eccentricity": _ring_signal,
    "encoder_jump": _jump_signal,
    "joint_compliance": _spring_signal,
}


def conflicts(cause: Cause, chosen: Sequence[Cause], arm: Arm) -> bool:
    """Return True if a cause overlaps with a chosen one: a link contains its joint's zero, the pose the first link."""
    same_place = {"joint_offset", "link_geometry"}
    first = {("joint_offset", arm.read[0]), ("link_geometry", arm.read[0])}
    return any(
        cause.key == other.key
        or ({cause.effect, other.effect} <= same_place and cause.where == other.where)
        or (cause.effect == "encoder_jump" == other.effect)
        or ("camera_pose" in (cause.effect, other.effect) and first & {cause.key[:2], other.key[:2]})
        for other in chosen
    )
