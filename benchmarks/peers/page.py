"""One self-contained HTML page: curves, tables, and a description of the runs and the machine."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

from benchmarks.peers.chart import Chart, Line, Style
from benchmarks.peers.growth_page import growth_section
from benchmarks.peers.problem import Competitor
from benchmarks.peers.results import Cell, Results, cell
from benchmarks.peers.tasks import Task

_OURS = ("#e4572e", "#f0a202", "#2a9d5c", "#1f8fe0", "#8e5bd6", "#d6409f", "#12a5a5", "#b5651d", "#5a7d00", "#c1121f")
# Peers are distinguished by the labels on their lines: one grey for other learners, ink for calibration.
_LEARNT, _CALIBRATED = "#929aa5", "var(--ink)"
_DASHES = ("6 3", "2 3", "8 3 2 3", "12 3")
# So many of ours, and of each group of peers, have their names at their lines' ends.
_NAMED = (("ours", 3), ("calibration", 1), ("learnt", 1))
_GROUPS = {"ours": "Ours", "calibration": "Calibration", "learnt": "Learners"}
_STYLE = (Path(__file__).parent / "page.css").read_text()
_SCRIPT = (Path(__file__).parent / "page.js").read_text()
_GOAL_FACTOR = 1.15


def styles(competitors: Sequence[Competitor]) -> dict[str, Style]:
    """Return a style for each competitor: ours solid, heavy and each in its own colour, peers dashed and light."""
    ours, calibrated, learnt = (
        [competitor.key for competitor in competitors if _group(competitor) == group] for group in _GROUPS
    )
    looks = {key: Style(_OURS[i % len(_OURS)]) for i, key in enumerate(ours)}
    for colour, keys in ((_CALIBRATED, calibrated), (_LEARNT, learnt)):
        looks |= {key: Style(colour, _DASHES[i % len(_DASHES)], 1.5) for i, key in enumerate(keys)}
    return looks


def _group(competitor: Competitor) -> str:
    """Return the group of a competitor: ours, calibration or learnt."""
    if competitor.family == "ours":
        return "ours"
    return "calibration" if competitor.calibrates else "learnt"


def write_page(path: Path, results: Results, tasks: Sequence[Task], competitors: Sequence[Competitor]) -> None:
    """Write the page of all results, task by task."""
    looks = styles(competitors)
    shown = [task for task in tasks if any(key[0] == task.key for key in results.outcomes)]
    body = [
        _head(results),
        _legend(competitors, looks),
        _glance(shown, results, competitors),
        *(_section(task, results, competitors, looks) for task in shown),
        growth_section(results, competitors, looks),
        _missing(tasks, shown),
        _about(competitors),
        _runs(results),
    ]
    path.write_text(
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>bodyschema: learners side by side</title><style>{_STYLE}</style></head>"
        f"<body><main>{''.join(body)}</main><script>{_SCRIPT}</script></body></html>\n"
    )


def tests_of(task: Task, results: Results) -> list[str]:
    """Return the names of the tests that a task has results for, in order of appearance."""
    return list(dict.fromkeys(t for key, o in results.outcomes.items() if key[0] == task.key for t in o.errors))


def counts_of(task: Task, results: Results) -> list[int]:
    """Return the numbers of pairs that a task has results at."""
    return sorted({key[2] for key in results.outcomes if key[0] == task.key})


def goal(task: Task, results: Results, pairs: int, test: str) -> float | None:
    """Return the target error [m], or 1.15 times the bound if that is larger; None without a target."""
    bound = results.bound(task.key, pairs, test)
    figure = task.goals.get(pairs)
    if figure is None or (test == "drawn alike" and "extrapolated" in tests_of(task, results)):
        return None
    return max(figure, _GOAL_FACTOR * bound) if bound is not None else figure


def _head(results: Results) -> str:
    seeds = len({key[3] for key in results.outcomes})
    spread = (
        "One seed only: a single arm for each task, so no figure has a spread."
        if seeds == 1
        else f"Means over up to {seeds} seeds, each another arm, with their standard errors."
    )
    return (
        "<header><h1>Learners of forward kinematics, side by side</h1>"
        "<p>Mean distance to the true position on poses that were not learnt [mm], against the number of pairs n. All "
        "are given the same pairs; who needs poses of its own choosing gets as many readings. "
        f"{spread} The grey floor is what the posterior of the right model with the right prior leaves, an expectation "
        "over arms and noise: no learner can do better on average, but on the arms of a few seeds one may. A diamond "
        "is a goal: the figure aimed at, or 1.15 times the floor where that is higher.</p>"
        "<p>Point at a name or a line to have it alone, press a name to hide it. The names of the best are at their "
        "lines' ends.</p></header>"
    )


def _legend(competitors: Sequence[Competitor], looks: dict[str, Style]) -> str:
    rows = []
    for group, name in _GROUPS.items():
        items = "".join(
            f'<button type="button" data-toggle="{c.key}" aria-pressed="true">{_swatch(looks[c.key])}'
            f"{escape(c.title)}</button>"
            for c in competitors
            if _group(c) == group
        )
        rows.append(f"<div><b>{name}</b><span>{items}</span></div>")
    return f'<nav class="legend" aria-label="Models; press to hide">{"".join(rows)}</nav>'


def _swatch(style: Style) -> str:
    dashes = f' stroke-dasharray="{style.dashes}"' if style.dashes else ""
    return (
        f'<svg class="swatch" viewBox="0 0 26 8" aria-hidden="true"><line x1="1" x2="25" y1="4" y2="4" '
        f'stroke="{style.colour}" stroke-width="{style.width}"{dashes}/></svg>'
    )


def _glance(tasks: Sequence[Task], results: Results, competitors: Sequence[Competitor]) -> str:
    rows = []
    for task in tasks:
        test = tests_of(task, results)[-1:]
        for pairs in counts_of(task, results) if test else ():
            if pairs in (30, 300) or pairs in task.goals:
                rows.append(_glance_row(task, test[0], pairs, results, competitors))
    head = "<th>Task<th>n<th>Floor<th>Goal<th>Best of ours<th><th>Best peer<th><th>Peer / ours"
    return (
        '<section id="glance"><h2>At a glance</h2><p>Extrapolated where the task asks for it; errors in mm.</p>'
        f'<div class="scroll"><table class="glance"><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody>'
        "</table></div></section>"
    )


def _glance_row(task: Task, test: str, pairs: int, results: Results, competitors: Sequence[Competitor]) -> str:
    best: dict[str, tuple[float, str]] = {}
    for competitor in competitors:
        mean = cell(results.of(task.key, competitor.key, pairs), test).mean
        if mean is not None and mean < best.get(competitor.family, (float("inf"), ""))[0]:
            best[competitor.family] = (mean, competitor.title)
    aim, bound = goal(task, results, pairs, test), results.bound(task.key, pairs, test)
    ours, peer = best.get("ours"), best.get("peer")
    reached = "" if aim is None or ours is None else ' class="good"' if ours[0] <= aim else ' class="miss"'
    ratio = "" if ours is None or peer is None else f"{peer[0] / ours[0]:.2g}×"
    cells = "".join(
        f"<td{mark}>{'' if entry is None else _mm(entry[0])}<td>{'' if entry is None else escape(entry[1])}"
        for entry, mark in ((ours, reached), (peer, ""))
    )
    aims = f"<td>{_mm(bound)}<td>{_mm(aim)}"
    return f'<tr><td><a href="#{task.key}">{escape(task.title)}</a><td>{pairs:,}{aims}{cells}<td>{ratio}</tr>'


def _section(task: Task, results: Results, competitors: Sequence[Competitor], looks: dict[str, Style]) -> str:
    tests = tests_of(task, results)
    panels = "".join(_panel(task, test, len(tests) > 1, results, competitors, looks) for test in tests)
    tables = "".join(_table(task, test, len(tests) > 1, results, competitors, looks) for test in tests)
    note = f"<p>{escape(task.note)}</p>" if task.note else ""
    head = f'<section id="{task.key}"><h2>{escape(task.title)}</h2>{note}'
    return f'{head}<div class="panels">{panels}</div>{tables}</section>'


def _panel(
    task: Task, test: str, captioned: bool, results: Results, competitors: Sequence[Competitor], looks: dict[str, Style]
) -> str:
    counts = counts_of(task, results)
    lines: list[Line] = []
    for competitor in competitors:
        cells = [(n, cell(results.of(task.key, competitor.key, n), test)) for n in counts]
        known = [(n, c) for n, c in cells if c.mean is not None]
        if known:
            points = [(float(n), 1e3 * (c.mean or 0.0)) for n, c in known]
            bars = [None if c.standard_error is None else 1e3 * c.standard_error for _, c in known]
            lines.append(Line(competitor.key, competitor.title, looks[competitor.key], points, bars))
    if not lines:
        return ""
    named = _best(lines, competitors)
    floor = [(float(n), 1e3 * b) for n in counts if (b := results.bound(task.key, n, test)) is not None]
    goals = [(float(n), 1e3 * g) for n in counts if (g := goal(task, results, n, test)) is not None]
    caption = f"<figcaption>{escape(test)}</figcaption>" if captioned else ""
    return f"<figure>{caption}{Chart('pairs n', 'mean error [mm]', lines, floor, goals, named=named).svg()}</figure>"


def _best(lines: Sequence[Line], competitors: Sequence[Competitor]) -> list[str]:
    """Return the keys of the best few of each group at the largest number of pairs."""
    last = max(line.points[-1][0] for line in lines)
    ended = sorted((line for line in lines if line.points[-1][0] == last), key=lambda line: line.points[-1][1])
    group = {competitor.key: _group(competitor) for competitor in competitors}
    return [line.key for of, few in _NAMED for line in [one for one in ended if group[one.key] == of][:few]]


def _table(
    task: Task, test: str, captioned: bool, results: Results, competitors: Sequence[Competitor], looks: dict[str, Style]
) -> str:
    counts = counts_of(task, results)
    cells = {c.key: [cell(results.of(task.key, c.key, n), test) for n in counts] for c in competitors}
    best = [
        min((mean for row in cells.values() if (mean := row[i].mean) is not None), default=None)
        for i in range(len(counts))
    ]
    rows = []
    bounds = [results.bound(task.key, n, test) for n in counts]
    if any(bound is not None for bound in bounds):
        floor = "".join(f"<td>{_mm(bound)}" for bound in bounds)
        rows.append(f'<tr class="floor-row"><td>Floor (expected){floor}<td><td></tr>')
    for competitor in competitors:
        row = cells[competitor.key]
        name = f"<td>{_swatch(looks[competitor.key])}{escape(competitor.title)}"
        if all(entry.mean is None and not entry.failed for entry in row):
            reason = next((entry.reason for entry in row if entry.reason), "not run")
            rows.append(f'<tr class="out">{name}<td class="why" colspan="{len(counts) + 2}">{escape(reason)}</tr>')
            continue
        last = [entry for entry in row if entry.mean is not None]
        times = f"<td>{_seconds(last[-1].learn_s)}<td>{_short(last[-1].predict_us)}" if last else "<td><td>"
        entries = "".join(_entry(entry, best[i]) for i, entry in enumerate(row))
        rows.append(f'<tr class="{competitor.family}">{name}{entries}{times}</tr>')
    heads = "".join(f"<th>n = {n:,}" for n in counts)
    caption = f"<caption>{escape(test)}</caption>" if captioned else ""
    return (
        f'<div class="scroll"><table>{caption}<thead><tr><th>mm ± standard error{heads}<th>learn<th>µs a row</tr>'
        f"</thead><tbody>{''.join(rows)}</tbody></table></div>"
    )


def _entry(entry: Cell, best: float | None) -> str:
    failed = f'<small class="bad">{entry.failed}/{entry.ran} failed</small>' if entry.failed else ""
    title = f' title="{escape(entry.reason or f"{entry.ran} seeds", quote=True)}"'
    if entry.mean is None:
        text = failed or '<span class="why">–</span>'
        return f"<td{title}>{text}"
    spread = "" if entry.standard_error is None else f"<small>±{_mm(entry.standard_error)}</small>"
    strong = best is not None and entry.mean <= 1.02 * best
    mean = f"<b>{_mm(entry.mean)}</b>" if strong else _mm(entry.mean)
    return f"<td{title}>{mean}{spread}{failed}"


def _missing(tasks: Sequence[Task], shown: Sequence[Task]) -> str:
    rest = [task.title for task in tasks if task not in shown]
    if not any(task.title.startswith("Recording") for task in tasks):
        rest.append("recordings of real robots (no folder given: --data or BODYSCHEMA_DATA)")
    return "" if not rest else f"<section><h2>Not run yet</h2><p>{escape('; '.join(rest))}.</p></section>"


def _about(competitors: Sequence[Competitor]) -> str:
    rows = "".join(f"<dt>{escape(c.title)} <code>{c.key}</code><dd>{escape(c.about)}" for c in competitors)
    return f'<section id="about"><h2>What was implemented</h2><dl>{rows}</dl></section>'


def _runs(results: Results) -> str:
    rows = "".join(
        f"<tr><td>{escape(run['when'])}<td>{run['seconds']:,} s<td>{escape(run['arguments'])}"
        f"<td>{escape(run['processor'])}<td>Python {escape(run['python'])}, NumPy {escape(run['numpy'])}</tr>"
        for run in results.runs
    )
    head = "<thead><tr><th>When<th>Took<th>What<th>Machine<th>Versions</tr></thead>"
    table = f'<div class="scroll"><table>{head}<tbody>{rows}</tbody></table></div>'
    return f'<section id="runs"><h2>Runs</h2>{table}</section>'


def _mm(metres: float | None) -> str:
    if metres is None:
        return ""
    value = 1e3 * metres
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}" if value >= 0.001 else f"{value:.0e}"


def _short(value: float | None) -> str:
    """Format two digits, without a power of ten."""
    if value is None:
        return ""
    return f"{value:,.0f}" if value >= 100 else f"{value:.2g}"


def _seconds(seconds: float | None) -> str:
    if seconds is None:
        return ""
    if seconds >= 1.0:
        return f"{seconds:.1f} s"
    return f"{1e3 * seconds:.0f} ms" if seconds >= 0.01 else f"{1e3 * seconds:.2g} ms"
