from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted_chains import bases_for, half_ranges, random_chain, random_map, random_q
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from kbmaps import (
    ChainTolerances,
    InverseKinematics,
    KBMap,
    Model,
    RigidChain,
    RigidLearner,
    SettingError,
    ShapeError,
    TensorLearner,
    learning_bases,
)

seeds = st.integers(0, 2**32 - 1)
RANGE_DEG = 100.0


class PositionsOnly:
    """A chain as a model with positions and their derivative only."""

    def __init__(self, chain: RigidChain) -> None:
        self.joints, self.predict, self.jacobian = chain.joints, chain.positions, chain.jacobian


def planted(rng: np.random.Generator, kinds: str, *, deg: float = RANGE_DEG) -> tuple[KBMap, np.ndarray]:
    """Return a random chain as a map of poses, and its half ranges."""
    return random_chain(rng, kinds).to_kbmap(bases_for(kinds, deg), orientation=True), half_ranges(kinds, deg)


def planar_arm(*links_m: float) -> RigidChain:
    fixed = np.tile(np.eye(4), (len(links_m) + 1, 1, 1))
    fixed[1:, 0, 3] = links_m
    return RigidChain(fixed, np.tile([0.0, 0.0, 1.0], (len(links_m), 1)), np.zeros(len(links_m), dtype=bool))


def planar_map(*links_m: float) -> KBMap:
    return planar_arm(*links_m).to_kbmap(learning_bases([-math.pi] * len(links_m), [math.pi] * len(links_m)))


def share_converged(joint_kinds: str, *, arms: int, targets: int, pose: bool, deg: float = RANGE_DEG) -> float:
    """Return the share of reachable random poses for which a solution is found to 1e-6 m (and rad)."""
    found = []
    for seed in range(arms):
        rng = np.random.default_rng(seed)
        kbmap, half = planted(rng, joint_kinds, deg=deg)
        solver = InverseKinematics(kbmap, -half, half)
        for truth in random_q(rng, joint_kinds, targets, deg):
            x, rotation = kbmap.predict(truth), kbmap.orientation(truth) if pose else None
            q = solver.solve(x, rotation).q
            off = np.linalg.norm(kbmap.predict(q) - x)
            turned = np.abs(kbmap.orientation(q) - kbmap.orientation(truth)).max() if pose else 0.0
            found.append(bool((np.abs(q) <= half).all() and off < 1e-6 and turned < 1e-6))
    return float(np.mean(found))


def test_seven_joint_arms_reach_99_percent_of_positions():
    assert share_converged("RRRRRRR", arms=20, targets=15, pose=False) >= 0.99


@pytest.mark.soak
@pytest.mark.parametrize("deg", [30.0, 80.0, 170.0])
@pytest.mark.parametrize("joint_kinds", ["RRR", "RRPR", "RRRRRRR"])
def test_99_percent_of_positions_reached_for_all_ranges(joint_kinds, deg):
    assert share_converged(joint_kinds, arms=100, targets=20, pose=False, deg=deg) >= 0.99


def test_reachable_poses_of_seven_joint_arms_are_reached():
    assert share_converged("RRRRRRR", arms=4, targets=8, pose=True) >= 0.9


@pytest.mark.soak
@pytest.mark.parametrize("joint_kinds", ["RRRRRR", "RRPRRR", "RRRRRRR"])
def test_99_percent_of_reachable_poses_are_reached(joint_kinds):
    assert share_converged(joint_kinds, arms=100, targets=10, pose=True) >= 0.99


@given(seed=seeds, joint_kinds=st.text("RP", min_size=1, max_size=5))
def test_far_targets_are_always_reported_out_of_reach(seed, joint_kinds):
    rng = np.random.default_rng(seed)
    kbmap, half = planted(rng, joint_kinds)
    corners = np.abs(kbmap.predict(random_q(rng, joint_kinds, 200, RANGE_DEG))).max() + 1.0
    direction = rng.normal(size=3)
    target = 4.0 * corners * direction / np.linalg.norm(direction)
    solution = InverseKinematics(kbmap, -half, half, samples=200, starts=4).solve(target)
    assert not solution.converged
    assert solution.reason == "out_of_reach"
    np.testing.assert_allclose(solution.distance, np.linalg.norm(target - kbmap.predict(solution.q)), rtol=1e-12)


@given(seed=seeds, beyond_m=st.floats(1e-4, 5.0))
def test_unreachable_target_returns_nearest_reachable_position(seed, beyond_m):
    bearing = np.random.default_rng(seed).uniform(-math.pi, math.pi)
    target = (0.5 + beyond_m) * np.array([math.cos(bearing), math.sin(bearing), 0.0])
    arm = InverseKinematics(planar_map(0.3, 0.2), [-4.0, -2.0], [4.0, 2.0], samples=500)
    solution = arm.solve(target)
    assert solution.reason == "out_of_reach"
    assert solution.distance == pytest.approx(beyond_m, abs=1e-6)


def test_target_in_inner_workspace_hole_reports_its_distance():
    solution = InverseKinematics(planar_map(0.3, 0.1), [-4.0, -4.0], [4.0, 4.0]).solve([0.05, 0.0, 0.0])
    assert (solution.reason, round(solution.distance, 6)) == ("out_of_reach", 0.15)


def test_target_on_workspace_boundary_is_reached():
    assert InverseKinematics(planar_map(0.3, 0.2), [-4.0, -2.0], [4.0, 2.0]).solve([0.0, 0.5, 0.0]).distance < 1e-6


def test_search_escapes_a_singular_stretched_start():
    solver = InverseKinematics(planar_map(0.3, 0.2), [-4.0, -2.0], [4.0, 2.0])
    assert solver.solve([0.3, 0.0, 0.0], start=[0.0, 0.0]).converged


@given(seed=seeds, joint_kinds=st.text("RP", min_size=1, max_size=5), pose=st.booleans())
def test_solutions_respect_limits_and_report_remaining_error(seed, joint_kinds, pose):
    rng = np.random.default_rng(seed)
    kbmap, half = planted(rng, joint_kinds)
    lower, upper = -half * rng.uniform(0, 1, len(half)), half * rng.uniform(0, 1, len(half))
    x, rotation = rng.normal(size=3), Rotation.random(rng=rng) if pose else None
    solver = InverseKinematics(kbmap, lower, upper, samples=200, starts=3)
    solution = solver.solve(x, rotation.as_quat() if rotation else None, start=rng.normal(size=len(half)))
    assert ((lower <= solution.q) & (solution.q <= upper)).all()
    np.testing.assert_allclose(solution.x, kbmap.predict(solution.q), atol=1e-12)
    np.testing.assert_allclose(solution.distance, np.linalg.norm(x - solution.x), atol=1e-12)
    if rotation:
        there = Rotation.from_matrix(kbmap.orientation(solution.q))
        assert solution.angle == pytest.approx((rotation * there.inv()).magnitude(), abs=1e-9)
    else:
        assert solution.angle is None


def test_quaternion_and_matrix_targets_give_the_same_solution():
    rng = np.random.default_rng(5)
    kbmap, half = planted(rng, "RRRRRRR")
    truth = random_q(rng, "RRRRRRR", 1, RANGE_DEG)[0]
    solver, rotation = InverseKinematics(kbmap, -half, half), kbmap.orientation(truth, orthonormal=True)
    from_matrix = solver.solve(kbmap.predict(truth), rotation)
    from_quaternion = solver.solve(kbmap.predict(truth), Rotation.from_matrix(rotation).as_quat())
    assert from_matrix.converged
    np.testing.assert_allclose(from_quaternion.q, from_matrix.q, atol=1e-6)


def test_same_seed_gives_bit_identical_solutions():
    kbmap, half = planted(np.random.default_rng(2), "RRRRR")
    answers = [InverseKinematics(kbmap, -half, half, seed=3).solve([0.3, 0.2, 0.1]).q.tobytes() for _ in range(2)]
    assert answers[0] == answers[1]


def test_solution_stays_near_a_start_near_target():
    rng = np.random.default_rng(8)
    kbmap, half = planted(rng, "RRRRRRR")
    solver = InverseKinematics(kbmap, -half, half)
    for start in 0.9 * random_q(rng, "RRRRRRR", 20, RANGE_DEG):
        solution = solver.solve(kbmap.predict(start) + 0.003 * rng.normal(size=3), start=start)
        assert solution.starts == 1
        assert np.abs(solution.q - start).max() < 0.2


@pytest.mark.parametrize("pose", [False, True])
def test_posture_is_optimised_within_the_null_space(pose):
    """Compare the objective with that of an independent solver started at our answer."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        kbmap, half = planted(rng, "RRRRRRR")
        truth = random_q(rng, "RRRRRRR", 1, RANGE_DEG)[0]
        x, rotation = kbmap.predict(truth), kbmap.orientation(truth)
        solver = InverseKinematics(kbmap, -half, half)
        solution = solver.solve(x, rotation if pose else None, start=truth, posture=solver.middle)

        def missing(q, x=x, rotation=rotation, kbmap=kbmap):
            turned = np.cross(kbmap.orientation(q).T, rotation.T).sum(axis=0) if pose else np.zeros(0)
            return np.concatenate([kbmap.predict(q) - x, turned])

        def far(q, half=half):
            return float(np.square(q / half).sum())

        best = minimize(
            far,
            solution.q,
            method="SLSQP",
            bounds=list(zip(-half, half, strict=True)),
            constraints=[{"type": "eq", "fun": missing}],
            options={"maxiter": 300, "ftol": 1e-12},
        )
        assert solution.converged
        assert far(solution.q) < far(truth)
        assert far(solution.q) <= 1.0001 * best.fun


def test_positions_only_model_solves_position_targets_only():
    rng = np.random.default_rng(4)
    chain, half = random_chain(rng, "RRRRR"), half_ranges("RRRRR", RANGE_DEG)
    solver, target = InverseKinematics(PositionsOnly(chain), -half, half), chain.positions(0.3 * half)
    assert np.linalg.norm(chain.positions(solver.solve(target).q) - target) < 1e-6
    with pytest.raises(SettingError, match="no orientation"):
        solver.solve(target, np.eye(3))


def test_true_reaching_error_equals_the_model_error():
    """A map that is wrong by some millimetres misplaces the true arm by as much, and no more."""
    rng = np.random.default_rng(6)
    chain, half = random_chain(rng, "RRRRRRR"), half_ranges("RRRRRRR", RANGE_DEG)
    exact = chain.to_kbmap(bases_for("RRRRRRR", RANGE_DEG))
    disturbed = KBMap(exact.bases, exact.net + 0.002 * random_map(rng, exact.bases).net)
    solver = InverseKinematics(disturbed, -half, half)
    truth = random_q(rng, "RRRRRRR", 40, RANGE_DEG)
    targets = disturbed.predict(truth)
    reached = np.array([solver.solve(target).q for target in targets])
    model_error = np.linalg.norm(disturbed.predict(reached) - chain.positions(reached), axis=1)
    reaching_error = np.linalg.norm(chain.positions(reached) - targets, axis=1)
    np.testing.assert_allclose(reaching_error, model_error, atol=1e-6)


def test_step_limit_is_respected_and_reported():
    kbmap, half = planted(np.random.default_rng(3), "RRRRRRR")
    solution = InverseKinematics(kbmap, -half, half, max_steps=5).solve([9.0, 0.0, 0.0])
    assert (solution.steps <= 5, solution.reason) == (True, "steps_ran_out")


def test_joint_without_limits_solves_from_any_start_angle():
    solver = InverseKinematics(planar_map(0.3, 0.2), [-math.inf, -2.0], [math.inf, 2.0])
    assert solver.solve([-0.4, 0.1, 0.0], start=[9.0, 1.0]).converged


def test_locked_joint_keeps_its_value():
    solution = InverseKinematics(planar_map(0.3, 0.2, 0.1), [-3.0, 0.5, -3.0], [3.0, 0.5, 3.0]).solve([0.3, 0.3, 0.0])
    assert (solution.converged, solution.q[1]) == (True, 0.5)


@pytest.mark.parametrize(
    ("lower", "upper", "settings_"),
    [([1.0, 0.0], [0.0, 1.0], {}), ([0.0, 0.0], [1.0, 1.0], {"starts": 0}), ([0, 0], [1, 1], {"tolerance": 0.0})],
)
def test_impossible_limits_and_settings_are_refused(lower, upper, settings_):
    with pytest.raises(SettingError):
        InverseKinematics(planar_map(0.3, 0.2), lower, upper, **settings_)


def test_targets_of_the_wrong_shape_are_refused():
    solver = InverseKinematics(planar_map(0.3, 0.2), [-1, -1], [1, 1])
    for arguments in (([0.0, 0.0],), ([0.0, 0.0, 0.0], [1.0, 0.0]), ([0.0, 0.0, 0.0], np.tile(np.eye(3), (2, 1, 1)))):
        with pytest.raises(ShapeError):
            solver.solve(*arguments)
    with pytest.raises(ShapeError):
        InverseKinematics(planar_map(0.3, 0.2), [-1, -1, -1], [1, 1, 1])


def humanoid() -> RigidChain:
    """Return a chain of twenty joints, links of 60 mm, axes in turn about z, y and x."""
    fixed = np.tile(np.eye(4), (21, 1, 1))
    fixed[1:, :3, 3] = [0.05, 0.02, 0.03]
    return RigidChain(fixed, np.eye(3)[[2 - k % 3 for k in range(20)]], np.zeros(20, dtype=bool))


@pytest.mark.parametrize("kind", ["rigid", "train"])
def test_learnt_twenty_joint_arms_reach_within_five_sigma(kind):
    rng = np.random.default_rng(0)
    drawing, reach = humanoid(), np.full(20, np.radians(40.0))
    real = drawing.with_tool([0.02, -0.01, 0.03])
    learner: Model = RigidLearner(drawing, ChainTolerances(tool=0.03))
    if kind == "train":
        learner = TensorLearner.around(drawing, learning_bases(-reach, reach))
    q = rng.uniform(-reach, reach, (60, 20))
    learner.learn(q, real.positions(q) + 1e-3 * rng.normal(size=(60, 3)), 1e-3)
    solver = InverseKinematics(learner, -reach, reach)
    for target in real.positions(rng.uniform(-reach, reach, (3, 20))):
        solution = solver.solve(target)
        assert solution.converged
        off = np.abs(real.positions(solution.q) - target)
        assert (off < 5.0 * learner.estimate(solution.q).sigma + 1e-6).all()


def test_a_chain_reaches_a_pose():
    rng = np.random.default_rng(1)
    chain = random_chain(rng, "RRRPRRR")
    half = half_ranges("RRRPRRR", RANGE_DEG)
    truth = random_q(rng, "RRRPRRR", 1, RANGE_DEG)[0]
    solution = InverseKinematics(chain, -half, half).solve(chain.predict(truth), chain.orientation(truth))
    assert solution.converged
    np.testing.assert_allclose(chain.poses(solution.q), chain.poses(truth), rtol=0, atol=1e-6)


def test_non_model_error_lists_missing_attributes():
    class Guess:
        joints = 2
        predict = staticmethod(np.zeros)

    with pytest.raises(SettingError, match="a Guess has no jacobian"):
        InverseKinematics(Guess(), [-1, -1], [1, 1])
    with pytest.raises(SettingError, match="a str has no joints, predict, jacobian"):
        InverseKinematics("arm", [-1, -1], [1, 1])
