"""docs/marker_sources.md: its tables are read and its sender is understood."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from test_marker_wires import first_fix, free_udp_port, opened

from bodyschema.drivers.markers.config import TABLE, source_tables
from bodyschema.drivers.markers.report import Fault
from bodyschema.robot.toml_file import read_toml

PAGE = Path(__file__).parents[2] / "docs" / "marker_sources.md"
TEXT = PAGE.read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", TEXT, re.DOTALL | re.MULTILINE)


def test_every_table_is_valid(tmp_path) -> None:
    kinds = []
    for number, block in enumerate(blocks("toml")):
        file = tmp_path / f"{number}.toml"
        file.write_text(block)
        tables, text = read_toml(file)
        if TABLE in tables:
            kinds += [source.kind for source in source_tables(tables[TABLE], file, text)]
    assert kinds == ["udp", "natnet", "ros2", "natnet", "udp"]


def test_sender_of_the_page_is_understood(tmp_path) -> None:
    [sender] = blocks("python")
    assert len(sender.splitlines()) <= 15
    port = free_udp_port()
    file = tmp_path / "sender.py"
    file.write_text(sender.replace("5005", str(port)))
    with opened(port=port) as stream, subprocess.Popen([sys.executable, str(file)]) as running:
        try:
            fix = first_fix(stream)
            assert fix.x == pytest.approx([0.1, 0.2, 0.3])
            assert not stream.ledger.total[Fault.MALFORMED]
        finally:
            running.kill()
