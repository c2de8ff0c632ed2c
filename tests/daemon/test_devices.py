"""Devices that read the joints, kept with the pairs; the status of servos."""

from __future__ import annotations

import re
import sqlite3
from io import StringIO
from pathlib import Path

import msgspec
import numpy as np
import pytest
from rich.console import Console

from bodyschema.cli.terminal.status_view import servos_table
from bodyschema.daemon.sampler.devices import DeviceWatch, differences
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.records import MarkerFix, frozen_array
from bodyschema.interfaces.servos import ServoStatus
from bodyschema.recordings.mcap_export import write_mcap
from bodyschema.recordings.recording import Recording
from bodyschema.recordings.store.store import PairReader, PairStore, Session

SESSION = Session(("elbow",), "2026-01-01T00:00:00+00:00", "[robot]", "<robot/>", "{}", "0", "host")
ELBOW = {
    "joint": "elbow",
    "model": "XM430-W350",
    "firmware": 46,
    "drive_mode": 0,
    "homing_offset_ticks": 0,
    "zero_ticks": 2048,
    "direction": 1,
    "return_delay_s": 5e-4,
}


class Joints:
    """Encoders of which only the device record is used."""

    joints = ("elbow",)

    def __init__(self, **changes) -> None:
        self.record = (ELBOW | changes,)

    def __enter__(self):
        return self

    def __exit__(self, *_) -> None:
        """Do nothing: nothing was opened."""

    def read(self, timeout_s: float) -> None:
        """Return None."""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "pairs.sqlite"


def fill(store: PairStore, count: int) -> None:
    for _ in range(count):
        fix = MarkerFix(1.0, frozen_array([0.0, 0.0, 1.0]), frozen_array(np.eye(3)))
        store.append(1, "utc", frozen_array([0.1]), fix)


def test_each_session_keeps_device_record_of_its_pairs(file) -> None:
    for _ in range(2):
        with PairStore(file, SESSION) as store:
            assert not DeviceWatch(Joints(), store, SystemClock()).check()
            fill(store, 3)
    with PairReader(file) as reader:
        kept = reader.devices()
    assert [(one.session, one.from_seq, one.record) for one in kept] == [(1, 1, (ELBOW,)), (2, 4, (ELBOW,))]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"homing_offset_ticks": 100}, "homing_offset was 0, is 100.*servos homing_offset=0 --joint elbow"),
        ({"drive_mode": 1}, "drive_mode was 0, is 1"),
        ({"firmware": 47}, "the firmware of 'elbow' was 46, is 47"),
        ({"model": "XM540-W270"}, "another servo than the samples before: XM430-W350 then, XM540-W270 now"),
        ({"zero_ticks": 1000}, "zero_ticks in robot.toml was 2048, is 1000"),
    ],
)
def test_device_change_since_last_session_is_reported_once(file, caplog, changes, said) -> None:
    with PairStore(file, SESSION) as store:
        DeviceWatch(Joints(), store, SystemClock()).check()
        fill(store, 1)
    with PairStore(file, SESSION) as store:
        watch = DeviceWatch(Joints(**changes), store, SystemClock())
        assert (watch.check(), watch.check()) == (True, False)
    (message,) = caplog.messages
    assert watch.changes == [message]
    assert re.search(said, message)


def test_device_change_while_running_applies_from_next_pair(file) -> None:
    with PairStore(file, SESSION) as store:
        joints = Joints()
        watch = DeviceWatch(joints, store, SystemClock())
        watch.check()
        fill(store, 3)
        joints.record = (ELBOW | {"homing_offset_ticks": 100},)
        assert watch.check()
        fill(store, 1)
        assert [one.from_seq for one in store.reader.devices()] == [1, 4]


def test_device_record_without_pairs_is_forgotten(file) -> None:
    with PairStore(file, SESSION) as store:
        DeviceWatch(Joints(), store, SystemClock()).check()
        fill(store, 1)
    for offset in (100, 0):
        with PairStore(file, SESSION) as store:
            watch = DeviceWatch(Joints(homing_offset_ticks=offset), store, SystemClock())
            assert watch.check() == bool(offset)


def test_changed_return_delay_is_not_a_device_change() -> None:
    assert differences([ELBOW], [ELBOW | {"return_delay_s": 0.0}]) == []


def as_schema_1(file: Path) -> None:
    """Convert the store to the previous schema."""
    connection = sqlite3.connect(file)
    connection.executescript(
        "DROP TABLE devices; ALTER TABLE pairs DROP COLUMN R; ALTER TABLE pairs DROP COLUMN cov_R;"
        "ALTER TABLE pairs DROP COLUMN checksum; ALTER TABLE sessions DROP COLUMN checksum;"
        "DELETE FROM meta WHERE key = 'checksum';"
        "PRAGMA user_version = 1;"
    )
    connection.close()


def test_schema_1_store_is_read_unchanged(file) -> None:
    with PairStore(file, SESSION) as store:
        fill(store, 2)
    as_schema_1(file)
    before = file.read_bytes()
    with PairReader(file) as reader:
        assert (reader.last_seq(), reader.devices()) == (2, [])
    assert file.read_bytes() == before


def test_writing_to_schema_1_store_migrates_its_pairs(file) -> None:
    with PairStore(file, SESSION) as store:
        fill(store, 2)
        identity = store.identity
    as_schema_1(file)
    with PairStore(file, SESSION) as store:
        DeviceWatch(Joints(), store, SystemClock()).check()
        fill(store, 1)
        assert (store.identity, store.reader.last_seq()) == (identity, 3)
        assert [one.from_seq for one in store.reader.devices()] == [3]


def test_mcap_file_carries_device_record(file, tmp_path) -> None:
    reader = pytest.importorskip("mcap.reader")
    with PairStore(file, SESSION) as store:
        DeviceWatch(Joints(), store, SystemClock()).check()
        fill(store, 1)
        devices = store.reader.devices()
    recording = Recording(("elbow",), np.zeros((1, 1)), np.zeros((1, 3)), t=np.zeros(1))
    write_mcap(recording, tmp_path / "a.mcap", devices)
    with (tmp_path / "a.mcap").open("rb") as stream:
        found = {part.name: part.metadata for part in reader.make_reader(stream).iter_metadata()}
    assert msgspec.json.decode(found["devices/1"]["elbow"]) == ELBOW


def test_unhealthy_servo_shows_in_80_column_table() -> None:
    hot = ServoStatus("arm", 3, "PH54-200-S500", 46, 0, 0, 24.0, 81.0, 0.12, ["it is too hot: let it cool down"])
    well = ServoStatus("arm", 4, "MX-28", 24, 0, 0, None, None, None, [])
    console = Console(file=StringIO(), width=80)
    console.print(servos_table({"shoulder_pitch": hot, "elbow": well}))
    assert isinstance(console.file, StringIO)
    lines = console.file.getvalue().splitlines()
    assert " ".join(lines[1].split()) == "shoulder_pitch 3 PH54-200-S500 46 24.0 V 81 °C 0.12 A it is too hot"
    assert " ".join(lines[2].split()) == "elbow 4 MX-28 24 - - - well"
