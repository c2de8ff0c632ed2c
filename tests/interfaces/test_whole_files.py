"""Files appear complete, or not at all."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from bodyschema.interfaces.whole_files import write_atomically


def contents(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def test_a_full_disk_changes_none_of_the_files(mount_small_disk: Callable[[str], Path]) -> None:
    folder = mount_small_disk("size=16k")
    write_atomically({folder / "a": b"old", folder / "b": b"old"})
    before = contents(folder)
    with pytest.raises(OSError, match="No space left"):
        write_atomically({folder / "a": b"new", folder / "b": bytes(20_000)})
    assert contents(folder) == before == {"a": b"old", "b": b"old"}


def test_all_files_are_replaced(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"old")
    write_atomically({tmp_path / "a": b"new", tmp_path / "b": b"other"})
    assert contents(tmp_path) == {"a": b"new", "b": b"other"}
