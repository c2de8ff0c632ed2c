"""Hide effects in recordings of an arm."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from .arms import Arm
from .arrays import BoolArray, FloatArray, IntArray
from .bullet import bullet
from .choice import Wish, chosen_arm, chosen_motion, placed, wishes
from .eyes import covariance, in_view, triangulate
from .files import write_recording, write_robot
from .hidden import Hidden, Parameters, Site, direction
from .kinds import KINDS, SHIFT, SIX
from .motion import SEGMENT_RAD, Motion, Style, move, narrowed
from .outliers import false_fixes
from .rendered import PIXEL_SIGMA, tracked
from .sizing import NoEffect, Sizer, drawn
from .world import World, noise, time_constant

MARGIN_PX = 60.0
SPARE = 0.05  # pairs recorded beyond those asked for: a hidden camera may lose some at the border
RANDOM_SIZES = (0.2, 15.0)
TRIES = 12
Size = float | str | Sequence[float]


@dataclass(frozen=True)
class Encoders:
    """Encoders that turn shaft positions into readings.

    Attributes:
        ticks: of each joint [rad or m], shape (d,).
        scatter: 1-sigma of each reading before it is rounded [ticks].
    """

    ticks: FloatArray
    scatter: float
    rng: np.random.Generator

    @classmethod
    def of(cls, arm: Arm, scatter: float, rng: np.random.Generator) -> Encoders:
        return cls(np.array([arm.quantum(name) for name in arm.read]), scatter, rng)

    def read(self, shaft: FloatArray) -> FloatArray:
        """Return readings (n, d) in whole ticks."""
        exact = shaft / self.ticks
        if self.scatter:
            exact = exact + self.scatter * self.rng.normal(size=exact.shape)
        return np.asarray(np.rint(exact) * self.ticks)


@dataclass(frozen=True)
class Taken:
    """One recording, and what it would be without noise.

    Attributes:
        t: stamps [s], shape (n,).
        segment: run of pairs, shape (n,).
        q: encoder readings, quantised [rad or m], shape (n, d).
        x: measured marker positions [m], shape (n, 3).
        x_noise_free: positions of the described cameras without pixel noise and false fixes [m], shape (n, 3).
        covariance: of x for the pixel noise [m²], optional in the recording, shape (n, 3, 3).
        noise: covariance of a residual at the readings, encoder noise included [m²], shape (n, 3, 3).
        outlier: mask of the fixes that are not the marker, shape (n,).
    """

    t: FloatArray
    segment: IntArray
    q: FloatArray
    x: FloatArray
    x_noise_free: FloatArray
    covariance: FloatArray
    noise: FloatArray
    outlier: BoolArray


@dataclass(frozen=True)
class HiddenCase:
    """Recordings with hidden effects, and the ground truth.

    Attributes:
        folder: with robot.toml, arm.urdf, measured.csv and fresh.csv; the truth is not in it.
        arm: as robot.toml describes it.
        truth: the hidden effects; none when nothing is hidden.
        nuisances: errors that are not findings, since robot.toml marks the parameters as unknown.
        measured, fresh: the recording, and another one of the same arm on another path. Moments (t0) count from the
            start of either.
        sigma_m: RMS length of the noise of a residual, encoder noise included.
        scatter: 1-sigma of the encoder noise before rounding [ticks].
    """

    folder: Path
    seed: int
    arm: Arm
    hold: str
    style: Style
    truth: tuple[Hidden, ...]
    nuisances: tuple[Hidden, ...]
    measured: Taken
    fresh: Taken
    sigma_m: float
    scatter: float

    @property
    def robot_file(self) -> Path:
        """robot.toml."""
        return self.folder / "robot.toml"


def hide(
    seed: int,
    folder: Path,
    effects: int | str | Sequence[str] = 1,
    *,
    arm: str | None = None,
    pairs: int = 1600,
    fresh_pairs: int | None = None,
    size: Size = "random",
    outliers: float = 0.0,
    hold: str | None = None,
    reach: float = 1.0,
    still: Sequence[str] = (),
    marker_known: bool = True,
    pose_known: bool = True,
    rendered: bool = False,
    scatter: tuple[float, float] | None = None,
) -> HiddenCase:
    """Write a case into `folder`; all random choices derive from `seed`.

    Args:
        effects: how many effects of the table to draw, or which ("backlash", "backlash@elbow",
            "joint_coupling@elbow:shoulder", "outside" for any outside the table).
        arm: a name of `ARMS`; any when None.
        pairs, fresh_pairs: of measured.csv and of fresh.csv (as many when None).
        size: of each effect in units of the noise, one for all or one for each; "random" draws 0.2..15 each.
        outliers: fraction of false fixes, in addition to any effect.
        hold: torque_free, zero_force or held; any in which the effects show when None.
        reach: part of each joint's range that both recordings cover, around a random posture.
        still: joints that never move.
        marker_known, pose_known: False writes a rough marker or camera pose into robot.toml and says so there.
        rendered: paint every image and look for the marker in it with the tracker (some tenths of a second a pair);
            a pair whose marker is not found is left out.
        scatter: range of the random encoder noise before rounding, 1-sigma [ticks]; joints that do not lead then
            stand still. None for encoders that only round.

    Raises:
        ValueError: an effect is not possible there, or does not show in this motion.
    """
    streams = [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(7)]
    choosing, building, moving, freshly, noising, rough, scattering = streams
    ticks = 0.0 if scatter is None else float(scattering.uniform(*scatter))
    nuisances = _rough(rough, marker_known=marker_known, pose_known=pose_known)
    wished = wishes(effects, hold, [nuisance.effect for nuisance in nuisances], choosing)
    described = chosen_arm(arm, wished, building)
    if rendered:
        described = replace(described, eyes=replace(described.eyes, pixel_sigma=PIXEL_SIGMA))
    hold, style = chosen_motion(hold, wished, choosing)
    if outliers > 0.0 and "outliers" not in [wish.effect for wish in wished]:
        wished.append(Wish("outliers"))
    with bullet() as client:
        nominal = World(client, described, [])
        spare = int(np.ceil(SPARE * pairs)) + 2
        visible = _visibility(nominal)
        ranges = narrowed(moving, described.ranges, visible, reach, [described.read.index(name) for name in still])
        motion = move(moving, style, ranges, pairs + spare, visible, rests=scatter is not None)
        truth = _hidden(wished, size, outliers, Sizer(client, nominal, motion, ticks), motion, described, choosing)
        world = World(client, described, [*truth, *nuisances])
        fraction = sum(hidden.parameters["fraction"] for hidden in truth if hidden.effect == "outliers")
        encoders = Encoders.of(described, ticks, scattering)
        measured = _taken(nominal, world, motion, pairs, fraction, noising, encoders, rendered=rendered)
        again = fresh_pairs or pairs
        other = move(freshly, style, ranges, again + spare, visible, rests=scatter is not None)
        fresh = _taken(nominal, world, other, again, fraction, noising, encoders, rendered=rendered)
    write_robot(folder, described, hold, marker_known=marker_known, pose_known=pose_known)
    tells_noise = bool(choosing.random() < 0.6)
    for name, taken in (("measured", measured), ("fresh", fresh)):
        _write(folder / f"{name}.csv", described, taken, in_runs=style != "held", tells_noise=tells_noise)
    sigma_m = float(np.sqrt(np.mean(np.trace(measured.noise, axis1=1, axis2=2))))
    return HiddenCase(folder, seed, described, hold, style, truth, nuisances, measured, fresh, sigma_m, ticks)


def _write(file: Path, arm: Arm, taken: Taken, *, in_runs: bool, tells_noise: bool) -> None:
    segment, covariance = taken.segment if in_runs else None, taken.covariance if tells_noise else None
    write_recording(file, arm.read, taken.t, segment, taken.q, taken.x, covariance)


def _visibility(nominal: World) -> Callable[[FloatArray], BoolArray]:
    def visible(q: FloatArray) -> BoolArray:
        return in_view(nominal.arm.eyes, nominal.marker(q, np.zeros(len(q))), MARGIN_PX)

    return visible


def _hidden(
    wished: Sequence[Wish],
    size: Size,
    outliers: float,
    sizer: Sizer,
    motion: Motion,
    arm: Arm,
    rng: np.random.Generator,
) -> tuple[Hidden, ...]:
    """Return the effects with their places and parameters."""
    truth: list[Hidden] = []
    for index, wish in enumerate(wished):
        if wish.effect == "outliers":
            share = {"fraction": outliers or float(rng.uniform(0.01, 0.1))}
            truth.append(Hidden("outliers", None, None, share, KINDS["outliers"].sign))
            continue
        truth.append(_one(wish, _size(size, index, rng), sizer, motion, arm, truth, rng))
    return tuple(truth)


def _size(size: Size, index: int, rng: np.random.Generator) -> float:
    if isinstance(size, str):
        if size != "random":
            raise ValueError(f"size is a number, one for each effect, or 'random', not {size!r}")
        return float(np.exp(rng.uniform(*np.log(RANDOM_SIZES))))
    return float(size) if isinstance(size, (int, float)) else float(size[index])


def _one(
    wish: Wish, size: float, sizer: Sizer, motion: Motion, arm: Arm, truth: Sequence[Hidden], rng: np.random.Generator
) -> Hidden:
    """Return one effect of that size, at a place where it shows."""
    taken = [(hidden.effect, hidden.where) for hidden in truth]
    for left in reversed(range(TRIES)):
        there = placed(wish, arm, taken, rng)
        site = Site(arm, motion, there.where, there.source)
        try:
            hidden = sizer.scaled(drawn(wish.kind, wish.effect, site, rng), wish.kind, size)
        except NoEffect:
            if wish.where is not None or not left:
                raise
            continue
        hidden = _finished(hidden, site, sizer)
        return replace(hidden, shows_on=sizer.shows_on(hidden, rng)) if hidden.outside else hidden
    raise AssertionError("the last try returns or raises")


def _finished(hidden: Hidden, site: Site, sizer: Sizer) -> Hidden:
    """Round lost ticks to whole ones; add the time constant to a lag."""
    p = hidden.parameters
    if hidden.effect == "encoder_jump":
        name, tick = f"jump_{site.unit}", site.arm.quantum(str(site.where))
        lost = np.sign(p[name]) * max(1.0, np.rint(abs(p[name]) / tick))
        return sizer.sized(replace(hidden, parameters={**p, name: float(lost * tick)}))
    if hidden.effect == "settling":
        return replace(hidden, parameters={"tau_s": time_constant(p), **p})
    return hidden


def _rough(rng: np.random.Generator, *, marker_known: bool, pose_known: bool) -> tuple[Hidden, ...]:
    """Return the errors of a marker and a camera pose that are only roughly known."""
    nuisances = []
    if not marker_known:
        shift: Parameters = dict(zip(SHIFT, (0.015 * direction(rng)).tolist(), strict=True))
        nuisances.append(Hidden("tool_offset", None, None, shift, KINDS["tool_offset"].sign))
    if not pose_known:
        six = np.concatenate([0.03 * direction(rng), 0.04 * direction(rng)])
        pose: Parameters = dict(zip(SIX, six.tolist(), strict=True))
        nuisances.append(Hidden("camera_pose", None, None, pose, KINDS["camera_pose"].sign))
    return tuple(nuisances)


def _taken(
    nominal: World,
    world: World,
    motion: Motion,
    pairs: int,
    fraction: float,
    rng: np.random.Generator,
    encoders: Encoders,
    *,
    rendered: bool,
) -> Taken:
    """Return the first `pairs` pairs that the true cameras see, with noise, ticks and outliers."""
    arm, sight = world.arm, world.measure(motion)
    width, height = arm.eyes.image_size_px
    inside = (sight.pixels > 0.0).all(axis=1) & (sight.pixels < [width, height, width, height]).all(axis=1)
    kept = np.flatnonzero(inside)[:pairs]
    sight = sight.of(kept)
    points, outlier = false_fixes(world, sight, fraction, rng)
    if rendered:
        found, x, told = tracked(world.eyes, points, rng)
    else:
        found, x, told = _fixed(world, points, rng)
    kept, sight, outlier, x, told = kept[found], sight.of(np.flatnonzero(found)), outlier[found], x[found], told[found]
    q = encoders.read(sight.readings)
    step = np.linalg.norm(np.diff(q, axis=0), axis=1)
    torn = (np.diff(motion.segment[kept]) > 0) | (step > SEGMENT_RAD[1])
    return Taken(
        t=motion.stamps[kept],
        segment=np.append(0, np.cumsum(torn)),
        q=q,
        x=x,
        x_noise_free=sight.x,
        covariance=told,
        noise=noise(nominal, q, sight.pixels, encoders.scatter),
        outlier=outlier,
    )


def _fixed(world: World, points: FloatArray, rng: np.random.Generator) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Return fixes from noisy pixel centres: a mask that is all true, positions and covariances."""
    eyes = world.arm.eyes
    pixels = world.eyes.project(points)
    pixels = pixels + rng.normal(0.0, eyes.pixel_sigma, pixels.shape)
    return np.ones(len(points), dtype=bool), triangulate(eyes, pixels), covariance(eyes, pixels)
