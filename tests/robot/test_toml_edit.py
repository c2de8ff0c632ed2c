"""Values are set in robot.toml, and the rest of its text stays as people wrote it."""

from __future__ import annotations

import os
import stat
import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bodyschema.interfaces.errors import ConfigError
from bodyschema.robot.toml_text import difference, with_values, write_edited

TEXT = """# mine
[robot]
name = "arm"   # the left one

[vision.cameras]
left = "a"
latency_s = 0.0  # to be measured
# exposure_s = 0.005

[drivers]
latency_s = 7
"""


def test_values_replace_or_join_those_of_their_table(tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    file.write_text(TEXT)
    edited = with_values(file, "vision.cameras", {"latency_s": 0.034, "latency_sigma_s": 0.001})
    was, added = "latency_s = 0.0  # to be measured\n# exposure_s = 0.005\n", "latency_sigma_s = 0.001\n"
    assert edited == TEXT.replace(was, was.replace("0.0 ", "0.034 ") + added)
    assert [line for line in difference(file, edited)[2:] if line[0] in "+-"] == [
        "-latency_s = 0.0  # to be measured",
        "+latency_s = 0.034  # to be measured",
        "+latency_sigma_s = 0.001",
    ]
    assert write_edited(file, edited).read_text() == TEXT
    assert file.read_text() == edited


def test_edit_targets_first_of_several_sources(tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    file.write_text('[[marker_source]]\nkind = "udp"\n\n[[marker_source]]\nkind = "ros2"')
    edited = with_values(file, "marker_source", {"latency_s": 0.01})
    assert edited == '[[marker_source]]\nkind = "udp"\nlatency_s = 0.01\n\n[[marker_source]]\nkind = "ros2"'


@pytest.mark.parametrize(
    "text", ["[robot]\n", "[vision]\ncameras = 1\n", '[vision]\nnote = """\n[vision.cameras]\n"""\n']
)
def test_missing_table_error_says_what_to_write(tmp_path: Path, text: str) -> None:
    (tmp_path / "robot.toml").write_text(text)
    with pytest.raises(ConfigError, match="no table") as error:
        with_values(tmp_path / "robot.toml", "vision.cameras", VALUES)
    assert error.value.remedy.endswith("[vision.cameras] yourself: latency_s = 0.01, latency_sigma_s = 0.001")


@pytest.mark.parametrize("text", ["[[vision.cameras]] # mine", "[[vision.cameras]]"])
def test_ambiguous_edit_is_left_to_user(tmp_path: Path, text: str) -> None:
    (tmp_path / "robot.toml").write_text(text)
    with pytest.raises(ConfigError, match=r"\[vision\.cameras\] is written so that it cannot be edited"):
        with_values(tmp_path / "robot.toml", "vision.cameras", VALUES)


WAS = b'[vision.cameras]  # two\r\nleft = "a"\r\nlatency_s = 0.0  # mine\r\n\r\n[robot]\r\n'
BECOMES = WAS.replace(b"0.0", b"0.01").replace(b"mine\r\n", b"mine\r\nlatency_sigma_s = 0.001\r\n")
VALUES = {"latency_s": 0.01, "latency_sigma_s": 0.001}


@pytest.mark.parametrize("bom", [b"", b"\xef\xbb\xbf"])
def test_line_ends_and_byte_order_mark_stay(tmp_path: Path, bom: bytes) -> None:
    file = tmp_path / "robot.toml"
    file.write_bytes(bom + WAS)
    edited = with_values(file, "vision.cameras", VALUES)
    assert len(difference(file, edited)) == 3 + 2 + 3
    write_edited(file, edited)
    assert file.read_bytes() == bom + BECOMES


def test_unterminated_last_line_gets_file_line_ending(tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    file.write_bytes(b'[robot]\r\n[vision.cameras]\r\nleft = "a"')
    edited = with_values(file, "vision.cameras", {"latency_s": 0.01})
    assert edited == '[robot]\r\n[vision.cameras]\r\nleft = "a"\r\nlatency_s = 0.01\r\n'


@pytest.mark.parametrize(
    "text",
    [
        "[vision.cameras]\nm = [\n[1, 2],\n  [3, 4],\n]\nlatency_s = 0.0\n",
        '[vision.cameras]\n"latency_s" = 0.0\n[robot]\n',
        "[vision.'cameras']\n'latency_s' = 0.0\n[robot]\n",
        '[robot]\nnote = """\n[vision.cameras]\nlatency_s = 1\n"""\n[vision.cameras]\nnote = "["\n',
        "[vision.cameras]\nlatency_s = [\n0.1,\n]\n",
        '[vision.cameras]\n"latency\\u005fs" = 0.1\n',
        'vision = {cameras = {left = "a"}}\n',
        "[vision]\ncameras.left = 1\n",
    ],
)
def test_arrays_strings_and_quoted_keys_follow_toml(tmp_path: Path, text: str) -> None:
    (tmp_path / "robot.toml").write_text(text)
    expected = tomllib.loads(text)
    expected["vision"]["cameras"] |= VALUES
    assert tomllib.loads(with_values(tmp_path / "robot.toml", "vision.cameras", VALUES)) == expected


def test_links_permissions_and_earlier_backups_stay(tmp_path: Path) -> None:
    (tmp_path / "shared").mkdir()
    target, link = tmp_path / "shared" / "left.toml", tmp_path / "robot.toml"
    target.write_text(TEXT)
    target.chmod(0o640)
    link.symlink_to(target)
    earlier = tmp_path / "shared" / "left.toml.before"
    earlier.write_text("mine")
    backup = write_edited(link, "[robot]\n")
    assert os.readlink(link) == str(target)
    assert (target.read_text(), backup.read_text(), earlier.read_text()) == ("[robot]\n", TEXT, "mine")
    assert {stat.S_IMODE(file.stat().st_mode) for file in (target, backup)} == {0o640}
    assert backup.name == "left.toml.before2"


def test_each_line_of_mixed_ends_keeps_its_own(tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    head = b'[robot]\nname = "arm"\r\n\n[vision.cameras]\r\nleft = "a"\n'
    file.write_bytes(head + b"latency_s = 0.0\r\n# last\r\n[drivers]\n")
    write_edited(file, with_values(file, "vision.cameras", VALUES))
    assert file.read_bytes() == head + b"latency_s = 0.01\r\n# last\r\nlatency_sigma_s = 0.001\r\n[drivers]\n"


@given(st.lists(st.tuples(st.sampled_from(["", "# a", "a = 1", "bb = 2"]), st.booleans()), max_size=9), st.booleans())
def test_line_ends_of_other_lines_never_change(tmp_path_factory, lines, ends_in_line_end) -> None:
    file = tmp_path_factory.mktemp("ends") / "robot.toml"
    seen: list[str] = []
    for line, windows in lines:
        if not (line and line[0] != "#" and line in "".join(seen)):
            seen.append(line + ("\r\n" if windows else "\n"))
    text = "[table]\n" + "".join(seen) + ("" if ends_in_line_end else "# end")
    file.write_bytes(text.encode())
    assert with_values(file, "table", {}) == text
    edited = with_values(file, "table", {"new": 1})
    added = [line for line in edited.splitlines() if line == "new = 1"]
    assert len(added) == 1
    rest = edited.replace("new = 1\r\n", "").replace("new = 1\n", "").replace("new = 1", "")
    assert rest.rstrip("\r\n") == text.rstrip("\r\n")
