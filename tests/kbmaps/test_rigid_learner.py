from __future__ import annotations

import copy
import math
import pickle
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted_chains import random_chain, random_q
from rough_arms import ROUGH, rough_arm
from scipy.spatial.transform import Rotation

from kbmaps import (
    ChainParameters,
    ChainTolerances,
    DegenerateDataError,
    ModelFormatError,
    NonFiniteError,
    RecursiveRigidLearner,
    RigidChain,
    RigidLearner,
    SettingError,
    ShapeError,
    align,
)
from kbmaps.chains import align as align_module

seeds = st.integers(0, 2**32 - 1)


@given(seed=seeds, kinds=st.sampled_from(["RRRRRRR", "RPRRRR", "PPPRRR", "RRP"]))
def test_fifteen_exact_pairs_correct_rough_nominal_model(seed, kinds):
    rng = np.random.default_rng(seed)
    arm = rough_arm(rng, kinds, replace(ROUGH, slide_zeros=0.01))
    learner = RigidLearner(arm.nominal, replace(ROUGH, slide_zeros=0.01))
    learner.learn(*arm.pairs(rng, 15))
    assert arm.error(learner, rng) < 1e-9


@given(seed=seeds)
def test_the_order_of_the_pairs_does_not_matter(seed):
    rng = np.random.default_rng(seed)
    arm = rough_arm(rng)
    q, x = arm.pairs(rng, 40, 0.005)
    order = rng.permutation(40)
    at_once, one_by_one = RigidLearner(arm.nominal, ROUGH), RigidLearner(arm.nominal, ROUGH)
    at_once.learn(q, x, 0.005)
    for k in order:
        one_by_one.learn(q[k], x[k], 0.005)
    assert one_by_one.pairs == 40
    np.testing.assert_allclose(one_by_one.predict(q), at_once.predict(q), rtol=0, atol=1e-6)


def test_posterior_matches_closed_form_for_linear_problem():
    """With tiny tolerances the chain is linear in its parameters and textbook formulas hold."""
    rng = np.random.default_rng(11)
    tolerances = ChainTolerances(axes=1e-5, points=1e-5, zeros=1e-5, tool=1e-5, base_rotation=1e-5)
    arm = rough_arm(rng, "RRRR", tolerances)
    q, x = arm.pairs(rng, 50, 1e-5)
    learner = RigidLearner(arm.nominal, tolerances)
    learner.learn(q, x, 1e-5)
    parameters = ChainParameters(arm.nominal)
    std = parameters.standard_deviations(tolerances)
    free = std > 0
    start, jacobian = parameters.linearised(np.zeros(parameters.size), q)
    design = jacobian[:, :, free].reshape(150, -1) / 1e-5
    covariance = np.linalg.inv(design.T @ design + np.diag(std[free] ** -2))
    change = covariance @ design.T @ (x - start).ravel() / 1e-5
    shift = (jacobian[:, :, free] @ change) - (learner.predict(q) - start)
    assert np.abs(shift).max() < 1e-8
    sigma = np.sqrt(np.einsum("nip,pr,nir->ni", jacobian[:, :, free], covariance, jacobian[:, :, free]))
    np.testing.assert_allclose(learner.estimate(q).sigma, sigma, rtol=1e-3)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda learner: pickle.loads(pickle.dumps(learner))])
def test_copies_of_a_taught_learner_predict_the_same(copied: Callable[[RigidLearner], RigidLearner]):
    rng = np.random.default_rng(5)
    arm = rough_arm(rng, "RPR")
    learner = RigidLearner(arm.nominal, ROUGH)
    q, x = arm.pairs(rng, 12, 0.005)
    learner.learn(q, x, 0.005)
    expected = learner.estimate(q)
    got = copied(learner).estimate(q)
    np.testing.assert_allclose(got.x, expected.x, rtol=0, atol=1e-12)
    np.testing.assert_allclose(got.sigma, expected.sigma, rtol=1e-9)


def test_claimed_intervals_cover_over_24_arms():
    inside, inside_twice = [], []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        arm = rough_arm(rng)
        learner = RigidLearner(arm.nominal, ROUGH)
        learner.learn(*arm.pairs(rng, 30, 0.01))
        q = random_q(rng, arm.kinds, 100, 80)
        estimate = learner.estimate(q)
        off = np.abs(estimate.x - arm.real.positions(q)) / estimate.sigma
        inside.append((off < 1).mean())
        inside_twice.append((off < 1.96).mean())
    # 24 arms with some 27 directions each: 2 % is the standard error of the first mean.
    assert 0.63 < np.mean(inside) < 0.74
    assert 0.92 < np.mean(inside_twice) < 0.98


def test_intervals_cover_errors_that_all_pairs_share():
    inside = {True: [], False: []}
    for seed in range(25):
        rng = np.random.default_rng(seed)
        arm = rough_arm(rng, "RRRR")
        (q, x), asked = arm.pairs(rng, 40, 0.001), random_q(rng, arm.kinds, 100, 80)
        common = 0.02 * arm.real.positions(q)[:, :, None] * np.eye(3)  # each axis's scale is off by 2 %
        seen = x + common @ rng.standard_normal(3)
        for told, covered in inside.items():
            learner = RigidLearner(arm.nominal, ROUGH)
            learner.learn(q, seen, 0.001, common=common if told else None)
            estimate = learner.estimate(asked)
            covered.append((np.abs(estimate.x - arm.real.positions(asked)) < estimate.sigma).mean())
    assert 0.58 < np.mean(inside[True]) < 0.80
    assert np.mean(inside[False]) < 0.58


@pytest.mark.soak
@pytest.mark.parametrize("learner", [RigidLearner, RecursiveRigidLearner])
@pytest.mark.parametrize("told", [True, False])
@pytest.mark.parametrize(("pairs", "reach_deg"), [(30, 80), (300, 80), (300, 20)])
def test_claimed_intervals_cover_over_two_hundred_arms(learner, told, pairs, reach_deg):
    inside, inside_twice = [], []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        arm = rough_arm(rng)
        model = learner(arm.nominal, ROUGH)
        model.learn(*arm.pairs(rng, pairs, 0.01, reach_deg), 0.01 if told else None)
        q = random_q(rng, arm.kinds, 200, 80)
        estimate = model.estimate(q)
        off = np.abs(estimate.x - arm.real.positions(q)) / estimate.sigma
        inside.append((off < 1).mean())
        inside_twice.append((off < 1.96).mean())
    assert 0.66 < np.mean(inside) < 0.70
    assert 0.93 < np.mean(inside_twice) < 0.97


@pytest.mark.parametrize("told", [True, False])
def test_gross_outliers_are_left_out(told):
    rng = np.random.default_rng(21)
    arm = rough_arm(rng)
    q, x = arm.pairs(rng, 200, 0.01)
    x[:30] += rng.choice([-1, 1], (30, 3)) * rng.uniform(0.15, 0.3, (30, 3))
    spoilt, clean = RigidLearner(arm.nominal, ROUGH), RigidLearner(arm.nominal, ROUGH)
    spoilt.learn(q, x, 0.01 if told else None)
    clean.learn(q[30:], x[30:], 0.01 if told else None)
    assert not spoilt.inliers[:30].any()
    assert spoilt.inliers[30:].all()
    np.testing.assert_allclose(spoilt.predict(q), clean.predict(q), atol=1e-4)


@pytest.mark.parametrize("told", [True, False])
@pytest.mark.parametrize("pairs", [8, 12])
def test_few_good_pairs_are_all_kept_as_inliers(told, pairs):
    for seed in range(12):
        rng = np.random.default_rng(seed)
        arm = rough_arm(rng)
        learner = RigidLearner(arm.nominal, ROUGH)
        learner.learn(*arm.pairs(rng, pairs, 0.01), 0.01 if told else None)
        assert learner.inliers.all()


@pytest.mark.soak
@pytest.mark.parametrize("told", [True, False])
@pytest.mark.parametrize("pairs", [30, 100, 300])
def test_outliers_cost_at_most_a_twentieth(told, pairs):
    spoilt, clean = [], []
    for seed in range(50):
        rng = np.random.default_rng(seed)
        arm = rough_arm(rng)
        q, x = arm.pairs(rng, pairs, 0.01)
        wrong = round(0.15 * pairs)
        directions = rng.normal(size=(wrong, 3))
        x[:wrong] += 0.2 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
        for begin, errors in ((0, spoilt), (wrong, clean)):
            learner = RigidLearner(arm.nominal, ROUGH)
            learner.learn(q[begin:], x[begin:], 0.01 if told else None)
            errors.append(arm.error(learner, rng))
    assert np.mean(spoilt) <= 1.05 * np.mean(clean)


def test_base_pose_alignment_runs_only_on_doubled_pairs(monkeypatch):
    rng = np.random.default_rng(32)
    arm = rough_arm(rng, "RRR", ChainTolerances(tool=0.1, base_rotation=0.9, base_translation=1.0))
    asked = []
    monkeypatch.setattr(align_module, "align", lambda *args, **known: asked.append(1) or align(*args, **known))
    learner = RigidLearner(arm.nominal, ChainTolerances(tool=0.1, base_rotation=math.inf, base_translation=math.inf))
    q, x = arm.pairs(rng, 40, 0.001)
    for k in range(40):
        learner.learn(q[k], x[k])
        learner.predict(q[k])
    assert len(asked) == 6  # with 1, 2, 4, 8, 16 and 32 pairs
    assert arm.error(learner, rng) < 0.001


def test_distant_marker_is_found_from_exact_pairs():
    rng = np.random.default_rng(31)
    arm = rough_arm(rng, "RRRRRRR")
    moved = arm.real.with_tool([0.0, 0.15, -0.2])
    learner = RigidLearner(arm.nominal, ROUGH)
    q = random_q(rng, arm.kinds, 40, 80)
    learner.learn(q, moved.positions(q))
    test = random_q(rng, arm.kinds, 100, 80)
    np.testing.assert_allclose(learner.predict(test), moved.positions(test), atol=1e-9)


# Camera and tool anywhere, links nominal: turning the base is equivalent to the first offset, the tool to the last.
MOUNTED = ChainTolerances(zeros=0.03, tool=0.1, base_rotation=0.5, base_translation=1.0)
UNMEASURED = replace(MOUNTED, tool=math.inf, base_rotation=math.inf, base_translation=math.inf)
NAMED = ("base_rotation", "base_translation", "tool_shift", "zeros")


def over_half_widths(arms: int, pairs: int = 200, sigma: float = 0.001) -> dict[str, np.ndarray]:
    """Return errors in half widths (arms, k) of each kind of number in the report."""
    off: dict[str, list[np.ndarray]] = {name: [] for name in NAMED}
    for seed in range(arms):
        rng = np.random.default_rng(seed)
        arm = rough_arm(rng, "RRRRRR", MOUNTED)
        learner = RigidLearner(arm.nominal, UNMEASURED)
        learner.learn(*arm.pairs(rng, pairs, sigma))
        report, parameters = learner.report(), ChainParameters(arm.nominal)
        parts = (parameters.base_turn, parameters.base_shift, parameters.tool, parameters.zeros)
        for name, part in zip(NAMED, parts, strict=True):
            interval = getattr(report, name)
            off[name].append((interval.value - arm.change[part]) / interval.half_width)
    return {name: np.abs(each) for name, each in off.items()}


def test_camera_pose_tool_and_zeros_lie_in_intervals():
    for off in over_half_widths(12, 60).values():
        # Even if the numbers of an arm were all in or all out: 5 of 12 arms are out in 1 of 6,000 choices of seeds.
        assert (off < 1.0).mean() > 1.0 - 5.0 / 12.0
        # The square of 4.5 standard deviations along an arc: 1 of 3,000 choices even if all arms were that bent.
        assert (off < 6.0).all()


@pytest.mark.soak
@pytest.mark.parametrize(("pairs", "sigma"), [(12, 0.001), (30, 0.001), (200, 0.001), (12, 0.01), (200, 0.01)])
def test_camera_tool_and_zero_intervals_cover_95_percent(pairs, sigma):
    for off in over_half_widths(300, pairs, sigma).values():
        # The numbers of an arm go together: were they all in or all out, 1.3 % would be the standard error.
        assert 0.91 < (off < 1.0).mean() < 0.99


@pytest.mark.parametrize("turned", [-0.06, 0.06])
def test_tool_on_curved_arc_lies_in_its_intervals(turned):
    rng = np.random.default_rng(15)
    drawn = random_chain(rng, "RRRRRR")
    fixed, axes = drawn.fixed.copy(), drawn.axes.copy()
    axes[-1], fixed[-1] = (0.0, 0.0, 1.0), np.eye(4)
    fixed[-1, :3, 3] = 0.3, 0.0, 0.0  # [m] from the last axis, about which another zero turns it
    nominal = RigidChain(fixed, axes, drawn.prismatic)
    parameters, change = ChainParameters(nominal), np.zeros(39)
    change[parameters.zeros][-1] = turned  # two of its standard deviations
    change[parameters.tool][:2] = 0.3 * np.cos(turned) - 0.3, -0.3 * np.sin(turned)
    learner, q = RigidLearner(nominal, UNMEASURED), random_q(rng, "RRRRRR", 100, 80)
    learner.learn(q, parameters.positions(change, q) + 0.0001 * rng.normal(size=(100, 3)), 0.0001)
    tool = learner.report().tool_shift
    # Two standard deviations along the arc, which bend it by 0.5 mm across; the noise leaves 0.02 mm there.
    assert (np.abs(tool.value - change[parameters.tool]) < 2.0 * tool.half_width).all()
    assert tool.half_width[0] < 0.0005


def test_the_reported_rotation_is_that_of_the_pose():
    rng = np.random.default_rng(6)
    arm = rough_arm(rng, "RRRR", MOUNTED)
    learner = RigidLearner(arm.nominal, UNMEASURED)
    learner.learn(*arm.pairs(rng, 60, 0.001))
    report = learner.report()
    turn = Rotation.from_rotvec(report.base_rotation.value.copy()).as_matrix()
    np.testing.assert_allclose(report.T_measured_nominal[:3, :3], turn, atol=1e-12)


def test_the_reported_noise_is_that_of_the_pairs():
    rng = np.random.default_rng(7)
    arm = rough_arm(rng)
    learner = RigidLearner(arm.nominal, ROUGH)
    learner.learn(*arm.pairs(rng, 200, 0.001))
    assert learner.report().noise == pytest.approx(0.001, rel=0.15)


def test_report_names_parameters_of_an_unmoved_joint():
    rng = np.random.default_rng(5)
    arm = rough_arm(rng, "RRR", ROUGH)
    learner = RigidLearner(arm.nominal, ROUGH)
    q = random_q(rng, arm.kinds, 60, 80)
    q[:, 1] = 0.0
    learner.learn(q, arm.real.positions(q))
    report = learner.report()
    assert set(report.undetermined) == {
        f"joint 2 axis {change} {side}" for change in ("tilt", "shift") for side in (1, 2)
    }
    assert report.determined == 4 * 2 + 3


def test_moving_every_joint_determines_axes_and_tool():
    rng = np.random.default_rng(5)
    arm = rough_arm(rng, "RRRR")
    learner = RigidLearner(arm.nominal, ROUGH)
    learner.learn(*arm.pairs(rng, 60))
    assert learner.report().undetermined == ()
    assert learner.report().determined == 4 * 4 + 3


def test_sigma_grows_and_support_ends_outside_data():
    rng = np.random.default_rng(8)
    arm = rough_arm(rng)
    learner = RigidLearner(arm.nominal, ROUGH)
    learner.learn(*arm.pairs(rng, 100, 0.01, reach_deg=20))
    near = learner.estimate(random_q(rng, arm.kinds, 200, 18))
    far = learner.estimate(random_q(rng, arm.kinds, 200, 120))
    assert far.sigma.mean() > 3 * near.sigma.mean()
    assert near.in_support.mean() > 0.95
    assert far.in_support.mean() < 0.05


def test_non_rigid_arm_widens_sigma_to_the_residual():
    rng = np.random.default_rng(9)
    arm = rough_arm(rng)
    q, x = arm.pairs(rng, 400)
    sag = 0.01 * np.sin(3.0 * q[:, :3])
    learner = RigidLearner(arm.nominal, ROUGH)
    learner.learn(q, x + sag + 0.001 * rng.normal(size=x.shape), 0.001)
    rest = learner.predict(q) - (x + sag)
    assert learner.estimate(q).sigma.mean() == pytest.approx(np.sqrt(np.square(rest).mean()), rel=0.2)
    assert learner.report().misfit > 3


def test_more_evidence_for_the_right_tolerances():
    rng = np.random.default_rng(12)
    arm = rough_arm(rng)
    q, x = arm.pairs(rng, 100, 0.005)
    evidence = []
    for factor in (0.05, 1.0, 20.0):
        tolerances = ChainTolerances(axes=factor * ROUGH.axes, points=factor * ROUGH.points, tool=factor * ROUGH.tool)
        learner = RigidLearner(arm.nominal, tolerances)
        learner.learn(q, x, 0.005)
        evidence.append(learner.log_evidence)
    assert evidence[1] > max(evidence[0], evidence[2])


def test_untrained_learner_predicts_nominal_model_with_tolerance_sigma():
    arm = rough_arm(np.random.default_rng(2), "RRRR")
    learner = RigidLearner(arm.nominal, ROUGH)
    q = random_q(np.random.default_rng(3), "RRRR", 20, 80)
    estimate = learner.estimate(q)
    np.testing.assert_allclose(estimate.x, arm.nominal.positions(q), atol=1e-12)
    assert 0.02 < estimate.sigma.mean() < 0.1
    assert not estimate.in_support.any()
    with pytest.raises(DegenerateDataError, match="before the first pair"):
        learner.report()


@pytest.mark.parametrize("sigma", [0.002, None])
@pytest.mark.parametrize("common", [None, np.full((30, 3, 1), 0.01)])
def test_bytes_give_the_same_learner_back(sigma, common):
    rng = np.random.default_rng(13)
    arm = rough_arm(rng, "RPRR")
    learner = RigidLearner(arm.nominal, ROUGH)
    learner.learn(*arm.pairs(rng, 30, 0.002), sigma, common=common)
    twin = RigidLearner.from_bytes(learner.to_bytes())
    more = arm.pairs(rng, 5, 0.002)
    learner.learn(*more, 0.002)
    twin.learn(*more, 0.002)
    assert twin.pairs == 35
    for a, b in zip(vars(learner.estimate(more[0])).values(), vars(twin.estimate(more[0])).values(), strict=True):
        np.testing.assert_array_equal(a, b)


@given(position=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_damaged_bytes_are_refused(position, bit):
    arm = rough_arm(np.random.default_rng(1), "RR")
    data = bytearray(RigidLearner(arm.nominal, ROUGH).to_bytes())
    data[int(position * len(data))] ^= 1 << bit
    with pytest.raises(ModelFormatError):
        RigidLearner.from_bytes(bytes(data))


@pytest.mark.parametrize(
    ("q", "x", "sigma", "error"),
    [
        (np.zeros((2, 3)), np.zeros((2, 3)), None, ShapeError),
        (np.zeros((2, 6)), np.zeros((3, 3)), None, ShapeError),
        (np.full((1, 6), np.nan), np.zeros((1, 3)), None, NonFiniteError),
        (np.zeros((1, 6)), np.full((1, 3), np.inf), None, NonFiniteError),
        (np.zeros((2, 6)), np.zeros((2, 3)), 0.0, SettingError),
        (np.zeros((2, 6)), np.zeros((2, 3)), [0.1, np.nan], NonFiniteError),
        (np.zeros((2, 6)), np.zeros((2, 3)), [0.1, 0.1, 0.1], ShapeError),
    ],
)
def test_bad_input_changes_nothing(q, x, sigma, error):
    rng = np.random.default_rng(14)
    arm = rough_arm(rng)
    learner = RigidLearner(arm.nominal, ROUGH)
    learner.learn(*arm.pairs(rng, 20, 0.01))
    before = learner.to_bytes()
    with pytest.raises(error):
        learner.learn(q, x, sigma)
    assert learner.to_bytes() == before


@pytest.mark.parametrize(
    ("common", "error"),
    [(np.zeros((2, 3)), ShapeError), (np.zeros((1, 3, 1)), ShapeError), (np.full((2, 3, 1), np.inf), NonFiniteError)],
)
def test_bad_common_errors_change_nothing(common, error):
    learner = RigidLearner(rough_arm(np.random.default_rng(14)).nominal, ROUGH)
    with pytest.raises(error):
        learner.learn(np.zeros((2, learner.joints)), np.zeros((2, 3)), common=common)
    assert learner.pairs == 0


def test_duplicate_and_empty_batches_are_learnt():
    arm = rough_arm(np.random.default_rng(4), "RRRR")
    learner = RigidLearner(arm.nominal, ROUGH)
    q, x = arm.pairs(np.random.default_rng(5), 1)
    learner.learn(q[:0], x[:0])
    learner.learn(q[0], x[0], 0.001)
    learner.learn(q[0], x[0], 0.001)
    assert np.linalg.norm(learner.predict(q[0]) - x[0]) < 0.002


def test_report_prints_zeros_in_millimetres_and_degrees():
    rng = np.random.default_rng(5)
    arm = rough_arm(rng, "RPR", ChainTolerances(axes=0.01, zeros=0.05, slide_zeros=0.02, tool=0.05))
    learner = RigidLearner(arm.nominal, ChainTolerances(axes=0.01, zeros=0.05, slide_zeros=0.02, tool=0.05))
    learner.learn(*arm.pairs(rng, 60, 0.001))
    report = learner.report()
    lines = str(report).splitlines()
    zero, half = (np.degrees(values[0]) for values in (report.zeros.value, report.zeros.half_width))
    assert f"joint 1 zero  {zero:>10.3f} ± {half:.3f} deg" in lines
    slide, half = (1e3 * values[1] for values in (report.zeros.value, report.zeros.half_width))
    assert f"joint 2 zero  {slide:>10.3f} ± {half:.3f} mm" in lines
    assert "array" not in str(report)
