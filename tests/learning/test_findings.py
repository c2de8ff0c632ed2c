"""The learner's reports of camera, tool and joint offsets, and its forecast, against planted arms."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from guided_arm import NOW_AND_THEN, Scene, make_pair, near, new_learning, teach
from scipy.spatial.transform import Rotation
from test_calibration import DESK_ARM, figures_of

import bodyschema.daemon.learner.findings
from bodyschema.calibration.chain_figures import ChainFigures, limited_to_exact_pairs, tolerances_determined
from bodyschema.calibration.plausibility.verdict import FEWEST_ROWS
from bodyschema.daemon.learner.findings import Findings, FindingsBudget, _Settings, figures
from bodyschema.interfaces.records import FloatArray
from bodyschema.learning.config import LearnerConfig
from bodyschema.learning.data_outlook import LearnerEvidence, ResidualScatter, forecast
from bodyschema.learning.nominal import NominalModel
from bodyschema.learning.online_learner import OnlineLearner
from bodyschema.learning.solvers.solver import DirectSolver
from bodyschema.learning.status import DataOutlook
from bodyschema.robot.description import RobotDescription
from kbmaps import ChainParameters, ChainTolerances

SIGMA_M = 0.0005
OTHER_TOOL = np.array([0.0, 0.02, 0.15])
NAMES = ("a", "b", "c", "d")
# From FEWEST_ROWS pairs on, they are checked in a turn of their own.
FEW = FEWEST_ROWS - 2


class Ticking:
    """A clock that stands still until it is moved."""

    def __init__(self) -> None:
        self.time = 0.0

    def now(self) -> float:
        return self.time

    def utc(self) -> str:
        return "2026-11-21T12:00:00.000+00:00"


class Slow(Ticking):
    """Clock on which everything done between two looks takes a while."""

    TICK_S = 0.1

    def now(self) -> float:
        self.time += self.TICK_S
        return self.time


@dataclass
class Planted:
    """A desk arm that deviates from nominal, and a learner that has pairs of it."""

    robot: RobotDescription
    parameters: ChainParameters
    change: FloatArray
    learning: OnlineLearner

    @classmethod
    def of(cls, seed: int, pairs: int) -> Planted:
        rng = np.random.default_rng(seed)
        robot = RobotDescription.load(DESK_ARM)
        parameters = ChainParameters(robot.chain)
        made = ChainTolerances(0.003, 0.001, 0.05, tool=0.03, base_rotation=0.5, base_translation=0.5)
        change = parameters.standard_deviations(made) * rng.normal(size=parameters.size)
        zeros = change[parameters.zeros]
        zeros[[0, -1]] = 0.0  # equivalent to a rotation of camera and marker in any motion
        arm = cls(robot, parameters, change, OnlineLearner(NominalModel.of(robot), LearnerConfig(), DirectSolver()))
        arm.teach(rng, pairs)
        return arm

    def teach(self, rng: np.random.Generator, pairs: int) -> None:
        """Learn pairs all over the joints' ranges; then do all background work but the replay."""
        first = self.learning.counters.last_seq + 1
        q = rng.uniform(self.robot.lower, self.robot.upper, (pairs, 4))
        x = self.parameters.positions(self.change, q) + SIGMA_M * rng.normal(size=(pairs, 3))
        for k in range(pairs):
            self.learning.learn(make_pair(first + k, q[k], x[k], SIGMA_M), 0.0)
            if k == 9:
                self.solve()
        self.solve()
        self.learning.learn(make_pair(first + pairs, q[0], x[0], SIGMA_M), 0.0)

    def solve(self) -> None:
        self.learning.solve_soon()
        while self.learning.work():
            pass

    def known(self) -> LearnerEvidence:
        known = self.learning.known()
        assert known is not None
        return known

    def covered(self) -> list[bool]:
        """Return a mask of the reported figures whose intervals contain the truth."""
        found, _ = figures(self.robot, self.known())
        off = found.values - figures_of(self)
        off[3:6] = np.remainder(off[3:6] + np.pi, 2.0 * np.pi) - np.pi
        told = np.append(np.ones(9, dtype=bool), found.shown)
        return (np.abs(off) < found.half_widths)[told].tolist()


@cache
def shared(seed: int, pairs: int) -> Planted:
    """Return an arm that tests share; none of them changes it."""
    return Planted.of(seed, pairs)


def findings_of(arm: Planted, clock: Ticking | None = None) -> Findings:
    clock = clock or Ticking()
    return Findings(arm.learning, arm.robot, clock, budget=FindingsBudget(clock.now))


# --- calibration


@pytest.mark.soak
def test_intervals_cover_the_planted_values() -> None:
    assert np.mean([inside for seed in range(3) for inside in shared(seed, 60).covered()]) > 0.8


@pytest.mark.soak
@pytest.mark.timeout(900)
def test_the_95_percent_intervals_cover_95_percent() -> None:
    assert 0.93 < np.mean([inside for seed in range(60) for inside in Planted.of(seed, 60).covered()]) < 0.995


def covered_after_another_tool(seed: int) -> list[bool]:
    arm = Planted.of(seed, 80)
    arm.change[arm.parameters.tool] += OTHER_TOOL
    arm.learning.tool_changed()
    arm.teach(np.random.default_rng(seed + 1000), 40)
    return arm.covered()


@pytest.fixture(scope="module")
def retooled() -> tuple[ChainFigures, Planted]:
    """Return what an arm's figures were before another tool, and the arm with pairs of it; no test changes it."""
    arm = Planted.of(3, 60)
    before, _ = figures(arm.robot, arm.known())
    arm.change[arm.parameters.tool] += OTHER_TOOL
    arm.learning.tool_changed()
    arm.teach(np.random.default_rng(7), 15)
    return before, arm


def test_freeing_unidentifiable_parameters_keeps_all_positions(retooled) -> None:
    arm = retooled[1]
    known = arm.known()
    prior = known.nominal.belief(known.belief.parameters.reference, known.tolerances)
    freed = limited_to_exact_pairs(known.belief, prior, arm.robot)
    q = np.random.default_rng(9).uniform(arm.robot.lower, arm.robot.upper, (50, 4))
    np.testing.assert_allclose(freed.predict(q), known.belief.predict(q), rtol=0, atol=0.02 * SIGMA_M)


@pytest.mark.soak
@pytest.mark.timeout(900)
def test_intervals_cover_95_percent_after_tool_change() -> None:
    assert 0.93 < np.mean([inside for seed in range(30) for inside in covered_after_another_tool(seed)]) < 0.995


def test_only_unidentifiable_joint_offsets_are_null() -> None:
    findings = findings_of(shared(2, 60))
    findings.renew()
    zeros = findings.calibration.zeros
    assert [name for name, zero in zeros.items() if zero is None] == ["base_yaw", "wrist_roll"]


def test_hand_eye_pose_matches_camera_figures() -> None:
    findings = findings_of(shared(2, 60))
    findings.renew()
    found = findings.calibration
    matrix = np.array(found.hand_eye.matrix)
    turned = Rotation.from_euler("xyz", [figure.learnt for figure in found.camera_rpy]).as_matrix()
    assert matrix[:3, 3] == pytest.approx([figure.learnt for figure in found.camera_xyz])
    assert matrix[:3, :3] == pytest.approx(turned, abs=1e-9)
    assert Rotation.from_quat(found.hand_eye.quaternion_xyzw).as_matrix() == pytest.approx(turned, abs=1e-9)
    assert matrix[3] == pytest.approx([0.0, 0.0, 0.0, 1.0])


def test_hand_eye_covariance_matches_camera_intervals() -> None:
    findings = findings_of(shared(2, 60))
    findings.renew()
    found = findings.calibration
    _, pitch, yaw = (figure.learnt for figure in found.camera_rpy)
    about_z = Rotation.from_euler("z", yaw)
    # Columns: the turns about the parent's axes by a step in roll, pitch and yaw.
    budget = np.column_stack(
        [(about_z * Rotation.from_euler("y", pitch)).apply([1.0, 0.0, 0.0]), about_z.apply([0.0, 1.0, 0.0]), [0, 0, 1]]
    )
    to_figures = np.zeros((6, 6))
    to_figures[:3, :3], to_figures[3:, 3:] = np.eye(3), np.linalg.inv(budget)
    variances = np.diag(to_figures @ np.reshape(found.hand_eye.covariance, (6, 6)) @ to_figures.T)
    expected = [figure.half_width for figure in (*found.camera_xyz, *found.camera_rpy)]
    assert 1.96 * np.sqrt(variances) == pytest.approx(expected, rel=1e-3)


def test_estimated_arm_tolerances_are_below_learner_defaults() -> None:
    arm = shared(2, 60)
    _, made = figures(arm.robot, arm.known())
    assert made is not None
    axes, points = made
    assert axes < 0.02
    assert points < 0.005


def test_joint_offset_intervals_survive_a_tool_change(retooled) -> None:
    before, arm = retooled
    after, _ = figures(arm.robot, arm.known())
    assert (after.half_widths[10:12] < 1.2 * before.half_widths[10:12]).all()
    assert np.linalg.norm((after.values - before.values)[6:9] - OTHER_TOOL) < 0.02


def test_the_noise_is_the_scatter_of_the_pairs() -> None:
    assert ResidualScatter.of(shared(2, 60).known()).noise_m == pytest.approx(SIGMA_M, rel=0.15)


# --- outlook


def outlook_of(learning: OnlineLearner) -> DataOutlook:
    known = learning.known()
    assert known is not None
    return forecast(known, ResidualScatter.of(known), NAMES)


def guided(seed: int, pairs: int) -> tuple[OnlineLearner, Scene]:
    scene, learning = Scene.draw(seed, pairs), new_learning()
    teach(learning, scene.pairs, every=NOW_AND_THEN)
    return learning, scene


@pytest.fixture(scope="module")
def after_60() -> list[tuple[OnlineLearner, Scene, DataOutlook]]:
    """Return learners that know the first 60 pairs of a path of 160, and their outlook then."""
    found = []
    for seed in range(2):
        scene, learning = Scene.draw(seed, 160), new_learning()
        teach(learning, scene.pairs[:60], every=NOW_AND_THEN)
        found.append((learning, scene, outlook_of(learning)))
    return found


def true_error_m(learning: OnlineLearner, scene: Scene, pairs: int) -> float:
    """Return the true error near the first `pairs` of the path."""
    q = near(np.random.default_rng(0), scene.q[:pairs])
    return float(np.linalg.norm(learning.snapshot.predict(q).x - scene.chain.positions(q), axis=1).mean())


def test_the_expected_error_is_the_true_one(after_60) -> None:
    ratios = [outlook.error_m / true_error_m(learning, scene, 60) for learning, scene, outlook in after_60]
    assert 0.6 < np.exp(np.mean(np.log(ratios))) < 1.7


def test_the_expected_error_is_the_claimed_one(after_60) -> None:
    for learning, _, outlook in after_60:
        assert outlook.error_m == pytest.approx(learning.claimed_error_m(), rel=1e-12)


@pytest.mark.soak  # of the forecast alone: tests/kbmaps/test_expected_gain.py
def test_forecast_for_further_pairs_matches_true_error(after_60) -> None:
    ratios = []
    for learning, scene, outlook in after_60:
        teach(learning, scene.pairs[60:], every=NOW_AND_THEN)
        ratios.append(outlook.like_so_far_m[0] / true_error_m(learning, scene, 60))
    assert 0.5 < np.exp(np.mean(np.log(ratios))) < 2.0


@pytest.mark.soak  # of the forecast alone: tests/kbmaps/test_expected_gain.py
def test_data_suffice_after_many_pairs_only() -> None:
    learning, _ = guided(1, 30)
    assert not outlook_of(learning).enough
    rest = Scene.draw(1, 500)
    teach(learning, rest.pairs[30:], background=False)
    learning.solve_soon()
    while learning.work():
        pass
    assert outlook_of(learning).enough


def test_moving_an_idle_joint_gains_most() -> None:
    scene, learning = Scene.draw(2, 80), new_learning()
    q = scene.q * np.array([1.0, 1.0, 0.05, 1.0])
    rng = np.random.default_rng(0)
    x = scene.chain.positions(q) + 0.002 * rng.normal(size=(80, 3))
    teach(learning, [make_pair(k + 1, q[k], x[k]) for k in range(80)], every=NOW_AND_THEN)
    outlook = outlook_of(learning)
    assert outlook.best_motion != "moving as so far"
    assert outlook.best_motion_m[-1] < outlook.like_so_far_m[-1]


def test_expected_error_is_larger_over_full_joint_ranges() -> None:
    outlook = outlook_of(guided(3, 60)[0])
    assert outlook.anywhere_m > outlook.error_m


# --- when they are found


def test_findings_are_empty_before_the_first_solution() -> None:
    robot = RobotDescription.load(DESK_ARM)
    findings = Findings(OnlineLearner(NominalModel.of(robot), LearnerConfig(), DirectSolver()), robot, Ticking())
    findings.renew()
    assert (findings.calibration, findings.outlook) == (None, None)


def test_findings_renew_with_new_chain_after_the_interval() -> None:
    arm, clock = Planted.of(1, FEW), Ticking()
    findings = findings_of(arm, clock)
    rested = [findings.at_rest]
    findings.renew()
    rested.append(findings.at_rest)
    first = findings.calibration
    arm.teach(np.random.default_rng(8), 12)
    rested.append(findings.at_rest)
    findings.renew()
    assert findings.calibration is first
    clock.time += _Settings.every_s
    findings.renew()
    assert findings.calibration.pairs > first.pairs
    assert rested == [False, True, False]  # they rest only while they are of the present chain


def test_wall_time_without_cpu_time_delays_no_findings() -> None:
    arm, clock = Planted.of(1, FEW), Slow()
    clock.TICK_S = 60.0  # a minute passes on a busy machine, and the finding takes no time of the processor
    findings = Findings(arm.learning, arm.robot, clock, budget=FindingsBudget(lambda: 0.0))
    findings.renew()
    first = findings.calibration
    arm.teach(np.random.default_rng(8), 12)
    findings.renew()
    assert findings.calibration.pairs > first.pairs


def test_of_several_robots_one_finds_at_a_time() -> None:
    clock = Slow()
    budget = FindingsBudget(clock.now)
    arm = shared(1, FEW)
    found = [Findings(arm.learning, arm.robot, clock, 2, budget) for _ in range(2)]
    for findings in found:
        findings.renew()
    assert [findings.calibration is not None for findings in found] == [True, False]
    clock.time += _Settings.share * Slow.TICK_S
    found[1].renew()
    assert found[1].calibration is not None


def test_the_same_chain_is_not_gone_through_twice() -> None:
    arm, clock = shared(1, FEW), Ticking()
    findings = findings_of(arm, clock)
    findings.renew()
    first = findings.calibration
    clock.time += 10.0 * _Settings.every_s
    findings.renew()
    assert findings.calibration is first


def test_tool_change_clears_findings_until_next_renewal() -> None:
    arm = Planted.of(1, FEW)
    findings = findings_of(arm)
    findings.renew()
    arm.learning.tool_changed()
    assert (findings.calibration, findings.outlook) == (None, None)
    findings.renew()
    arm.teach(np.random.default_rng(8), 12)
    assert arm.learning.belief is not None
    assert (findings.calibration, findings.outlook) == (None, None)  # it is not time to find them yet


def test_highly_uncertain_tolerance_estimate_is_not_reported() -> None:
    assert tolerances_determined([(0.003, 0.001), (0.001, 0.0005)])
    assert not tolerances_determined([(0.003, 0.001), (0.0003, 0.0001)])


def test_failed_findings_are_logged_without_stopping_the_learner(monkeypatch, caplog) -> None:
    def failing(*_: object) -> None:
        raise np.linalg.LinAlgError("Eigenvalues did not converge")

    monkeypatch.setattr(bodyschema.daemon.learner.findings, "figures", failing)
    findings = findings_of(shared(1, FEW))
    findings.renew()
    assert findings.calibration is None
    assert "status has no calibration for now: Eigenvalues did not converge" in caplog.text


def test_calibration_is_reported_without_outlook_before_solution_answers() -> None:
    arm = Planted.of(1, FEW)
    arm.learning.tool_changed()
    q = arm.robot.lower / 2.0
    arm.learning.learn(make_pair(FEW + 2, q, arm.parameters.positions(arm.change, q), SIGMA_M), 0.0)
    arm.solve()  # a solution that has not met a pair yet
    findings = findings_of(arm)
    findings.renew()
    assert findings.calibration is not None
    assert findings.outlook is None
