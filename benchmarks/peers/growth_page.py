"""The section of the page that shows the growth of time and memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from benchmarks.peers.chart import Chart, Line, Style
from benchmarks.peers.growth import SERIES, Law
from benchmarks.peers.problem import Competitor
from benchmarks.peers.results import Growth, Results

_ROOM_BELOW = 0.7
_LABELS = {"joints": "joints d", "pairs": "pairs n"}


def growth_section(results: Results, competitors: Sequence[Competitor], looks: dict[str, Style]) -> str:
    """Return charts of time and memory against joints and pairs; empty without measurements."""
    if not results.growth:
        return ""
    titles = {competitor.key: competitor.title for competitor in competitors}
    figures = []
    for what in ("joints", "pairs"):
        for label, value in (("time to learn [s]", _seconds), ("memory while learning [MiB]", _mebibytes)):
            chart = _chart(what, label, value, results, titles, looks)
            if chart.lines:
                figures.append(f"<figure>{chart.svg()}</figure>")
    by_joints, by_pairs = (
        "; ".join(f"{titles[series.competitor]}: {series.text}" for series in SERIES if series.what == what)
        for what in ("joints", "pairs")
    )
    return (
        '<section id="growth"><h2>Growth</h2><p>Dotted: the slope of theory, of time and of memory, through the '
        f"largest size. Against joints: {by_joints}; the full map with 64 pairs, the others with 12 d. Against pairs, "
        f"6 joints: {by_pairs}.</p>"
        f'<div class="panels">{"".join(figures)}</div></section>'
    )


def _seconds(entry: Growth) -> float:
    return entry.seconds


def _mebibytes(entry: Growth) -> float:
    return entry.mebibytes


def _chart(
    what: str,
    label: str,
    value: Callable[[Growth], float],
    results: Results,
    titles: dict[str, str],
    looks: dict[str, Style],
) -> Chart:
    lines: list[Line] = []
    laws: list[Line] = []
    for series in SERIES:
        entries = [e for e in results.growth if (e.what, e.competitor) == (series.what, series.competitor)]
        if series.what != what or not entries:
            continue
        key = series.competitor
        points = sorted((float(entry.size), value(entry)) for entry in entries)
        lines.append(Line(key, titles[key], looks[key], points))
        slope = _slope(series.time if value is _seconds else series.memory, points)
        laws.append(Line(key, titles[key], looks[key], slope))
    return Chart(_LABELS[what], label, lines, laws=laws)


def _slope(law: Law, points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return points of the law through the largest size, down to the bottom of the chart."""
    size, largest = points[-1]
    lowest = min(y for _, y in points)
    return [(x, y) for x, _ in points if (y := largest * law(x) / law(size)) > _ROOM_BELOW * lowest]
