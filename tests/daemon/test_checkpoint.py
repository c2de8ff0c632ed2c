from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from guided_arm import Scene, new_learning, teach

from bodyschema.daemon.learner.checkpoint import (
    MAX_BYTES,
    CheckpointError,
    generations,
    read_checkpoint,
    resume_from_checkpoint,
    set_aside,
    write_checkpoint,
)
from bodyschema.learning.state import LearningState

UTC = "2026-11-21T12:00:00.000+00:00"


def state(pairs: int) -> LearningState:
    learning = new_learning()
    teach(learning, Scene.draw(0, pairs).pairs, background=False)
    return learning.state()


def write(file: Path, written: LearningState, robot: str = "arm") -> None:
    write_checkpoint(file, written, robot=robot, utc=UTC)


def same(a: LearningState, b: LearningState | None) -> bool:
    return (
        b is not None
        and (a.header, a.arrays.keys()) == (b.header, b.arrays.keys())
        and all(np.array_equal(a.arrays[name], b.arrays[name], equal_nan=True) for name in a.arrays)
    )


@pytest.fixture(scope="module")
def old() -> LearningState:
    return state(3)


@pytest.fixture(scope="module")
def new() -> LearningState:
    return state(5)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "state" / "learner.ckpt"


@pytest.fixture
def written(file: Path, old: LearningState) -> Path:
    write(file, old)
    return file


def test_checkpoint_round_trip_is_bit_exact(written, old) -> None:
    assert same(old, read_checkpoint(written, robot="arm"))


def test_before_the_first_checkpoint_there_is_none(file) -> None:
    assert read_checkpoint(file, robot="arm") is None


def test_new_checkpoint_keeps_old_one_as_previous(written, old, new) -> None:
    write(written, new)
    present, previous = generations(written)
    assert same(new, read_checkpoint(present, robot="arm"))
    assert same(old, read_checkpoint(previous, robot="arm"))
    assert set(written.parent.iterdir()) == {present, previous}


def test_of_many_checkpoints_two_are_kept(written, old, new) -> None:
    for state in (new, old, new, old):
        write(written, state)
    assert set(written.parent.iterdir()) == set(generations(written))
    assert same(new, read_checkpoint(generations(written)[1], robot="arm"))


def test_previous_checkpoint_is_kept_without_hard_links(written, old, new, monkeypatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr("os.link", refuse)
    write(written, new)
    kept = [read_checkpoint(file, robot="arm") for file in generations(written)]
    assert all(map(same, (new, old), kept))


@pytest.mark.parametrize("name", ["net_nlms", "q", "x"])
def test_non_finite_state_is_not_written(written, old, new, name) -> None:
    invalid_array = {**new.arrays, name: np.full_like(new.arrays[name], np.nan)}
    with pytest.raises(CheckpointError, match=f"was not written: {name} is not finite"):
        write(written, LearningState(new.header, invalid_array))
    assert same(old, read_checkpoint(written, robot="arm"))


def test_full_disk_error_keeps_old_checkpoint(written, old, new) -> None:
    written.with_name("learner.ckpt.tmp").symlink_to("/dev/full")
    with pytest.raises(CheckpointError, match=f"{written} could not be written: the disk is full. Free some space"):
        write(written, new)
    assert same(old, read_checkpoint(written, robot="arm"))
    assert not written.with_name("learner.ckpt.tmp").exists()


def test_file_in_place_of_folder_is_reported(tmp_path, old) -> None:
    (tmp_path / "state").touch()
    with pytest.raises(CheckpointError, match=r"state is not a folder. Learning continues; give a folder as state_dir"):
        write(tmp_path / "state" / "learner.ckpt", old)


def test_a_read_only_disk_is_named(mount_small_disk, old) -> None:
    file = mount_small_disk("ro,size=512k") / "learner.ckpt"
    with pytest.raises(CheckpointError, match=r"Read-only file system. Learning continues; give a --state-dir"):
        write(file, old)


def test_another_robots_checkpoint_is_refused(written) -> None:
    with pytest.raises(CheckpointError, match="belongs to the robot 'arm', this one is 'leg'"):
        read_checkpoint(written, robot="leg")


def test_a_file_that_is_no_checkpoint_is_refused(written) -> None:
    written.write_text("my diary " * 100)
    with pytest.raises(CheckpointError, match="is not a checkpoint"):
        read_checkpoint(written, robot="arm")


def test_a_checkpoint_of_a_newer_version_is_refused(written) -> None:
    data = bytearray(written.read_bytes())
    data[8] = 99
    written.write_bytes(data)
    with pytest.raises(CheckpointError, match="has the version 99"):
        read_checkpoint(written, robot="arm")


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.999])
def test_a_torn_checkpoint_is_refused(written, share) -> None:
    data = written.read_bytes()
    written.write_bytes(data[: int(share * len(data))])
    with pytest.raises(CheckpointError, match=r"is not a checkpoint|is damaged"):
        read_checkpoint(written, robot="arm")


def test_a_flipped_bit_anywhere_is_found(written) -> None:
    data = written.read_bytes()
    for place in range(12, len(data), len(data) // 50):
        written.write_bytes(data[:place] + bytes([data[place] ^ 4]) + data[place + 1 :])
        with pytest.raises(CheckpointError, match="is damaged"):
            read_checkpoint(written, robot="arm")


def test_setting_aside_keeps_earlier_set_aside_files(written) -> None:
    content = written.read_bytes()
    first = set_aside(written)
    written.write_bytes(b"second")
    second = set_aside(written)
    assert (first.read_bytes(), second.read_bytes()) == (content, b"second")
    assert not written.exists()


# --- checksums that are right, of headers that are not


def sealed(file: Path, change: Callable[[dict[str, Any]], None], arrays: Callable[[bytes], bytes] = bytes) -> Path:
    """Write the checkpoint with a changed header and changed arrays, under a valid checksum."""
    data = file.read_bytes()
    end = 16 + int.from_bytes(data[12:16], "little")
    header = msgspec.msgpack.decode(data[16:end])
    change(header)
    encoded = msgspec.msgpack.encode(header)
    body = data[:12] + len(encoded).to_bytes(4, "little") + encoded + arrays(data[end:-16])
    file.write_bytes(body + hashlib.blake2b(body, digest_size=16).digest())
    return file


@pytest.mark.parametrize("shape", [[-1, -1], [-8], [2**62, 2**62], [0, 2**63 - 1], [1] * 70, [1.5], None, ["1"], [[1]]])
def test_an_array_that_cannot_be_is_refused(written, shape) -> None:
    def change(header: dict[str, Any]) -> None:
        header["arrays"][0]["shape"] = shape

    with pytest.raises(CheckpointError, match=str(written)):
        read_checkpoint(sealed(written, change), robot="arm")


def test_shapes_that_cancel_are_refused(written) -> None:
    def change(header: dict[str, Any]) -> None:
        first, second, *_ = header["arrays"]
        first["shape"], second["shape"] = [-1], [math.prod(first["shape"]) + math.prod(second["shape"]) + 1]

    with pytest.raises(CheckpointError, match="cannot be understood"):
        read_checkpoint(sealed(written, change), robot="arm")


def test_a_header_of_many_layers_is_refused(written) -> None:
    def change(header: dict[str, Any]) -> None:
        for _ in range(400):
            header["learning"] = {**header["learning"], "before": dict(header["learning"])}

    with pytest.raises(CheckpointError):
        read_checkpoint(sealed(written, change, lambda _: b""), robot="arm")


@pytest.mark.parametrize(("name", "number"), [("q", 1e7), ("q", 1e308), ("x", 2000.0), ("x", -1e308)])
def test_impossible_kept_pairs_are_refused(written, old, name, number) -> None:
    arrays = {**old.arrays, name: np.full_like(old.arrays[name], number)}
    data = b"".join(np.ascontiguousarray(array, dtype="<f8").tobytes() for array in arrays.values())
    sealed(written, lambda header: None, lambda _: data)
    learning, said = resume_from_checkpoint(new_learning, written, "arm")
    assert learning.counters.pairs == 0
    assert said is not None
    assert f"{name} is not finite or too large" in said


@pytest.mark.parametrize("endless", ["/dev/zero", "/dev/urandom"])
def test_a_device_as_checkpoint_is_refused(file, endless) -> None:
    file.parent.mkdir()
    file.symlink_to(endless)
    with pytest.raises(CheckpointError, match="a device, not a file"):
        read_checkpoint(file, robot="arm")


def test_a_huge_checkpoint_is_refused_unread(file) -> None:
    file.parent.mkdir()
    with file.open("wb") as stream:
        stream.truncate(MAX_BYTES + 1)
    with pytest.raises(CheckpointError, match="cannot read the checkpoint"):
        read_checkpoint(file, robot="arm")


def test_a_folder_as_checkpoint_is_refused(file) -> None:
    file.mkdir(parents=True)
    with pytest.raises(CheckpointError, match="cannot read the checkpoint"):
        read_checkpoint(file, robot="arm")


NASTY = (0, -1, 2**63 - 1, -(2**63), 1e308, math.nan, None, "", "\0", b"\xff", [], [[]], {}, True, [1e308] * 3)


def altered(value: Any, rng: np.random.Generator) -> Any:
    """Return the value with one malformed entry somewhere inside."""
    if isinstance(value, dict) and value and ("learning" in value or rng.random() < 0.9):
        key = list(value)[rng.integers(len(value))]
        return {**value, key: altered(value[key], rng)}
    if isinstance(value, list) and value and rng.random() < 0.9:
        place = int(rng.integers(len(value)))
        return [*value[:place], altered(value[place], rng), *value[place + 1 :]]
    return NASTY[rng.integers(len(NASTY))]


def go_on_from_nasty_headers(written: Path, count: int) -> None:
    """Assert that a learner resumes from malformed headers, or says why it does not."""
    data, rng = written.read_bytes(), np.random.default_rng(0)
    for _ in range(count):
        written.write_bytes(data)
        sealed(written, lambda header: header.update(altered(header, rng)))
        learning, _ = resume_from_checkpoint(new_learning, written, "arm")
        assert learning.counters.pairs >= 0
        learning.state()


def test_a_harmful_header_ends_no_learner(written) -> None:
    go_on_from_nasty_headers(written, 40)


@pytest.mark.soak
def test_ten_thousand_harmful_headers_end_no_learner(written) -> None:
    go_on_from_nasty_headers(written, 10_000)
