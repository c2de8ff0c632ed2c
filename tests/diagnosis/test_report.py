"""report.html of planted causes: well-formed, self-contained and complete."""

from __future__ import annotations

import dataclasses
import re
from html import escape
from html.parser import HTMLParser

import msgspec
import numpy as np
import pytest
from walked import DESK_ARM, walked

from bodyschema.diagnosis.diagnosis import Diagnosis, diagnose
from bodyschema.diagnosis.fit.observations import encoder_steps
from bodyschema.diagnosis.report.conclusion import conclusion
from bodyschema.diagnosis.report.page import About, page
from bodyschema.diagnosis.report.presenters.registry import presenter_of
from bodyschema.diagnosis.report.residuals import Residuals, binned, structure
from bodyschema.diagnosis.report.result import DiagnosisFile, Interval
from bodyschema.diagnosis.report.svg_plot import round_up
from bodyschema.diagnosis.report.svg_plot import ticks as axis_ticks
from bodyschema.diagnosis.report.text import remedies
from bodyschema.effects import EFFECT_TYPES, Effect, Simulation
from bodyschema.robot.description import RobotDescription

ABOUT = About("<samples> & more.csv", "desk", "1.2.3")
VOID = {"meta", "br", "rect", "path", "line", "polyline", "polygon", "circle"}
# May be left open in HTML.
OPTIONAL = {"p", "li", "tr", "td", "th", "thead", "tbody"}


@pytest.fixture(scope="module")
def robot() -> RobotDescription:
    return RobotDescription.load(DESK_ARM)


@pytest.fixture(scope="module")
def planted(robot) -> Diagnosis:
    jump = Effect.at(robot, "encoder_jump", robot.joints[0], values={"jump_rad": 0.02, "t0": 40.0})
    scale = Effect.at(robot, "joint_scale", robot.joints[2], values={"scale_error": 0.02})
    recording = walked(robot, jump, scale)
    x = recording.x.copy()
    x[20::40] += 0.2
    return diagnose(dataclasses.replace(recording, x=x), Simulation(robot), only=("encoder_jump", "joint_scale"))


@pytest.fixture(scope="module")
def file(planted) -> DiagnosisFile:
    return conclusion(planted)


def advice_on(diagnosis: Diagnosis, file: DiagnosisFile) -> list[str]:
    robot = diagnosis.nominal.simulation.robot
    return remedies(file, robot, encoder_steps(diagnosis.extended.run.motion.q), np.zeros(len(robot.joints)))


@pytest.fixture(scope="module")
def html(planted, file) -> str:
    return page(planted, file, advice_on(planted, file), ABOUT)


class Nesting(HTMLParser):
    """Parser that collects elements not closed in order, and the references of elements."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.wrong: list[str] = []
        self.attributes: list[tuple[str, str | None]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += attrs
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += attrs

    def handle_endtag(self, tag: str) -> None:
        while self.open and self.open[-1] != tag and self.open[-1] in OPTIONAL:
            self.open.pop()
        if not self.open or self.open.pop() != tag:
            self.wrong.append(tag)


def parsed(html: str) -> Nesting:
    nesting = Nesting()
    nesting.feed(html)
    nesting.close()
    return nesting


def test_every_element_is_closed_in_its_order(html) -> None:
    nesting = parsed(html)
    assert (nesting.wrong, nesting.open) == ([], [])


def test_nothing_is_loaded_from_elsewhere(html) -> None:
    names = {name for name, _ in parsed(html).attributes}
    assert names & {"src", "href", "srcset", "xlink:href", "data", "action"} == set()
    assert re.findall(r"https?:|//\w|url\(|@import|<script|<link|<iframe", html) == []


def test_no_figure_is_not_a_number(html) -> None:
    assert re.findall(r"\bnan\b|\binf\b", re.sub(r"<style>.*?</style>", "", html, flags=re.DOTALL)) == []


def test_every_cause_is_named(planted, file, html) -> None:
    assert {cause.effect for cause in file.causes} == {"encoder_jump", "joint_scale", "outliers"}
    for cause in file.causes:
        assert f"{cause.effect}{'' if cause.where is None else f' at {cause.where}'}" in html


def test_every_remedy_is_given(planted, file, html) -> None:
    for remedy in advice_on(planted, file):
        assert escape(remedy) in html


def test_jump_time_is_marked_in_time_plots(html) -> None:
    assert "Over time" in html
    assert html.count('class="moment"') == 3


def test_names_from_outside_are_text(html) -> None:
    assert "<pairs>" not in html
    assert "&lt;samples&gt; &amp; more.csv" in html


def test_report_states_version_and_seed(html) -> None:
    assert "bodyschema 1.2.3" in html
    assert "seed 0" in html


def test_a_report_is_less_than_a_megabyte(html) -> None:
    assert len(html.encode()) < 1_000_000


def test_stylesheet_covers_dark_mode_small_screens_and_print(html) -> None:
    for rule in ("prefers-color-scheme:dark", "max-width:720px", "@media print", 'name="viewport"'):
        assert rule in html


@pytest.mark.parametrize(
    ("verdict", "words"),
    [("explained", "Explained"), ("nothing_found", "Nothing found"), ("undecided", "Undecided"),
     ("unexplained", "Not all explained")],
)  # fmt: skip
def test_verdicts_look_different(planted, file, verdict, words) -> None:
    other = msgspec.structs.replace(file, verdict=verdict)
    assert f'<span class="verdict {verdict}">{words}</span>' in page(planted, other, advice_on(planted, file), ABOUT)


def test_report_without_findings_has_no_causes_section(robot) -> None:
    found = diagnose(walked(robot), Simulation(robot), only=("backlash",))
    html = page(found, conclusion(found), [], ABOUT)
    assert 'id="causes"' not in html
    assert parsed(html).wrong == []


PLACES = [
    (kind.name, 1 if kind.at_joint else None, 2 if kind.takes_source else None)
    for kind in EFFECT_TYPES.values()
]  # fmt: skip


@pytest.mark.parametrize(("name", "where", "source"), PLACES)
def test_every_effect_has_a_plot_and_a_remedy(robot, planted, file, name, where, source) -> None:
    joints = robot.joints
    at = (None if where is None else joints[where], None if source is None else joints[source])
    effect = Effect.at(robot, name, *at)
    values = np.array([0.1 * p.usual if p.is_amount else p.usual for p in effect.parameters])
    if effect.kind.begins:
        values[-1] = 50.0
    effect = effect.with_values(values)
    fit = planted.extended.with_causes([effect])
    panel = presenter_of(name).panel(Residuals(dataclasses.replace(planted, extended=fit)), fit.causes[0])
    assert "<path" in panel.svg
    assert "nan" not in panel.svg
    parameters = {p.name: Interval(v, (v, v)) for p, v in zip(effect.parameters, effect.values.tolist(), strict=True)}
    extra = {"amplitude_rad": Interval(0.1, (0.1, 0.1)), "phase_rad": Interval(0.2, (0.2, 0.2))}
    known = next(cause for cause in file.causes if cause.effect == "joint_scale")
    cause = msgspec.structs.replace(
        known,
        effect=name,
        where=at[0],
        source=at[1],
        parameters=parameters | (extra if "sine_rad" in parameters else {}),
    )
    told = remedies(msgspec.structs.replace(file, causes=(cause,)), robot, np.zeros(len(joints)), np.zeros(len(joints)))
    assert len(told[0]) > 20


def test_bins_of_a_step_function_have_its_values() -> None:
    x = np.repeat([0.0, 1.0, 2.0], 50)
    assert binned(x, 3.0 * x).y.tolist() == [0.0, 3.0, 6.0]


def test_structure_is_the_variance_share_explained_by_x() -> None:
    rng = np.random.default_rng(5)
    x = rng.uniform(size=4000)
    assert structure(x, np.sin(6.0 * x) + 1e-3 * rng.normal(size=4000)) > 0.95
    assert structure(x, rng.normal(size=4000)) == 0.0


def test_ticks_are_round() -> None:
    assert axis_ticks(-0.6, 1.02) == pytest.approx([-0.5, 0.0, 0.5, 1.0])
    assert round_up(0.03) == pytest.approx(0.05)
