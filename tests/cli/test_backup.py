"""`bodyschema backup` and `bodyschema backup --restore`."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import shutil
import sqlite3
import threading
import zipfile
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
import warm
from guided_arm import Scene, new_learning, teach
from small_arm import URDF, write_small_arm

from bodyschema.cli.install.backup import MANIFEST, ROBOT_TOML, STORE, Backup, BackupError, write_backup
from bodyschema.cli.install.restore import restore
from bodyschema.cli.main import command_line
from bodyschema.daemon.config import Config
from bodyschema.daemon.learner.checkpoint import read_checkpoint, write_checkpoint
from bodyschema.daemon.sampler.devices import session_of
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import ZenohSession
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import StoreError
from bodyschema.interfaces.records import MarkerFix, frozen_array
from bodyschema.learning.state import LearningState
from bodyschema.recordings.store.store import PairReader, PairStore

UTC = "2026-11-21T12:00:00.000+00:00"
COV = frozen_array(np.eye(3) * 1e-6)
PAIRS = 20


def fill(store: PairStore, count: int) -> None:
    for k in range(count):
        fix = MarkerFix(float(k), frozen_array([0.1 * k, 0.2, 1.0]), COV)
        store.append(1, UTC, frozen_array([0.01 * k, -0.1]), fix)


def stored(file: Path) -> list[tuple[int, list[float]]]:
    with PairReader(file) as pairs:
        return [(pair.seq, pair.x.tolist()) for pair in pairs.read()]


@pytest.fixture
def config(tmp_path: Path, free_endpoint: Callable[[], str]) -> Config:
    """Return a robot with pairs and no checkpoint."""
    folder = tmp_path / "robot"
    folder.mkdir()
    zenoh = f'[zenoh]\nsampler = "{free_endpoint()}"\nlearner = "{free_endpoint()}"\n'
    config = Config.load(write_small_arm(folder, zenoh + '[daemon]\nstate_dir = "state"\n'), {})
    with PairStore(config.store_file, session_of(config, SystemClock())) as store:
        fill(store, PAIRS)
    return config


@pytest.fixture(scope="module")
def learnt() -> LearningState:
    learning = new_learning()
    teach(learning, Scene.draw(0, 5).pairs, background=False)
    return learning.state()


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "arm.zip"


@pytest.fixture
def backed_up(config: Config, file: Path) -> Path:
    write_backup(config, file, utc=UTC, version="0")
    return file


def put_back(file: Path, robot: Path, *, force: bool = False) -> Config:
    with Backup(file) as backup:
        restore(backup, robot, force=force)
    return Config.load(robot, {})


@pytest.fixture
def elsewhere(tmp_path: Path) -> Path:
    return tmp_path / "other" / "robot.toml"


def test_restored_files_on_another_machine_equal_the_backup(config, backed_up, elsewhere) -> None:
    again = put_back(backed_up, elsewhere)
    assert stored(again.store_file) == stored(config.store_file)
    assert elsewhere.read_bytes() == config.file.read_bytes()
    assert elsewhere.with_name("arm.urdf").read_text() == URDF


def test_new_pair_follows_the_newest_restored_one(backed_up, elsewhere) -> None:
    again = put_back(backed_up, elsewhere)
    with PairStore(again.store_file, session_of(again, SystemClock())) as store:
        fill(store, 1)
    assert stored(again.store_file)[-1][0] == PAIRS + 1


def test_backup_of_running_sampler_has_no_missing_pairs(config, file) -> None:
    sampling, enough = threading.Event(), threading.Event()

    def sample() -> None:
        with PairStore(config.store_file, session_of(config, SystemClock())) as store:
            while not enough.is_set():
                fill(store, 10)
                sampling.set()

    thread = threading.Thread(target=sample)
    thread.start()
    try:
        assert sampling.wait(300)
        made = write_backup(config, file, utc=UTC, version="0")
    finally:
        enough.set()
        thread.join()
    with zipfile.ZipFile(file) as archive:
        archive.extract(STORE, file.parent)
    assert [seq for seq, _ in stored(file.parent / STORE)] == list(range(1, made.last_seq + 1))
    assert made.last_seq > PAIRS


def test_the_checkpoint_goes_on_with_the_restored_store(config, file, elsewhere, learnt) -> None:
    with PairReader(config.store_file) as pairs:
        learnt.header.counters.store = pairs.identity
    write_checkpoint(config.checkpoint_file, learnt, robot="arm", utc=UTC)
    write_backup(config, file, utc=UTC, version="0")
    again = put_back(file, elsewhere)
    state = read_checkpoint(again.checkpoint_file, robot="arm")
    with PairReader(again.store_file) as pairs:
        assert state.header.counters.store == pairs.identity
    assert state.header.counters.pairs == learnt.header.counters.pairs


def test_restored_store_gets_a_new_identity(config, backed_up, elsewhere) -> None:
    again = put_back(backed_up, elsewhere)
    with PairReader(config.store_file) as one, PairReader(again.store_file) as other:
        assert one.identity != other.identity


def contents(folder: Path) -> dict[str, bytes | None]:
    """Return everything in a folder; None for what is not a file."""
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


def refused(file: Path, robot: Path) -> str:
    """Return the message that refuses a backup; assert that nothing else changed."""
    robot.parent.mkdir(exist_ok=True)
    before = contents(robot.parent)
    with pytest.raises((BackupError, StoreError)) as refusal:
        put_back(file, robot)
    assert contents(robot.parent) == before
    return str(refusal.value)


def test_existing_store_is_not_overwritten(config, backed_up) -> None:
    message = refused(backed_up, config.file)
    assert f"{config.store_file}: there already, and not what {backed_up} has" in message
    assert "Give --force" in message


def test_force_keeps_old_store_under_another_name(config, backed_up) -> None:
    with PairStore(config.store_file, session_of(config, SystemClock())) as store:
        fill(store, 5)
    put_back(backed_up, config.file, force=True)
    kept = config.store_file.with_name("pairs.sqlite.before-restore-1")
    assert (len(stored(config.store_file)), len(stored(kept))) == (PAIRS, PAIRS + 5)


def test_another_robot_toml_is_not_overwritten(backed_up, elsewhere) -> None:
    elsewhere.parent.mkdir()
    elsewhere.write_text("# mine\n")
    assert f"{elsewhere}: there already" in refused(backed_up, elsewhere)


@pytest.mark.soak
def test_restore_is_refused_while_a_sampler_writes(config, backed_up) -> None:
    with (
        PairStore(config.store_file, session_of(config, SystemClock())),
        pytest.raises(StoreError, match="another sampler is writing"),
    ):
        put_back_in_another_process(backed_up, config)


def put_back_in_another_process(file: Path, config: Config) -> None:
    """Restore in another process: the lock belongs to a process, so this one's own would not block it."""
    done = warm.run("-m", "bodyschema", "backup", file, "--restore", "--robot", config.file, "--force")
    if done.returncode:
        raise StoreError(done.stderr)


def test_a_running_learner_is_to_be_stopped_first(config, backed_up, elsewhere) -> None:
    with ZenohSession(listen=config.tables.zenoh.learner) as bus:
        bus.token(Keys("arm").alive("learner"))
        assert "the learner of arm runs. Nothing was changed. Stop it first" in refused(backed_up, elsewhere)


# --- files that are no backups


def altered(file: Path, change: Callable[[dict[str, bytes]], None]) -> Path:
    with zipfile.ZipFile(file) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    other = file.with_name("altered.zip")
    with zipfile.ZipFile(other, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return other


def test_a_damaged_store_in_it_is_refused(backed_up, elsewhere) -> None:
    def damage(members: dict[str, bytes]) -> None:
        members[STORE] = members[STORE][:-1] + b"x"

    assert f"{STORE} in" in (said := refused(altered(backed_up, damage), elsewhere))
    assert "its checksum does not match" in said


def test_member_longer_than_its_manifest_size_is_refused(backed_up, elsewhere) -> None:
    def swell(members: dict[str, bytes]) -> None:
        members[STORE] += bytes(10**7)

    assert "its checksum does not match" in refused(altered(backed_up, swell), elsewhere)


@pytest.mark.parametrize("name", ["robot/../../escaped", "/etc/escaped", "elsewhere/escaped"])
def test_a_name_that_leads_elsewhere_is_refused(backed_up, elsewhere, name) -> None:
    def lead_astray(members: dict[str, bytes]) -> None:
        manifest = json.loads(members[MANIFEST])
        manifest["files"][name] = manifest["files"][ROBOT_TOML]
        members[MANIFEST], members[name] = json.dumps(manifest).encode(), members[ROBOT_TOML]

    said = refused(altered(backed_up, lead_astray), elsewhere)
    assert f"has {name!r}, which its robot.toml does not name so. Nothing was changed" in said


def test_a_robot_s_name_that_leads_elsewhere_is_refused(backed_up, elsewhere) -> None:
    def lead_astray(members: dict[str, bytes]) -> None:
        manifest = json.loads(members[MANIFEST])
        manifest["robot"] = "../../escaped"
        members[MANIFEST] = json.dumps(manifest).encode()

    assert "cannot be understood" in refused(altered(backed_up, lead_astray), elsewhere)


def test_member_absent_from_manifest_is_refused(backed_up, elsewhere) -> None:
    stranger = altered(backed_up, lambda members: members.update({"robot/stranger": b"x"}))
    assert "does not hold the files that its manifest.json says" in refused(stranger, elsewhere)


def test_a_backup_of_a_newer_version_is_refused(backed_up, elsewhere) -> None:
    def renew(members: dict[str, bytes]) -> None:
        members[MANIFEST] = members[MANIFEST].replace(b'"schema": 1', b'"schema": 2')

    assert "was written by a newer bodyschema (schema 2" in refused(altered(backed_up, renew), elsewhere)


@pytest.mark.parametrize("data", [b"", b"my diary", b"PK\x03\x04 not quite"])
def test_a_file_that_is_no_archive_is_refused(file, elsewhere, data) -> None:
    file.write_bytes(data)
    assert f"{file} is no backup, or is damaged" in refused(file, elsewhere)


def test_a_device_as_backup_is_refused(elsewhere) -> None:
    assert "a device, not a file" in refused(Path("/dev/zero"), elsewhere)


def test_a_torn_backup_is_refused(backed_up, elsewhere) -> None:
    backed_up.write_bytes(backed_up.read_bytes()[:-100])
    assert "is no backup, or is damaged" in refused(backed_up, elsewhere)


# --- archives that were made to do harm


def described(change: Callable[[str], str]) -> Callable[[dict[str, bytes]], None]:
    """Return a change of an archive to another robot.toml with matching checksums."""

    def altered_members(members: dict[str, bytes]) -> None:
        members[ROBOT_TOML] = change(members[ROBOT_TOML].decode()).encode()
        seal(members)

    return altered_members


def seal(members: dict[str, bytes]) -> None:
    manifest = json.loads(members.pop(MANIFEST))
    manifest["files"] = {
        name: {"size": len(data), "blake2b": hashlib.blake2b(data, digest_size=32).hexdigest(), "origin": "/there"}
        for name, data in members.items()
    }
    members[MANIFEST] = json.dumps(manifest).encode()


HARMFUL = [
    ".git/hooks/post-checkout", ".bashrc", "venv/lib/python3.11/site-packages/evil.pth", "Makefile", "conftest.py",
    "a/../.ssh/authorized_keys", "a\nb.urdf", "state/../../arm.urdf", "/etc/cron.d/evil.urdf",
]  # fmt: skip


@pytest.mark.parametrize("name", HARMFUL)
@pytest.mark.parametrize("named", [False, True], ids=["not named by robot.toml", "named as the URDF"])
def test_an_executable_file_is_not_written(backed_up, elsewhere, name, named) -> None:
    def plant(members: dict[str, bytes]) -> None:
        text = members[ROBOT_TOML].decode()
        if named:
            members[ROBOT_TOML] = text.replace('"arm.urdf"', json.dumps(name)).encode()
            del members["robot/arm.urdf"]
        members[f"robot/{name}"] = members[ROBOT_TOML] if name == "robot.toml" else b"import os"
        seal(members)

    assert "Nothing was changed" in refused(altered(backed_up, plant), elsewhere)


def test_an_encrypted_archive_is_refused(backed_up, elsewhere) -> None:
    data = bytearray(backed_up.read_bytes())
    data[data.rindex(b"PK\x01\x02") + 8] |= 1
    backed_up.write_bytes(data)
    assert "is no backup, or is damaged" in refused(backed_up, elsewhere)


@pytest.mark.parametrize("folder", ["/srv/state", "../state", "a/../../state", ".git/hooks"])
def test_a_state_dir_elsewhere_is_asked_for(backed_up, elsewhere, folder, tmp_path) -> None:
    archive = altered(backed_up, described(lambda text: text.replace('"state"', json.dumps(folder))))
    where = "in a hidden folder" if folder.startswith(".git") else "outside of its folder"
    assert f"keeps samples and checkpoint {where}. Nothing was changed. Give --state-dir" in refused(archive, elsewhere)
    with Backup(archive) as backup:
        restore(backup, elsewhere, tmp_path / "given")
    assert len(stored(tmp_path / "given" / "pairs.sqlite")) == PAIRS


def test_a_known_state_dir_is_not_asked_for(config, file, tmp_path) -> None:
    config.file.write_text(config.file.read_text().replace('"state"', json.dumps(str(tmp_path / "far"))))
    far = Config.load(config.file, {})
    config.state_dir.rename(far.state_dir)
    write_backup(far, file, utc=UTC, version="0")
    assert len(stored(put_back(file, far.file, force=True).store_file)) == PAIRS


@pytest.mark.parametrize("name", ["ROBOT/robot.toml", "state/PAIRS.sqlite"])
def test_names_that_differ_in_case_alone_are_refused(backed_up, elsewhere, name) -> None:
    assert "has two files of the same name" in refused(altered(backed_up, lambda m: m.update({name: b""})), elsewhere)


def test_a_name_that_comes_twice_is_refused(backed_up, elsewhere) -> None:
    with zipfile.ZipFile(backed_up, "a") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr(ROBOT_TOML, "other")
    assert "has two files of the same name" in refused(backed_up, elsewhere)


def test_a_link_in_an_archive_is_not_made(backed_up, elsewhere) -> None:
    with zipfile.ZipFile(backed_up) as archive:
        members = {info: archive.read(info) for info in archive.infolist()}
    with zipfile.ZipFile(backed_up, "w") as archive:
        for info, data in members.items():
            info.external_attr = 0o120777 << 16
            archive.writestr(info, data)
    again = put_back(backed_up, elsewhere)
    assert not any(path.is_symlink() for path in again.file.parent.rglob("*"))


@pytest.mark.parametrize("packing", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_packing_that_swells_without_limit_is_refused(backed_up, elsewhere, packing) -> None:
    with zipfile.ZipFile(backed_up) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(backed_up, "w", packing) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    assert "is packed in another way than a backup" in refused(backed_up, elsewhere)


@pytest.mark.parametrize(
    "text", ["robot = 3", "[robot", "robot = { urdf = 4 }\nzenoh = 5", "x" * 10, "\x00", "a." * 500]
)
def test_a_robot_toml_that_is_none_is_refused(backed_up, elsewhere, text) -> None:
    assert str(backed_up.with_name("altered.zip")) in refused(altered(backed_up, described(lambda _: text)), elsewhere)


def test_endpoints_that_are_none_are_refused(backed_up, elsewhere) -> None:
    archive = altered(backed_up, described(lambda text: text.replace("[zenoh]", "[zenoh]\nlearner = 5\n[other]")))
    assert "zenoh" in refused(archive, elsewhere)


def test_a_store_with_a_trigger_is_refused(backed_up, elsewhere, tmp_path) -> None:
    def plant(members: dict[str, bytes]) -> None:
        (tmp_path / "planted").write_bytes(members[STORE])
        with contextlib.closing(sqlite3.connect(tmp_path / "planted")) as connection:
            connection.execute("CREATE TRIGGER t AFTER INSERT ON pairs BEGIN DELETE FROM pairs; END")
        members[STORE] = (tmp_path / "planted").read_bytes()
        seal(members)

    assert "it has a trigger" in refused(altered(backed_up, plant), elsewhere)


def test_a_backup_leaves_out_changed_pairs(config, file, elsewhere, capsys) -> None:
    with contextlib.closing(sqlite3.connect(config.store_file)) as connection:
        connection.execute("UPDATE pairs SET q = '[0.5,0.5]' WHERE seq IN (3, 4)")
        connection.commit()
    before = config.store_file.read_bytes()
    for words in (["backup", file, "--robot", config.file], ["backup", file, "--restore", "--robot", elsewhere]):
        command_line(words[0])(list(map(str, words)), exit_on_error=False, result_action="return_value")
    shown = capsys.readouterr().out
    assert f"{file}: arm, 18 samples to number 20" in shown
    assert "2 samples cannot be read and are not in it" in shown
    assert "2 samples between could not be read when it was written" in shown
    assert config.store_file.read_bytes() == before
    with PairReader(elsewhere.parent / "state" / "pairs.sqlite") as pairs:
        audit = pairs.audit()
    assert (audit.pairs, audit.newest, audit.lost_rows) == (18, 20, 0)


def test_restore_leaves_out_changed_pairs(backed_up, elsewhere, tmp_path) -> None:
    def damage(members: dict[str, bytes]) -> None:
        members[STORE] = members[STORE].replace(b"[0.1,0.2,1.0]", b"[0.1,0.3,1.0]")
        seal(members)

    again = put_back(altered(backed_up, damage), elsewhere)
    assert [seq for seq, _ in stored(again.store_file)] == [1, *range(3, PAIRS + 1)]


# --- "Nothing was changed" is true


@pytest.mark.parametrize("nth", range(1, 6))
def test_a_restore_that_fails_midway_is_undone(config, backed_up, monkeypatch, nth) -> None:
    with PairStore(config.store_file, session_of(config, SystemClock())) as store:
        fill(store, 5)
    config.file.with_name("arm.urdf").write_text("<other/>")
    config.file.write_text(config.file.read_text() + "# changed\n")
    before, left = contents(config.file.parent), [nth]

    def failing(do: Callable[..., object]) -> Callable[..., object]:
        def once(*paths: object) -> object:
            left[0] -= 1
            if left[0] == 0:
                raise OSError(errno.EIO, "Input/output error", str(paths[0]))
            return do(*paths)

        return once

    monkeypatch.setattr("os.replace", failing(os.replace))
    monkeypatch.setattr("bodyschema.cli.install.restore.sync_folder", failing(lambda folder: None))
    with pytest.raises(BackupError, match=r"Input/output error\. Nothing was changed"):
        put_back(backed_up, config.file, force=True)
    assert contents(config.file.parent) == before


def test_a_restore_without_room_changes_nothing(mount_small_disk, backed_up) -> None:
    folder = mount_small_disk("size=64k")
    (folder / "ballast").write_bytes(bytes(2**15))
    said = refused(backed_up, folder / "robot.toml")
    assert "Nothing was changed" in said
    assert "is full" in said or "MB are needed" in said


def test_files_of_others_beside_the_robot_stay(backed_up, elsewhere) -> None:
    elsewhere.parent.mkdir()
    for name in ("robot.toml.restored", "arm.urdf.restored", ".restore-1"):
        (elsewhere.parent / name).write_text("mine")
    put_back(backed_up, elsewhere)
    assert (elsewhere.parent / "arm.urdf.restored").read_text() == "mine"


def flip_each(bits: Iterable[int], archive: Path, robot: Path) -> Counter[str]:
    """Restore from the archive with one bit changed: what was backed up, or a message and no change."""
    outcomes: Counter[str] = Counter()
    data, flipped = archive.read_bytes(), archive.with_name("flipped.zip")
    for bit in bits:
        changed = bytearray(data)
        changed[bit // 8] ^= 1 << bit % 8
        flipped.write_bytes(changed)
        shutil.rmtree(robot.parent, ignore_errors=True)
        robot.parent.mkdir()
        try:
            with Backup(flipped) as backup:
                restore(backup, robot)
        except (BackupError, StoreError):
            outcomes["refused"] += 1
            assert contents(robot.parent) == {}
        else:
            outcomes["restored"] += 1
            assert robot.with_name("arm.urdf").read_text() == URDF
            assert len(stored(robot.parent / "state" / "pairs.sqlite")) == PAIRS
    return outcomes


@pytest.fixture
def at_rest(monkeypatch) -> None:
    """Skip the check for running processes: there are none."""
    monkeypatch.setattr("bodyschema.cli.install.restore.is_alive", lambda *_: False)


@pytest.mark.usefixtures("at_rest")
def test_a_flipped_bit_in_an_archive_is_found(backed_up, elsewhere) -> None:
    size = 8 * backed_up.stat().st_size
    rng = np.random.default_rng(0)
    bits = [*rng.choice(size, 40, replace=False).tolist(), *range(size - 8 * 600, size, 97)]  # its directory is last
    outcomes = flip_each(bits, backed_up, elsewhere)
    assert outcomes["refused"] > 40


@pytest.mark.soak
@pytest.mark.timeout(7200)
@pytest.mark.usefixtures("at_rest")
def test_every_flipped_bit_in_an_archive_is_found(backed_up, elsewhere) -> None:
    size = 8 * backed_up.stat().st_size
    assert flip_each(range(size), backed_up, elsewhere)["refused"] > 0.8 * size


# --- writing one


def test_a_backup_that_is_there_is_not_overwritten(config, backed_up) -> None:
    before = backed_up.read_bytes()
    with pytest.raises(BackupError, match=r"is there already\. Give another name, or --force"):
        write_backup(config, backed_up, utc=UTC, version="0")
    assert backed_up.read_bytes() == before


def test_failed_backup_keeps_old_archive_without_leftovers(config, backed_up) -> None:
    before = backed_up.read_bytes()
    shutil.rmtree(config.state_dir)
    with pytest.raises(StoreError, match="there is no store"):
        write_backup(config, backed_up, utc=UTC, version="0", replace=True)
    assert backed_up.read_bytes() == before
    assert sorted(path.name for path in backed_up.parent.iterdir()) == ["arm.zip", "robot"]


def test_only_its_owner_reads_it(backed_up) -> None:
    assert backed_up.stat().st_mode & 0o777 == 0o600


def test_restore_keeps_outside_urdf_and_names_its_place(config, file, elsewhere, capsys) -> None:
    urdf = config.file.parent.parent / "models" / "arm.urdf"
    urdf.parent.mkdir()
    config.robot.tree.file.rename(urdf)
    config.file.write_text(config.file.read_text().replace('"arm.urdf"', '"../models/arm.urdf"'))
    write_backup(Config.load(config.file, {}), file, utc=UTC, version="0")
    command_line("backup")(
        ["backup", str(file), "--restore", "--robot", str(elsewhere)], exit_on_error=False, result_action="return_value"
    )
    kept = elsewhere.parent / "elsewhere" / "arm.urdf"
    assert kept.read_text() == URDF
    assert f"put {kept} there" in capsys.readouterr().out


def test_the_commands_go_there_and_back(config, file, elsewhere, capsys) -> None:
    for words in (["backup", file, "--robot", config.file], ["backup", file, "--restore", "--robot", elsewhere]):
        command_line(words[0])(list(map(str, words)), exit_on_error=False, result_action="return_value")
    shown = capsys.readouterr().out
    assert f"{file}: arm, 20 samples to number 20, no checkpoint yet" in shown
    assert f"  {elsewhere}\n" in shown
