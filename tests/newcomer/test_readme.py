"""What the README shows is true."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from daemon.cli import COMMANDS

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("code", re.findall(r"```python\n(.*?)```", README, re.DOTALL))
def test_the_readme_s_python_runs(code: str) -> None:
    scope: dict[str, object] = {}
    exec(code, scope)
    assert "learnt" in scope


@pytest.mark.parametrize("target", sorted(set(re.findall(r"\]\(([^)#:]+)\)", README))))
def test_what_the_readme_links_to_is_there(target: str) -> None:
    assert (ROOT / target).exists()


@pytest.mark.parametrize("target", sorted(set(re.findall(r"^make ([a-z]+)$", README, re.MULTILINE))))
def test_the_readme_s_make_targets_exist(target: str) -> None:
    assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)


def test_the_readme_lists_every_command_with_its_own_words() -> None:
    assert re.findall(r"^\| `bodyschema (\w+)` \| (.*) \|$", README, re.MULTILINE) == list(COMMANDS.items())


PAGES = sorted((ROOT / "docs").rglob("*.md"))
LINKS = [
    pytest.param(page, target, id=f"{page.name}:{target}")
    for page in PAGES
    for target in sorted(set(re.findall(r"\]\(([^):]+)\)", page.read_text(encoding="utf-8"))))
]


@pytest.mark.parametrize(("page", "target"), LINKS)
def test_what_a_page_links_to_is_there(page: Path, target: str) -> None:
    file, _, heading = target.partition("#")
    linked = page.parent / file if file else page
    assert linked.exists()
    assert not heading or heading in anchors(linked)


def anchors(page: Path) -> list[str]:
    """Of a page's headings, as they are linked to."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return [re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings]
