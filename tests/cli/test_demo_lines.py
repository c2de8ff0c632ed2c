from __future__ import annotations

import io
from types import SimpleNamespace
from typing import cast

import pytest
from rich.console import Console

from bodyschema.cli.demo import view
from bodyschema.cli.demo.play import Snapshot, stalled
from bodyschema.daemon.transport.status import SamplerStatus


def snapshot(pairs: int, angle_rad: float | None = None) -> Snapshot:
    learner = SimpleNamespace(pairs=pairs, answering="rigid", prequential_m={"rigid": 0.3456}, claimed_error_m=0.2345)
    verdict = SimpleNamespace(error_m=0.1234, angle_rad=angle_rad)
    told = SimpleNamespace(phase="guided", target=900, learner=learner, verdict=verdict)
    return cast(Snapshot, told)


@pytest.fixture
def lines(monkeypatch):
    monkeypatch.setattr(view.ScreenSettings, "tell_every_s", 0.0)
    console = Console(file=io.StringIO(), width=200, force_terminal=False, record=True)

    def shown(*pairs: int, angle_rad: float | None = None) -> list[str]:
        with view.shown_on(console) as show:
            for number in pairs:
                show(snapshot(number, angle_rad))
        return console.export_text().splitlines()

    return shown


def test_without_a_terminal_the_demo_says_nothing_twice(lines) -> None:
    assert len(lines(10, 10, 10, 20)) == 1 + 2


def test_demo_lines_without_terminal_fit_80_columns(lines) -> None:
    assert max(len(line) for line in lines(900)) < 80


def test_demo_lines_show_held_out_angle_with_orientations(lines) -> None:
    said = lines(900, angle_rad=0.0123)
    assert "held out 123 mm 0.705°" in said[-1]
    assert max(len(line) for line in said) < 80


def test_stalled_demo_reports_rejected_frames() -> None:
    sampler = cast(SamplerStatus, SimpleNamespace(frames=217, rejected={"not_new": 2, "no_marker": 215}))
    assert "has seen 217 frames, 215 rejected: no marker, 2 rejected: not new." in stalled(sampler)
