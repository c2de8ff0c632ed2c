"""Small scenes, and the figures by which a setting is judged: it matters as much as it moves one of them."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

import numpy as np
from ball_renderer import SMALL, Look
from guided_arm import built_chain, make_pair, measured, near, new_learning, path, teach
from scenes import Ball, place, stage
from scipy.spatial.transform import Rotation
from tag_renderer import Sheet, photograph

from benchmarks.rough_arm import ROUGH, rough_arm
from bodyschema.diagnosis.diagnosis import diagnose
from bodyschema.diagnosis.report.conclusion import conclusion
from bodyschema.effects import Simulation, load_simulation
from bodyschema.interfaces.records import FloatArray, MarkerFix, MarkerMiss, Pair, StereoFrame
from bodyschema.learning.config import LearnerConfig
from bodyschema.recordings.recording import Recording
from bodyschema.vision.ball.tracker import StereoTracker
from bodyschema.vision.tags.body import TagBody
from bodyschema.vision.tags.config import TagConfig
from bodyschema.vision.tags.tracker import TagTracker
from kbmaps import ResidualLearner, RigidChain

Figures = dict[str, float | str]
"""Numbers by their names, and as a text what was decided, which no setting may change."""


def learner() -> Figures:
    """Return error and claimed sigma [m] of the online learner after another tool was taken, two outliers before it."""
    pairs, q, true = _guided()
    learning = new_learning(settings=LearnerConfig(replays_per_pair=1.0))
    teach(learning, pairs, every=20)
    found, counters = learning.snapshot.predict(q), learning.counters
    sigma = float(np.sqrt(np.square(found.sigma).mean()))
    return {
        "error": _rms(found.x - true),
        "sigma": sigma,
        "seen": f"{counters.doubted} outliers, {counters.changes} changes",
    }


@cache
def _guided() -> tuple[list[Pair], FloatArray, FloatArray]:
    rng = np.random.default_rng(5)
    chain, q = built_chain(rng), path(rng, 90)
    other = chain.with_tool([0.03, -0.04, 0.05])
    pairs = [*measured(chain, q[:50], rng), *measured(other, q[50:], rng, first=51)]
    for row in (30, 41):
        pairs[row] = make_pair(row + 1, pairs[row].q, pairs[row].x + 0.2)
    asked = near(rng, q, 100)
    return pairs, asked, other.positions(asked)


def models() -> Figures:
    """Return error [m] and sigma [m] of a chain with residual, of an arm that bends."""
    arm, q, x, asked, true = _bent()
    model = ResidualLearner(arm, ROUGH)
    model.learn(q, x, 0.001)
    estimate = model.estimate(asked)
    return {"error": _rms(estimate.x - true), "sigma": float(np.sqrt(np.square(estimate.sigma).mean()))}


@cache
def _bent() -> tuple[RigidChain, FloatArray, FloatArray, FloatArray, FloatArray]:
    rng = np.random.default_rng(3)
    arm = rough_arm(3, rng, ROUGH)
    q, asked = arm.angles(100, 60.0, rng), arm.angles(100, 60.0, rng)

    def bent(angles: FloatArray) -> FloatArray:
        return angles + 0.02 * np.sin(angles)

    return arm.drawing, q, arm.measured(bent(q), 0.001, rng), asked, arm.measured(bent(asked), 0.0, rng)


def diagnosis() -> Figures:
    """Return the held-out error [mm] of the extended simulation of a hidden case, and the causes that are named."""
    recording, simulation = _hidden()
    found = conclusion(diagnose(recording, simulation, seed=1))
    error, noise = found.rms_mm.extended, found.rms_mm.noise_floor
    assert error is not None
    assert noise is not None
    named = " ".join(sorted(f"{cause.effect}@{cause.where}" for cause in found.causes))
    return {"error": error, "noise": noise, "causes": f"{found.verdict}: {named}"}


@cache
def _hidden() -> tuple[Recording, Simulation]:
    from tests.blind.cases import hide

    with tempfile.TemporaryDirectory() as folder:
        case = hide(4, Path(folder), ["backlash", "link_geometry"], arm="head", pairs=200, size=8.0)
        simulation = load_simulation(case.robot_file)
        return Recording.read(case.folder / "measured.csv", simulation.robot.joints), simulation


def ball() -> Figures:
    """Return the RMS error and sigma [m] of a ball's fixes, and what became of each frame."""
    frames, true = _balls()
    return _judged([StereoTracker(SMALL).track(frame) for frame in frames], true)


@cache
def _balls() -> tuple[list[StereoFrame], FloatArray]:
    rng = np.random.default_rng(2)
    true = np.array([place(SMALL, radius_px, rng) for radius_px in (6, 8, 10, 14, 18, 24)])
    looks = [Look(noise_sd=noise) for noise in (1.0, 2.0, 4.0)] * 2
    return [stage(Ball(tuple(x)), look=look) for x, look in zip(true, looks, strict=True)], true


def tag() -> Figures:
    """Return the RMS error and sigma [m] of a tag's fixes, and what became of each frame."""
    frames, true = _tags()
    config = TagConfig(side_m=0.03)
    return _judged([TagTracker(SMALL, TagBody.single(config), config).track(frame) for frame in frames], true)


@cache
def _tags() -> tuple[list[StereoFrame], FloatArray]:
    rng, frames, true = np.random.default_rng(4), [], []
    for degrees in (0.0, 15.0, 30.0, 40.0, 50.0):
        axis = rng.normal(size=3)
        turn = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
        x = np.array([rng.uniform(0.01, 0.05), rng.uniform(-0.03, 0.03), rng.uniform(0.3, 0.45)])
        sheet = Sheet(0, turn @ np.diag([1.0, -1.0, -1.0]), x, 0.03)
        frames.append(photograph([sheet], SMALL, Look(wall=0.4, samples=6), rng))
        true.append(x)
    return frames, np.array(true)


def _judged(found: list[MarkerFix | MarkerMiss], true: FloatArray) -> Figures:
    fixes = [(fix.x - x, fix.cov) for fix, x in zip(found, true, strict=True) if isinstance(fix, MarkerFix)]
    outcomes = " ".join("fix" if isinstance(each, MarkerFix) else each.reason.value for each in found)
    if not fixes:
        return {"outcomes": outcomes}
    sigma = float(np.sqrt(np.mean([np.trace(cov) for _, cov in fixes])))
    return {"error": _rms(np.array([miss for miss, _ in fixes])), "sigma": sigma, "outcomes": outcomes}


def _rms(miss: FloatArray) -> float:
    return float(np.sqrt(np.square(miss).sum(axis=1).mean()))
