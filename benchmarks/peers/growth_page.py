"""The part of the page that shows how time and memory grow."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from benchmarks.peers.chart import Chart, Line, Style
from benchmarks.peers.growth import BY_JOINTS, BY_PAIRS
from benchmarks.peers.problem import Competitor
from benchmarks.peers.results import Growth, Results

_LABELS = {"joints": "joints d", "pairs": "pairs n"}


def growth_section(results: Results, competitors: Sequence[Competitor], looks: dict[str, Style]) -> str:
    """Charts of time and memory against joints and pairs; nothing where they were not measured."""
    if not results.growth:
        return ""
    titles = {competitor.key: competitor.title for competitor in competitors}
    figures = []
    for what in ("joints", "pairs"):
        for label, value in (("time to learn [s]", _seconds), ("memory while learning [MiB]", _mebibytes)):
            chart = _chart(what, label, value, results, titles, looks)
            if chart.lines:
                figures.append(f"<figure>{chart.svg()}</figure>")
    laws = "; ".join(f"{titles[series.competitor]}: {series.law_text}" for series in BY_JOINTS)
    by_pairs = "; ".join(f"{titles[key]}: {text}" for key, (_, text) in BY_PAIRS.items())
    return (
        '<section id="growth"><h2>Growth</h2><p>Dotted: the slope of theory through the largest size. Against joints: '
        f"{laws} (the full map with 64 pairs, to 10 joints; the others to 30). Against pairs, 6 joints: {by_pairs}.</p>"
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
    for key in dict.fromkeys(entry.competitor for entry in results.growth if entry.what == what):
        entries = [entry for entry in results.growth if entry.what == what and entry.competitor == key]
        points = [(float(entry.size), value(entry)) for entry in entries]
        lines.append(Line(key, titles[key], looks[key], points))
        if value is _seconds:
            law = _law(what, key)
            size, largest = points[-1]
            slope = [(x, largest * law(x) / law(size)) for x, _ in points]
            lowest = min(y for _, y in points)
            laws.append(Line(key, titles[key], looks[key], [point for point in slope if point[1] > 0.3 * lowest]))
    return Chart(_LABELS[what], label, lines, laws=laws)


def _law(what: str, key: str) -> Callable[[float], float]:
    if what == "pairs":
        return BY_PAIRS[key][0]
    return next(series.law for series in BY_JOINTS if series.competitor == key)
