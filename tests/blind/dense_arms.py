"""Arms from desk size to industrial size, with manufacturing tolerances at every link and drive."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from .arms import BASE, FLOOR, MOUNT, Arm, Eyes, Joint, Mass
from .arrays import FloatArray, Vector, vector

REACH_M = (0.35, 2.4)
LENGTH_M, ANGLE_RAD = 0.3e-3, math.radians(0.06)  # 1 sigma of a tolerance at scale 1
WIDEST_SCALE = 10.0  # scales lie between 1/10 and 10
SHARED = 0.6  # correlation of the logarithms of both scales
DRIVE_DEG = (0.002, 0.05)
DRIVE_M = (5e-6, 100e-6)  # of a sliding joint
HEAD_SHARE, SLIDE_SHARE = 0.12, 0.25
ELBOW_PATTERNS = ("zyyyxz", "zyyxyx", "zyyyzy", "zyxyxyx", "zxyzyxy")
NO_EYES = Eyes(700.0, 0.2, 0.2)  # the instrument reports positions; these numbers are not written


@dataclass(frozen=True, eq=False)
class Made:
    """Deviations of one arm from its URDF, without any cause.

    Attributes:
        length_m, angle_rad: 1 sigma of the shifts and turns of this arm's links.
        drive_rad, drive_m: the usual amplitude of periodic errors of its revolute and sliding joints.
        frames: small motion of each joint's frame in the frame of the URDF, shift [m] and rotation vector [rad],
            shape (d, 6).
        harmonics: of each joint, rows (periods per radian or metre, sine, cosine) of output minus shaft.
    """

    length_m: float
    angle_rad: float
    drive_rad: float
    drive_m: float
    frames: FloatArray
    harmonics: tuple[FloatArray, ...]

    def drive_error(self, joint: int, shaft: FloatArray) -> FloatArray:
        """Return output minus shaft position [rad or m] of a joint at the positions (n,)."""
        rows = self.harmonics[joint]
        phase = np.multiply.outer(shaft, rows[:, 0])
        return np.sin(phase) @ rows[:, 1] + np.cos(phase) @ rows[:, 2]


def made(arm: Arm, rng: np.random.Generator) -> Made:
    """Draw the tolerances and drives of one arm."""
    length, angle = _scales(rng)
    sigma = np.repeat([LENGTH_M * length, ANGLE_RAD * angle], 3)
    drive_rad = math.radians(_log_uniform(rng, *DRIVE_DEG))
    drive_m = _log_uniform(rng, *DRIVE_M)
    harmonics = []
    for name in arm.read:
        slides = arm.joint(name).kind == "prismatic"
        first = 2.0 * math.pi / rng.uniform(0.01, 0.25) if slides else 1.0
        higher = [first * rng.integers(3, 120)] if rng.random() < 0.3 else []
        periods = np.array([first, 2.0 * first, *higher])
        size = np.array([1.0, 0.6, 0.4])[: len(periods), None] * (drive_m if slides else drive_rad)
        harmonics.append(np.column_stack([periods, size * rng.normal(size=(len(periods), 2)) / math.sqrt(2.0)]))
    frames = sigma * rng.normal(size=(len(arm.read), 6))
    return Made(float(sigma[0]), float(sigma[-1]), drive_rad, drive_m, frames, tuple(harmonics))


def _scales(rng: np.random.Generator) -> tuple[float, float]:
    """Return the scales of lengths and of angles."""
    while True:
        shared, own = rng.normal(size=2)
        logs = np.array([shared, SHARED * shared + math.sqrt(1.0 - SHARED**2) * own])
        if np.abs(logs).max() <= math.log(WIDEST_SCALE):
            length, angle = np.exp(logs)
            return float(length), float(angle)


def described(rng: np.random.Generator, *, with_masses: bool) -> Arm:
    """Draw an arm of 5 to 9 read joints."""
    reach = _log_uniform(rng, *REACH_M)
    head = rng.random() < HEAD_SHARE
    letters = str(rng.choice(ELBOW_PATTERNS))
    letters = letters[: int(rng.integers(5, len(letters) + 1))]
    slides = [False] * len(letters)
    if not head and rng.random() < SLIDE_SHARE:
        letters, slides = _with_slide(letters, slides, rng)
    chain = _chain(BASE, "j", letters, slides, reach, rng)
    start = Joint(MOUNT, "fixed", FLOOR, BASE, (0.0, 0.0, round(float(rng.uniform(0.0, 0.8)), 3)))
    neck = _neck(reach) if head else ()
    kilograms = 12.0 * reach**1.5 * 0.65 ** np.arange(len(chain)) * rng.uniform(0.7, 1.3, len(chain))
    masses = _masses(chain, kilograms, reach, rng) if with_masses else {}
    names = tuple(joint.name for joint in chain)
    read = ("head_tilt", "head_pan", *names) if head else names
    eye = "head_tilt_link" if head else FLOOR
    tip = Joint("flange", "fixed", chain[-1].child, "tool", vector(rng.uniform(-0.01, 0.01, 3)))
    return Arm(
        name="dense",
        joints=(start, *neck, *chain, tip),
        masses=masses,
        read=read,
        ticks={joint.name: _ticks(joint, rng) for joint in (*neck, *chain)},
        camera_link=eye,
        camera_xyz=(0.05, 0.02, 0.04) if head else vector(reach * rng.uniform([-1.0, -1.5, 0.2], [1.0, 1.5, 1.0])),
        camera_rpy=vector(rng.uniform(-math.pi, math.pi, 3) * [1.0, 0.45, 1.0]),
        eyes=NO_EYES,
        marker_link="tool",
        marker_xyz=vector(np.round(reach * rng.uniform([-0.05, -0.05, 0.03], [0.05, 0.05, 0.15]), 4)),
    )


def _with_slide(letters: str, slides: list[bool], rng: np.random.Generator) -> tuple[str, list[bool]]:
    """Put a rail or lift before the arm, or a sliding joint in place of the elbow."""
    if rng.random() < 0.7:
        return str(rng.choice(["x", "z"])) + letters, [True, *slides]
    return letters[:2] + "x" + letters[3:], [*slides[:2], True, *slides[3:]]


def _chain(
    start: str, prefix: str, letters: str, slides: list[bool], reach: float, rng: np.random.Generator
) -> tuple[Joint, ...]:
    """Return joints in series; in some arms the frames are rotated by quarter turns."""
    proportions = np.array([0.15, 0.10, 0.36, 0.28, 0.10, 0.08, 0.07, 0.06])[: len(letters)]
    turned = rng.random() < 0.6
    frame, parent, joints, stretched = np.eye(3), start, [], (0.0, 0.0, 1.0)
    for index, (letter, slide) in enumerate(zip(letters, slides, strict=True)):
        sideways = 0.04 * reach * rng.uniform(-1.0, 1.0, 3) * (rng.random(3) < 0.5)
        place = np.round(reach * proportions[index] * rng.uniform(0.8, 1.2) * np.array(stretched) + sideways, 4)
        rpy = vector(rng.integers(-1, 3, 3) * [1, 0, 1] * (0.5 * math.pi if turned else 0.0))
        after = frame @ Rotation.from_euler("xyz", rpy).as_matrix()
        along = after.T @ np.eye(3)["xyz".index(letter)]
        lower, upper = _range(index, slide, reach, rng)
        name = f"{prefix}{index + 1}"
        kind = "prismatic" if slide else "revolute"
        joints.append(
            Joint(
                name, kind, parent, f"{name}_link", vector(frame.T @ place), rpy, vector(np.rint(along)), lower, upper
            )
        )
        frame, parent = after, f"{name}_link"
        stretched = (0.9, 0.0, 0.3) if index >= 1 else stretched
    return tuple(joints)


def _range(index: int, slide: bool, reach: float, rng: np.random.Generator) -> tuple[float, float]:
    if slide:
        return 0.0, round(float(reach * rng.uniform(0.25, 0.6)), 3)
    widest = 120 if index < 3 else 165
    low, high = np.radians(rng.uniform([-widest, 35], [-35, widest]))
    return float(low), float(high)


def _neck(reach: float) -> tuple[Joint, ...]:
    """Return two joints that carry the instrument."""
    up = round(0.5 * reach, 3)
    pan = Joint("head_pan", "revolute", BASE, "head_pan_link", (0.02, 0.0, up), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    tilt = Joint("head_tilt", "revolute", "head_pan_link", "head_tilt_link", (0.02, 0.01, 0.08), axis=(0.0, 1.0, 0.0))
    return (_ranged(pan, -60.0, 60.0), _ranged(tilt, -20.0, 50.0))


def _ranged(joint: Joint, low_deg: float, high_deg: float) -> Joint:
    values = {**vars(joint), "lower": math.radians(low_deg), "upper": math.radians(high_deg)}
    return Joint(**values)


def _masses(chain: tuple[Joint, ...], kilograms: FloatArray, reach: float, rng: np.random.Generator) -> dict[str, Mass]:
    """Return centres of mass about half way to the next joint."""
    ends: dict[str, Vector] = {joint.parent: joint.xyz for joint in chain}
    return {
        joint.child: Mass(
            round(float(kg), 3),
            vector(0.5 * np.array(ends.get(joint.child, (0.0, 0.0, 0.0))) + 0.03 * reach * rng.uniform(-1, 1, 3)),
        )
        for joint, kg in zip(chain, kilograms, strict=True)
    }


def _ticks(joint: Joint, rng: np.random.Generator) -> int:
    """Return the ticks per turn, or per metre."""
    return int(rng.choice([100_000, 1_000_000]) if joint.kind == "prismatic" else 2 ** rng.integers(15, 21))


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(math.log(low), math.log(high))))
