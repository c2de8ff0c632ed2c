"""Show a finished diagnosis in a terminal of 80 columns."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from bodyschema.cli.terminal.screen import ScreenSettings
from bodyschema.diagnosis.report.numbers import chance, mm, numbers_of, percent, place, share, significant_numbers
from bodyschema.diagnosis.report.presenters.registry import named, rival_named
from bodyschema.diagnosis.report.result import DiagnosisFile, Indistinguishable, ResultSettings, Verdict
from bodyschema.diagnosis.report.text import actions, in_order, modelled, other_shares, tolerance_sentence

_HEADS: dict[Verdict, tuple[str, str]] = {
    "explained": ("EXPLAINED", "bold white on dark_green"),
    "nothing_found": ("NOTHING FOUND", "bold white on blue"),
    "undecided": ("UNDECIDED", "bold black on yellow"),
    "unexplained": ("NOT ALL EXPLAINED", "bold white on dark_red"),
}
_MEANING: dict[Verdict, str] = {
    "explained": "",
    "nothing_found": "",
    "undecided": "What was found describes the error, but this recording cannot tell some of it from other causes.",
    "unexplained": "Something acts on this arm that is not among the effects that are known here. Take the causes "
    "below as a description, and change nothing on the robot because of them alone.",
}
_ERRORS = (
    ("nominal", "simulation as it is"),
    ("aligned", "placed as well as it can be"),
    ("geometry", "best geometry"),
    ("extended", "with what was found"),
    ("noise_floor", "noise alone"),
)
# Rows that are omitted when equal to another row.
_SAME_AS = {"aligned": "nominal", "extended": "aligned"}


def view(diagnosis: DiagnosisFile, remedies: Sequence[str], *, timed: bool) -> Group:
    """Return a view of the verdict, errors before and after, causes, rejected hypotheses and remedies.

    Args:
        remedies: remedies of the causes.
        timed: True if the recording has times.
    """
    head, style = _HEADS[diagnosis.verdict]
    sentence = diagnosis.sentence.rstrip(".") + "."
    parts: list[RenderableType] = [Text.assemble((f" {head} ", style), "  ", (sentence, "bold"))]
    if meaning := _MEANING[diagnosis.verdict]:
        parts.append(Text(meaning))
    if diagnosis.unexplained.depends_on:
        parts.append(Text(unexplained(diagnosis)))
    parts.append(_errors(diagnosis))
    if diagnosis.causes:
        parts.append(_causes(diagnosis, timed))
    if diagnosis.tolerances is not None:
        parts.append(Text(tolerance_sentence(diagnosis.tolerances, diagnosis.seen_by)))
    if rivals := _rivals(diagnosis):
        parts.append(_list("Not distinguished", rivals))
    if diagnosis.rejected:
        parts.append(_rejected(diagnosis))
    first, small = actions(diagnosis, remedies)
    if first:
        parts.append(_list("What to do", first, numbered=True))
    if small:
        parts.append(_list(f"Small causes, each less than {ResultSettings.small_percent:.0f} % of the gain", small))
    if diagnosis.advice:
        parts.append(_list("What to measure next", diagnosis.advice))
    if diagnosis.limitations:
        parts.append(_list("What this recording cannot show", diagnosis.limitations))
    return Group(*(Padding(part, (0, 0, 1, 0), expand=False) for part in parts[:-1]), parts[-1])


def unexplained(diagnosis: DiagnosisFile) -> str:
    """Return a sentence on the residual that no effect explains."""
    left = diagnosis.unexplained
    return (
        f"About {mm(left.rms_mm)} mm (RMS) is left that has structure and fits no known effect; it depends on "
        f"{', '.join(left.depends_on)}.{''.join(f' {what[0].upper()}{what[1:]}.' for what in left.what)} "
        f"{modelled(left)}"
    )


def _rivals(diagnosis: DiagnosisFile) -> list[str]:
    """Return one sentence for each alternative explanation of a cause."""
    causes, by = [cause for cause in diagnosis.causes if not cause.is_correction], diagnosis.seen_by
    names = [named(cause.effect, cause.where, cause.source, by) for cause in causes]
    pairs = zip(names, causes, strict=True)
    return list(dict.fromkeys(_rival(name, rival, by) for name, cause in pairs for rival in cause.rivals))


def _rival(itself: str, rival: Indistinguishable, seen_by: str) -> str:
    instead = f"{itself} may be {rival_named(rival, seen_by)} ({percent(rival.probability)})"
    if rival.by == "any_motion":
        return f"{instead}; no motion tells them apart."
    return f"{instead}; another motion can tell."


def _table(title: str) -> Table:
    table = Table(
        box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, title=Text(title, style="bold"), title_justify="left"
    )
    table.title_style = ""
    return table


def _errors(diagnosis: DiagnosisFile) -> Table:
    table = _table("Error on data not used in the fit [mm]")
    table.add_column("")
    for name in ("RMS", "mean"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("")
    rms, mean = diagnosis.rms_mm, diagnosis.mean_mm
    # The nominal error may be so large that its bar would leave no room for the others.
    longest = max(rms.aligned, rms.extended, rms.noise_floor or 0.0, 1e-12)
    for name, label in _ERRORS:
        value: float | None = getattr(rms, name)
        if value is not None and not (name in _SAME_AS and value == getattr(rms, _SAME_AS[name])):
            table.add_row(label, mm(value), mm(getattr(mean, name)), _bar(value / longest))
    return table


def _bar(part: float) -> str:
    return "█" * max(round(ScreenSettings.bar_width * min(part, 1.0)), 1) + ("…" if part > 1.001 else "")


def _causes(diagnosis: DiagnosisFile, timed: bool) -> Table:
    table = _table("Causes")
    table.padding = (0, 1, 0, 0)
    table.add_column("effect", overflow="fold", min_width=18)
    table.add_column("number", no_wrap=True)
    table.add_column("± for 95 %", overflow="fold")
    for name in ("sure", "share", "gain"):
        table.add_column(name, justify="right", no_wrap=True)
    for cause in in_order(diagnosis.causes):
        if cause.is_correction:
            break
        numbers = significant_numbers(numbers_of(cause, timed=timed))
        figures = (percent(cause.probability), share(cause.share_of_gain_percent), share(cause.held_out_gain_percent))
        labels, values = ("\n".join(lines) for lines in ([n.label for n in numbers], [str(n) for n in numbers]))
        table.add_row(Text(place(cause).replace(" ", "\n", 1)), labels, values, *figures)
    for label, part in other_shares(diagnosis):
        table.add_row(label, "", "", "", share(part), "")
    return table


def _rejected(diagnosis: DiagnosisFile, nearest: int = 6) -> Table:
    table = _table(f"Not there (nearest of {len(diagnosis.rejected)})")
    table.add_column("effect", overflow="fold")
    table.add_column("would gain", justify="right", no_wrap=True)
    table.add_column("p-value", justify="right", no_wrap=True)
    shown = diagnosis.rejected[:nearest]
    if any(row.why for row in shown):
        table.add_column("and yet", overflow="fold")
    for row in shown:
        why = [row.why] if any(other.why for other in shown) else []
        table.add_row(Text(place(row)), f"{row.held_out_gain_percent:+.2f} %", chance(row.p_value), *why)
    return table


def _list(title: str, sentences: Sequence[str], *, numbered: bool = False) -> Group:
    grid = Table.grid(padding=(0, 1))
    grid.add_column(no_wrap=True)
    grid.add_column(overflow="fold")
    for k, sentence in enumerate(sentences, 1):
        grid.add_row(f"{k}." if numbered else "-", Text(sentence))
    return Group(Text(title, style="bold"), grid)
