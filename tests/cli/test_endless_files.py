"""Devices, pipes and endless files in place of every input file."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from small_arm import write_small_arm

from bodyschema.cli.hardware.wiggling import read_wiggle
from bodyschema.cli.install.backup import Backup
from bodyschema.cli.servos.fitting import read_scan
from bodyschema.daemon.config import Config
from bodyschema.daemon.transport.identity import Identity, TlsConfig
from bodyschema.effects.files import load_simulation
from bodyschema.interfaces.errors import BodyschemaError, ConfigError, RecordingError, StoreError
from bodyschema.recordings import csv_file as recording_csv
from bodyschema.recordings.recording import Recording
from bodyschema.recordings.store import schema as store_schema
from bodyschema.recordings.store.store import PairReader
from bodyschema.robot.limited import UnfitFile, read_at_most
from bodyschema.robot.toml_file import read_toml
from bodyschema.robot.urdf import UrdfTree
from bodyschema.vision.cameras.recorded_eyes import read_times
from bodyschema.vision.image_file import read_image

JOINTS = ("waist", "shoulder")
HEADER = b"waist,shoulder,x,y,z\n"


def a_device(file: Path) -> None:
    file.symlink_to("/dev/zero")


def a_pipe(file: Path) -> None:
    os.mkfifo(file)


def a_sparse_file(file: Path) -> None:
    with file.open("wb") as stream:
        stream.truncate(100 * 2**30)


def a_file_that_tells_no_size(file: Path) -> None:
    file.symlink_to("/proc/self/pagemap")


def a_folder(file: Path) -> None:
    file.mkdir()


MADE = (a_device, a_pipe, a_sparse_file, a_file_that_tells_no_size, a_folder)


def unexplained(file: Path) -> object:
    model = f'[unexplained]\nmodel = "{file.name}"\njoints = ["waist"]\n'
    return load_simulation(write_small_arm(file.parent, model))


READERS: dict[str, Callable[[Path], object]] = {
    "robot.toml": Config.load,
    "a.urdf": UrdfTree.load,
    "a.csv": lambda file: Recording.read(file, JOINTS),
    "a.parquet": lambda file: Recording.read(file, JOINTS),
    "a.kbmap": unexplained,
    "scan.json": read_scan,
    "times.txt": lambda file: read_times(file, 3),
    "wiggle.csv": lambda file: read_wiggle(file, JOINTS),
    "pairs.sqlite": lambda file: PairReader(file).__enter__(),
    "a.zip": lambda file: Backup(file).__enter__(),
    "ca.pem": lambda file: Identity.of(TlsConfig(ca=file.name), None, None, file.parent),
}


@pytest.mark.parametrize("make", MADE)
@pytest.mark.parametrize("name", READERS)
def test_no_reader_takes_a_file_without_end(tmp_path: Path, name: str, make: Callable[[Path], None]) -> None:
    make(tmp_path / name)
    with pytest.raises(BodyschemaError, match=name):
        READERS[name](tmp_path / name)


@pytest.mark.parametrize("make", MADE)
def test_device_or_endless_file_yields_no_image(tmp_path: Path, make: Callable[[Path], None]) -> None:
    make(tmp_path / "a.png")
    assert read_image(tmp_path / "a.png") is None


@pytest.mark.parametrize("make", [a_device, a_pipe, a_folder])
def test_no_store_is_opened_where_something_else_is(tmp_path: Path, make: Callable[[Path], None]) -> None:
    make(tmp_path / "pairs.sqlite")
    with pytest.raises(StoreError, match="is not a file"):
        store_schema.connect(tmp_path / "pairs.sqlite")
    with pytest.raises(StoreError, match="is not a file"), PairReader(tmp_path / "pairs.sqlite"):
        pass


def test_image_with_too_many_pixels_is_not_read(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"P6\n40000 40000\n255\n" + bytes(100))
    assert read_image(tmp_path / "a.png") is None


@pytest.mark.parametrize(
    ("make", "said"),
    [(a_device, "a device, not a file"), (a_pipe, "a pipe, not a file"), (a_sparse_file, "than 3 MiB")],
)
def test_unfit_file_error_names_the_reason(tmp_path: Path, make: Callable[[Path], None], said: str) -> None:
    make(tmp_path / "a")
    with pytest.raises(UnfitFile, match=said):
        read_at_most(tmp_path / "a", 3 * 2**20)


@pytest.mark.parametrize(
    "text",
    [
        '"="' + '."="' * 200 + " = 1",
        "'='" + ".'='" * 200 + " = 1",
        'a = {b = """\nx""""", "="' + '."="' * 200 + " = 1}",
        "a = {b = '''\nx''''', '='" + ".'='" * 200 + " = 1}",
        'a = {b = "\\"", "="' + '."="' * 200 + " = 1}",
        "a = [{ b" + ". b" * 200 + " = 1}]",
    ],
)
def test_excess_key_parts_behind_quotes_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "robot.toml").write_text(text)
    with pytest.raises(ConfigError, match="a key has more than 100 parts"):
        read_toml(tmp_path / "robot.toml")


def test_texts_with_many_full_stops_are_no_keys(tmp_path: Path) -> None:
    dots = ".".join("a" * 300)
    numbers = ", ".join(["0.5"] * 300)
    text = f"# {dots}\na = '{dots}'\nb = \"{dots}\"\nc = [{numbers}]\nd = '''\n{dots}'''\ne = 1 # {dots}\n"
    (tmp_path / "robot.toml").write_text(text)
    assert read_toml(tmp_path / "robot.toml")[0]["b"] == dots


# --- recordings


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (bytes(3 * 2**20), "line 1: the line is longer than 1 MiB"),
        (bytes(100), r"line 1: this is not a text file: its first line has the character '\\x00'"),
        (HEADER + b"0,0,1,2,3\n" * 3 + bytes(3 * 2**20), "line 5: the line is longer than 1 MiB"),
        (HEADER + b"0,0,1,2,3\n" * 3 + b"\0,0,1,2,3\n", r"line 5, column waist: '\\x00' is not a number"),
        (b"a" * 10_000 + b"," + HEADER, "a column's name has 10,000 characters"),
    ],
)
def test_reading_ends_at_the_first_line_of_nonsense(tmp_path: Path, data: bytes, said: str) -> None:
    (tmp_path / "a.csv").write_bytes(data)
    with pytest.raises(RecordingError, match=said):
        Recording.read(tmp_path / "a.csv", JOINTS)


def test_blocks_of_a_recording_are_one_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = np.random.default_rng(0).normal(size=(60, 5))
    text = HEADER.decode() + "".join(",".join(map(repr, row)) + "\r\n" for row in rows.tolist())
    (tmp_path / "a.csv").write_bytes(text.encode())
    monkeypatch.setattr(recording_csv._Settings, "block_bytes", 500)
    recording = Recording.read(tmp_path / "a.csv", JOINTS)
    np.testing.assert_array_equal(np.hstack([recording.q, recording.x]), rows)
    for wrong, said in (
        (text + "0,0,1,2\n", "line 62, column z: 4 fields where the header names 5"),
        (text + "0,0,1", "line 62: the last line is torn"),
        (text[:-2], "line 61, column z: the last line has no line end"),
    ):
        (tmp_path / "a.csv").write_text(wrong, newline="")
        with pytest.raises(RecordingError, match=said):
            Recording.read(tmp_path / "a.csv", JOINTS)


def test_more_numbers_than_fit_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording_csv.ColumnLimits, "max_numbers", 50)
    monkeypatch.setattr(recording_csv._Settings, "block_bytes", 50)
    (tmp_path / "a.csv").write_bytes(HEADER + b"0,0,1,2,3\n" * 11)
    with pytest.raises(RecordingError, match="there are more than 10 rows of these columns"):
        Recording.read(tmp_path / "a.csv", JOINTS)
