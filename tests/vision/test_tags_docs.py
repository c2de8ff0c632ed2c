"""docs/tags.md agrees with the code."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec

from bodyschema.interfaces.records import Reason
from bodyschema.vision.config import VisionConfig
from bodyschema.vision.tags.body import TagBody
from bodyschema.vision.tags.config import TagConfig
from bodyschema.vision.tags.settings import EdgeSettings, TagSettings

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "tags.md").read_text(encoding="utf-8")
TABLES = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)


def test_the_page_shows_every_setting_with_its_default() -> None:
    assert msgspec.toml.decode(TABLES[0])["vision"]["tag"] == msgspec.to_builtins(TagConfig())


def test_the_limits_on_the_page_are_the_trackers() -> None:
    assert f"less certain than {100 * TagSettings.max_corner_sigma:g} % of the side" in PAGE
    assert f"differ by less than {EdgeSettings.min_contrast:g} grey levels" in PAGE


def test_the_page_s_cluster_is_one() -> None:
    vision = msgspec.convert(msgspec.toml.decode(TABLES[1])["vision"], VisionConfig)
    assert list(TagBody.cluster(vision.cluster, vision.tag).corners) == [0, 1]


def test_page_lists_every_reason_of_tag_tracker() -> None:
    files = (
        ROOT / "vision" / name
        for name in ("tags/edge.py", "tags/image.py", "tags/bleed.py", "tags/finder.py", "tags/tracker.py", "pose.py")
    )
    given = {Reason[name].value for file in files for name in re.findall(r"\bReason\.([A-Z_]+)", file.read_text())}
    assert given == set(re.findall(r"^\| `(\w+)` \|", PAGE, re.MULTILINE))
