"""Alternatives to a cause: the same in any motion or in this one only, and the motion that would distinguish them."""

from __future__ import annotations

import re
import tomllib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from planted_cases import (
    BASE,
    ELBOW,
    SHOULDER,
    desk_arm,
    measured,
    motion_of,
    scattered,
    seen,
    start_of,
    surveyed_arm,
    walk,
)
from walked import DESK_ARM

from bodyschema.diagnosis.assess.rivals import whole_range
from bodyschema.diagnosis.diagnosis import Diagnosis, diagnose
from bodyschema.diagnosis.report.conclusion import conclusion, merged_ripples
from bodyschema.effects import Effect, Motion, Simulation
from bodyschema.robot.description import RobotDescription

ROWS = 200
ADVISED = re.compile(r"move joint (\w+) through its whole range \((-?\d+)° to (-?\d+)°\)")


def diagnosed(robot: RobotDescription, motion: Motion, truth: Effect, only: tuple[str, ...]) -> Diagnosis:
    return diagnose(seen(robot, motion, (truth,), 1), Simulation(robot), only=only)


@pytest.fixture(scope="module")
def turned_camera() -> Diagnosis:
    robot = surveyed_arm()
    truth = Effect.at(robot, "camera_pose", values=[0.004, -0.003, 0.002, 0.01, -0.02, 0.015])
    return diagnosed(robot, walk(robot, 2, ROWS), truth, ("camera_pose", "link_geometry", "joint_offset"))


def test_camera_pose_equals_first_link_in_any_motion(turned_camera) -> None:
    (cause,) = conclusion(turned_camera).causes
    assert cause.effect == "camera_pose"
    same = {(rival.effect, rival.where): rival.by for rival in cause.rivals}
    assert same == {("link_geometry", BASE): "any_motion"}


def test_equivalent_rival_does_not_lower_the_cause_s_probability(turned_camera) -> None:
    (cause,) = conclusion(turned_camera).causes
    assert cause.probability > 0.99
    assert cause.rivals[0].probability > 0.02
    assert conclusion(turned_camera).verdict == "explained"


def test_advice_for_equivalent_causes_is_fixing_either(turned_camera) -> None:
    assert conclusion(turned_camera).advice == (
        f"No motion tells a wrong place of the camera from a wrong link before joint {BASE}: fix whichever is easier.",
    )


NARROW = ("joint_offset", "joint_scale")
PLANTED = (("joint_scale", 0.03), ("joint_offset", 0.03))


def narrow(robot: RobotDescription) -> Motion:
    """Return a motion in which one joint stays near one position and all others move widely."""
    q = walk(robot, 2, ROWS).q.copy()
    q[:, 1] = 1.0 + 0.002 * np.sin(np.arange(len(q)))
    return motion_of(q)


@pytest.fixture(scope="module", params=PLANTED, ids=[name for name, _ in PLANTED])
def planted(request) -> Effect:
    name, amount = request.param
    return Effect.at(surveyed_arm(), name, SHOULDER, values=[amount])


@pytest.fixture(scope="module")
def open_case(planted) -> Diagnosis:
    robot = surveyed_arm()
    return diagnosed(robot, narrow(robot), planted, NARROW)


def test_narrow_motion_leaves_offset_and_scale_as_rivals(open_case) -> None:
    file = conclusion(open_case)
    (cause,) = file.causes
    (rival,) = cause.rivals
    assert {cause.effect, rival.effect} == set(NARROW)
    assert (cause.where, rival.where, rival.by) == (SHOULDER, SHOULDER, "this_motion")
    assert cause.indistinguishable_from == (rival,)
    assert cause.probability + rival.probability == pytest.approx(1.0, abs=0.01)
    assert file.verdict == "undecided"


def advised(robot: RobotDescription, advice: str) -> Motion:
    """Return the narrow motion with the recommended joint moved as recommended."""
    match = ADVISED.search(advice)
    assert match is not None
    joint, low, high = match[1], *np.radians([float(match[2]), float(match[3])])
    q = narrow(robot).q.copy()
    share = 0.5 + 0.5 * np.sin(np.arange(len(q)) / 7.0)
    q[:, robot.joints.index(joint)] = low + share * (high - low)
    return motion_of(q)


def test_following_the_advice_separates_the_rivals(planted, open_case) -> None:
    robot = surveyed_arm()
    (advice,) = conclusion(open_case).advice
    file = conclusion(diagnosed(robot, advised(robot, advice), planted, NARROW))
    (cause,) = file.causes
    assert (cause.effect, cause.where, cause.rivals) == (planted.name, SHOULDER, ())
    assert file.verdict == "explained"
    assert file.advice == ()


@pytest.mark.soak
def test_advised_motion_separates_simulations_of_both_rivals(open_case) -> None:
    robot = surveyed_arm()
    (assessment,) = open_case.assessments
    (rival,) = assessment.rivals
    (advice,) = conclusion(open_case).advice
    motion = advised(robot, advice)
    for simulation in (open_case.extended.simulation, rival.fit_with_it.simulation):
        (effect,) = simulation.effects
        file = conclusion(diagnosed(robot, motion, effect, NARROW))
        assert [(cause.effect, cause.rivals) for cause in file.causes] == [(effect.name, ())]


def test_small_effects_are_not_equivalent_in_any_motion() -> None:
    robot = surveyed_arm()
    truth = Effect.at(robot, "joint_eccentricity", SHOULDER, values=[0.0018, 0.0])
    kinds = ("joint_eccentricity", "joint_scale")
    found = diagnosed(robot, walk(robot, 2, ROWS), truth, kinds)
    rivals = [rival for assessment in found.assessments for rival in assessment.rivals]
    assert rivals
    assert not any(rival.is_same_anywhere for rival in rivals)
    assert conclusion(found).advice[0].startswith("To tell an eccentric encoder of joint ")


def test_more_flexible_rival_does_not_raise_cause_s_probability() -> None:
    robot = surveyed_arm()
    motion = walk(robot, 2, ROWS)
    truth = Effect.at(robot, "encoder_jump", robot.joints[-1], values=[0.02, float(motion.clock[ROWS // 2]) + 0.01])
    found = diagnosed(robot, motion, truth, ("encoder_jump", "tool_slip"))
    (assessment,) = found.assessments
    (rival,) = (
        rival
        for rival in assessment.rivals
        if isinstance(rival.hypothesis, Effect) and rival.hypothesis.name == "tool_slip"
    )
    assert rival.is_same_anywhere
    assert not rival.is_equivalent
    assert assessment.probability < 1.0 - rival.probability + 1e-9
    assert any("from a marker that slipped, which can do more besides" in line for line in conclusion(found).advice)


@pytest.fixture(scope="module")
def arm_of_one_length(tmp_path_factory) -> RobotDescription:
    """Return a desk arm whose positions show one length alone: all else is free with the marker's place."""
    file, text = tmp_path_factory.mktemp("arm") / DESK_ARM.name, DESK_ARM.read_text()
    urdf = DESK_ARM.with_name("desk_arm.urdf").read_text()
    assert "0.03 0 0.06" in urdf
    file.with_name("desk_arm.urdf").write_text(urdf.replace("0.03 0 0.06", "0 0 0.06"))
    return RobotDescription.from_tables(tomllib.loads(text), text, file)


@pytest.mark.parametrize(
    "truth",
    [("link_geometry", ELBOW, [0.0, 0.0, 0.008, 0.0, 0.0, 0.0]), ("camera_scale", None, [0.03])],
    ids=["link", "scale"],
)
def test_indistinguishable_length_and_scale_are_both_reported(arm_of_one_length, truth) -> None:
    robot, (name, where, values) = arm_of_one_length, truth
    hidden = Effect.at(robot, name, where, values=values)
    file = conclusion(diagnosed(robot, walk(robot, 2, ROWS), hidden, ("camera_scale", "link_geometry")))
    (cause,) = file.causes
    (rival,) = cause.rivals
    assert (cause.effect, rival.effect, rival.where) == ("camera_scale", "link_geometry", ELBOW)
    assert 0.4 < rival.probability < 0.6
    assert cause.probability + rival.probability == pytest.approx(1.0, abs=0.01)
    assert file.verdict == "undecided"
    assert f"(or a wrong link before joint {ELBOW})" in file.sentence
    assert file.advice == (
        f"No motion tells a wrong scale of all that is measured from a wrong link before joint {ELBOW}: measure both.",
    )


@pytest.mark.parametrize(("cycles", "sure"), [((4.0, 7.0), False), ((4.0, 9.0), True)])
def test_ripples_unresolved_by_joint_range_are_merged(cycles, sure) -> None:
    robot = surveyed_arm()
    motion = scattered(robot, 3, ROWS)
    assert np.ptp(motion.q[:, 1]) < 0.9 * 2.0 * np.pi
    values = [[0.01, 0.0, cycles[0]], [0.0, 0.01, cycles[1]]]
    ripples = [
        replace(Effect.at(robot, "joint_ripple", SHOULDER, values=each), ordinal=k) for k, each in enumerate(values)
    ]
    fit = start_of(robot, motion, tuple(ripples), 3).with_causes(ripples)
    assert merged_ripples(fit) == (set() if sure else {ripple.identity for ripple in ripples})


def test_ripples_describing_one_curve_leave_verdict_undecided() -> None:
    robot = surveyed_arm()
    motion = scattered(robot, 3)
    q = motion.q.copy()
    q[:, 1] += 0.05 * np.exp(-0.5 * np.square((q[:, 1] - 0.4) / 0.2))
    x = Simulation(robot).positions(replace(motion, q=q))
    x += 3e-4 * np.random.default_rng(3).normal(size=x.shape)
    file = conclusion(
        diagnose(measured(robot, motion, x), Simulation(robot), only=("joint_ripple", "joint_eccentricity"))
    )
    assert sum(cause.effect == "joint_ripple" for cause in file.causes) > 1
    assert all(cause.probability <= 0.5 for cause in file.causes if cause.effect == "joint_ripple")
    assert file.verdict == "undecided"
    assert f"(or another error of {SHOULDER} that depends on its angle)" in file.sentence


def test_clearly_distinguished_cause_has_no_rivals() -> None:
    robot = desk_arm()
    truth = Effect.at(robot, "joint_scale", SHOULDER, values=[0.02])
    kinds = ("joint_offset", "joint_scale", "joint_eccentricity", "backlash")
    (assessment,) = diagnosed(robot, walk(robot, 2, ROWS), truth, kinds).assessments
    assert assessment.rivals == ()
    assert assessment.probability > 0.999


def test_advised_range_of_unlimited_prismatic_joint_is_short() -> None:
    robot = SimpleNamespace(lower=[-np.pi], upper=[np.pi], chain=SimpleNamespace(prismatic=[True]))
    motion = SimpleNamespace(q=np.array([[0.1], [0.3]]))
    fit = SimpleNamespace(simulation=SimpleNamespace(robot=robot), observations=SimpleNamespace(motion=motion))
    assert whole_range(fit, 0) == pytest.approx((-0.1, 0.5))


def only_shoulder(robot: RobotDescription, seed: int) -> Motion:
    q = np.tile(scattered(robot, seed, 1).q, (150, 1))
    k = robot.joints.index(SHOULDER)
    q[:, k] = scattered(robot, seed, 150).q[:, k]
    return motion_of(q)


@pytest.mark.parametrize(("hold", "what"), [("torque_free", "sag, which was not tested"), ("held", "the spread of")])
@pytest.mark.parametrize("seed", [1, 2])
def test_joint_error_equally_explained_by_sag_is_unsure(seed, hold, what) -> None:
    held, robot = desk_arm({"torque_free": "held"}), desk_arm({"torque_free": hold})
    springs = tuple(Effect.at(held, "joint_compliance", joint, values=[0.02]) for joint in (SHOULDER,))
    recording = seen(held, only_shoulder(held, seed), springs, seed)
    only = ("joint_scale", "joint_eccentricity", "joint_ripple")
    (cause,) = conclusion(diagnose(recording, Simulation(robot), only=only)).causes
    assert cause.probability <= 0.5
    assert cause.rivals[0].what.startswith(what)


@pytest.mark.parametrize("seed", [1, 2])
def test_joint_scale_with_all_joints_moving_is_sure(seed) -> None:
    robot = desk_arm()
    recording = seen(robot, scattered(robot, seed), (Effect.at(robot, "joint_scale", SHOULDER, values=[0.01]),), seed)
    (cause,) = conclusion(diagnose(recording, Simulation(robot), only=("joint_scale", "joint_offset"))).causes
    assert cause.probability > 0.9
