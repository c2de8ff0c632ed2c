"""Write the tables of a report."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

from bodyschema.diagnosis.report.numbers import (
    Number,
    chance,
    mm,
    numbers_of,
    percent,
    place,
    share,
    significant_numbers,
)
from bodyschema.diagnosis.report.presenters.registry import rival_named
from bodyschema.diagnosis.report.result import Cause, DiagnosisFile, Indistinguishable, Rejected
from bodyschema.diagnosis.report.text import in_order, other_shares

_SAME_AS = {"aligned": "nominal", "extended": "aligned"}  # rows to omit where they equal another
# Number of rejected hypotheses shown at first.
NEAREST = 12
_ERRORS = (
    ("nominal", "The simulation as it is"),
    ("aligned", "Placed as well as it can be"),
    ("geometry", "The best geometry"),
    ("extended", "With what was found"),
    ("noise_floor", "Noise alone"),
)


def errors(diagnosis: DiagnosisFile) -> str:
    rms, mean = diagnosis.rms_mm, diagnosis.mean_mm
    longest = max(value for name, _ in _ERRORS[1:] if (value := getattr(rms, name)) is not None) or 1.0
    rows = []
    for name, label in _ERRORS:
        value = getattr(rms, name)
        if value is None or (name in _SAME_AS and value == getattr(rms, _SAME_AS[name])):
            continue
        share = min(value / longest, 1.0)
        bar = f'<span class="bar {name}" style="width:{100 * share:.1f}%"></span>'
        rows.append(f"<tr><td>{label}<td>{mm(value)}<td>{mm(getattr(mean, name))}<td class=wide>{bar}</tr>")
    return _table(("Not used in the fit", "RMS [mm]", "mean [mm]", ""), rows)


def causes(diagnosis: DiagnosisFile, *, timed: bool) -> str:
    """Return a table of the causes with their non-zero numbers, and of the other shares of the gain."""
    rows, others = [], other_shares(diagnosis)
    for cause in in_order(diagnosis.causes):
        if cause.is_correction:
            break
        figures = (
            f"<td>{percent(cause.probability)}<td>{share(cause.share_of_gain_percent)}"
            f"<td>{cause.held_out_gain_percent:.1f} %"
        )
        shown = _lines(significant_numbers(numbers_of(cause, timed=timed)))
        rows.append(f"<tr><td>{escape(place(cause))}<td class=text>{shown}{figures}</tr>")
    rows += [f"<tr><td>{name}<td><td><td>{share(part)}<td></tr>" for name, part in others]
    return _table(("Cause", "Numbers, ± for 95 %", "Sure", "Share of the gain", "Gain"), rows)


def numbers(cause: Cause, *, timed: bool) -> str:
    """Return all numbers of a cause, one per line, and name those that are not identifiable."""
    every = numbers_of(cause, timed=timed)
    hidden = ", ".join(n.label for n in every if not n.is_identifiable)
    untold = f"<br><small>not determined by this motion: {escape(hidden)}</small>" if hidden else ""
    return f"{_lines(n for n in every if n.is_identifiable)}{untold}"


def _lines(shown: Iterable[Number]) -> str:
    return "<br>".join(f"{escape(n.label)} <b>{escape(n.value)}</b> <small>{escape(n.interval)}</small>" for n in shown)


def rivals(cause: Cause, seen_by: str) -> str:
    """Return a list of a cause's rivals; empty if there are none."""
    if not cause.rivals:
        return ""
    items = "".join(f"<li>{_rival(rival, seen_by)}" for rival in cause.rivals)
    return f"<p>It could also be:<ul>{items}</ul>"


def _rival(rival: Indistinguishable, seen_by: str) -> str:
    tell = "no motion tells them apart" if rival.by == "any_motion" else "another motion can tell"
    what = escape(rival_named(rival, seen_by))
    return f"<b>{what}</b>, with a probability of {percent(rival.probability)}; {tell}"


def hypotheses(rejected: Sequence[Rejected]) -> str:
    """Return a table of the rejected hypotheses, the nearest first, the rest collapsed."""
    rows = [
        f"<tr><td>{escape(place(row))}<td>{row.held_out_gain_percent:+.2f} %<td>{chance(row.p_value)}"
        f"<td>{escape(row.why)}</tr>"
        for row in rejected
    ]
    heads = ("Not there", "would gain, held out", "p-value, corrected", "why not")
    shown = _table(heads, rows[:NEAREST])
    if len(rows) <= NEAREST:
        return shown
    rest = _table(heads, rows[NEAREST:])
    return f"{shown}<details><summary>{len(rows) - NEAREST} more</summary>{rest}</details>"


def _table(heads: Sequence[str], rows: Sequence[str]) -> str:
    head = "".join(f"<th>{escape(text)}" for text in heads)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'
