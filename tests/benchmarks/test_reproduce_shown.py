"""Output of `bodyschema reproduce` while it runs, on the terminal and in the pictures."""

from __future__ import annotations

import io
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from bodyschema.cli.terminal import screen
from bodyschema.reproduce import Column, Comparison, Curve, Experiment, Panel, Reading, plot
from bodyschema.reproduce.show import show

pytestmark = pytest.mark.skipif(
    find_spec("matplotlib") is None, reason="no matplotlib; to run it: pip install -e '.[plots]'"
)
LONG = "without noise; steps of 1° to 3° a joint; near the walk"


def printed(experiment: Experiment, width: int) -> str:
    console = Console(width=width, record=True, file=io.StringIO())
    show(console, experiment, Path("x.png"))
    return console.export_text()


def test_tables_fit_80_columns_without_a_broken_cell() -> None:
    models = ("rigid chain, from nothing", "tensor train, from nothing", "KB-Map, precision from the pairs")
    columns = [Column(test, n) for test in ("test", "extrapolation") for n in (30, 100, 300, 2_200, 13_000)]
    table = Comparison("others", columns, {name: [12.3e-3] * len(columns) for name in models})
    readings = [Reading("after 1,800 cycles", LONG, "about 50 mm", 0.0319)]
    lines = printed(Experiment("x", "X", "cycles", [], readings, table, []), 80).splitlines()
    for words in (*models, LONG, "about 50 mm", "13,000"):
        assert any(words in line for line in lines), words


def test_table_has_row_per_test_column_per_count() -> None:
    columns = [Column("near", 30), Column("near", 600), Column("far", 30)]
    table = Comparison("others", columns, {"rigid": [0.001, 0.002, 0.003]})
    rows = [line.split() for line in printed(Experiment("x", "X", "cycles", [], [], table, []), 80).splitlines()]
    assert ["rigid", "1", "2"] in rows
    assert ["rigid", "3"] in rows


def test_a_long_step_says_how_far_it_is(monkeypatch) -> None:
    monkeypatch.setattr(screen.ScreenSettings, "tell_every_s", 0.0)
    said: list[str] = []
    assert list(screen.counted(said.append, "fits", [4, 5])) == [4, 5]
    assert said == ["fits", "fits: 0 of 2", "fits: 1 of 2"]


def test_a_short_step_says_only_what_it_is() -> None:
    said: list[str] = []
    assert len(list(screen.counted(said.append, "fits", range(100)))) == 100
    assert said == ["fits"]


def test_without_a_terminal_each_step_is_a_line() -> None:
    console = Console(file=io.StringIO(), record=True)
    with screen.shown_on(console, "fig4") as say:
        say("one")
        say("two")
    assert console.export_text().splitlines() == ["fig4: one", "fig4: two"]


def test_terminal_step_overwrites_last_one() -> None:
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=True, width=60)
    with screen.shown_on(console, "fig4") as say:
        say("one")
        say("x" * 100)
    assert stream.getvalue().count("\n") == 1
    assert stream.getvalue().endswith("\x1b[2K"), "the line is not erased in the end"


def axes_of(panel: Panel):
    from matplotlib.figure import Figure  # it takes a second to import

    axes = Figure().add_subplot()
    plot.draw(axes, panel, 1e-5)
    return axes


def test_varying_curve_is_band_around_median() -> None:
    rng = np.random.default_rng(0)
    lengths = rng.uniform(0.001, 0.002, 7_000).tolist()
    axes = axes_of(Panel("", [Curve("each pair", "green", thin=True, count=list(range(7_000)), mean=lengths)], True))
    (median,), (band,) = axes.get_lines(), axes.collections
    assert len(np.asarray(median.get_xydata())) == 70
    np.testing.assert_allclose(np.asarray(median.get_ydata()), 1.5, atol=0.2)
    heights = np.asarray(band.get_paths()[0].vertices)[:, 1]
    assert (heights.min() > 1.0, heights.max() < 2.0) == (True, True)


def test_logarithmic_axis_thins_points_and_keeps_last() -> None:
    curve = Curve("rule", "red", count=list(range(0, 3_000, 10)), mean=np.linspace(0.1, 0.01, 300).tolist())
    (line,) = axes_of(Panel("", [curve])).get_lines()
    points = np.asarray(line.get_xydata())
    assert len(points) < 50
    assert points[-1].tolist() == pytest.approx([2_990.0, 10.0])


def test_narrow_curve_covers_coinciding_wide_one() -> None:
    curves = [Curve(str(width), "red", width=width, count=[1, 2, 3], mean=[0.1] * 3) for width in (1.4, 5.0)]
    narrow, wide = axes_of(Panel("", curves)).get_lines()
    assert narrow.get_zorder() > wide.get_zorder()


def test_legend_explains_styles_and_dotted_lines() -> None:
    curve = Curve("rule", "red", count=[1, 2], mean=[0.1, 0.1], largest=[0.2, 0.2])
    axes = axes_of(Panel("", [curve], as_paper=True, styles={"--": "without noise"}))
    legend = axes.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == ["rule", "without noise", "dotted: the largest error"]
