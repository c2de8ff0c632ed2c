"""Causes in words, and what to do about them."""

from __future__ import annotations

from msgspec.structs import replace

from bodyschema.diagnosis.report import tables
from bodyschema.diagnosis.report.result import (
    Cause,
    DiagnosisFile,
    Errors,
    Gain,
    Indistinguishable,
    Interval,
    Pairs,
    Tolerances,
    Unexplained,
)
from bodyschema.diagnosis.report.text import actions, finding, sentence, tolerance_sentence

SHIFT = {"x_m": 0.001, "y_m": 0.0, "z_m": 0.0}
TURN = {"rx_rad": 0.0, "ry_rad": 0.01, "rz_rad": 0.0}


def _link(untold_m: float) -> Cause:
    """Return a link whose shift in x and turns are identified, and whose other shifts are not."""
    told = {name: Interval(value, (value - 1e-4, value + 1e-4)) for name, value in (SHIFT | TURN).items()}
    untold = {name: Interval(0.05, (0.05 - untold_m, 0.05 + untold_m)) for name in ("y_m", "z_m")}
    return Cause("link_geometry", "elbow", None, told | untold, 1.0, 100.0, 80.0, (), (), "")


def test_purely_rotated_link_is_described_by_angle_only():
    assert (
        finding("link_geometry", "elbow", None, TURN) == "the link before joint elbow is off by 0.57°, mainly about y"
    )


def test_link_error_names_its_directions():
    said = finding("link_geometry", "elbow", None, {"x_m": 0.003, "z_m": 0.004, "ry_rad": 0.01})
    assert said == "the link before joint elbow is off by 5 mm in x and z and 0.57° about y"


def test_link_error_names_its_main_axis():
    said = finding("link_geometry", "elbow", None, {"rx_rad": 0.0117, "ry_rad": -0.0007, "rz_rad": 0.001})
    assert said == "the link before joint elbow is off by 0.67°, mainly about x"
    said = finding("link_geometry", "elbow", None, {"x_m": 0.003, "y_m": 1e-4, "z_m": 0.0, "ry_rad": 0.01})
    assert said == "the link before joint elbow is off by 3 mm, mainly in x, and 0.57° about y"


def test_undetermined_shift_is_omitted_from_the_sentence():
    errors = Errors(5.0, 5.0, 1.0, 1.0, 0.9)
    assert "1 mm in x and 0.57°" in sentence("explained", [_link(1.0)], errors, Gain(80.0, (75.0, 85.0)))


def test_gain_absent_on_held_out_data_is_denied():
    errors = Errors(5.0, 3.6, 1.8, 3.9, 0.7)
    said = sentence("unexplained", [_link(1.0)], errors, Gain(-9.0, (-20.0, 2.0)))
    assert "no others" in said
    assert "-9" not in said


def test_sentence_states_the_smooth_model_s_contribution():
    errors = Errors(10.0, 10.0, 5.0, 2.0, 1.9)
    said = sentence("unexplained", [_link(1.0)], errors, Gain(80.0, (75.0, 85.0)), named_mm=6.0)
    assert "10 → 2 mm on held-out data, 6 mm without the smooth model" in said


def test_tolerances_share_the_credit_with_a_smooth_model():
    errors, of = Errors(10.0, 10.0, 5.0, 2.0, 1.9), Interval(0.1, (0.05, 0.2))
    arm = Tolerances(of, of, of, links_share_percent=60.0)
    said = sentence("unexplained", [], errors, Gain(80.0, (75.0, 85.0)), arm, named_mm=3.0)
    assert "small errors everywhere and a smooth model of the rest explain 80 %" in said
    assert "(10 → 2 mm on held-out data, 3 mm without the model)" in said


def _zero(joint: str, probability: float = 1.0, share: float = 10.0) -> Cause:
    rival = Indistinguishable("link_geometry", joint, None, "this_motion", 1.0 - probability)
    rivals = (rival,) if probability < 1.0 else ()
    numbers = {"offset_rad": Interval(0.02, (0.019, 0.021))}
    return Cause("joint_offset", joint, None, numbers, probability, share, share, (), rivals, "")


def test_the_headline_of_many_causes_fits_two_lines():
    causes = [_zero(f"joint_{k}", share=10.0 + k) for k in range(6)]
    said = sentence("explained", causes, Errors(5.0, 5.0, 1.0, 1.0, 0.9), Gain(80.0, (75.0, 85.0)), tolerated_mm=3.0)
    assert "joint_5" in said
    assert "4 smaller causes" in said
    assert len(said) < 2 * 96


def test_headline_names_only_one_of_two_long_causes():
    causes = [_zero(f"shoulder_pitch_of_arm_{k}", 0.6, share=10.0 + k) for k in range(2)]
    said = sentence("undecided", causes, Errors(5.0, 5.0, 1.0, 1.0, 0.9), Gain(80.0, (75.0, 85.0)))
    head = said.partition(". RMS")[0]
    assert "or a wrong link before joint shoulder_pitch_of_arm_1" in head
    assert "shoulder_pitch_of_arm_0" not in head
    assert head.endswith("and 1 smaller cause")


def test_tolerances_come_before_causes_of_little_weight():
    arm = Tolerances(Interval(0.3, (0.2, 0.4)), Interval(0.06, (0.05, 0.07)), Interval(0.01, (0.0, 0.02)), 60.0, 9.0)
    causes = [_zero("slight", share=0.4), _zero("elbow", share=30.0)]
    said = sentence("explained", causes, Errors(5.0, 5.0, 1.0, 1.0, 0.9), Gain(80.0, (75.0, 85.0)), arm)
    assert "joint elbow is off by -1.15°, small errors everywhere and 1 smaller cause." in said.replace("+", "-")
    assert "slight" not in said


def test_an_undecided_headline_names_what_is_unsure():
    causes = [_zero("elbow", 0.6), _zero("wrist")]
    said = sentence("undecided", causes, Errors(5.0, 5.0, 1.0, 1.0, 0.9), Gain(80.0, (75.0, 85.0)))
    assert said.endswith("Not sure: a wrong zero of joint elbow; other causes explain as much")


def test_an_instrument_is_not_called_a_camera():
    assert finding("camera_moved", None, None, SHIFT, "instrument") == "the instrument moved by 1 mm"


def test_scale_error_of_camera_blames_the_target_size() -> None:
    numbers = {"scale_error": -0.03}
    assert finding("camera_scale", None, None, numbers) == (
        "all that is measured is 3 % too small: a tag, ball or board has another size than stated"
    )
    assert finding("camera_scale", None, None, numbers, "instrument") == "all that is measured is 3 % too small"


def test_prismatic_ripple_is_described_despite_unsure_pitch():
    numbers = {
        "amplitude_m": Interval(2e-4, (1e-4, 3e-4)),
        "phase_rad": Interval(0.0, (-9.0, 9.0)),
        "cycles_per_m": Interval(10.0, (-90.0, 110.0)),
    }
    cause = Cause("joint_ripple", "lift", None, numbers, 1.0, 100.0, 80.0, (), (), "")
    said = sentence("explained", [cause], Errors(5.0, 5.0, 1.0, 1.0, 0.9), Gain(80.0, (75.0, 85.0)))
    assert "joint lift has a ripple of ±0.2 mm, 10 times a metre" in said.lower()


def test_undetected_tolerances_are_reported_as_upper_bounds():
    size, none = Interval(0.3, (0.2, 0.4)), Interval(0.01, (0.0, 0.02))
    assert tolerance_sentence(Tolerances(size, none, none), "camera") == (
        "The arm is made to about 0.3 mm and at most 0.02°; its drives run true to at most ±0.02°."
    )


def test_alternatives_to_tolerances_appear_in_headline_and_details() -> None:
    size, gain = Interval(0.6, (0.5, 0.7)), Gain(80.0, (75.0, 85.0))
    link = Indistinguishable("link_geometry", "elbow", None, "this_motion", 0.3)
    rough = Tolerances(size, size, size, links_share_percent=90.0, rivals=(link,))
    beside = " Or the links are more exact than that, and there is a wrong link before joint elbow (30 %)."
    assert tolerance_sentence(rough, "camera").endswith(beside)
    errors = Errors(5.0, 5.0, 1.0, 1.0, 0.9)
    said = [
        sentence("nothing_found", [], errors, gain, rough),
        sentence("undecided", [_zero("wrist")], errors, gain, rough),
    ]
    assert all("small errors everywhere (or a wrong link before joint elbow, 30 %)" in one for one in said)
    assert not replace(rough, links_share_percent=1.0).leaves_open
    scale = Indistinguishable("camera_scale", None, None, "this_motion", 0.6)
    unexplained = sentence("unexplained", [], errors, gain, replace(rough, rivals=(scale,)))
    assert "explains (or a wrong scale of all that is measured, 60 %)" in unexplained


def test_more_probable_alternative_is_stated_as_such() -> None:
    errors, gain = Errors(5.0, 5.0, 1.0, 1.0, 0.9), Gain(80.0, (75.0, 85.0))
    said = sentence("undecided", [_zero("elbow", probability=0.1)], errors, gain)
    assert said.startswith("The zero of joint elbow is off by +1.15° (more probably a wrong link before joint elbow)")


def test_headline_calls_improbable_small_causes_corrections() -> None:
    causes = [_zero("elbow"), *(_zero(f"joint_{k}", probability=0.1, share=1.0) for k in range(2))]
    errors, gain = Errors(5.0, 5.0, 1.0, 1.0, 0.9), Gain(80.0, (75.0, 85.0))
    of = Interval(0.1, (0.05, 0.2))
    said = sentence("explained", causes, errors, gain, Tolerances(of, of, of, links_share_percent=50.0))
    assert "small errors everywhere and 2 corrections whose cause is not known" in said


def test_headline_calls_them_corrections_without_tolerances_too() -> None:
    causes = [_zero("elbow"), *(_zero(f"joint_{k}", probability=0.1, share=1.0) for k in range(2))]
    said = sentence("explained", causes, Errors(5.0, 5.0, 1.0, 1.0, 0.9), Gain(80.0, (75.0, 85.0)))
    assert said.startswith("The zero of joint elbow is off by +1.15° and 2 corrections whose cause is not known")


def test_improbable_small_causes_are_untabled_without_action() -> None:
    heavy, few = _zero("elbow"), [_zero(f"joint_{k}", probability=0.1, share=1.0) for k in range(2)]
    none, gain = Errors(5.0, 5.0, 1.0, 1.0, 0.9), Gain(80.0, (75.0, 85.0))
    left = Unexplained(0.0, (), 1.0)
    file = DiagnosisFile("undecided", "", Pairs(9, 9, 0), none, none, gain, (*few, heavy), (), left, (), ())
    shown = tables.causes(file, timed=False)
    assert "elbow" in shown
    assert "joint_0" not in shown
    assert "2 corrections whose cause is not known" in shown
    todo, small = actions(file, ["turn the elbow", "turn joint_0", "turn joint_1"])
    assert todo == ["turn the elbow"]
    assert [said.split(":")[0] for said in small] == [
        "Change nothing because of 2 corrections whose cause is not known"
    ]


def test_outliers_follow_tolerances_in_the_headline() -> None:
    of, gain = Interval(0.1, (0.05, 0.2)), Gain(80.0, (75.0, 85.0))
    outliers = Cause("outliers", None, None, {"share": Interval(0.006, (0.002, 0.01))}, 1.0, 0.0, 0.0, (), (), "")
    rough = Tolerances(of, of, of, links_share_percent=90.0)
    said = sentence("unexplained", [outliers], Errors(5.0, 5.0, 1.0, 1.0, 0.9), gain, rough)
    assert said.startswith("Small errors everywhere and 0.6 % of the fixes are not the marker. ")
