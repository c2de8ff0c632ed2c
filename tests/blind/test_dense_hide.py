"""Hidden causes in arms with tolerances: generator and observer agree."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from .dense_arms import ANGLE_RAD, LENGTH_M, described, made
from .dense_causes import Cause, Way, all_causes, columns
from .dense_chain import Built
from .dense_hide import DenseCase, _eye_R, _Robot, _way, hide_dense, written
from .dense_observer import Observer
from .motion import Motion, move

pytestmark = pytest.mark.soak  # they check the cases that only `make soak` judges in number
SMALL = 1e-4  # usual amounts: the nonlinear remainder is much smaller
EFFECTS = (
    "joint_offset",
    "joint_scale",
    "joint_coupling",
    "joint_eccentricity",
    "joint_ripple",
    "encoder_jump",
    "backlash",
    "joint_compliance",
    "link_geometry",
    "tool_offset",
    "tool_slip",
    "camera_moved",
    "camera_pose",
)


@pytest.fixture(scope="module")
def scene() -> tuple[Built, Motion, Way, list[Cause]]:
    """Return an arm with a prismatic joint and its instrument on a head, a walk, and all causes."""
    rng = np.random.default_rng(3)
    arm = next(a for a in (described(rng, with_masses=True) for _ in range(99)) if "head_pan" in a.read)
    as_made = made(arm, rng)
    built = Built(
        arm, as_made.frames, np.array(arm.marker_xyz), _eye_R(arm), np.array(arm.camera_xyz), np.zeros(len(arm.read))
    )
    motion = move(rng, "walk", arm.ranges, 120, lambda q: np.ones(len(q), dtype=bool))
    way = _way(arm, motion, built, True)
    causes = all_causes(
        arm, float(way.clock[-1]), rng, loaded=arm.read, marker_known=True, pose_known=True, longest=1.0
    )
    return built, motion, way, causes


@pytest.mark.parametrize("effect", EFFECTS)
def test_observer_columns_match_the_simulated_effect(
    scene: tuple[Built, Motion, Way, list[Cause]], effect: str
) -> None:
    built, motion, way, causes = scene
    by_joints, by_frames = way.posture.by_joints(), way.posture.by_frames()
    arm = replace(built.arm, ticks=dict.fromkeys(built.arm.ticks, 2**52))
    still = replace(
        made(arm, np.random.default_rng(1)), frames=built.frames, harmonics=(np.zeros((1, 3)),) * len(arm.read)
    )
    chosen = [cause for cause in causes if cause.effect == effect]
    assert chosen
    for cause in chosen:
        amounts = SMALL * cause.amounts
        shape = cause.shape | ({"width": float(amounts[0])} if effect == "backlash" else {})
        small = replace(cause, amounts=amounts, shape=shape)
        robot = _Robot(arm, still, built, (small,))
        read = robot.readings(way.shaft, way.clock)
        shown = robot.positions(motion, way.clock) - built.measured(read)
        expected = columns(small, way, by_joints, by_frames) @ amounts
        assert np.abs(shown - expected).max() < 0.01 * np.abs(expected).max() + 1e-10, written(cause)


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> DenseCase:
    return hide_dense(2, tmp_path_factory.mktemp("dense"), rows=200, count=2)


def test_ground_truth_is_outside_the_diagnosed_folder(case: DenseCase) -> None:
    assert sorted(file.name for file in (case.folder / "case").iterdir()) == ["arm.urdf", "measured.csv", "robot.toml"]


def test_sealed_truth_lists_each_cause_with_its_evidence(case: DenseCase) -> None:
    told = json.loads((case.folder / "sealed.json").read_text(encoding="utf-8"))
    assert [entry["cause"] for entry in told["truth"]] == [written(cause) for cause in case.truth]
    assert all(entry["nats"] == pytest.approx(nats) for entry, nats in zip(told["truth"], case.nats, strict=True))


def test_equal_seeds_write_equal_recordings(case: DenseCase, tmp_path: Path) -> None:
    again = hide_dense(2, tmp_path, rows=200, count=2)
    assert again.recording.read_bytes() == case.recording.read_bytes()


def test_tolerances_keep_to_their_two_decades() -> None:
    rng = np.random.default_rng(5)
    arm = described(rng, with_masses=False)
    scales = np.array([(m.length_m / LENGTH_M, m.angle_rad / ANGLE_RAD) for m in (made(arm, rng) for _ in range(300))])
    assert scales.min() > 0.1
    assert scales.max() < 10.0
    assert 0.3 < np.corrcoef(np.log(scales.T))[0, 1] < 0.8


def _observer(amounts: list[float]) -> Observer:
    """Return an observer with one column of tolerances, and causes of one number with orthogonal columns."""
    rows = 50
    basis = np.linalg.qr(np.random.default_rng(0).normal(size=(rows, len(amounts) + 1)))[0]
    blocks = [100.0 * basis[:, [k]] for k in range(len(amounts))]
    costs = np.full(len(amounts), 3.0)
    return Observer.of(np.empty((rows, 0)), basis[:, -1:], np.zeros(1), blocks, [np.array([a]) for a in amounts], costs)


def test_the_observer_is_sure_of_a_large_cause() -> None:
    evidence, spare = _observer([1.0, 1.0, 1.0]).evidence([1])
    # Half the squared signal beyond the tolerances, the loss for its degree of freedom, and the cost of a cause.
    shown = 0.5 * 100.0**2 * 1e4 / (1e4 + 1.0) - 0.5 * np.log(1e4 + 1.0) + 0.5 - 3.0
    assert evidence[0].nats == pytest.approx(shown, rel=1e-3)
    assert spare > 0.0


def test_observer_rejects_cause_below_the_noise() -> None:
    evidence, _ = _observer([1.0, 0.005, 1.0]).evidence([1])
    assert evidence[0].nats < 0.0


def test_observer_rejects_cause_absorbed_by_instrument_pose() -> None:
    rng = np.random.default_rng(1)
    column, other = rng.normal(size=(60, 1)), rng.normal(size=(60, 1))
    observer = Observer.of(
        column, 0.01 * other, np.zeros(1), [100 * column, 100 * other], [np.ones(1), np.ones(1)], np.full(2, 3.0)
    )
    assert observer.evidence([0])[0][0].nats < 0.0


def test_causes_with_proportional_columns_are_equivalent() -> None:
    rng = np.random.default_rng(1)
    column, other = rng.normal(size=(60, 1)), rng.normal(size=(60, 1))
    blocks, amounts = [100 * column, 50 * column, 100 * other], [np.ones(1)] * 3
    observer = Observer.of(np.empty((60, 0)), np.empty((60, 0)), np.zeros(0), blocks, amounts, np.full(3, 3.0))
    assert observer.same(0, [0]) == [1]


def test_evidence_is_that_of_the_whole_covariance() -> None:
    rng = np.random.default_rng(4)
    rows, flat, background = 40, rng.normal(size=(40, 2)), rng.normal(size=(40, 5))
    blocks, costs = [rng.normal(size=(rows, m)) for m in (1, 2, 3, 1)], np.array([3.0, 2.0, 1.0, 4.0])
    drawn, amounts = rng.normal(size=5), [rng.normal(size=b.shape[1]) for b in blocks]
    observer = Observer.of(flat, background, drawn, blocks, amounts, costs)
    truth = [0, 2]
    data = background @ drawn + blocks[0] @ amounts[0] + blocks[2] @ amounts[2]

    def mean_log_evidence(chosen: list[int]) -> float:
        C = np.eye(rows) + 1e8 * flat @ flat.T + background @ background.T
        C = C + sum(blocks[k] @ blocks[k].T for k in chosen)
        fit = data @ np.linalg.solve(C, data) + np.trace(np.linalg.inv(C))
        return float(-0.5 * fit - 0.5 * np.linalg.slogdet(C)[1] - costs[chosen].sum())

    sets = [[2], [1, 2], [2, 3], [], [1], [3], [1, 2, 3], [1, 3]]
    evidence, spare = observer.evidence(truth)
    best = max(map(mean_log_evidence, sets))
    assert evidence[0].nats == pytest.approx(mean_log_evidence(truth) - best, abs=1e-3)
    more = max(mean_log_evidence([*truth, k]) for k in (1, 3))
    assert spare == pytest.approx(mean_log_evidence(truth) - more, abs=1e-3)
