from __future__ import annotations

import re
from pathlib import Path

import msgspec

from bodyschema.sim_backend import SimConfig

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "simulation.md").read_text(encoding="utf-8")


def block(language):
    return re.search(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)[1]


def test_the_pages_example_runs():
    names = {}
    exec(block("python"), names)
    assert names["frame"].t >= names["reading"].t > 0
    assert names["changed_at"] >= names["frame"].t


def test_the_pages_settings_are_the_defaults():
    tables = msgspec.toml.decode(block("toml"))["sim"]
    del tables["tool_changes"]
    assert msgspec.convert(tables, SimConfig) == SimConfig()


def test_the_page_shows_every_setting():
    shown = msgspec.toml.decode(re.sub("^# ", "", block("toml"), flags=re.MULTILINE))["sim"]
    defaults = msgspec.to_builtins(SimConfig())
    assert set(shown) == set(defaults)
    for name in ("encoders", "camera", "errors", "guide"):
        assert set(shown[name]) == set(defaults[name])
