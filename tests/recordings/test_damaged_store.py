"""Data corruption on disk: every intact pair is kept, and no damaged one is accepted."""

from __future__ import annotations

import contextlib
import os
import shutil
import sqlite3
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from bodyschema.cli.hardware.doctor import store_checks
from bodyschema.daemon.sampler.history import answer_pairs
from bodyschema.daemon.transport.session import Request
from bodyschema.daemon.transport.wire import JSON, PairsReply, decode, pair_to_wire
from bodyschema.interfaces.errors import RecordingError, StoreError
from bodyschema.interfaces.records import MarkerFix, frozen_array
from bodyschema.recordings.files import from_store, stored_pairs
from bodyschema.recordings.store import schema as store_schema
from bodyschema.recordings.store.damage import Damage
from bodyschema.recordings.store.damage import _Settings as DamageSettings
from bodyschema.recordings.store.retention import Keep
from bodyschema.recordings.store.rows import COLUMNS, checksum
from bodyschema.recordings.store.store import PairReader, PairStore, Session, commits, leave_out_damage

JOINTS = ("waist", "shoulder")
SESSION = Session(JOINTS, "2026-01-01T00:00:00+00:00", "[robot]", "<robot/>", "{}", "0", "host")
COV = frozen_array(np.diag([1e-6, 2e-6, 9e-6]) + 1e-7)
TURN, COV_TURN = frozen_array([0.0, 0.6, 0.0, 0.8]), frozen_array(1e-4 * np.eye(3))
PAIRS, LONG, PAGE_BYTES = 20, 150, 4096


def add(store: PairStore, count: int) -> None:
    for k in range(count):
        fix = MarkerFix(float(k), frozen_array([0.1 * k, 0.2, 1.0]), COV, (1.0, 2.0, 3.0, 4.5), 0.0, TURN, COV_TURN)
        store.append(1, f"2026-01-01T00:00:{k % 60:02}", frozen_array([0.1 * k, -0.1]), fix)


def written(folder: Path, pairs: int) -> Path:
    folder.mkdir(exist_ok=True)
    with PairStore(folder / "pairs.sqlite", SESSION) as store:
        store.note_devices("utc", [{"joint": "waist", "zero_ticks": 7}])
        add(store, pairs)
    return store.file


@pytest.fixture(scope="module")
def short_and_long(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return a store of a few pages, and one of many."""
    return written(tmp_path_factory.mktemp("short"), PAIRS), written(tmp_path_factory.mktemp("long"), LONG)


@pytest.fixture
def file(short_and_long: tuple[Path, Path], tmp_path: Path) -> Path:
    (tmp_path / "state").mkdir()
    return Path(shutil.copy(short_and_long[0], tmp_path / "state"))


@pytest.fixture
def long(short_and_long: tuple[Path, Path], tmp_path: Path) -> Path:
    return Path(shutil.copy(short_and_long[1], tmp_path))


def alter(file: Path, statement: str, *values: object) -> None:
    with contextlib.closing(sqlite3.connect(file)) as connection:
        connection.execute(statement, values)
        connection.commit()


def numbers(reader: PairReader | PairStore) -> list[int]:
    return [pair.seq for pair in reader.read()]


CHANGED = {
    "seq": "100",
    "session": "session + 1",
    "segment": "segment + 8",
    "t": "t + 0.5",
    "utc": "replace(utc, '2026', '2027')",
    "q": "replace(q, '1', '9')",
    "x": "replace(x, '2', '3')",
    "cov": "replace(cov, '1', '7')",
    "centres_px": "replace(centres_px, '4', '5')",
    "R": "replace(R, '6', '5')",
    "cov_R": "NULL",
    "checksum": "checksum + 1",
}


@pytest.mark.parametrize(
    ("column", "seq"),
    [("seq", PAIRS), *((column, seq) for column in CHANGED for seq in (1, 7, PAIRS) if column != "seq")],
)
def test_one_changed_value_costs_one_pair(file, column, seq) -> None:
    alter(file, f"UPDATE pairs SET {column} = {CHANGED[column]} WHERE seq = ?", seq)
    with PairReader(file) as reader:
        assert numbers(reader) == [k for k in range(1, PAIRS + 1) if k != seq]
        assert reader.audit().damage == Damage(((seq, seq),))
    with PairStore(file, SESSION) as store:
        assert f"1 sample of {file} cannot be read" in store.complaints[0]
        assert f"It is left out (number {seq})." in store.complaints[0]
        add(store, 1)
        assert numbers(store)[-1] == PAIRS + 1


@pytest.mark.parametrize("damage", ["x'ff'", "'[1,2'", "'[null,0.1]'", "'[1e999,0.1]'", "5", "''"])
def test_an_unreadable_row_is_left_out(file, damage) -> None:
    alter(file, f"UPDATE pairs SET q = {damage} WHERE seq = 7")
    with PairStore(file, SESSION) as store:
        assert 7 not in numbers(store)
        assert len(numbers(store)) == PAIRS - 1


def test_missing_numbers_are_reported_and_skipped(file) -> None:
    alter(file, "DELETE FROM pairs WHERE seq BETWEEN 5 AND 6")
    with PairStore(file, SESSION) as store:
        assert "2 samples of" in store.complaints[0]
        assert "(numbers 5 to 6)" in store.complaints[0]


def test_damage_to_an_open_store_is_reported(file) -> None:
    with PairStore(file, SESSION) as store:
        assert store.complaints == []
        alter(file, "UPDATE pairs SET x = replace(x, '2', '3') WHERE seq = 7")
        assert 7 not in numbers(store)
        assert "(number 7)" in store.complaints[0]


def test_deleted_damage_is_no_longer_reported(file) -> None:
    alter(file, "UPDATE pairs SET x = replace(x, '2', '3') WHERE seq = 7")
    with PairStore(file, SESSION) as store:
        while store.trim(Keep(None, 0.0, 10), "2026-01-02T00:00:00"):
            pass
        assert store.complaints == []


def test_a_damaged_newest_number_deletes_nothing(file) -> None:
    alter(file, "UPDATE pairs SET seq = 1000000 WHERE seq = ?", PAIRS)
    with PairStore(file, SESSION) as store:
        assert store.trim(Keep(None, 0.0, PAIRS), "2026-01-02T00:00:00") == 0
        add(store, 1)
        assert numbers(store) == [*range(1, PAIRS), PAIRS + 1]


def test_history_answers_with_the_other_pairs(file) -> None:
    alter(file, "UPDATE pairs SET q = 'x' WHERE seq IN (7, 20)")
    with PairReader(file) as reader:
        reply = decode(answer_pairs(reader, Request({}, b"", JSON)), PairsReply)
    assert [pair.seq for pair in reply.pairs] == [k for k in range(1, PAIRS) if k != 7]
    assert reply.last_seq == PAIRS


def test_a_changed_record_of_devices_is_left_out(file) -> None:
    alter(file, "UPDATE devices SET record = replace(record, '7', '8')")
    with PairStore(file, SESSION) as store:
        assert store.reader.devices() == []
        assert store.audit.lost_rows == 1


# --- pages that SQLite cannot read


def zero(file: Path, page: int, pages: int = 1) -> None:
    with file.open("r+b") as stream:
        stream.seek((page - 1) * PAGE_BYTES)
        stream.write(bytes(pages * PAGE_BYTES))


def leaves(file: Path) -> list[int]:
    """Return the pages that hold pairs, in order."""
    data = file.read_bytes()
    pages = [data[k : k + PAGE_BYTES] for k in range(0, len(data), PAGE_BYTES)]
    return [k for k, page in enumerate(pages, 1) if page[0] == 0x0D and page.count(b"2026-01-01T00:00:") > 2]


def test_a_lost_page_costs_its_own_pairs(long) -> None:
    page = leaves(long)[4]
    zero(long, page)
    damaged = long.read_bytes()
    with PairReader(long) as reader:
        readable = numbers(reader)
        assert reader.audit().damage.count == LONG - len(readable)
    assert len(from_store(long)) == len(readable)
    assert [check.state for check in store_checks(long)] == ["wrong"]
    assert len(readable) > LONG - 30
    with PairStore(long, SESSION) as store:
        assert numbers(store) == readable
        rebuilt, left_out = store.complaints
        add(store, 1)
        assert numbers(store)[-1] == LONG + 1
    kept = long.with_name("pairs.sqlite.damaged-1")
    assert f"{long} was damaged" in rebuilt
    assert f"kept as {kept}" in rebuilt
    assert f"{LONG - len(readable)} samples of {long} cannot be read" in left_out
    assert kept.read_bytes()[100:] == damaged[100:]  # its header has another journal mode
    with PairStore(long, SESSION) as store:
        assert store.complaints == [left_out]


def test_numbers_of_lost_pages_are_not_reused(long) -> None:
    zero(long, leaves(long)[-1])
    with PairStore(long, SESSION) as store:
        newest = numbers(store)[-1]
        add(store, 1)
        assert numbers(store)[-1] == newest + DamageSettings.left_free + 1 > LONG + 1


@pytest.mark.parametrize("place", [0, -1])
def test_readers_get_pairs_beside_a_lost_end(long, place) -> None:
    zero(long, leaves(long)[place])
    with PairReader(long) as reader:
        readable = numbers(reader)
        assert len(readable) > LONG - 30
        assert reader.last_seq() == readable[-1]
        assert reader.last().seq == readable[-1]
        page = decode(answer_pairs(reader, Request({}, b"", JSON)), PairsReply)
    assert [pair.seq for pair in page.pairs] == readable == list(from_store(long).t.astype(int) + 1)


def test_several_lost_pages_cost_their_own_pairs(long) -> None:
    pages = leaves(long)
    for page in (pages[2], pages[5], pages[6]):
        zero(long, page)
    with PairStore(long, SESSION) as store:
        assert LONG - 3 * 30 < len(numbers(store)) < LONG


def test_a_lost_identity_costs_no_pair(file) -> None:
    alter(file, "UPDATE meta SET value = replace(value, '-', '+') WHERE key = 'store'")
    with pytest.raises(StoreError, match="Start the sampler: it puts the samples"), PairReader(file):
        pass
    with PairStore(file, SESSION) as store:
        assert numbers(store) == list(range(1, PAIRS + 1))
        assert store.reader.joints == JOINTS
        assert "+" not in store.identity


def test_a_rebuild_without_room_leaves_the_damaged_file(mount_small_disk, long) -> None:
    folder = mount_small_disk("size=1M")
    (folder / "state").mkdir()
    file = Path(shutil.copy(long, folder / "state"))
    zero(file, leaves(file)[4])
    with PairReader(file) as reader:
        before = numbers(reader)
    (folder / "ballast").write_bytes(bytes(os.statvfs(folder).f_bavail * os.statvfs(folder).f_bsize - 2**15))
    with pytest.raises(StoreError, match="is full"), PairStore(file, SESSION):
        pass
    assert {path.name for path in file.parent.iterdir()} <= {"pairs.sqlite", "pairs.sqlite.lock"}
    (folder / "ballast").unlink()
    with PairStore(file, SESSION) as store:
        assert numbers(store) == before


# --- each single bit


class Flips:
    """A store whose bits are flipped one after the other, and the results."""

    def __init__(self, file: Path, folder: Path) -> None:
        with PairReader(file) as reader:
            self._true = [replace(pair_to_wire(pair), store="") for pair in reader.read()]
        self._bytes, self._folder = file.read_bytes(), folder
        self.outcomes: Counter[str] = Counter()
        self.bits = 8 * len(self._bytes)

    def flip(self, bit: int) -> None:
        data = bytearray(self._bytes)
        data[bit // 8] ^= 1 << bit % 8
        shutil.rmtree(self._folder, ignore_errors=True)
        self._folder.mkdir()
        file = self._folder / "pairs.sqlite"
        file.write_bytes(data)
        for use in (self._read, self._export, self._copy, self._open):
            self.outcomes[f"{use.__name__} {self._outcome(use, file, bit)}"] += 1

    def _outcome(self, use: Callable[[Path], int], file: Path, bit: int) -> str:
        try:
            return {0: "well", 1: "lost"}.get(use(file), "page lost")
        except (StoreError, RecordingError):
            # Without the first page SQLite knows no table, and the second has the identity.
            assert bit < 2 * 8 * PAGE_BYTES
            return "refused"

    def _lost(self, reader: PairReader | PairStore) -> int:
        there = [replace(pair_to_wire(pair), store="") for pair in reader.read()]
        lost = [pair for pair in self._true if pair not in there]
        assert [pair for pair in self._true if pair in there] == there  # no pair that was not written
        return len(lost)

    def _read(self, file: Path) -> int:
        with PairReader(file) as reader:
            reader.last()
            reader.devices()
            lost = self._lost(reader)
            assert lost > 1 or reader.last_seq() >= PAIRS - 1
        return lost

    def _export(self, file: Path) -> int:
        try:
            return len(self._true) - len(from_store(file))
        except RecordingError as error:
            if "the store has no samples" not in str(error):
                raise
        return PAIRS

    def _copy(self, file: Path) -> int:
        copy = Path(shutil.copy(file, file.with_name("copy.sqlite")))
        leave_out_damage(copy, JOINTS)
        with PairReader(copy) as reader:
            return self._lost(reader)

    def _open(self, file: Path) -> int:
        with PairStore(file, SESSION) as store:
            lost = self._lost(store)
            assert bool(lost) <= bool(store.complaints)
            add(store, 1)
            assert lost > 1 or numbers(store)[-1] > PAIRS
        return lost


@pytest.fixture
def flips(file: Path, tmp_path: Path) -> Iterator[Flips]:
    done = Flips(file, tmp_path / "flipped")
    yield done
    print(dict(sorted(done.outcomes.items())))


def test_a_flipped_bit_costs_one_pair_at_most(flips) -> None:
    for bit in np.random.default_rng(0).choice(flips.bits, 25, replace=False).tolist():
        flips.flip(bit)
    assert flips.outcomes["_open lost"] > 1
    assert not any("page" in outcome for outcome in flips.outcomes)


@pytest.mark.soak
@pytest.mark.timeout(7200)
def test_few_flipped_bits_cost_more_than_one_pair(flips) -> None:
    """A page without its header or the order of its rows is lost; these are a fiftieth of its bytes."""
    for bit in range(0, flips.bits, 7):  # each byte, and each place in a byte
        flips.flip(bit)
    assert flips.outcomes["_open lost"] > 1000
    for use in ("_read", "_export", "_copy", "_open"):
        assert flips.outcomes[f"{use} page lost"] < 0.02 * flips.outcomes[f"{use} lost"]


def opened(file: Path) -> None:
    with PairStore(file, SESSION):
        pass


# SQLite quotes the first in its message, which Python then cannot decode. With the others, no pair would be readable.
BITS_OF_A_DEFINITION = [
    (b"CREATE TABLE sessions", b"CR\xc5ATE TABLE sessions"),
    (b"seq INTEGER", b"seq INTEGDR"),
    (b"t REAL", b"t REAM"),
]


@pytest.mark.parametrize("use", [from_store, opened, lambda file: leave_out_damage(file, JOINTS)])
@pytest.mark.parametrize(("before", "after"), BITS_OF_A_DEFINITION)
def test_a_damaged_table_definition_changes_nothing(file, use, before, after) -> None:
    data = file.read_bytes().replace(before, after, 1)
    file.write_bytes(data)
    with pytest.raises(StoreError, match="is damaged"):
        use(file)
    assert file.read_bytes() == data


# --- stores that somebody else made


def remade(file: Path, *statements: str) -> Path:
    with contextlib.closing(sqlite3.connect(file)) as connection:
        for statement in statements:
            connection.execute(statement)
        connection.commit()
    return file


LOOP = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT"
HOSTILE = {
    "a view that never ends": (
        "ALTER TABLE pairs RENAME TO old",
        f"CREATE VIEW pairs AS {LOOP} i AS seq, 1 AS session, 1 AS segment, 0.5 AS t, '' AS utc, '[0,0]' AS q, "
        "'[0,0,0]' AS x, '[0,0,0,0,0,0]' AS cov, NULL AS centres_px, NULL AS R, NULL AS cov_R, 0 AS checksum FROM n",
    ),
    "a trigger": ("CREATE TRIGGER t AFTER INSERT ON pairs BEGIN DELETE FROM pairs; END",),
    "a computed column": ("ALTER TABLE pairs ADD COLUMN y AS (q || q)",),
    "a further column": ("ALTER TABLE pairs ADD COLUMN y TEXT",),
    "a virtual table": ("DROP TABLE pairs", "CREATE VIRTUAL TABLE pairs USING fts4(seq, q, x)"),
    "no samples": ("DROP TABLE pairs",),
    "no meta": ("DROP TABLE meta",),
    "no joints": ("DELETE FROM meta WHERE key = 'joints'",),
    "joints that are numbers": ("UPDATE meta SET value = '[1,2]' WHERE key = 'joints'",),
    "joints of many lines": ("UPDATE meta SET value = '[\"a\\nb\",\"c\"]' WHERE key = 'joints'",),
    "an older schema than its tables": ("PRAGMA user_version = 4",),
    "a schema below zero": ("PRAGMA user_version = -1",),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_store_of_other_tables_is_refused(file, name) -> None:
    remade(file, *HOSTILE[name])
    with pytest.raises(StoreError, match=str(file)):
        from_store(file)


def test_every_reader_refuses_a_store_with_a_program(file) -> None:
    remade(file, *HOSTILE["a trigger"])
    for use in (from_store, lambda file: leave_out_damage(file, JOINTS), lambda file: list(store_checks(file))):
        with pytest.raises(StoreError, match="it has a trigger"):
            use(file)
    with pytest.raises(StoreError, match="it has a trigger"), PairStore(file, SESSION):
        pass


VALUES = (
    "x'00'",
    "1",
    "'x'",
    "NULL",
    "9e999",
    "-1",
    "zeroblob(1000000)",
    "'[1e999,0]'",
    "'[' || hex(zeroblob(99)) || ']'",
)


def row_of_pair_7(file: Path) -> object:
    with contextlib.closing(sqlite3.connect(file)) as connection:
        return connection.execute("SELECT * FROM pairs WHERE seq = 7").fetchone()


@pytest.mark.parametrize("column", COLUMNS["pairs"].split(", "))
@pytest.mark.parametrize("value", VALUES)
def test_a_wrong_type_costs_its_own_pair(file, column, value) -> None:
    before = row_of_pair_7(file)
    with contextlib.suppress(sqlite3.IntegrityError):
        remade(file, f"UPDATE pairs SET {column} = {value} WHERE seq = 7")
    intact = row_of_pair_7(file) == before
    assert list(stored_pairs(file).numbers) == [k for k in range(1, PAIRS + 1) if k != 7 or intact]


def test_sealed_nonsense_costs_its_own_pairs(file) -> None:
    """Check rows whose checksums are valid."""
    rng = np.random.default_rng(0)
    with contextlib.closing(store_schema.connect(file)) as connection:
        for seq in range(1, PAIRS):
            column = COLUMNS["pairs"].split(", ")[rng.integers(1, 11)]
            with contextlib.suppress(sqlite3.IntegrityError):
                connection.execute(f"UPDATE pairs SET {column} = {rng.choice(VALUES)} WHERE seq = ?", (seq,))
            row = connection.execute(f"SELECT {COLUMNS['pairs']} FROM pairs WHERE seq = ?", (seq,)).fetchone()
            connection.execute("UPDATE pairs SET checksum = ? WHERE seq = ?", (checksum(row), seq))
    recording = from_store(file)
    assert np.isfinite(recording.q).all()
    assert np.isfinite(recording.x).all()
    with PairStore(file, SESSION) as store:
        add(store, 1)
        assert numbers(store)[-1] == PAIRS + 1


def test_reading_circular_pages_ends(long) -> None:
    data = bytearray(long.read_bytes())
    root = next(k for k in range(PAGE_BYTES, len(data), PAGE_BYTES) if data[k] == 0x05)
    cells = int.from_bytes(data[root + 3 : root + 5], "big")
    for cell in range(cells):  # each leads to the first leaf
        at = root + int.from_bytes(data[root + 12 + 2 * cell : root + 14 + 2 * cell], "big")
        data[at : at + 4] = leaves(long)[0].to_bytes(4, "big")
    long.write_bytes(data)
    with PairReader(long) as reader:
        assert 0 < len(numbers(reader)) < LONG
    with PairStore(long, SESSION) as store:
        assert 0 < len(numbers(store)) < LONG


FRAME_BYTES, LOG_HEADER_BYTES = 24 + PAGE_BYTES, 32


def left_by_a_killed_sampler(folder: Path) -> Path:
    """Return a store whose newest pairs are in the write-ahead log alone."""
    with PairStore(folder / "live" / "pairs.sqlite", SESSION) as store:
        add(store, PAIRS)
        shutil.copytree(store.file.parent, folder / "killed")
    return folder / "killed" / "pairs.sqlite"


def with_a_flip_in_the_log(file: Path, commits_behind: int) -> None:
    log = file.with_name(f"{file.name}-wal")
    place = LOG_HEADER_BYTES + FRAME_BYTES * (len(commits(file)) - commits_behind) + 1000
    data = bytearray(log.read_bytes())
    data[place] ^= 1
    log.write_bytes(data)


def test_numbers_lost_in_damaged_log_are_not_reused(tmp_path: Path) -> None:
    file = left_by_a_killed_sampler(tmp_path)
    with_a_flip_in_the_log(file, 5)
    with PairStore(file, SESSION) as store:
        assert numbers(store)[-1] == PAIRS - 5
        assert str(store.reader.damage) == f"{PAIRS - 4} to {PAIRS}"
        add(store, 1)
        assert numbers(store)[-1] == PAIRS + 1


def test_a_torn_last_transaction_is_no_damage(tmp_path: Path) -> None:
    file = left_by_a_killed_sampler(tmp_path)
    with_a_flip_in_the_log(file, 1)
    with PairStore(file, SESSION) as store:
        assert store.complaints == []
