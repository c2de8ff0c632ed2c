"""Judgements of made-up diagnoses."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from bodyschema.diagnosis.report.result import (
    Cause,
    DiagnosisFile,
    Errors,
    Gain,
    Indistinguishable,
    Interval,
    Pairs,
    Unexplained,
)
from bodyschema.effects import Motion
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription

from .cases import HiddenCase, hide
from .figures import Rate, calibration, confusion, coverage, error_of_probability, failures, goals
from .hidden import Hidden
from .judge import Truth, compared, joints_right, judge, outcome
from .judgement import CauseJudged, Crash, Judgement, Number, TruthJudged
from .kinds import KINDS
from .meaning import meant
from .sealed import encoded, read

pytestmark = pytest.mark.soak  # they check the cases that only `make soak` judges in number
PAIRS = 80
ELBOW = "joint_offset@elbow"
Hide = Callable[..., Truth]


@pytest.fixture(scope="module")
def truth_of(tmp_path_factory: pytest.TempPathFactory) -> Hide:
    """Return a function that hides effects and returns the ground truth; each case is built once."""
    made: dict[tuple[object, ...], Truth] = {}

    def truth(*effects: str, arm: str = "humanoid", size: float = 4.0, **more: object) -> Truth:
        key = (effects, arm, size, *sorted(more.items()))
        if key not in made:
            case = _hidden(tmp_path_factory.mktemp("case"), *effects, arm=arm, size=size, **more)
            robot = RobotDescription.load(case.robot_file)
            motion = Motion.of(Recording.read(case.folder / "measured.csv", robot.joints))
            made[key] = Truth.of(case, robot, motion)
        return made[key]

    return truth


def _hidden(folder: Path, *effects: str, **more: object) -> HiddenCase:
    return hide(11, folder, list(effects), pairs=PAIRS, **more)  # pyright: ignore[reportArgumentType]


def _cause(name: str, *listed: Indistinguishable, probability: float = 0.99, **numbers: Interval) -> Cause:
    """Return a cause from its name `effect@where:source`."""
    effect, _, at = name.partition("@")
    where, _, source = at.partition(":")
    return Cause(
        effect=effect,
        where=where or None,
        source=source or None,
        parameters=numbers,
        probability=probability,
        share_of_gain_percent=100.0,
        held_out_gain_percent=50.0,
        indistinguishable_from=listed,
        rivals=listed,
        evidence="",
    )


def _like(name: str, by: str) -> Indistinguishable:
    cause = _cause(name)
    return msgspec.convert(
        {"effect": cause.effect, "where": cause.where, "source": cause.source, "by": by, "probability": 0.4},
        Indistinguishable,
    )


def _file(*causes: Cause, verdict: str = "explained", depends_on: tuple[str, ...] = ()) -> DiagnosisFile:
    """Return a diagnosis with these causes."""
    errors = Errors(10.0, 10.0, 5.0, 2.0, 2.0)
    return DiagnosisFile(
        verdict=verdict,  # pyright: ignore[reportArgumentType]
        sentence="",
        pairs=Pairs(PAIRS, PAIRS, 0),
        rms_mm=errors,
        mean_mm=errors,
        gain=Gain(80.0, (79.0, 81.0)),
        causes=causes,
        rejected=(),
        unexplained=Unexplained(0.0, depends_on, 0.5),
        advice=(),
        limitations=(),
    )


def test_the_hidden_cause_at_its_joint_is_right(truth_of: Hide) -> None:
    hidden, causes, said = compared(truth_of(ELBOW), _file(_cause(ELBOW)))
    assert (said, causes[0].is_right, hidden[0].found_as) == ("right", True, ("joint_offset", "elbow", None))


def test_the_right_effect_at_another_joint_is_wrong(truth_of: Hide) -> None:
    _, causes, said = compared(truth_of(ELBOW), _file(_cause("joint_offset@shoulder_pitch")))
    assert (said, causes[0].is_right) == ("wrong", False)


def test_another_effect_at_the_right_joint_is_wrong(truth_of: Hide) -> None:
    assert compared(truth_of(ELBOW), _file(_cause("backlash@elbow")))[2] == "wrong"


def test_a_cause_beside_the_right_one_is_wrong(truth_of: Hide) -> None:
    assert compared(truth_of(ELBOW), _file(_cause(ELBOW), _cause("camera_scale")))[2] == "wrong"


def test_finding_nothing_of_large_effect_is_missed(truth_of: Hide) -> None:
    assert compared(truth_of(ELBOW), _file(verdict="nothing_found"))[2] == "missed"


def test_naming_one_of_two_is_missing_the_other(truth_of: Hide) -> None:
    assert compared(truth_of(ELBOW, "camera_scale"), _file(_cause(ELBOW)))[2] == "missed"


def test_a_right_cause_called_unexplained_is_wrong(truth_of: Hide) -> None:
    assert compared(truth_of(ELBOW), _file(_cause(ELBOW), verdict="unexplained"))[2] == "wrong"


def test_wrong_cause_with_right_rival_is_honest(truth_of: Hide) -> None:
    rival = _cause("joint_scale@elbow", _like(ELBOW, "this_motion"), probability=0.5)
    assert compared(truth_of(ELBOW), _file(rival, verdict="undecided"))[2] == "honest"


def test_sure_wrong_cause_is_wrong_despite_right_rival(truth_of: Hide) -> None:
    rival = _cause("joint_scale@elbow", _like(ELBOW, "this_motion"), probability=0.97)
    assert compared(truth_of(ELBOW), _file(rival, verdict="undecided"))[2] == "wrong"


def test_a_needless_member_is_needless(truth_of: Hide) -> None:
    _, causes, _ = compared(truth_of(ELBOW), _file(_cause(ELBOW, _like("camera_scale", "this_motion"))))
    assert len(causes[0].needless) == 1


def test_equivalent_cause_may_be_listed_for_any_motion(truth_of: Hide) -> None:
    _, causes, _ = compared(truth_of(ELBOW), _file(_cause(ELBOW, _like("link_geometry@elbow", "any_motion"))))
    assert (causes[0].needless, causes[0].wrong_reach) == ((), ())


def test_listing_equivalent_cause_for_this_motion_is_wrong(truth_of: Hide) -> None:
    _, causes, _ = compared(truth_of(ELBOW), _file(_cause(ELBOW, _like("link_geometry@elbow", "this_motion"))))
    assert len(causes[0].wrong_reach) == 1


def test_first_link_error_must_be_named_camera_pose(truth_of: Hide) -> None:
    truth = truth_of("link_geometry@shoulder_pitch")
    named = [compared(truth, _file(_cause(name)))[2] for name in ("camera_pose", "link_geometry@shoulder_pitch")]
    assert named == ["right", "wrong"]


def test_the_camera_pose_is_not_the_first_link(truth_of: Hide) -> None:
    assert compared(truth_of("camera_pose"), _file(_cause("link_geometry@shoulder_pitch")))[2] == "wrong"


def test_oracle_rival_is_never_an_equivalent_cause(truth_of: Hide) -> None:
    hidden, _, _ = compared(truth_of(ELBOW), _file(_cause(ELBOW)))
    assert hidden[0].told_chi2 > 25.0
    assert hidden[0].rival is not None
    assert hidden[0].rival[0] != "link_geometry"


def test_chi_square_scales_with_squared_effect_size(truth_of: Hide) -> None:
    small, large = (truth_of("camera_scale", size=size).judged(0, None, False) for size in (1.0, 3.0))
    assert large.seen_chi2 / small.seen_chi2 == pytest.approx(9.0, rel=0.15)
    assert large.told_chi2 / small.told_chi2 == pytest.approx(9.0, rel=0.3)


@pytest.mark.parametrize("name", [name for name in KINDS if name != "outliers"])
def test_effect_model_with_true_parameters_explains_simulated_positions(name: str, truth_of: Hide) -> None:
    truth = truth_of(name)
    target, effect = truth.case.measured.x_noise_free, truth.meanings[0].effect
    if name == "settling":
        assert truth.meanings[0].told == {"fraction", "memory"}
    nothing, best = truth.scene.chi2(target, []), truth.fitted.chi2
    assert truth.scene.chi2(target, [effect]) < best + 0.02 * (nothing - best)


@pytest.mark.parametrize(("usual_s", "memory"), [(0.06, math.exp(-1.0)), (0.12, math.exp(-2.0))])
def test_settling_memory_is_evaluated_at_usual_interval(usual_s: float, memory: float, truth_of: Hide) -> None:
    parameters = {"left": 0.3, "move_s": 0.03, "rest_s": 0.03, "tau_s": 0.06}
    hidden = Hidden("settling", "elbow", None, parameters, KINDS["settling"].sign)
    meaning = meant(hidden, truth_of(ELBOW).robot, usual_s)
    assert meaning is not None
    assert meaning.effect.values.tolist() == pytest.approx([0.3, memory])


def test_numbers_are_judged_by_their_interval(truth_of: Hide) -> None:
    truth = truth_of(ELBOW)
    value = float(truth.meanings[0].effect.values[0])
    inside, outside = (
        compared(
            truth, _file(_cause(ELBOW, offset_rad=Interval(value + off, (value + off - 1e-3, value + off + 1e-3))))
        )
        for off in (5e-4, -2e-3)
    )
    assert [n.is_inside for _, causes, _ in (inside, outside) for n in causes[0].numbers] == [True, False]


def test_a_moment_between_the_right_rows_is_right(truth_of: Hide) -> None:
    truth = truth_of("encoder_jump@elbow")
    clock, t0 = truth.scene.motion.clock, truth.meanings[0].effect.value("t0")
    inside = []
    for off in (0, 3):
        moment = float(clock[clock >= t0][off]) - 1e-6
        cause = _cause("encoder_jump@elbow", t0=Interval(moment, (moment, moment)))
        inside += [n.is_inside for n in compared(truth, _file(cause))[1][0].numbers]
    assert inside == [True, False]


def test_parameter_not_determined_by_motion_is_left_out(truth_of: Hide) -> None:
    _, causes, _ = compared(truth_of(ELBOW), _file(_cause(ELBOW, offset_rad=Interval(0.0, (-3.0, 3.0)))))
    assert (causes[0].numbers, causes[0].left_out) == ((), {"offset_rad": "not determined by this motion"})


def test_false_fixes_that_are_not_named_are_missed(truth_of: Hide) -> None:
    truth = truth_of(ELBOW, outliers=0.1)
    share = float(truth.case.measured.outlier.mean())
    named = _cause("outliers", share=Interval(share, (0.5 * share, 2.0 * share)))
    found, missed = (compared(truth, _file(_cause(ELBOW), *more))[2] for more in ((named,), ()))
    assert (found, missed) == ("right", "missed")


def test_false_fixes_where_there_are_none_are_wrong(truth_of: Hide) -> None:
    named = _cause("outliers", share=Interval(0.02, (0.01, 0.03)))
    assert compared(truth_of(ELBOW), _file(_cause(ELBOW), named))[2] == "wrong"


@pytest.mark.parametrize(
    ("probability", "told_chi2", "said"), [(0.6, 20.0, "honest"), (0.95, 20.0, "wrong"), (0.6, 30.0, "wrong")]
)
def test_unsure_name_is_honest_below_oracle_threshold(
    truth_of: Hide, probability: float, told_chi2: float, said: str
) -> None:
    truth = truth_of("vergence", pose_known=True)
    nameless = Indistinguishable("unexplained", None, None, "this_motion", 0.4, "the eyes are turned")
    file = _file(_cause("camera_scale", nameless, probability=probability), verdict="undecided")
    (hidden,), causes, _ = compared(truth, file)
    assert outcome(file, [msgspec.structs.replace(hidden, told_chi2=told_chi2)], causes, False) == said


def test_outside_effect_is_right_unexplained_and_wrong_named(truth_of: Hide) -> None:
    truth = truth_of("square_of_other@elbow:shoulder_pitch")
    unexplained = _file(verdict="unexplained", depends_on=("elbow", "shoulder_pitch"))
    named = _file(_cause("joint_scale@elbow"))
    assert (compared(truth, unexplained)[2], compared(truth, named)[2]) == ("right", "wrong")


def test_right_joints_are_those_showing_the_effect() -> None:
    hidden = Hidden("link_bend", "a", None, {}, "", True, ("b",), shows_on={"a": 0.1, "b": 0.8, "c": 0.01})
    said = [("b",), ("a", "b"), ("a",), ("b", "c")]
    assert [joints_right(hidden, joints) for joints in said] == [True, True, False, False]


def test_wandering_offset_must_depend_on_time() -> None:
    hidden = Hidden("wandering_zero", "a", None, {}, "", True)
    assert [joints_right(hidden, joints) for joints in (("a", "time"), ("a",))] == [True, False]


def test_missing_an_effect_below_noise_is_honest() -> None:
    hidden = TruthJudged("backlash", "a", None, 0.01, False, 3.0, 2.0, None, None, False)
    assert outcome(_file(verdict="nothing_found"), [hidden], [], False) == "honest"


def test_diagnosis_of_large_offset_is_judged_right(tmp_path: Path) -> None:
    judgement = judge(_hidden(tmp_path, ELBOW, arm="humanoid", size=8.0), "one", "command")
    assert judgement.outcome == "right"
    assert judgement.gain == pytest.approx(judgement.gain_of_truth, abs=0.05)


def _judgement(*causes: CauseJudged, **changed: object) -> Judgement:
    truth = TruthJudged("backlash", "a", None, 2.0, False, 900.0, 400.0, ("settling", "a", None), None, False)
    plain = Judgement(
        scenario="one",
        seed=3,
        arm="humanoid",
        hold="held",
        style="held",
        pairs=PAIRS,
        verdict="explained",
        outcome="right",
        truth=(msgspec.structs.replace(truth, found_as=("backlash", "a", None)),),
        causes=causes,
        gain=0.9,
        gain_of_truth=0.91,
        stated_gain_percent=60.0,
        depends_on=(),
        shows_on={},
        joints_right=None,
        smooth_ratio=None,
        seconds=1.0,
        cpu_seconds=1.0,
        memory_mb=200.0,
        command="python again",
    )
    return msgspec.structs.replace(plain, **changed)


def _named(right: bool, probability: float, *numbers: Number) -> CauseJudged:
    return CauseJudged("backlash", "a", None, probability, right, False, 0, (), (), numbers, {})


def test_calibration_error_is_stated_minus_observed_frequency() -> None:
    cases = [_judgement(_named(right, 0.85)) for right in (True, True, True, False)]
    assert error_of_probability(cases) == pytest.approx(0.10)
    assert "3 of 4" in calibration(cases)


def test_coverage_counts_the_intervals_that_hold_the_truth() -> None:
    numbers = [Number("width_rad", 1.0, 1.1, ci95) for ci95 in ((0.9, 1.3), (1.05, 1.15))]
    assert "1 of 2" in coverage([_judgement(_named(True, 0.9, number)) for number in numbers])


def test_wrong_name_appears_in_confusion_matrix_and_failures() -> None:
    lost = msgspec.structs.replace(_judgement().truth[0], found_as=None)
    wrong = CauseJudged("settling", "a", None, 0.99, False, False, 0, (), (), (), {})
    case = _judgement(wrong, truth=(lost,), outcome="wrong")
    assert "| backlash | 1 | 0 | 0 | settling 1 |" in confusion([case])
    assert "`python again`" in failures([case], [])


def test_a_case_below_the_oracle_counts_by_itself() -> None:
    near = msgspec.structs.replace(_judgement().truth[0], told_chi2=10.0)
    rows = goals([_judgement(), _judgement(truth=(near,), outcome="wrong")])
    assert "| one | Δχ² ≥ 25: all named | ≥ 99 % | 100.0 %" in rows
    assert "| one | Δχ² < 25: named wrongly | ≤ 1 % | 100.0 %" in rows


def test_a_rate_tells_its_interval() -> None:
    assert str(Rate(97, 100)) == "97.0 % (91 to 99), 97 of 100"


def test_a_run_goes_on_from_its_records(tmp_path: Path) -> None:
    records = [_judgement(_named(True, 0.9)), Crash("one", 4, ("backlash a",), "Error: broke", "python again")]
    file = tmp_path / "run.jsonl"
    file.write_bytes(b"".join(encoded(record) + b"\n" for record in records))
    assert read(file) == records


def test_a_broken_diagnosis_is_a_failure() -> None:
    crash = Crash("one", 4, ("backlash a",), "Traceback\nError: broke", "python again")
    assert "| crashed | backlash a | Error: broke |" in failures([], [crash])
