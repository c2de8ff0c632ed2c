from __future__ import annotations

import io
from types import SimpleNamespace
from typing import cast

import pytest
from rich.console import Console

from daemon.demo import view
from daemon.demo.play import Snapshot


def snapshot(pairs: int) -> Snapshot:
    learner = SimpleNamespace(pairs=pairs, answering="rigid", prequential_m={"rigid": 0.3456}, claimed_error_m=0.2345)
    told = SimpleNamespace(phase="guided", target=900, learner=learner, verdict=SimpleNamespace(error_m=0.1234))
    return cast(Snapshot, told)


@pytest.fixture
def lines(monkeypatch):
    monkeypatch.setattr(view, "PLAIN_EVERY_S", 0.0)
    console = Console(file=io.StringIO(), width=200, force_terminal=False, record=True)

    def shown(*pairs: int) -> list[str]:
        with view.shown_on(console) as show:
            for number in pairs:
                show(snapshot(number))
        return console.export_text().splitlines()

    return shown


def test_without_a_terminal_the_demo_says_nothing_twice(lines) -> None:
    assert len(lines(10, 10, 10, 20)) == 1 + 2


def test_without_a_terminal_the_demos_lines_fit_80_columns(lines) -> None:
    assert max(len(line) for line in lines(900)) < 80
