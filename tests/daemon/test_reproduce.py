from __future__ import annotations

import json

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from daemon.cli import app
from daemon.reproduce import EXPERIMENTS, Curve, Experiment
from daemon.reproduce.arm import arm, longer_tool, walk


def run(name: str, seed: int = 0) -> Experiment:
    return EXPERIMENTS[name](np.random.default_rng(seed), lambda _said: None)


def curve(experiment: Experiment, name: str) -> Curve:
    return next(curve for curve in experiment.curves if curve.name.startswith(name))


def test_a_walk_takes_steps_between_one_and_three_degrees() -> None:
    q = walk(np.random.default_rng(0), 300, arm(7))
    steps = np.degrees(np.linalg.norm(np.diff(q, axis=0), axis=1))
    assert (steps.min() >= 1.0, steps.max() <= 3.0) == (True, True)


def test_the_longer_tool_moves_the_marker_by_its_length() -> None:
    chain = arm(7)
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 7))
    moved = np.linalg.norm(longer_tool(chain, 0.25).positions(q) - chain.positions(q), axis=1)
    np.testing.assert_allclose(moved, 0.25)


@pytest.mark.parametrize("joints", [5, 6, 7])
def test_every_joint_of_the_arm_moves_the_marker(joints: int) -> None:
    q = np.random.default_rng(0).uniform(-0.5, 0.5, joints)
    moves = [
        np.linalg.norm(arm(joints).positions(q + 0.1 * axis) - arm(joints).positions(q)) for axis in np.eye(joints)
    ]
    assert min(moves) > 0.003


def test_a_curve_tells_from_where_on_it_stays_below_a_limit() -> None:
    found = Curve("", "", count=[10, 20, 30, 40], mean=[5.0, 1.0, 3.0, 1.0])
    assert (found.first_below(2.0), found.first_below(0.5)) == (40, None)


def test_with_noise_the_test_error_falls_below_the_training_error_near_the_papers_2200_samples() -> None:
    found = run("fig4")
    training, test = curve(found, "training"), curve(found, "test")
    crossing = next(n for n, a, b in zip(test.count, test.mean, training.mean, strict=True) if a <= b)
    assert 1_800 <= crossing <= 2_600


def test_as_many_noise_free_samples_as_control_points_give_the_arm_back() -> None:
    found = run("exactness")
    assert max(curve.mean[0] for curve in found.curves if curve.name.endswith("±80°")) < 1e-9


def test_on_figure_7s_pairs_the_daemons_learner_is_ahead_of_the_papers_rule() -> None:
    found = run("fig7")
    rule, ours = (
        curve(found, name) for name in ("the paper's rule, near the walk, σ", "this learner, near the walk, σ")
    )
    assert ours.mean[-1] < 0.6 * rule.at(600)


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(5))
def test_after_figure_6s_tool_change_thirty_pairs_tell_more_than_1800_cycles_of_the_papers_rule(seed: int) -> None:
    found = run("fig6", seed)
    for noise in ("without noise", "σ = 20 mm"):
        rule, ours = (curve(found, f"{name}, near the walk, {noise}") for name in ("the paper's rule", "this learner"))
        assert ours.at(30) < rule.at(1_800)


def test_the_command_shows_the_papers_figure_beside_ours_and_draws_the_curves(tmp_path, capsys) -> None:
    app(["reproduce", "fig5", "--out", str(tmp_path)], result_action="return_value")
    assert "its method, here" in capsys.readouterr().out
    assert (tmp_path / "fig5.png").read_bytes().startswith(b"\x89PNG")


def test_the_command_gives_all_curves_as_json(tmp_path, capsys) -> None:
    app(["reproduce", "fig5", "--json", "--out", str(tmp_path)], result_action="return_value")
    (found,) = json.loads(capsys.readouterr().out)["experiments"]
    assert len(found["curves"][0]["count"]) == len(found["curves"][0]["mean"]) > 10
