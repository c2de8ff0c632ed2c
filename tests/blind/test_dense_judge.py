"""Outcomes of made-up diagnoses of arms with tolerances."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from .dense import Checkout
from .dense_hide import hide_dense
from .dense_judge import DenseJudgement, inside, line, outcome, page_table, placed, rms_mm, runs, table

ZERO, LINK, PLAY = "joint_offset@elbow", "link_geometry@elbow", "backlash@wrist"


def _entry(name: str) -> dict[str, Any]:
    effect, _, at = name.partition("@")
    where, _, source = at.partition(":")
    return {"effect": effect, "where": where or None, "source": source or None}


def _cause(
    name: str, probability: float = 0.99, share: float = 90.0, *, rivals: tuple[str, ...] = ()
) -> dict[str, Any]:
    told = {"probability": probability, "share_of_gain_percent": share, "parameters": {}}
    return _entry(name) | told | {"rivals": [_entry(r) for r in rivals], "indistinguishable_from": []}


def _told(*causes: dict[str, Any], verdict: str = "explained", depends_on: tuple[str, ...] = ()) -> dict[str, Any]:
    return {"verdict": verdict, "causes": list(causes), "unexplained": {"depends_on": list(depends_on)}}


def _sealed(*truth: str, same: tuple[str, ...] = (), noise: str = "gauss") -> dict[str, Any]:
    entries = [{"cause": cause, "same": list(same), "amounts": [0.02]} for cause in truth]
    return {"truth": entries, "noise": {"kind": noise}}


def test_all_hidden_causes_named_is_right() -> None:
    assert outcome(_sealed(ZERO, PLAY), _told(_cause(PLAY), _cause(ZERO)))[0] == "right"


def test_nothing_named_of_nothing_hidden_is_right() -> None:
    assert outcome(_sealed(), _told(verdict="nothing_found"))[0] == "right"


def test_a_false_cause_of_little_weight_is_forgiven() -> None:
    assert outcome(_sealed(ZERO), _told(_cause(ZERO), _cause(PLAY, share=10.0)))[0] == "right"


def test_tolerances_do_not_dilute_a_false_cause() -> None:
    assert outcome(_sealed(ZERO), _told(_cause(ZERO, share=8.0), _cause(PLAY, share=2.0)))[0] == "wrong"


def test_a_sure_false_cause_of_weight_is_wrong() -> None:
    assert outcome(_sealed(ZERO), _told(_cause(ZERO), _cause(PLAY, share=20.0))) == ("wrong", [PLAY], [])


def test_sure_cause_is_wrong_when_nothing_is_hidden() -> None:
    assert outcome(_sealed(), _told(_cause(LINK)))[0] == "wrong"


def test_link_named_instead_of_joint_offset_is_wrong() -> None:
    assert outcome(_sealed(ZERO), _told(_cause(LINK))) == ("wrong", [LINK], [ZERO])


def test_joint_offset_named_instead_of_link_is_wrong() -> None:
    assert outcome(_sealed(LINK), _told(_cause(ZERO)))[0] == "wrong"


def test_cause_equivalent_in_any_motion_is_right() -> None:
    assert outcome(_sealed(LINK, same=("link_geometry@wrist",)), _told(_cause("link_geometry@wrist")))[0] == "right"


def test_one_named_cause_covers_one_hidden_cause_only() -> None:
    hidden = _sealed(ZERO, PLAY, same=("encoder_jump@elbow",))
    assert outcome(hidden, _told(_cause("encoder_jump@elbow")))[2] == [PLAY]


def test_false_cause_with_truth_as_rival_is_honest() -> None:
    assert outcome(_sealed(ZERO), _told(_cause(LINK, rivals=(ZERO,))))[0] == "honest"


def test_unexplained_at_the_right_joint_is_honest() -> None:
    assert outcome(_sealed(ZERO), _told(verdict="unexplained", depends_on=("elbow",)))[0] == "honest"


def test_unexplained_at_another_joint_is_vague() -> None:
    assert outcome(_sealed(ZERO), _told(verdict="unexplained", depends_on=("wrist",)))[0] == "vague"


def test_unexplained_tool_slip_depending_on_time_is_honest() -> None:
    assert outcome(_sealed("tool_slip"), _told(verdict="unexplained", depends_on=("time",)))[0] == "honest"


def test_finding_nothing_of_a_hidden_cause_is_vague() -> None:
    assert outcome(_sealed(ZERO), _told(verdict="nothing_found"))[0] == "vague"


def test_an_unsure_false_cause_is_vague() -> None:
    assert outcome(_sealed(ZERO), _told(_cause(LINK, 0.6), verdict="undecided"))[0] == "vague"


def test_outliers_named_in_heavy_tailed_noise_are_right() -> None:
    assert outcome(_sealed(noise="student"), _told(_cause("outliers")))[0] == "right"


def test_false_fixes_named_in_gaussian_noise_are_false() -> None:
    assert outcome(_sealed(), _told(_cause("outliers")))[1] == ["outliers"]


def test_an_interval_counts_offsets_as_true_minus_reading() -> None:
    cause = _cause(ZERO) | {"parameters": {"offset_rad": {"value": -0.02, "ci95": [-0.021, -0.019]}}}
    assert inside(_sealed(ZERO), _told(cause)) == (1, 1)


def test_placed_model_recovers_instrument_and_marker_poses(tmp_path: Path) -> None:
    case = hide_dense(3, tmp_path, rows=80, count=0)
    true = replace(
        case.nominal, marker=case.nominal.marker + 0.01, eye_x=case.nominal.eye_x + np.array([1.0, -2.0, 0.5])
    )
    q = case.measured.q
    built = placed(case.nominal, q, true.measured(q), pose_known=False, marker_known=False)
    assert rms_mm(built.measured(case.fresh.q) - true.measured(case.fresh.q)) < 1e-6


def test_hung_process_is_killed() -> None:
    ran = Checkout(Path.cwd(), 0.5)._run("import time; time.sleep(60)")
    assert ran.code < 0


def test_the_command_is_run_with_its_cost(tmp_path: Path) -> None:
    ran = Checkout(tmp_path, 60.0)._run("import sys; print('said'); sys.exit(3)")
    assert (ran.code, ran.said.strip()) == (3, "said")
    assert 0.0 < ran.cpu_seconds < 10.0
    assert ran.rss_mb > 1.0


def _record(**more: Any) -> DenseJudgement:
    usual: dict[str, Any] = {
        "seed": 1, "rows": 100, "joints": 6, "style": "held", "noise": "gauss", "decidable": True, "truth": (ZERO,),
        "nats": (9.0,), "outcome": "right", "verdict": "explained", "named": (ZERO,), "false": (), "missed": (),
        "inside": (1, 1), "placed_mm": 2.0, "extended_mm": 1.0, "floor_ratio": 1.1, "tolerances": {},
        "stated_tolerances": None, "cpu_seconds": 3.0, "rss_mb": 100.0,
    }  # fmt: skip
    return DenseJudgement(**(usual | more))


def test_table_counts_predictions_worse_than_placed_model() -> None:
    assert "no worse than the placed nominal model 1 of 2" in table([_record(), _record(extended_mm=2.5)])


def test_cases_that_no_observer_decides_stand_apart() -> None:
    shown = table([_record(), _record(decidable=False, outcome="vague")])
    assert "| all decidable | 1 | 1 | 0 | 0 | 0 | 0 |" in shown
    assert "| not decidable | 1 | 0 | 0 | 1 | 0 | 0 |" in shown


def test_the_page_s_table_counts_a_crash_as_wrong() -> None:
    several = _record(seed=3, truth=(ZERO, "a"), outcome="crashed"), _record(seed=2, decidable=False, outcome="honest")
    shown = page_table([_record(), *several])
    assert shown.rows == [
        ["one", 1, 1, 0, 0, 0, 97],
        ["two", 1, 0, 0, 0, 1, 95],
        ["cannot be decided", 1, 0, 1, 0, 0, None],
        ["all", 3, 1, 1, 0, 1, None],
    ]
    assert shown.commands == ["python -m tests.blind.dense --cases 3 --first-seed 1"]


def test_seeds_are_told_by_their_runs() -> None:
    assert runs([7, 3, 4, 4, 5]) == [range(3, 6), range(7, 8)]


def test_line_reports_the_crash_error() -> None:
    assert line(_record(outcome="crashed", extended_mm=None, error="Traceback\nValueError: no")).endswith(
        "ValueError: no"
    )
