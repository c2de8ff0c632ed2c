"""A loose marker is no noise and no cause."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from planted_cases import SIGMA_M, measured, scattered, seen, surveyed_arm, walk

from bodyschema.diagnosis import diagnosis
from bodyschema.diagnosis.diagnosis import diagnose
from bodyschema.diagnosis.fit.alignment import aligned
from bodyschema.diagnosis.fit.fit import Fit
from bodyschema.diagnosis.fit.observations import Observations
from bodyschema.diagnosis.report.conclusion import conclusion
from bodyschema.diagnosis.report.result import DiagnosisFile
from bodyschema.diagnosis.unnamed.rattle import LooseMarker, rattle, rattle_with_refit
from bodyschema.diagnosis.unnamed.rattle import _Settings as Limits
from bodyschema.effects import Effect, Simulation

HALF_M = 2e-3


@pytest.fixture(scope="module")
def file() -> DiagnosisFile:
    robot, rng = surveyed_arm(), np.random.default_rng(4)
    motion = scattered(robot, 1, rows=150)
    run = Simulation(robot).run(motion)
    sides = HALF_M * rng.choice([-1.0, 1.0], size=len(motion))
    way = np.array([0.6, 0.0, 0.8])
    x = run.measured + sides[:, None] * (run.columns(Effect.at(robot, "tool_offset")) @ way)
    noisy = x + SIGMA_M * rng.normal(size=x.shape)
    return conclusion(diagnose(measured(robot, motion, noisy), Simulation(robot)))


def test_loose_marker_is_unexplained_with_its_play_reported(file) -> None:
    assert (file.verdict, file.causes) == ("unexplained", ())
    assert file.unexplained.rms_mm == pytest.approx(1e3 * HALF_M, rel=0.05)
    assert "Fasten the marker" in file.advice[0]


def test_loose_marker_play_does_not_raise_noise_floor(file) -> None:
    assert file.rms_mm.noise_floor == pytest.approx(1e3 * np.sqrt(3.0) * SIGMA_M, rel=0.15)


def test_marker_on_its_gravity_side_is_loose() -> None:
    robot, rng = surveyed_arm(), np.random.default_rng(6)
    motion = walk(robot, 2)
    run, way = Simulation(robot).run(motion), np.array([0.6, 0.0, 0.8])
    directions = run.columns(Effect.at(robot, "tool_offset")) @ way
    down = (directions @ run.simulation.camera_pose[:3, :3].T)[:, 2]
    x = run.measured + HALF_M * np.sign(down)[:, None] * directions + SIGMA_M * rng.normal(size=directions.shape)
    found = conclusion(diagnose(measured(robot, motion, x), Simulation(robot)))
    assert (found.verdict, found.causes) == ("unexplained", ())
    assert found.unexplained.rms_mm == pytest.approx(1e3 * HALF_M, rel=0.1)


def beside_tolerances(seed: int, changes: tuple[int, ...]) -> DiagnosisFile:
    """Diagnose a walk of an arm whose links are a little off, with a marker that changes its side at some rows."""
    robot, rng = surveyed_arm(), np.random.default_rng(seed)
    links = [
        Effect.at(robot, "link_geometry", joint, values=rng.normal(size=6) * np.repeat([1e-3, 4e-3], 3))
        for joint in robot.joints
    ]
    motion = walk(robot, seed)
    run = Simulation(robot, tuple(links)).run(motion)
    beyond = 2.0 * HALF_M * (np.searchsorted(changes, np.arange(len(motion)), "right") % 2)
    directions = run.columns(Effect.at(robot, "tool_offset")) @ np.array([0.6, 0.0, 0.8])
    x = run.measured + beyond[:, None] * directions + SIGMA_M * rng.normal(size=directions.shape)
    return conclusion(diagnose(measured(robot, motion, x), Simulation(robot)))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_marker_rarely_on_its_other_side_is_loose(seed) -> None:
    found = beside_tolerances(seed, changes=(120, 132, 200, 206, 290))
    assert (found.verdict, found.causes) == ("unexplained", ())
    assert found.unexplained.rms_mm == pytest.approx(1e3 * HALF_M, rel=0.1)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_marker_that_slips_once_is_not_loose(seed) -> None:
    found = beside_tolerances(seed, changes=(200,))
    assert (found.verdict, [cause.effect for cause in found.causes]) == ("explained", ["tool_slip"])


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_single_slip_on_exact_arm_is_not_loose(seed) -> None:
    robot, motion = surveyed_arm(), scattered(surveyed_arm(), seed)
    slip = Effect.at(robot, "tool_slip", values={"x_m": 0.0, "y_m": 0.0024, "z_m": -0.0015, "t0": 44.9})
    found = conclusion(diagnose(seen(robot, motion, (slip,), seed), Simulation(robot)))
    assert (found.verdict, [cause.effect for cause in found.causes]) == ("explained", ["tool_slip"])


@pytest.mark.parametrize("count", [1, 3, 12])
def test_outliers_are_no_second_side(count) -> None:
    robot, rng = surveyed_arm(), np.random.default_rng(5)
    motion = walk(robot, 5, rows=150)
    x = Simulation(robot).positions(motion) + SIGMA_M * rng.normal(size=(150, 3))
    x[rng.choice(150, count, replace=False)] += 6e-3 * rng.normal(size=(count, 3))
    assert diagnose(measured(robot, motion, x), Simulation(robot)).unexplained.rattle is None


def test_marker_side_is_undetermined_beside_a_change() -> None:
    robot, rng = surveyed_arm(), np.random.default_rng(3)
    motion = walk(robot, 3)
    run = Simulation(robot).run(motion)
    sides = np.where(np.arange(len(motion)) // 50 % 2, HALF_M, -HALF_M)
    directions = run.columns(Effect.at(robot, "tool_offset")) @ np.array([0.6, 0.0, 0.8])
    x = run.measured + sides[:, None] * directions + SIGMA_M * rng.normal(size=directions.shape)
    play = rattle(aligned(Observations.of(measured(robot, motion, x), Simulation(robot)), Simulation(robot)))
    assert play is not None
    changes = np.arange(50, 300, 50)
    assert np.flatnonzero(play.sides == 0.0).tolist() == sorted([*changes - 1, *changes])


def test_marker_changing_side_once_has_no_play() -> None:
    robot, rng = surveyed_arm(), np.random.default_rng(3)
    motion = walk(robot, 3)
    run = Simulation(robot).run(motion)
    sides = np.where(np.arange(len(motion)) < 120, HALF_M, -HALF_M)
    directions = run.columns(Effect.at(robot, "tool_offset")) @ np.array([0.6, 0.0, 0.8])
    x = run.measured + sides[:, None] * directions + SIGMA_M * rng.normal(size=directions.shape)
    assert rattle(aligned(Observations.of(measured(robot, motion, x), Simulation(robot)), Simulation(robot))) is None


@pytest.mark.parametrize(
    ("limit", "factor"),
    [("apart", 0.3), ("apart", 3.0), ("named", 0.3), ("named", 3.0), ("beyond_noise", 0.3), ("rounds", 0.3)],
)
def test_clear_marker_play_is_insensitive_to_the_limits(monkeypatch, limit, factor) -> None:
    robot, rng = surveyed_arm(), np.random.default_rng(4)
    simulation, motion = Simulation(robot), scattered(robot, 1, rows=150)
    run = simulation.run(motion)
    x = run.measured + SIGMA_M * rng.normal(size=(150, 3))
    directions = run.columns(Effect.at(robot, "tool_offset")) @ np.array([0.6, 0.0, 0.8])
    moved = x + HALF_M * rng.choice([-1.0, 1.0], 150)[:, None] * directions
    usual = getattr(Limits, limit)
    monkeypatch.setattr(Limits, limit, type(usual)(factor * usual))
    fixed, loose = (aligned(Observations.of(measured(robot, motion, at), simulation), simulation) for at in (x, moved))
    play = rattle(loose)
    assert play is not None
    assert play.half_m == pytest.approx(HALF_M, rel=0.01)
    assert rattle(fixed) is None


@pytest.mark.parametrize("seed", [1, 2])
def test_a_loose_marker_without_noise_is_loose(seed) -> None:
    robot, rng = surveyed_arm(), np.random.default_rng(seed + 5)
    motion = scattered(robot, seed, rows=100)
    run = Simulation(robot).run(motion)
    directions = run.columns(Effect.at(robot, "tool_offset")) @ np.array([0.6, 0.0, 0.8])
    x = run.measured + HALF_M * rng.choice([-1.0, 1.0], 100)[:, None] * directions
    found = conclusion(diagnose(measured(robot, motion, x), Simulation(robot)))
    assert (found.verdict, found.causes) == ("unexplained", ())
    assert found.unexplained.rms_mm == pytest.approx(1e3 * HALF_M, rel=1e-3)


def test_loose_marker_keeps_noise_factor_and_excluded_rows(monkeypatch) -> None:
    robot, rng = surveyed_arm(), np.random.default_rng(0)
    simulation, motion = Simulation(robot), scattered(robot, 1, rows=40)
    x = simulation.run(motion).measured + SIGMA_M * rng.normal(size=(40, 3))
    left_out, begun = np.arange(40) < 4, []

    def aligned(observations: Observations, of: Simulation) -> Fit:
        begun.append(observations)
        return alignment(observations, of)

    class Searched(Exception):
        pass

    def explained(*_: object) -> None:
        raise Searched

    alignment, axis = diagnosis.aligned, np.array([0.0, 0.0, 1.0])
    loose = LooseMarker(HALF_M, 3.0, axis, directions=np.tile(axis, (40, 1)), sides=np.zeros(40), likelihood=0.0)
    monkeypatch.setattr(diagnosis, "aligned", aligned)
    monkeypatch.setattr(diagnosis, "together", lambda start, *_: start.with_tolerances(diagnosis.Scales()))
    monkeypatch.setattr(diagnosis, "_searched", lambda begun, *_: begun)
    monkeypatch.setattr(diagnosis, "instrument_factor", lambda _: 2.0)
    monkeypatch.setattr(diagnosis, "_left_out", lambda _: left_out)
    monkeypatch.setattr(diagnosis, "reshaped", lambda _: None)
    monkeypatch.setattr(diagnosis, "explain", lambda *_: SimpleNamespace(unknown=None))
    monkeypatch.setattr(diagnosis, "_loose", lambda *_: loose)
    monkeypatch.setattr(diagnosis, "rattle", lambda _: loose)
    monkeypatch.setattr(diagnosis, "useful", explained)
    with pytest.raises(Searched):
        diagnosis.diagnose(measured(robot, motion, x), simulation)
    assert begun[-1].play_covariance is not None
    assert begun[-1].stated_factor == 2.0
    assert (begun[-1].ignored == left_out).all()


def test_loose_marker_and_causes_share_the_compared_rows(monkeypatch) -> None:
    robot, rng = surveyed_arm(), np.random.default_rng(0)
    simulation, motion = Simulation(robot), scattered(robot, 1, rows=40)
    x = simulation.run(motion).measured + SIGMA_M * rng.normal(size=(40, 3))
    left_out, compared = iter([np.zeros(40, dtype=bool), np.arange(40) < 4]), []

    class Compared(Exception):
        pass

    def loose(_: object, fits: list[Fit], *__: object) -> None:
        compared.extend(fits)
        raise Compared

    monkeypatch.setattr(diagnosis, "together", lambda start, *_: start.with_tolerances(diagnosis.Scales()))
    monkeypatch.setattr(diagnosis, "_searched", lambda begun, *_: begun)
    monkeypatch.setattr(diagnosis, "_left_out", lambda _: next(left_out))
    monkeypatch.setattr(diagnosis, "reshaped", lambda _: None)
    monkeypatch.setattr(diagnosis, "explain", lambda *_: SimpleNamespace(unknown=None))
    monkeypatch.setattr(diagnosis, "_loose", loose)
    with pytest.raises(Compared):
        diagnosis.diagnose(measured(robot, motion, x), simulation)
    assert {int(fit.observations.trusted.sum()) for fit in compared} == {36}


@pytest.mark.parametrize("rows", [14, 20])
def test_a_loose_marker_in_few_rows_has_noise(rows) -> None:
    """Functions of three coordinates are as many as the coordinates of 20 rows."""
    robot, rng = surveyed_arm(), np.random.default_rng(6)
    motion = scattered(robot, 1, rows=rows)
    run = Simulation(robot).run(motion)
    sides = HALF_M * rng.choice([-1.0, 1.0], rows)
    x = run.measured + sides[:, None] * (run.columns(Effect.at(robot, "tool_offset")) @ np.array([0.6, 0.0, 0.8]))
    found = diagnose(measured(robot, motion, x + SIGMA_M * rng.normal(size=x.shape)), Simulation(robot))
    assert found.extended.noise.sigma > 0.5
    assert conclusion(found).causes == ()


@pytest.mark.parametrize("seed", range(2, 6))
def test_imprecise_rows_are_not_a_second_marker_side(seed) -> None:
    robot, rng = surveyed_arm(), np.random.default_rng([seed, 8])
    motion = walk(robot, seed, 400)
    run = Simulation(robot).run(motion)
    turns = run.simulation.camera_pose[:3, :3].T @ run.frames[:, -1, :3, :3]
    sizes = np.full((len(motion), 3), SIGMA_M)
    sizes[rng.random(len(motion)) < 0.05, 2] = 5e-3
    roots = turns * sizes[:, None, :]
    x = run.measured + np.einsum("nij,nj->ni", roots, rng.normal(size=sizes.shape))
    exact = measured(robot, motion, x)
    stated = np.array([root @ root.T for root in roots])
    recording = replace(exact, cov=0.5 * (stated + np.swapaxes(stated, 1, 2)))
    assert rattle_with_refit(aligned(Observations.of(recording, Simulation(robot)), Simulation(robot))) is None
