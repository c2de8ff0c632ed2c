"""Statements of the README are true."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from typed_pages import command_of

from bodyschema.cli.hardware.emulator_run import EmulatorRun
from bodyschema.cli.main import COMMANDS, RENAMED, command_line
from bodyschema.daemon.config import Config

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_library_page_s_python_runs() -> None:
    [code] = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "library.md").read_text(encoding="utf-8"), re.DOTALL)
    scope: dict[str, object] = {}
    exec(code, scope)
    assert "learnt" in scope


def test_the_readme_has_at_most_600_words() -> None:
    assert len(README.split()) <= 600


@pytest.mark.parametrize("target", sorted(set(re.findall(r"\]\(([^)#:]+)\)", README))))
def test_what_the_readme_links_to_is_there(target: str) -> None:
    assert (ROOT / target).exists()


@pytest.mark.parametrize("target", sorted(set(re.findall(r"^make ([a-z]+)$", README, re.MULTILINE))))
def test_the_readme_s_make_targets_exist(target: str) -> None:
    assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)


def test_the_page_of_commands_has_them_all() -> None:
    page = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| `bodyschema (\w+)` \| (.*) \|$", page, re.MULTILINE) == list(COMMANDS.items())


@pytest.mark.parametrize("command", re.findall(r"^\.venv/bin/(bodyschema .*)$", README, re.MULTILINE))
def test_every_command_in_the_readme_is_understood(command: str) -> None:
    assert command_of(command).startswith("bodyschema.cli.commands.")  # not that of a help page


@pytest.mark.usefixtures("patient_host")
def test_real_arm_commands_work_on_emulated_servos(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Run the README's commands on an emulated arm: the port and one baud rate are given, and there are no prompts."""
    with EmulatorRun(Config.load(ROOT / "examples" / "desk_arm" / "servos.toml", {}), tmp_path / "bus") as run:
        port = ["--port", str(tmp_path / "bus"), "--baud", "1000000"]
        urdf, robot = str(ROOT / "examples" / "desk_arm" / "desk_arm.urdf"), str(tmp_path / "robot.toml")
        for words in (
            ["scan", *port],
            ["init", "--urdf", urdf, "--from", "scan", *port, "--robot", robot, "--yes"],
            ["scan", *port, "--robot", robot],
            ["doctor", "--robot", str(run.robot_file)],
            ["watch", "joints", "--robot", robot, "--once"],
        ):
            command_line(words[0])(words, exit_on_error=False, result_action="return_value")
    shown = capsys.readouterr().out
    assert "4 servos found." in shown
    assert "4 servos: those of robot.toml, all of them." in shown
    assert "no other program has it open" in shown


PAGES = sorted((ROOT / "docs").rglob("*.md"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_what_a_page_links_to_is_there(page: Path) -> None:
    for target in set(re.findall(r"\]\(([^):]+)\)", page.read_text(encoding="utf-8"))):
        file, _, heading = target.partition("#")
        linked = page.parent / file if file else page
        assert linked.exists(), target
        assert not heading or heading in anchors(linked), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_page_names_only_commands_of_today(page: Path) -> None:
    """Check code between backticks, which may go over the end of a line, and the lines of code blocks."""
    text = page.read_text(encoding="utf-8")
    blocks = "\n".join(re.findall(r"^```.*?^```", text, re.MULTILINE | re.DOTALL))
    typed = re.findall(r"^(?:\$ )?(?:\.venv/bin/)?bodyschema (.*)$", blocks, re.MULTILINE)
    code = re.findall(r"(?<!`)`(?!`)([^`]+)`(?!`)", re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL))
    named = [words.removeprefix("bodyschema ") for words in code if words.startswith("bodyschema ")]
    for words in (line.split() for line in [*typed, *named]):
        assert words[0] in COMMANDS or words[0].startswith("-"), words
    for words in (tuple(line.split()) for line in [*typed, *named, *code]):
        # Many things are called like a former command of one word.
        assert not any(len(name) > 1 and words[: len(name)] == name for name in RENAMED), words


def anchors(page: Path) -> list[str]:
    """Return the anchors of a page: its headings, and former ones kept as `<a id="...">`."""
    text = page.read_text(encoding="utf-8")
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    kept = re.findall(r'^<a id="([\w-]+)"></a>$', text, re.MULTILINE)
    return [re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings] + kept
