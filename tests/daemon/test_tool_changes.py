"""What the learner says of a change of the tool."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from guided_arm import Scene, measured, new_learning, path, teach

from daemon.status import ToolChange
from daemon.tool_changes import ToolChanges

OTHER_TOOL = [0.0, 0.15, 0.2]


def test_a_change_that_the_pairs_show_is_logged_and_kept_with_the_first_pair_of_the_other_tool(caplog) -> None:
    caplog.set_level(logging.INFO)
    scene, rng, learning = Scene.draw(0, 200), np.random.default_rng(0), new_learning()
    changes = ToolChanges(learning.counters)
    q = scene.q[-1] + path(rng, 50)
    for pair in [*scene.pairs, *measured(scene.chain.with_tool(OTHER_TOOL), q, rng, first=201)]:
        teach(learning, [pair])
        changes.note(learning.counters, found=True)
    assert changes.last is not None
    assert changes.last.found
    assert 201 <= changes.last.first_seq <= 206
    assert [r.getMessage() for r in caplog.records] == [f"tool changed at pair {changes.last.first_seq} (found)"]


@pytest.fixture
def after_a_told_change() -> tuple[ToolChanges, object]:
    scene, learning = Scene.draw(0, 20), new_learning()
    changes = ToolChanges(learning.counters)
    teach(learning, scene.pairs, background=False)
    learning.tool_changed()
    changes.note(learning.counters, found=False)
    return changes, learning


def test_a_told_change_is_from_the_next_pair_on(after_a_told_change) -> None:
    assert after_a_told_change[0].last == ToolChange(first_seq=21, found=False)


def test_after_a_new_beginning_there_was_no_change(after_a_told_change) -> None:
    changes, learning = after_a_told_change
    learning.reset_to_prior()
    changes.forget(learning.counters)
    changes.note(learning.counters, found=True)
    assert changes.last is None
