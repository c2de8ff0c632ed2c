from __future__ import annotations

import contextlib
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bodyschema.interfaces.errors import StoreError, StoreUnwritable
from bodyschema.interfaces.records import MarkerFix, Pair, frozen_array
from bodyschema.recordings.store import schema as store_schema
from bodyschema.recordings.store.rows import pair_of, row_of
from bodyschema.recordings.store.schema import APPLICATION_ID
from bodyschema.recordings.store.store import PairReader, PairStore, Session

JOINTS = ("waist", "shoulder")
SESSION = Session(JOINTS, "2026-01-01T00:00:00+00:00", "[robot]", "<robot/>", "{}", "0", "host")
COV = frozen_array(np.diag([1e-6, 2e-6, 9e-6]) + 1e-7)


def fix(t: float) -> MarkerFix:
    return MarkerFix(t, frozen_array([0.1 * t, 0.2, 1.0]), COV, (1.0, 2.0, 3.0, 4.5))


def turned_fix(t: float) -> MarkerFix:
    return replace(fix(t), R=frozen_array([0.0, 0.6, 0.0, 0.8]), cov_R=frozen_array(1e-4 * np.eye(3) + 1e-6))


def fill(store: PairStore, count: int) -> list[Pair]:
    return [store.append(1, f"utc {i}", frozen_array([0.1 * i, -0.1]), fix(float(i))) for i in range(count)]


def same(a: Pair, b: Pair) -> bool:
    arrays = all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("q", "x", "cov", "R", "cov_R"))
    plain = ("store", "seq", "segment", "t", "utc", "centres_px")
    return arrays and all(getattr(a, name) == getattr(b, name) for name in plain)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "state" / "pairs.sqlite"


@pytest.fixture
def store(file: Path) -> Iterator[PairStore]:
    with PairStore(file, SESSION) as store:
        yield store


def test_pairs_are_numbered_from_one_without_gaps(store) -> None:
    assert [pair.seq for pair in fill(store, 5)] == [1, 2, 3, 4, 5]


def test_numbering_continues_when_store_is_reopened(file) -> None:
    with PairStore(file, SESSION) as store:
        fill(store, 3)
        identity = store.identity
    with PairStore(file, SESSION) as store:
        assert (store.identity, [pair.seq for pair in fill(store, 2)]) == (identity, [4, 5])


def test_read_pairs_match_appended_pairs_bit_for_bit(store) -> None:
    appended = fill(store, 4)
    assert all(map(same, appended, store.read()))


def stored(row: tuple[object, ...]) -> tuple[object, ...]:
    """Return a row as SQLite gives it back."""
    with contextlib.closing(sqlite3.connect(":memory:")) as connection:
        connection.text_factory = bytes
        connection.execute(f"CREATE TABLE pairs (seq, session, segment, t REAL, {', '.join('abcdefg')})")
        connection.execute("INSERT INTO pairs VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", row)
        return connection.execute("SELECT * FROM pairs").fetchone()


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=14, max_size=14), st.booleans())
def test_every_finite_number_survives_the_row_format(numbers, with_centres) -> None:
    cov = np.reshape([*numbers[5:8], numbers[6], *numbers[8:10], numbers[7], *numbers[9:11]], (3, 3))
    centres = tuple(numbers[10:14]) if with_centres else None
    turn = (frozen_array(numbers[3:7]), frozen_array(cov)) if with_centres else (None, None)
    pair = Pair(
        "id", 1, 2, numbers[0], "utc", frozen_array(numbers[:2]), frozen_array(numbers[2:5]), cov, centres, *turn
    )
    assert same(pair, pair_of("id", stored(row_of(pair, session=1)), joints=2))


def test_orientations_come_back_as_they_were_measured(store) -> None:
    pair = store.append(1, "utc", frozen_array([0.0, 0.1]), turned_fix(1.0))
    assert same(pair, store.read()[0])
    assert pair.R is not None


# As schema 2 laid a store out.
SCHEMA_2 = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE sessions (
    id INTEGER PRIMARY KEY, started_utc TEXT NOT NULL, robot_toml TEXT NOT NULL, urdf TEXT NOT NULL,
    config TEXT NOT NULL, version TEXT NOT NULL, host TEXT NOT NULL
);
CREATE TABLE pairs (
    seq INTEGER PRIMARY KEY, session INTEGER NOT NULL REFERENCES sessions, segment INTEGER NOT NULL,
    t REAL NOT NULL, utc TEXT NOT NULL, q TEXT NOT NULL, x TEXT NOT NULL, cov TEXT NOT NULL, centres_px TEXT
);
CREATE TABLE devices (
    id INTEGER PRIMARY KEY, session INTEGER NOT NULL REFERENCES sessions, from_seq INTEGER NOT NULL, utc TEXT NOT NULL,
    record TEXT NOT NULL
);
INSERT INTO meta VALUES ('store', '5c6e'), ('created_utc', ''), ('joints', '["waist","shoulder"]');
INSERT INTO sessions VALUES (1, '', '', '', '{}', '0', 'host');
INSERT INTO pairs VALUES (1, 1, 1, 0.5, 'utc', '[0.1,0.2]', '[0.0,0.2,1.0]', '[1e-6,0,0,1e-6,0,1e-6]', '[1,2,3,4]');
PRAGMA application_id = 0x42534348;
PRAGMA user_version = 2;
"""


@pytest.fixture
def before_orientation(file: Path) -> Path:
    file.parent.mkdir()
    with contextlib.closing(sqlite3.connect(file)) as connection:
        connection.executescript(SCHEMA_2)
    return file


def test_schema_2_store_accepts_pairs_with_orientation(before_orientation) -> None:
    with PairStore(before_orientation, SESSION) as store:
        store.append(1, "utc", frozen_array([0.2, 0.2]), turned_fix(1.0))
        old, new = store.read()
    assert (old.seq, old.R, old.centres_px) == (1, None, (1, 2, 3, 4))
    assert new.R is not None
    assert new.seq == 2


def test_reading_schema_2_store_leaves_it_unchanged(before_orientation) -> None:
    before = before_orientation.read_bytes()
    with PairReader(before_orientation) as reader:
        assert [pair.R for pair in reader.read()] == [None]
    assert before_orientation.read_bytes() == before


def test_range_read_stops_at_the_limit(store) -> None:
    fill(store, 10)
    assert [pair.seq for pair in store.read(3, 9, limit=4)] == [3, 4, 5, 6]


def test_empty_store_has_no_last_pair(store) -> None:
    assert store.last() is None


def test_the_joints_ranges_are_over_all_pairs(store) -> None:
    fill(store, 3)
    low, high = store.reader.audit().joint_ranges
    assert (low.tolist(), high.tolist()) == ([0.0, -0.1], [0.2, -0.1])


def test_readers_see_each_appended_pair_immediately(file, store) -> None:
    with PairReader(file) as reader:
        seen = []
        for _ in range(3):
            fill(store, 1)
            seen.append(reader.last_seq())
    assert seen == [1, 2, 3]


def test_many_threads_read_while_pairs_come(file, store) -> None:
    with PairReader(file) as reader, ThreadPoolExecutor(4) as pool:
        reads = [pool.submit(reader.read) for _ in range(40)]
        fill(store, 100)
        for read in reads:
            pairs = read.result()
            assert [pair.seq for pair in pairs] == list(range(1, len(pairs) + 1))


def test_reader_reports_store_identity_and_joints(file, store) -> None:
    with PairReader(file) as reader:
        assert (reader.identity, reader.joints) == (store.identity, JOINTS)


def test_the_store_keeps_what_the_sampler_worked_with(file, store) -> None:
    fill(store, 1)
    with contextlib.closing(sqlite3.connect(file)) as connection:
        row = connection.execute("SELECT robot_toml, urdf, config, version, host FROM sessions").fetchone()
    assert row == ("[robot]", "<robot/>", "{}", "0", "host")


def test_runs_that_see_no_pair_leave_nothing_behind(file) -> None:
    for _ in range(5):
        with PairStore(file, SESSION):
            pass
    with contextlib.closing(sqlite3.connect(file)) as connection:
        assert connection.execute("SELECT count(*) FROM sessions").fetchone()[0] == 1


def test_store_uses_wal_with_full_synchronous_commits(store) -> None:
    assert store._connection.execute("PRAGMA synchronous").fetchone()[0] == 2  # FULL
    assert store._connection.execute("PRAGMA journal_mode").fetchone()[0] == b"wal"


def test_a_second_sampler_on_the_store_is_refused(file, store) -> None:
    code = (
        "import sys; from pathlib import Path; from bodyschema.recordings.store.store import PairStore, Session\n"
        "with PairStore(Path(sys.argv[1]), Session(('waist', 'shoulder'), '', '', '', '', '', '')): pass"
    )
    done = subprocess.run([sys.executable, "-c", code, file], capture_output=True, text=True, check=False)
    assert f"another sampler is writing {file}" in done.stderr


@pytest.mark.parametrize("part", ["", "-wal"])
def test_append_to_missing_file_is_rejected(file, store, part) -> None:
    fill(store, 2)
    there, aside = file.with_name(file.name + part), file.with_name("aside")
    there.rename(aside)
    with pytest.raises(StoreUnwritable, match="deleted, moved or replaced while"):
        fill(store, 1)
    there.write_bytes(b"")
    with pytest.raises(StoreUnwritable, match="deleted, moved or replaced"):
        fill(store, 1)
    aside.replace(there)
    assert [pair.seq for pair in fill(store, 2)] == [3, 4]


def refused(file: Path) -> str:
    """Return the message that refuses the store; assert that the file does not change."""
    before = file.read_bytes()
    with pytest.raises(StoreError) as refusal, PairStore(file, SESSION):
        pass
    assert file.read_bytes() == before
    message = str(refusal.value)
    assert str(file) in message
    return message


@pytest.fixture
def closed(file: Path) -> Path:
    with PairStore(file, SESSION) as store:
        fill(store, 200)
    return file


def test_opening_a_store_reports_progress(closed, monkeypatch) -> None:
    monkeypatch.setattr("bodyschema.recordings.store.schema._Settings.steps_until_told", 100)
    told: list[int] = []
    with PairStore(closed, SESSION, working=lambda: told.append(1)) as store:
        opened = len(told)
        fill(store, 20)
        store.read()
    assert opened > 10
    assert len(told) == opened


def alter(file: Path, statement: str) -> None:
    connection = sqlite3.connect(file)
    connection.execute(statement)
    connection.commit()
    connection.close()


def test_a_file_that_is_no_database_is_refused(file) -> None:
    file.parent.mkdir()
    file.write_text("my diary, 2026 " * 100)
    assert "is not a sample store. Move it away" in refused(file)


def test_another_programs_database_is_refused(file) -> None:
    file.parent.mkdir()
    alter(file, "CREATE TABLE recipes (name)")
    assert "another SQLite file" in refused(file)


def test_a_store_of_a_newer_version_is_refused(closed) -> None:
    alter(closed, "PRAGMA user_version = 99")
    assert "written by a newer bodyschema (schema 99" in refused(closed)


def test_another_robots_store_is_refused(closed) -> None:
    with contextlib.closing(store_schema.connect(closed)) as connection:
        store_schema.write_meta(connection, {**store_schema.meta(connection), "joints": '["hip","knee"]'})
    assert "holds samples of the joints hip, knee; robot.toml has waist, shoulder" in refused(closed)


def test_a_state_dir_below_a_file_is_refused(tmp_path) -> None:
    (tmp_path / "file").touch()
    with (
        pytest.raises(StoreError, match="cannot make the directory"),
        PairStore(tmp_path / "file" / "x.sqlite", SESSION),
    ):
        pass


def test_reading_a_store_never_written_is_rejected(file) -> None:
    with pytest.raises(StoreError, match="there is no store"), PairReader(file):
        pass


def test_a_closed_store_takes_nothing(file) -> None:
    store = PairStore(file, SESSION)
    with pytest.raises(StoreError, match="use it in a with statement"):
        fill(store, 1)


def test_empty_store_file_is_initialized_on_opening(file) -> None:
    file.parent.mkdir()
    file.touch()
    with PairStore(file, SESSION) as store:
        assert fill(store, 1)[0].seq == 1


def test_store_killed_during_creation_is_initialized_on_opening(file) -> None:
    code = (
        "import os, sys; from pathlib import Path; from bodyschema.recordings.store import schema, store\n"
        "statements = schema.statements_of\n"
        "def until_killed(number): yield from statements(number)[:2]; os._exit(9)\n"
        "schema.statements_of = until_killed\n"
        "with store.PairStore(Path(sys.argv[1]), store.Session(('waist', 'shoulder'), '', '', '', '', '', '')): pass"
    )
    assert subprocess.run([sys.executable, "-c", code, file], check=False).returncode == 9
    with PairStore(file, SESSION) as store:
        assert fill(store, 1)[0].seq == 1


def fill_until_refused(store: PairStore) -> tuple[str, int]:
    """Return the error message and the number of pairs appended before it."""
    for appended in range(100_000):
        try:
            fill(store, 1)
        except StoreError as error:
            return str(error), appended
    raise AssertionError("the disk was never full")


def test_full_disk_loses_no_appended_pair(mount_small_disk) -> None:
    file = mount_small_disk("size=512k") / "pairs.sqlite"
    with PairStore(file, SESSION) as store:
        message, appended = fill_until_refused(store)
    assert f"the disk of {file} is full" in message
    with PairReader(file) as reader:
        assert [pair.seq for pair in reader.read()] == list(range(1, appended + 1))


def test_numbering_continues_after_a_full_disk_is_freed(mount_small_disk) -> None:
    folder = mount_small_disk("size=512k")
    with PairStore(folder / "pairs.sqlite", SESSION) as store:
        (folder / "ballast").write_bytes(bytes(2**18))
        _, appended = fill_until_refused(store)
        (folder / "ballast").unlink()
        assert fill(store, 1)[0].seq == appended + 1


def test_initially_full_disk_is_reported(mount_small_disk) -> None:
    folder = mount_small_disk("size=16k")
    (folder / "ballast").write_bytes(bytes(2**14 - 4096))
    with pytest.raises(StoreError, match="is full"), PairStore(folder / "pairs.sqlite", SESSION):
        pass


def test_read_only_disk_is_reported(mount_small_disk) -> None:
    folder = mount_small_disk("ro,size=512k")
    store = PairStore(folder / "pairs.sqlite", SESSION)
    with pytest.raises(StoreError, match=r"the disk is read-only. Give a --state-dir"), store:
        pass


def test_the_file_names_its_kind() -> None:
    assert APPLICATION_ID.to_bytes(4) == b"BSCH"
