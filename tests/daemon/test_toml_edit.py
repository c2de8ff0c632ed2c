"""Values are set in robot.toml, and the rest of its text stays as people wrote it."""

from __future__ import annotations

from pathlib import Path

import pytest

from bodyschema.interfaces.errors import ConfigError
from bodyschema.robot.toml_edit import difference, with_values, write_edited

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


def test_a_source_among_several_is_edited_in_the_first(tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    file.write_text('[[marker_source]]\nkind = "udp"\n\n[[marker_source]]\nkind = "ros2"')
    edited = with_values(file, "marker_source", {"latency_s": 0.01})
    assert edited == '[[marker_source]]\nkind = "udp"\nlatency_s = 0.01\n\n[[marker_source]]\nkind = "ros2"'


@pytest.mark.parametrize("text", ["[robot]\n", 'vision = {cameras = {left = "a"}}\n', "[vision]\ncameras.left = 1\n"])
def test_a_table_that_is_not_there_is_told(tmp_path: Path, text: str) -> None:
    (tmp_path / "robot.toml").write_text(text)
    with pytest.raises(ConfigError, match="no table"):
        with_values(tmp_path / "robot.toml", "vision.cameras", {"latency_s": 0.01})
