"""Files of older versions, kept in tests/daemon/older_versions: the state of a robot after an upgrade."""

from __future__ import annotations

import contextlib
import shutil
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from small_arm import URDF
from two_processes import running, status_when, write_robot

from bodyschema.cli.install.backup import Backup, write_backup
from bodyschema.cli.install.restore import restore
from bodyschema.daemon.config import Config
from bodyschema.daemon.learner.checkpoint import CheckpointError, read_checkpoint
from bodyschema.daemon.sampler.devices import session_of
from bodyschema.daemon.transport.status import LearnerStatus
from bodyschema.daemon.transport.wire import PairMessage, pair_to_wire
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import StoreError
from bodyschema.interfaces.records import Pair
from bodyschema.recordings.store.damage import Damage
from bodyschema.recordings.store.schema import SCHEMA_VERSION
from bodyschema.recordings.store.store import PairReader, PairStore

OLDER = Path(__file__).parents[1] / "daemon" / "older_versions"
PAIRS = 40  # in each of the files
ROWS = 60


@pytest.fixture
def config(tmp_path: Path, free_endpoint: Callable[[], str]) -> Config:
    """Return a robot with the pairs of the first version."""
    config = write_robot(tmp_path, free_endpoint, rows=ROWS)
    config.state_dir.mkdir()
    shutil.copy(OLDER / "pairs_1.sqlite", config.store_file)
    return config


def schema(file: Path) -> int:
    with contextlib.closing(sqlite3.connect(file)) as connection:
        return connection.execute("PRAGMA user_version").fetchone()[0]


@pytest.fixture(params=[1, 4])
def older(config: Config, request: pytest.FixtureRequest) -> Config:
    """Return the robot with the pairs of an older schema."""
    shutil.copy(OLDER / f"pairs_{request.param}.sqlite", config.store_file)
    return config


def told(pairs: list[Pair]) -> list[PairMessage]:
    return [pair_to_wire(pair) for pair in pairs]


def test_an_upgrade_keeps_older_pairs_as_they_were(older: Config) -> None:
    before = schema(older.store_file)
    with PairReader(older.store_file) as reader:
        pairs, identity = told(reader.read()), reader.identity
    assert schema(older.store_file) == before  # a reader changes nothing
    with PairStore(older.store_file, session_of(older, SystemClock())) as store:
        assert (store.identity, told(store.read())) == (identity, pairs)
        assert (store.audit.pairs, store.audit.lost_rows, store.complaints) == (PAIRS, 0, [])
    assert (schema(older.store_file), len(pairs)) == (SCHEMA_VERSION, PAIRS)


def test_after_an_upgrade_a_changed_digit_is_found(older: Config) -> None:
    with PairStore(older.store_file, session_of(older, SystemClock())):
        pass
    with contextlib.closing(sqlite3.connect(older.store_file)) as connection:
        connection.execute("UPDATE pairs SET x = replace(x, '1', '2') WHERE seq = 7")
        connection.commit()
    with PairReader(older.store_file) as reader:
        assert reader.audit().damage == Damage(((7, 7),))


def test_an_unreadable_older_row_is_left_out(older: Config) -> None:
    with contextlib.closing(sqlite3.connect(older.store_file)) as connection:
        connection.execute("UPDATE pairs SET q = CAST(x'5b80' AS TEXT) WHERE seq = 7")
        connection.commit()
    with PairStore(older.store_file, session_of(older, SystemClock())) as store:
        assert store.audit.damage == Damage(((7, 7),))
        assert store.audit.pairs == PAIRS - 1


KILLED_WHILE_MIGRATING = """
import os, signal, sys
from pathlib import Path
from bodyschema.daemon.config import Config
from bodyschema.daemon.sampler.devices import session_of
from bodyschema.recordings.store import schema as store_schema
from bodyschema.recordings.store.store import PairStore
from bodyschema.interfaces.clock import SystemClock
left = int(sys.argv[2])
seal = store_schema.decoded
def doomed(*row):
    global left
    left -= 1
    if left == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return seal(*row)
store_schema.decoded = doomed
config = Config.load(Path(sys.argv[1]))
with PairStore(config.store_file, session_of(config, SystemClock())):
    pass
"""


def test_a_killed_upgrade_leaves_older_pairs(older: Config) -> None:
    before = schema(older.store_file)
    with PairReader(older.store_file) as reader:
        pairs = told(reader.read())
    command = [sys.executable, "-P", "-c", KILLED_WHILE_MIGRATING, str(older.file), "30"]
    done = subprocess.run(command, timeout=400, check=False)
    assert done.returncode == -signal.SIGKILL
    with PairStore(older.store_file, session_of(older, SystemClock())) as store:
        assert told(store.read()) == pairs
    assert before < schema(older.store_file) == SCHEMA_VERSION


def test_a_downgrade_is_refused_with_the_remedy(config: Config, monkeypatch) -> None:
    with PairStore(config.store_file, session_of(config, SystemClock())):
        pass
    monkeypatch.setattr("bodyschema.recordings.store.schema.SCHEMA_VERSION", SCHEMA_VERSION - 1)
    said = rf"written by a newer bodyschema \(schema {SCHEMA_VERSION}, this one knows {SCHEMA_VERSION - 1}\). Install"
    with pytest.raises(StoreError, match=said), PairReader(config.store_file):
        pass


def test_interrupted_migration_leaves_first_version(config: Config) -> None:
    with contextlib.closing(sqlite3.connect(config.store_file)) as connection:
        connection.execute("CREATE TABLE devices (somebody, elses)")
    with pytest.raises(StoreError), PairStore(config.store_file, session_of(config, SystemClock())):
        pass
    assert schema(config.store_file) == 1


def test_first_version_pairs_survive_backup_and_restore(config: Config, tmp_path: Path) -> None:
    write_backup(config, tmp_path / "arm.zip", utc="", version="0")
    with Backup(tmp_path / "arm.zip") as backup:
        restore(backup, tmp_path / "other" / "robot.toml")
    with PairReader(tmp_path / "other" / "state" / "pairs.sqlite") as pairs:
        assert pairs.last_seq() == PAIRS


@pytest.mark.parametrize(
    ("version", "said"),
    [
        (1, "has the version 1; this bodyschema reads"),
        (2, "has the version 2; this bodyschema reads"),
        (3, "cannot be understood: Object missing required field"),
    ],
)
def test_unreadable_old_checkpoint_says_why(version: int, said: str) -> None:
    with pytest.raises(CheckpointError, match=said):
        read_checkpoint(OLDER / f"learner_{version}.ckpt", robot="arm")


def test_old_checkpoint_is_kept_and_store_relearnt(config: Config) -> None:
    shutil.copy(OLDER / "learner_1.ckpt", config.checkpoint_file)
    with running(config, "sampler"), running(config, "learner"):
        status = status_when(config, "learner", LearnerStatus, lambda status: status.pairs == PAIRS + ROWS)
    assert (status.last_seq, status.missed, status.refused) == (PAIRS + ROWS, 0, 0)
    kept = config.checkpoint_file.with_name("learner.ckpt.unusable-1")
    assert f"It was kept as {kept}; the learner learns again" in status.health[0]
    assert kept.read_bytes() == (OLDER / "learner_1.ckpt").read_bytes()


def test_the_first_version_s_robot_toml_is_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "arm.urdf").write_text(URDF)
    shutil.copy(OLDER / "robot_1.toml", tmp_path / "robot.toml")
    config = Config.load(tmp_path / "robot.toml", {})
    assert config.tables.learner.checkpoint_every_s == 0.2
    assert config.tables.sim.tool_changes == ()
    said = [record.getMessage().partition("robot.toml:")[2] for record in caplog.records]
    assert "25: [daemon] segment_gap_s is no key any more, and its value is not used. Delete the line" in said
    assert len(said) == len(set(said)) == 17
