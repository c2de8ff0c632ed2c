"""Every competitor learns; our versions of published algorithms reproduce published results."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.peers.competitors.calibration import Placements, identifiable
from benchmarks.peers.competitors.gradient_schema import BodySchema
from benchmarks.peers.competitors.lwpr import LWPR, Settings
from benchmarks.peers.competitors.psom import Grid, chebyshev, lagrange
from benchmarks.peers.competitors.virtual_robots import hand_pose
from benchmarks.peers.problem import Competitor, Problem
from benchmarks.peers.registry import BY_KEY, COMPETITORS
from benchmarks.peers.tasks import Setting
from kbmaps import ChainTolerances, RigidChain

pytestmark = pytest.mark.soak  # no part of the product
REACH = np.full(2, 1.0)
TOLERANCES = ChainTolerances(axes=0.05, points=0.015, tool=0.03)


def two_joints() -> RigidChain:
    fixed = np.tile(np.eye(4), (3, 1, 1))
    fixed[1, :3, 3], fixed[2, :3, 3] = (0.3, 0.0, 0.05), (0.2, 0.04, 0.1)
    return RigidChain(fixed, np.array([[0.0, 0.0, 1.0], [0.0, 0.8, 0.6]]), np.zeros(2, dtype=np.bool_))


def simple_problem(pairs: int = 80) -> Problem:
    """Return a problem of two joints, 0.1 mm of noise and a nominal model whose tool is off by 50 mm."""
    chain, rng = two_joints(), np.random.default_rng(5)
    q = rng.uniform(-REACH, REACH, (pairs, 2))
    return Problem(
        q=q,
        x=chain.positions(q) + 1e-4 * rng.normal(size=(pairs, 3)),
        low=-REACH,
        high=REACH,
        rng=rng,
        sigma=1e-4,
        drawing=chain.with_tool([0.03, -0.03, 0.02]),
        tolerances=TOLERANCES,
        measure=lambda at, shift: chain.with_tool(shift).positions(at) + 1e-4 * rng.normal(size=(len(at), 3)),
    )


def mean_error(competitor: Competitor, problem: Problem) -> float:
    test = np.random.default_rng(6).uniform(-REACH, REACH, (200, 2))
    predicted = competitor.learn(problem, None).predict(test)
    return float(np.linalg.norm(predicted - two_joints().positions(test), axis=1).mean())


LEARNERS = [competitor for competitor in COMPETITORS if competitor.key != "drawing"]


@pytest.mark.parametrize("competitor", LEARNERS, ids=lambda c: c.key)
def test_a_competitor_learns_an_arm_of_two_joints(competitor):
    problem = simple_problem()
    assert competitor.refuses(problem) is None
    assert mean_error(competitor, problem) < 0.01


WITHOUT_DRAWING = [c for c in LEARNERS if c.refuses(replace(simple_problem(), drawing=None, tolerances=None)) is None]


@pytest.mark.parametrize("competitor", WITHOUT_DRAWING, ids=lambda c: c.key)
def test_a_competitor_that_needs_no_drawing_learns_without(competitor):
    problem = replace(simple_problem(), drawing=None, tolerances=None)
    start = float(np.linalg.norm(problem.x - problem.x.mean(axis=0), axis=1).mean())
    assert mean_error(competitor, problem) < 0.3 * start


def test_nominal_model_errs_by_its_tool():
    assert mean_error(BY_KEY["drawing"], simple_problem()) == pytest.approx(
        np.linalg.norm([0.03, 0.03, 0.02]), rel=1e-6
    )


@pytest.mark.parametrize("key", ["calibration", "drawing", "rigid", "rigid-recursive"])
def test_what_starts_from_a_drawing_says_so(key):
    assert BY_KEY[key].refuses(replace(simple_problem(), drawing=None)) == "starts from a drawing"


@pytest.mark.parametrize("key", ["psom", "virtual-psom", "virtual-kb"])
def test_what_chooses_its_own_poses_refuses_a_recording(key):
    reason = BY_KEY[key].refuses(replace(simple_problem(), measure=None))
    assert reason is not None
    assert "own choosing" in reason


def test_what_cannot_hold_thirty_joints_says_why():
    trial = Setting(joints=30)(0, 30)
    refused = {competitor.key for competitor in COMPETITORS if competitor.refuses(trial.problem)}
    assert {"exact", "evidence", "nlms", "psom+", "psom", "padasip-nlms", "padasip-rls"} <= refused
    assert not {"rigid", "train", "calibration", "gp", "mlp"} & refused


def test_nlms_matches_padasip_on_first_pass():
    problem = simple_problem(1)
    test = np.zeros((1, 2))
    # With one pair the replays repeat the same step, so both have seen it five times.
    ours, theirs = (BY_KEY[key].learn(problem, None).predict(test) for key in ("nlms", "padasip-nlms"))
    np.testing.assert_allclose(ours, theirs, atol=1e-9)


def test_scipys_calibration_finds_an_exact_arm():
    chain = two_joints()
    problem = replace(simple_problem(30), x=chain.positions(simple_problem(30).q))
    assert mean_error(BY_KEY["calibration"], problem) < 1e-9


def test_two_joints_have_eleven_identifiable_parameters():
    problem = simple_problem()
    assert problem.drawing is not None
    assert len(identifiable(Placements(problem.drawing, np.zeros(18)), problem.q)) == 11


def test_placement_derivatives_are_those_of_differences():
    problem, rng = simple_problem(5), np.random.default_rng(0)
    assert problem.drawing is not None
    change, step = 0.1 * rng.normal(size=18), 1e-6
    model = Placements(problem.drawing, change)
    _, jacobian = model.linearised(change, problem.q)
    for k, unit in enumerate(np.eye(18)):
        up, down = (model.linearised(change + sign * step * unit, problem.q)[0] for sign in (1.0, -1.0))
        np.testing.assert_allclose(jacobian[:, :, k], (up - down) / (2.0 * step), atol=1e-8)


def test_body_schema_of_nominal_arm_predicts_like_it():
    problem = simple_problem()
    assert problem.drawing is not None
    schema = BodySchema.drawn(problem.drawing)
    np.testing.assert_allclose(schema.predict(problem.q), problem.drawing.positions(problem.q), atol=1e-12)


def test_body_schema_step_descends_squared_error():
    problem = simple_problem()
    assert problem.drawing is not None
    schema = BodySchema.drawn(problem.drawing)
    for pair in range(20):
        q, x = problem.q[pair : pair + 1], problem.x[pair : pair + 1]
        before = np.linalg.norm(schema.predict(q) - x)
        schema.learn(problem.q, problem.x, np.array([pair]), np.array([0.1]))
        assert np.linalg.norm(schema.predict(q) - x) < before


def test_lagrange_weights_reproduce_polynomials_of_their_degree():
    at = np.linspace(-1.0, 1.0, 9)
    nodes = chebyshev(4)
    np.testing.assert_allclose(lagrange(at, nodes) @ nodes**3, at**3, atol=1e-14)


def test_a_psom_grid_meets_its_own_readings():
    grid = Grid(-REACH, REACH, (3, 4))
    np.testing.assert_allclose(grid.weights(grid.poses()), np.eye(12), atol=1e-12)


def test_a_hands_pose_follows_from_three_markers():
    chain, q = two_joints(), simple_problem().q
    shifts = ([0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0])
    rotation, origin = hand_pose([chain.with_tool(shift).positions(q) for shift in shifts])
    np.testing.assert_allclose(rotation, chain.poses(q)[:, :3, :3], atol=1e-12)
    np.testing.assert_allclose(origin, chain.positions(q), atol=1e-12)


def cross(x: np.ndarray) -> np.ndarray:
    """Return the test function of Schaal and Atkeson 1998, and of Vijayakumar, D'Souza and Schaal 2005."""
    ridges = np.stack([np.exp(-10.0 * x[:, 0] ** 2), np.exp(-50.0 * x[:, 1] ** 2)])
    return np.maximum(ridges.max(axis=0), 1.25 * np.exp(-5.0 * np.square(x).sum(axis=1)))


def lwpr_on_cross(updates: int, settings: Settings) -> tuple[float, LWPR]:
    rng = np.random.default_rng(1)
    model = LWPR(2, 1, settings)
    for x in rng.uniform(-1.0, 1.0, (updates, 2)):
        model.learn(x, cross(x[None]) + 0.1 * rng.normal(size=1))
    grid = np.stack(np.meshgrid(*2 * [np.linspace(-1.0, 1.0, 41)]), axis=-1).reshape(-1, 2)
    return float(np.mean((model.predict(grid)[:, 0] - cross(grid)) ** 2) / np.var(cross(grid))), model


def test_lwpr_learns_cross_function_to_published_level():
    error, model = lwpr_on_cross(4000, Settings(first_metric=120.0))
    assert error < 0.03
    assert 40 < model.fields < 100


def test_lwpr_width_adaptation_corrects_wide_start():
    still, _ = lwpr_on_cross(3000, Settings(first_metric=20.0, learning_rate=0.0))
    adapted, _ = lwpr_on_cross(3000, Settings(first_metric=20.0))
    assert adapted < 0.85 * still
