from __future__ import annotations

import re
from pathlib import Path

import msgspec
import pytest

from bodyschema.interfaces.records import MarkerMiss, Reason
from bodyschema.vision.ball.settings import PatchSettings, TrackSettings
from bodyschema.vision.config import NAMED_COLOURS, HueBand

ROOT = Path(__file__).resolve().parents[2]
PAGE, METHOD = ((ROOT / "docs" / name).read_text(encoding="utf-8") for name in ("vision.md", "vision_method.md"))


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


def test_the_pages_example_runs(capsys):
    names: dict = {}
    exec(blocks("python")[0], names)
    assert names["answer"] == MarkerMiss(0.0, Reason.NO_MARKER)
    assert capsys.readouterr().out.strip() in blocks("python")[0]


def test_page_shows_every_hue_band_setting_with_default():
    shown = msgspec.toml.decode(blocks("toml")[0])["vision"]["colour"]
    assert shown == msgspec.to_builtins(HueBand(shown["hue_deg"]))


def test_the_page_names_every_colour():
    sentence = next(line for line in PAGE.splitlines() if "`colour` (" in line)
    assert all(colour in sentence for colour in NAMED_COLOURS)


def test_the_limits_on_the_page_are_the_trackers():
    assert f"no patch of the colour of {PatchSettings.min_pixels} pixels" in PAGE
    assert f"closer than {PatchSettings.border_px:g} pixels to the border" in PAGE
    assert "less than three quarters of the outline" in PAGE
    assert PatchSettings.min_visible == 0.75
    assert f"less certain than {PatchSettings.max_sigma_px:g} px" in PAGE
    assert f"farther away than {TrackSettings.fastest_m_s:g} m/s allows" in PAGE


def test_page_lists_every_reason_of_the_tracker():
    files = [file for folder in ("", "ball", "tags") for file in (ROOT / "vision" / folder).glob("*.py")]
    sources = "".join(file.read_text(encoding="utf-8") for file in files)
    given = {Reason[name].value for name in re.findall(r"\bReason\.([A-Z_]+)", sources)}
    assert given == set(re.findall(r"^\| `(\w+)` \|", PAGE, re.MULTILINE)) & set(Reason)


@pytest.mark.parametrize("file", re.findall(r"`([\w/]+\.py)`", PAGE + METHOD))
def test_every_module_that_the_pages_name_exists(file):
    assert (ROOT / "vision" / file).is_file()
