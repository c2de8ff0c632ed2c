"""Write the report as one self-contained page: verdict, figures, causes with evidence, hypotheses, and method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from itertools import zip_longest
from pathlib import Path

import numpy as np

from bodyschema.diagnosis.diagnosis import Diagnosis
from bodyschema.diagnosis.report.numbers import chance, identifiable_values, mm, share
from bodyschema.diagnosis.report.presenters.outliers import outlier_panel
from bodyschema.diagnosis.report.presenters.registry import presenter_of
from bodyschema.diagnosis.report.result import Cause, DiagnosisFile, Gain, Verdict
from bodyschema.diagnosis.report.text import actions, corrections, finding, in_order, modelled, tolerance_sentence
from bodyschema.effects import Effect

from . import tables
from .panels import Panel, arrows, error_panels, histogram
from .residuals import Residuals

_STYLE = (Path(__file__).parent / "page.css").read_text(encoding="utf-8")
_VERDICTS: dict[Verdict, tuple[str, str]] = {
    "explained": ("Explained", "Apart from noise and small errors everywhere, the whole error has named causes."),
    "nothing_found": ("Nothing found", "What is left of the error is noise: there is nothing to correct."),
    "undecided": (
        "Undecided",
        "What was found describes the error, but this recording cannot tell some of it from other causes. See below "
        "which, and which motion would.",
    ),
    "unexplained": (
        "Not all explained",
        "Something acts on this arm that is not among the known effects. Take the causes as a description, and change "
        "nothing on the robot because of them alone.",
    ),
}


class _Settings:
    named_rows = 40  # maximum of outlier rows listed by number
    open_causes = 4  # number of causes shown with their plots; further and small ones are collapsed


@dataclass(frozen=True)
class About:
    """Names of the recording and the robot, and the version that made the report."""

    recording: str
    robot: str
    version: str


def page(diagnosis: Diagnosis, file: DiagnosisFile, remedies: Sequence[str], about: About) -> str:
    """Return the page as HTML.

    Args:
        remedies: the remedy of each cause, in the order of `remedies()`.
    """
    residuals = Residuals(diagnosis)
    body = [
        _head(file, about),
        _glance(residuals, file),
        _causes(residuals, file, remedies),
        _tolerances(file),
        _advice(file),
        _where(residuals),
        _against(residuals),
        _hypotheses(file),
        _limits(file),
        _done(diagnosis, file, about),
    ]
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(about.robot)}: diagnosis of {escape(about.recording)}</title><style>{_STYLE}</style></head>"
        f"<body><main>{''.join(body)}</main></body></html>\n"
    )


def _head(file: DiagnosisFile, about: About) -> str:
    name, meaning = _VERDICTS[file.verdict]
    found, _, figures = file.sentence.rstrip(".").partition(". ")
    return (
        f'<header><p class="of">{escape(about.robot)} · {escape(about.recording)} · {file.pairs.total:,} samples</p>'
        f'<h1><span class="verdict {file.verdict}">{name}</span> {escape(found)}.</h1>'
        f"<p>{escape(figures)}{'. ' if figures else ''}{meaning}</p>{_unexplained(file)}</header>"
    )


def _unexplained(file: DiagnosisFile) -> str:
    left = file.unexplained
    if not left.depends_on:
        return ""
    return (
        f"<p>About <b>{mm(left.rms_mm)} mm</b> (RMS) is left that fits no known effect. It depends on "
        f"<b>{escape(', '.join(left.depends_on))}</b>; by chance that much is as improbable as p "
        f"{_equals(left.p_value)}.</p>{f'<ul>{_items(left.what)}</ul>' if left.what else ''}"
        f"<p>{escape(modelled(left))}</p>"
    )


def _equals(p: float) -> str:
    text = chance(p)
    return text if text.startswith("<") else f"= {text}"


def _gain_with_outliers(gain: Gain) -> str:
    if gain.with_outliers_percent is None or gain.with_outliers_ci95 is None:
        return ""
    low, high = map(share, gain.with_outliers_ci95)
    return f"; with them the gain is {share(gain.with_outliers_percent)} ({low} to {high})"


def _glance(residuals: Residuals, file: DiagnosisFile) -> str:
    rms, gain = file.rms_mm, file.gain
    tiles = [
        (f"{mm(rms.aligned)} → {mm(rms.extended)} mm", "RMS before → after"),
        (share(gain.held_out_percent), f"gain, held out ({share(gain.ci95[0])} to {share(gain.ci95[1])})"),
        (f"{mm(rms.noise_floor)} mm", "noise alone (RMS)"),
        (
            f"{file.pairs.outliers:,} of {file.pairs.total:,}",
            f"fixes that are not the marker{_gain_with_outliers(gain)}",
        ),
    ]
    items = "".join(f"<div><b>{value}</b><span>{escape(label)}</span></div>" for value, label in tiles)
    return (
        f'<section><div class="tiles">{items}</div><div class="beside"><div>{_panels([histogram(residuals)])}</div>'
        f"<div>{tables.errors(file)}</div></div></section>"
    )


def _causes(residuals: Residuals, file: DiagnosisFile, remedies: Sequence[str]) -> str:
    if not file.causes:
        return ""
    # Outliers come last and have no effect.
    effects = {id(cause): effect for cause, effect in zip_longest(file.causes, residuals.diagnosis.causes)}
    ordered = in_order(file.causes)
    articles = [
        _cause(
            residuals, cause, effects[id(cause)], remedy, file, opened=k < _Settings.open_causes and not cause.is_small
        )
        for k, (cause, remedy) in enumerate(zip(ordered, remedies, strict=True))
    ]
    if more := sum(cause.is_correction for cause in ordered):
        folded = "".join(articles[-more:])
        articles[-more:] = [f"<details><summary>{corrections(more).capitalize()}</summary>{folded}</details>"]
    return (
        f'<section id="causes"><h2>Causes</h2>{tables.causes(file, timed=residuals.timed)}'
        '<p class="key">In the plots: pale dots are single samples, strong dots their means with 95 % intervals, the '
        f'<span class="fitted">line</span> what was fitted.</p>{"".join(articles)}</section>'
    )


def _cause(
    residuals: Residuals, cause: Cause, effect: Effect | None, remedy: str, file: DiagnosisFile, *, opened: bool
) -> str:
    numbers, seen_by, timed = identifiable_values(cause), file.seen_by, residuals.timed
    said = finding(cause.effect, cause.where, cause.source, numbers, seen_by, timed=timed, weighed=file.weighed)
    plot = outlier_panel(residuals) if effect is None else presenter_of(effect.name).panel(residuals, effect)
    state = " open" if opened else ""
    return (
        f'<details class="cause"{state}><summary>{escape(said[0].upper() + said[1:])}</summary><div class="beside">'
        f"{_panels([plot])}<div><p>{tables.numbers(cause, timed=residuals.timed)}</p><p>{escape(cause.evidence)}</p>"
        f"{tables.rivals(cause, file.seen_by)}<p><b>What to do.</b> {escape(remedy)}</p></div></div></details>"
    )


def _tolerances(file: DiagnosisFile) -> str:
    if file.tolerances is None:
        return ""
    use = actions(file, [])[0]
    text = " ".join([tolerance_sentence(file.tolerances, file.seen_by), *use])
    return f'<section id="tolerances"><p>{escape(text)}</p></section>'


def _advice(file: DiagnosisFile) -> str:
    if not file.advice:
        return ""
    return f'<section id="next"><h2>What to measure next</h2><ul>{_items(file.advice)}</ul></section>'


def _where(residuals: Residuals) -> str:
    views, stretch = arrows(residuals)
    return (
        '<section id="where"><h2>Where the marker is, and where it should be</h2>'
        f"<p>From where the simulation expects it (dot) to where it was measured, {stretch:g} times as long as it is. "
        f'{_KEY}</p><div class="views">{_panels(views)}</div></section>'
    )


_KEY = '<span class="before">■ before</span> <span class="after">■ after</span>, on data not used in the fit.'


def _against(residuals: Residuals) -> str:
    found = error_panels(residuals)
    telling = [panel for panel in found if panel.is_significant]
    silent = [panel for panel in found if not panel.is_significant]
    shown = f'<div class="panels">{_panels(telling)}</div>' if telling else "<p>Nothing: the error depends on none.</p>"
    folded = ""
    if silent:
        folded = (
            f"<details><summary>Plots without a visible trend: {len(silent)}</summary>"
            f'<div class="panels">{_panels(silent)}</div></details>'
        )
    return (
        f'<section id="against"><h2>What the error depends on</h2><p>{_KEY} Pale dots are single samples, strong dots '
        "means with 95 % intervals. An error along a joint is counted on the way on which that joint moves the "
        f"marker.</p>{shown}{folded}</section>"
    )


def _hypotheses(file: DiagnosisFile) -> str:
    if not file.rejected:
        return ""
    return (
        '<section id="hypotheses"><h2>What it is not</h2><p>By how much the squared error on data not used in the fit '
        f"would fall with each of these beside the causes, and how probable this is by chance, corrected for their "
        f"number.</p>{tables.hypotheses(file.rejected)}</section>"
    )


def _limits(file: DiagnosisFile) -> str:
    if not file.limitations:
        return ""
    return f'<section id="limits"><h2>What this recording cannot show</h2><ul>{_items(file.limitations)}</ul></section>'


def _done(diagnosis: Diagnosis, file: DiagnosisFile, about: About) -> str:
    away = np.flatnonzero(~diagnosis.markers) + 1
    rows = ", ".join(str(k) for k in away[: _Settings.named_rows]) + (" …" if len(away) > _Settings.named_rows else "")
    left_out = f"<p>Rows left out: {rows}.</p>" if len(away) else ""
    return (
        '<section id="method"><h2>What was done</h2>'
        f"<p>{len(diagnosis.hypotheses.effects)} hypotheses, each effect at each place where it can sit, were tried "
        "as extensions of the simulation, alone and beside each other. Their numbers were fitted to all samples "
        "together by maximum likelihood, with a share of outliers. An effect was added if it made the data "
        "more probable by more than its freedom and the number of trials explain, and removed when others made it "
        "redundant. Every "
        f"error on this page is of held-out samples: {diagnosis.blocks.count} blocks of time, left out in turn. "
        f"Intervals of gains are from a bootstrap over blocks: neighbouring samples are not independent.</p>{left_out}"
        f'<p class="of">bodyschema {escape(about.version)}, {file.pairs.total:,} samples of {escape(about.recording)}, '
        f"seed {diagnosis.seed}.</p></section>"
    )


def _panels(found: Sequence[Panel]) -> str:
    return "".join(panel.html() for panel in found)


def _items(sentences: Sequence[str]) -> str:
    return "".join(f"<li>{escape(sentence)}" for sentence in sentences)
