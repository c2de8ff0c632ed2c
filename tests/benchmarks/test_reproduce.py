from __future__ import annotations

import io
import json
import re
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from rich.console import Console

from benchmarks.reproduced import models, readings
from bodyschema.cli.main import app
from bodyschema.interfaces.errors import ConfigError
from bodyschema.learning.online_learner import OnlineLearner
from bodyschema.reproduce import EXPERIMENTS, Column, Comparison, Curve, Experiment, Panel, Reading, Run
from bodyschema.reproduce.arm import JOINTS, OTHER_SIX, arm, longer_tool
from bodyschema.reproduce.exactness import exactness
from bodyschema.reproduce.experiment import MEAN_NOISE
from bodyschema.reproduce.fig4 import fig4
from bodyschema.reproduce.fig5 import fig5
from bodyschema.reproduce.fig6 import fig6
from bodyschema.reproduce.fig7 import fig7
from bodyschema.reproduce.measured import Measured, guided_walk, postures
from bodyschema.reproduce.models import WITH_DRAWING, Contender, Knowledge, learn_all
from bodyschema.reproduce.show import show
from bodyschema.reproduce.stream import RULE, Stream, bernstein_map, in_stages, papers_rule
from bodyschema.reproduce.walk import walk
from kbmaps import ChainTolerances, NonFiniteError, RigidChain

pytestmark = pytest.mark.skipif(
    find_spec("matplotlib") is None, reason="no matplotlib; to run it: pip install -e '.[plots]'"
)
PAGE = Path(__file__).parents[2] / "docs" / "results" / "paper.md"
# Small variants, so that every curve and table is made in seconds.
SMALL = {
    "fig4": lambda run: fig4(run, samples=800, tests=50),
    "fig5": lambda run: fig5(run, train=300, test=30),
    "fig6": lambda run: fig6(run, online=32, cycles=64),
    "fig7": lambda run: fig7(run, online=32, cycles=32),
    "exactness": lambda run: exactness(run, joints=(5,)),
}


def a_run(seed: int = 0, *, real: bool = False) -> Run:
    return Run(np.random.default_rng(seed), seed, real, lambda _said: None)


def value(experiment: Experiment, *words: str) -> float:
    """Return the value of the one reading that contains all these words."""
    (found,) = [r for r in experiment.readings if all(word in f"{r.what}; {r.read_as}" for word in words)]
    assert found.value is not None
    return found.value


def error(experiment: Experiment, model: str, *words: str) -> float:
    """Return the error of one model in the one column that contains all these words."""
    table = experiment.comparison
    assert table is not None
    (place,) = [k for k, c in enumerate(table.columns) if all(word in f"{c.test} at {c.count}" for word in words)]
    found = table.rows[model][place]
    assert found is not None
    return found


def planted(joints: int, count: int, seed: int, say: Callable[[str], None]) -> Measured:
    """Return a measured walk of large steps with 1 mm of noise."""
    rng, nominal = np.random.default_rng(seed), arm(joints)
    say("planted")
    q = np.arctan(np.cumsum(rng.normal(0.0, 0.3, (count, joints)), axis=0))
    true = longer_tool(nominal, 0.01)
    return Measured(q, true.positions(q) + 0.001 * rng.normal(size=(count, 3)), true, nominal)


class Seldom(OnlineLearner):
    """Does its background work after every thirtieth pair only, which costs much less."""

    def work(self) -> bool:
        return self.counters.pairs % 30 == 0 and super().work()


def stepping(rng: np.random.Generator, count: int, joints: tuple[str, ...], say: Callable[[str], None]) -> np.ndarray:
    """Return a walk of large steps that no sampler has taken."""
    say("walked")
    return np.arctan(np.cumsum(rng.normal(0.0, 0.3, (count, len(joints))), axis=0))


@cache
def small(name: str) -> Experiment:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("bodyschema.reproduce.fig5.walk", stepping)
        patch.setattr("bodyschema.reproduce.fig7.TEST_POSES", 100)
        patch.setattr("bodyschema.reproduce.stream.OnlineLearner", Seldom)
        patch.setattr("bodyschema.reproduce.stream.spread_counts", lambda _first, last: [last])
        return SMALL[name](a_run())


def test_walk_steps_are_one_to_three_degrees() -> None:
    q = walk(np.random.default_rng(0), 30, JOINTS[7])
    steps = np.degrees(np.linalg.norm(np.diff(q, axis=0), axis=1))
    assert (steps.min() >= 1.0, steps.max() <= 3.0) == (True, True)


def test_walk_by_joint_has_rms_step_size() -> None:
    q = walk(np.random.default_rng(0), 30, JOINTS[7], each_joint=True)
    steps = np.degrees(np.sqrt(np.square(np.diff(q, axis=0)).mean(axis=1)))
    assert (steps.min() >= 1.0, steps.max() <= 3.0) == (True, True)


def test_walk_is_reproducible_across_threads() -> None:
    walks = [walk(np.random.default_rng(3), 20, JOINTS[5]) for _ in range(2)]
    np.testing.assert_array_equal(*walks)


def test_longer_tool_moves_marker_by_its_length() -> None:
    chain = arm(7)
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 7))
    moved = np.linalg.norm(longer_tool(chain, 0.25).positions(q) - chain.positions(q), axis=1)
    np.testing.assert_allclose(moved, 0.25)


@pytest.mark.parametrize("joints", [*JOINTS.values(), OTHER_SIX], ids=len)
def test_every_joint_of_the_arm_moves_the_marker(joints: tuple[str, ...]) -> None:
    chain, q = arm(joints), np.random.default_rng(0).uniform(-0.5, 0.5, len(joints))
    moves = [np.linalg.norm(chain.positions(q + 0.1 * axis) - chain.positions(q)) for axis in np.eye(len(joints))]
    assert min(moves) > 0.003


def test_curve_reports_where_it_stays_below_limit() -> None:
    found = Curve("", "", count=[10, 20, 30, 40], mean=[5.0, 1.0, 3.0, 1.0])
    assert (found.first_below(2.0), found.first_below(0.5)) == (40, None)


def test_a_curve_says_nothing_before_its_first_point() -> None:
    found = Curve("", "", count=[10, 20], mean=[5.0, 1.0])
    assert (found.at(9), found.at(19), found.at(20)) == (None, 5.0, 1.0)


def test_mean_length_of_unit_noise_matches_draws() -> None:
    drawn = np.linalg.norm(np.random.default_rng(0).normal(size=(100_000, 3)), axis=1)
    assert drawn.mean() == pytest.approx(MEAN_NOISE, rel=0.005)


def test_stream_stage_learns_each_pair_once() -> None:
    order = in_stages(np.random.default_rng(0), 50, 150)
    assert [sorted(stage) for stage in order.reshape(3, 50)] == [list(range(50))] * 3


def test_custom_model_joins_with_one_line() -> None:
    chain, q = arm(5), np.random.default_rng(0).uniform(-1.0, 1.0, (40, 5))
    mine = Contender("mine", "black", WITH_DRAWING[0].make)
    known = Knowledge(longer_tool(chain, 0.1), ChainTolerances(tool=0.1), np.pi)
    curves = learn_all([mine], known, (q, chain.positions(q)), [0, 20, 40], {"test": (q, chain.positions(q))})
    assert curves["mine"]["test"].mean[0] == pytest.approx(0.1)
    assert curves["mine"]["test"].mean[-1] < 1e-6


def test_a_contender_that_fails_is_not_passed_over() -> None:
    chain, q = arm(5), np.zeros((2, 5))
    known = Knowledge(chain, ChainTolerances(tool=0.1), np.pi)
    with pytest.raises(NonFiniteError):
        learn_all(WITH_DRAWING, known, (q, np.full((2, 3), np.nan)), [2], {"test": (q, chain.positions(q))})


# fig5 is the like of fig4, and fig7 of fig6.
NAMES = [pytest.param(name, marks=pytest.mark.soak if name in ("fig4", "fig6") else ()) for name in SMALL]


@pytest.mark.parametrize("name", NAMES)
def test_every_experiment_has_readings_and_curves_without_gaps(name: str) -> None:
    curves = [curve for panel in small(name).panels for curve in panel.curves]
    assert all(np.isfinite(curve.mean).all() and len(curve.mean) == len(curve.count) > 0 for curve in curves)
    assert small(name).readings


@pytest.mark.parametrize("name", NAMES[:4])
def test_figures_compare_new_models_with_paper_method(name: str) -> None:
    table = small(name).comparison
    assert table is not None
    names = [curve.name for panel in small(name).panels for curve in panel.curves]
    assert {contender.name for contender in WITH_DRAWING} <= set(table.rows) & set(names)


def test_rigid_chain_beats_paper_on_figure_7() -> None:
    where = ("σ = 20 mm", "near", "at 32")
    assert error(small("fig7"), "rigid chain", *where) < 0.6 * error(small("fig7"), "paper's rule", *where)


def test_noise_free_samples_per_control_point_recover_arm() -> None:
    assert value(small("exactness"), "5 joints", "from ±80°", "mean error") < 1e-9


def test_terminal_shows_quantity_once_with_each_interpretation() -> None:
    readings = [Reading("error", read_as, "50 mm", given) for read_as, given in (("near", 0.0235), ("far", None))]
    table = Comparison("others", [Column("near", 30)], {"rigid chain": [1e-15], "tensor train": [0.118]})
    console = Console(width=120, record=True, file=io.StringIO())
    show(console, Experiment("x", "X", "cycles", [], readings, table, []), Path("x.png"))
    text = console.export_text()
    assert (text.count("error"), text.count("50 mm")) == (1, 1)
    assert all(words in text for words in ("23.5 mm", "not reached", "< 1e-09", "118"))


@pytest.mark.soak
def test_command_plots_curves_and_prints_both_figures(tmp_path, capsys, monkeypatch) -> None:
    def told(run: Run) -> Experiment:
        run.say("exact learning")
        return small("fig4")

    monkeypatch.setitem(EXPERIMENTS, "fig4", told)
    app(["reproduce", "fig4", "--out", str(tmp_path)], result_action="return_value")
    said = capsys.readouterr()
    assert "its method, here" in said.out
    assert "fig4: exact learning" in said.err
    assert (tmp_path / "fig4.png").read_bytes().startswith(b"\x89PNG")


@pytest.fixture(scope="module")
def printed(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """Return what --json prints of figure 7, and the folder of its picture."""
    folder = tmp_path_factory.mktemp("fig7")
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()) as out:
        patch.setitem(EXPERIMENTS, "fig7", lambda _run: small("fig7"))
        app(["reproduce", "fig7", "--no-real", "--json", "--out", str(folder)], result_action="return_value")
    return json.loads(out.getvalue()), folder


def test_the_command_gives_everything_as_json(printed) -> None:
    told, folder = printed
    (found,) = told["experiments"]
    parsed = msgspec.convert({name: found[name] for name in Experiment.__dataclass_fields__}, Experiment)
    assert parsed.readings
    assert (told["schema"], told["seed"], told["real"], found["plot"]) == (3, 0, False, str(folder / "fig7.png"))


def test_the_json_becomes_the_tables_of_the_page(printed) -> None:
    [experiment] = printed[0]["experiments"]
    figures, others = readings(experiment), models(experiment)
    assert (figures.name, others.name) == ("reproduced_fig7", "reproduced_fig7_models")
    assert len(figures.rows) == len(experiment["readings"])
    assert [column.name for column in others.columns[1:]] == list(experiment["comparison"]["rows"])


def test_the_page_documents_every_field_of_the_json(printed) -> None:
    told, _ = printed
    kinds = (Experiment, Panel, Curve, Reading, Comparison, Column)
    known = {*told, *told["experiments"][0], *(name for kind in kinds for name in kind.__dataclass_fields__)}
    documented = set(re.findall(r"`(\w+)`", PAGE.read_text(encoding="utf-8").partition("## What --json prints")[2]))
    assert known <= documented


def test_a_negative_seed_is_refused() -> None:
    with pytest.raises(ConfigError, match="Give 0 or more"):
        app(["reproduce", "exactness", "--seed", "-1"], result_action="return_value")


def test_a_folder_that_cannot_be_made_is_told(tmp_path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="--out"):
        app(["reproduce", "exactness", "--out", str(tmp_path / "file" / "x")], result_action="return_value")


def test_measured_curves_without_pybullet_name_what_to_install(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("bodyschema.interfaces.extras.find_spec", lambda name: None if name == "pybullet" else object())
    with pytest.raises(ConfigError, match="no-real"):
        app(["reproduce", "fig7", "--out", str(tmp_path)], result_action="return_value")


@pytest.mark.soak
def test_figure_5_simulates_measured_postures(monkeypatch) -> None:
    monkeypatch.setattr("bodyschema.reproduce.fig5.postures", planted)
    monkeypatch.setattr("bodyschema.reproduce.fig5._models", lambda *_: {})  # only least squares is asked here
    found = fig5(a_run(real=True), train=300, test=30)
    assert [curve.name for curve in found.panels[0].curves] == ["measured", "simulated, σ = 20 mm"]
    # The tracker's noise planted is a twentieth of the simulated one.
    ratio = value(found, "the postures measured", "σ per axis", "true") / value(found, "measured, after 300", "true")
    assert 10.0 < ratio < 40.0


def by_the_rule_and_a_rigid_chain(
    stream: Stream, nominal: RigidChain, known: Knowledge, say: Callable[[str], None], *, tool_changed: bool
) -> dict[str, dict[str, Curve]]:
    """Run two models on one stream, in the place of all."""
    assert not tool_changed
    rule = {RULE: papers_rule(bernstein_map(nominal), stream, say)}
    return rule | learn_all(WITH_DRAWING[:1], known, (stream.q, stream.x), [stream.online], stream.tests)


@pytest.mark.soak
def test_figure_7_tests_on_measurements_and_truth(monkeypatch) -> None:
    monkeypatch.setattr("bodyschema.reproduce.fig7.learn_stream", by_the_rule_and_a_rigid_chain)
    monkeypatch.setattr("bodyschema.reproduce.fig7.guided_walk", planted)
    found = fig7(a_run(real=True), online=32, cycles=64, held_out=20, onward=20)
    of_truth = error(found, "rigid chain", "measured", "held out, true", "at 32")
    assert of_truth < error(found, "rigid chain", "measured", "held out, as measured", "at 32")


@pytest.mark.soak
def test_guided_walk_has_sampler_steps_and_tracker_noise() -> None:
    pytest.importorskip("pybullet")
    found = guided_walk(6, 5, 0, lambda _said: None)
    steps = np.degrees(np.linalg.norm(np.diff(found.q, axis=0), axis=1))
    assert (steps.min() >= 1.0, steps.max() <= 3.0, found.noise_m < 0.003) == (True, True, True)


@pytest.mark.soak
def test_distant_postures_have_tracker_noise() -> None:
    pytest.importorskip("pybullet")
    found = postures(5, 5, 0, lambda _said: None)
    steps = np.degrees(np.linalg.norm(np.diff(found.q, axis=0), axis=1))
    assert steps.min() > 3.0
    assert found.noise_m < 0.003


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(3))
def test_error_crosses_training_error_near_2200_samples(seed: int) -> None:
    found = fig4(a_run(seed), tests=2_000)
    assert 1_800 <= value(found, "test error < training") <= 2_600


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(3))
def test_thirty_pairs_beat_1800_paper_cycles_after_change(seed: int) -> None:
    found = fig6(a_run(seed))
    for noise in ("without noise", "σ = 20 mm"):
        of_rule = value(found, "1,800", f"; {noise}; near")
        assert error(found, "this learner", noise, "near", "at 30") < of_rule


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(3))
def test_figure_7_replay_lowers_measured_and_simulated_error(seed: int) -> None:
    pytest.importorskip("pybullet")
    found = fig7(a_run(seed, real=True))
    for curve in ("measured; held out, as", "simulated in the measured poses; held out, true"):
        assert value(found, "2,200", curve) < 0.5 * value(found, "600", curve)
