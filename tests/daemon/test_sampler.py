from __future__ import annotations

import contextlib
import json
import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from queue import Queue

import msgspec
import numpy as np
import pytest
from scripted_sources import COV, FRAME_S, Scripted, Walk, World, simulated
from small_arm import write_small_arm

from bodyschema.daemon.config import Config
from bodyschema.daemon.sampler.devices import session_of
from bodyschema.daemon.sampler.sampler import Sampler
from bodyschema.daemon.sampler.sources import Sources
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import ZenohSession, client
from bodyschema.daemon.transport.status import SamplerStatus
from bodyschema.daemon.transport.wire import MSGPACK, CommandRequest, PairMessage, PairsReply, decode, encode
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import BusError, ConfigError, RequestError, SourceError, SourceLost, StoreError
from bodyschema.interfaces.records import JointReading, MarkerFix, MarkerMiss, Pair, Reason, frozen_array
from bodyschema.interfaces.rejections import REMEDIES
from bodyschema.recordings.store.store import PairStore

LIMIT_S = 500.0
KEYS = Keys("arm")


def small_arm(folder: Path, endpoint: str) -> Config:
    tables = f'[zenoh]\nsampler = "{endpoint}"\n[daemon]\nstate_dir = "state"\n'
    return Config.load(write_small_arm(folder, tables), {})


@pytest.fixture
def config(tmp_path: Path, endpoint: str) -> Config:
    return small_arm(tmp_path, endpoint)


@contextmanager
def sampling(config: Config, sources: Sources, *, exit_at_end: bool = False) -> Iterator[Sampler]:
    with (
        PairStore(config.store_file, session_of(config, SystemClock())) as store,
        ZenohSession(listen=config.tables.zenoh.sampler) as bus,
    ):
        yield Sampler(config, sources, bus, store, exit_at_end=exit_at_end)


def sample(config: Config, sources: Sources) -> tuple[list[Pair], SamplerStatus]:
    """Sample to the end of the sources; return the pairs in the store and the last status."""
    with sampling(config, sources, exit_at_end=True) as sampler:
        sampler.run()
        return sampler._store.read(), sampler.status()


@contextmanager
def running(config: Config, sources: Sources) -> Iterator[ZenohSession]:
    """Yield a client of a sampler that runs in a thread until the block ends."""
    with sampling(config, sources) as sampler:
        thread = threading.Thread(target=sampler.run)
        with client(config.tables.zenoh.sampler) as asking:
            watched = threading.Event()
            asking.watch(KEYS.alive("sampler"), lambda alive: watched.set() if alive else None)
            thread.start()
            try:
                assert watched.wait(LIMIT_S)
                yield asking
            finally:
                sampler.stop()
                thread.join(LIMIT_S)
    assert not thread.is_alive()


def status_when(bus: ZenohSession, true: Callable[[SamplerStatus], bool]) -> SamplerStatus:
    """Return the first published status for which `true` holds."""
    published: Queue[bytes] = Queue()
    bus.subscribe(KEYS.status("sampler"), published.put)
    status = decode(bus.ask_one(KEYS.status("sampler")), SamplerStatus)
    while not true(status):
        status = decode(published.get(timeout=LIMIT_S), SamplerStatus)
    return status


def command(bus: ZenohSession, name: str) -> str:
    return json.loads(bus.ask_one(KEYS.command("sampler"), encode(CommandRequest(name))))["message"]


# --- the path of a pair


def test_each_frame_becomes_pair_with_its_joint_angles(config) -> None:
    walk = Walk(config.robot, 20)
    pairs, _ = sample(config, walk.sources())
    assert np.array_equal([pair.q for pair in pairs], walk.q)


def test_frames_between_readings_get_interpolated_angles(config) -> None:
    walk = Walk(config.robot, 20)
    between = [MarkerFix(fix.t - FRAME_S / 3, fix.x, fix.cov) for fix in walk.fixes[1:]]
    pairs, _ = sample(config, walk.sources(fixes=between))
    expected = (walk.q[:-1] + 2 * walk.q[1:]) / 3
    assert np.abs(expected - [pair.q for pair in pairs]).max() < 1e-12


def test_a_pair_keeps_the_fix_as_it_came(config) -> None:
    walk = Walk(config.robot, 2)
    fix = MarkerFix(walk.fixes[0].t, walk.fixes[0].x, COV, (1.0, 2.0, 3.0, 4.0))
    pairs, _ = sample(config, walk.sources(fixes=[fix]))
    pair = pairs[0]
    assert (pair.t, pair.x.tolist(), pair.centres_px) == (fix.t, fix.x.tolist(), fix.centres_px)


def test_every_frame_is_counted_as_pair_or_rejection(config) -> None:
    walk = Walk(config.robot, 20, step_deg=0.6)
    fixes = walk.fixes
    fixes[5] = MarkerMiss(fixes[5].t, Reason.AT_BORDER)
    fixes[6] = MarkerMiss(fixes[6].t, Reason.AT_BORDER)
    pairs, status = sample(config, walk.sources(fixes=fixes))
    assert status.rejected["at_border"] == 2
    assert len(pairs) + sum(status.rejected.values()) == status.frames == 20


def test_pair_is_stored_before_it_is_published(config) -> None:
    walk, found = Walk(config.robot, 10), []
    with sampling(config, walk.sources(), exit_at_end=True) as sampler:
        publish = sampler._publish

        def check(payload: bytes) -> None:
            found.append(sampler._store.last().seq == decode(payload, PairMessage).seq)
            publish(payload)

        sampler._publish = check
        sampler.run()
    assert found == [True] * 10


def test_restart_continues_numbering_in_new_segment(config) -> None:
    walk = Walk(config.robot, 10)
    sample(config, walk.sources())
    pairs, _ = sample(config, walk.sources())
    assert [(pair.seq, pair.segment) for pair in pairs[8:12]] == [(9, 1), (10, 1), (11, 2), (12, 2)]


def test_coverage_includes_pairs_before_restart(config) -> None:
    walk = Walk(config.robot, 10)
    sample(config, walk.sources())
    _, status = sample(config, Sources(Scripted([], config.robot.joints), Scripted([]), SystemClock()))
    waist = status.coverage["waist"]
    assert (waist.low, waist.high, waist.lower_limit) == (walk.q[0, 0], walk.q[-1, 0], -3.0)


def test_non_finite_readings_are_skipped_and_reported(config) -> None:
    walk = Walk(config.robot, 10)
    readings = walk.readings
    readings[4] = JointReading(readings[4].t, frozen_array([np.nan, 0.0]))
    pairs, status = sample(config, walk.sources(readings=readings))
    assert np.isfinite([pair.q for pair in pairs]).all()
    assert status.health == ["1 encoder readings were not finite and were not used"]


def test_encoders_of_other_joints_are_refused(config) -> None:
    sources = Sources(Scripted([], ("hip", "knee")), Scripted([]), SystemClock())
    with pytest.raises(ConfigError, match="the encoders give the joints hip, knee"), sampling(config, sources):
        pass


# --- sources that fail


@pytest.fixture
def impatient(monkeypatch) -> None:
    """Reopen lost sources at once."""
    monkeypatch.setattr("bodyschema.interfaces.waits.Waits.first_s", 0.0)


def test_reopened_camera_starts_new_segment(config, impatient) -> None:
    walk = Walk(config.robot, 6)
    fixes = [*walk.fixes[:3], SourceLost("unplugged"), *walk.fixes[3:]]
    pairs, _ = sample(config, walk.sources(fixes=fixes))
    assert [pair.segment for pair in pairs] == [1, 1, 1, 2, 2, 2]


def test_lost_encoders_are_opened_again(config, impatient) -> None:
    walk = Walk(config.robot, 6)
    joints = Scripted([SourceLost("no power"), *walk.readings], config.robot.joints)
    pairs, _ = sample(config, Sources(joints, Scripted(walk.fixes), SystemClock()))
    assert (joints.opened, joints.closed, len(pairs)) == (2, 2, 6)


def test_lost_source_is_reported_in_status(config) -> None:
    marker = Scripted([SourceLost("unplugged")], openings=[None, *[SourceLost("still unplugged")] * 100])
    held = threading.Event()
    sources = Sources(Scripted([held], config.robot.joints), marker, SystemClock())
    with running(config, sources) as bus:
        status = status_when(bus, lambda status: bool(status.health))
    assert status.health[0].startswith("the cameras are lost (")


def test_source_unavailable_at_start_raises_error(config) -> None:
    sources = Sources(Scripted([], config.robot.joints, [SourceError("no such port")]), Scripted([]), SystemClock())
    with sampling(config, sources) as sampler, pytest.raises(SourceError, match="no such port"):
        sampler.run()


def test_a_failure_of_the_encoders_ends_the_sampler(config) -> None:
    held = threading.Event()
    sources = Sources(Scripted([RuntimeError("a bug")], config.robot.joints), Scripted([held]), SystemClock())
    with sampling(config, sources) as sampler, pytest.raises(RuntimeError, match="a bug"):
        sampler.run()


def test_all_sources_are_closed_in_the_end(config) -> None:
    sources = Walk(config.robot, 3).sources()
    sample(config, sources)
    assert (sources.joints.closed, sources.marker.closed) == (1, 1)


# --- a store that fails


def test_pairs_lost_to_full_disk_are_reported_unpublished(config, mount_small_disk) -> None:
    file = mount_small_disk("size=256k") / "pairs.sqlite"
    walk, published = Walk(config.robot, 3000, step_deg=1.0005), []
    with (
        PairStore(file, session_of(config, SystemClock())) as store,
        ZenohSession(listen=config.tables.zenoh.sampler) as bus,
    ):
        sampler = Sampler(config, walk.sources(), bus, store, exit_at_end=True)
        sampler._publish = published.append
        sampler.run()
        assert len(published) == store.last().seq
        status = sampler.status()
    lost = status.rejected["not_stored"]
    assert lost == 3000 - len(published)
    assert status.health[0] == (
        f"the disk of {file} is full. Free some space, or give a --state-dir on another disk. Nothing was changed. "
        f"No samples are taken until the disk does ({lost} frames so far)"
    )


def test_a_store_that_is_damaged_ends_the_sampler(config, monkeypatch) -> None:
    def append(*_: object) -> None:
        raise StoreError("the store is damaged")

    monkeypatch.setattr(PairStore, "append", append)
    with sampling(config, Walk(config.robot, 5).sources()) as sampler, pytest.raises(StoreError, match="is damaged"):
        sampler.run()


def test_non_finite_position_makes_no_pair(config) -> None:
    walk = Walk(config.robot, 10)
    fixes = list(walk.fixes)
    fixes[4] = replace(fixes[4], x=frozen_array([np.nan, 0.0, 1.0]))
    pairs, status = sample(config, walk.sources(fixes=fixes))
    assert (len(pairs), status.rejected) == (9, {"not_finite": 1})


# --- published data


def test_pairs_are_published_in_order(config) -> None:
    walk, start = Walk(config.robot, 30), threading.Event()
    received: Queue[bytes] = Queue()
    with running(config, walk.sources(fixes=[start, *walk.fixes])) as bus:
        bus.subscribe(KEYS.pair, received.put)
        # The subscription is known to the sampler once it has answered something that was asked after it.
        bus.ask_one(KEYS.status("sampler"))
        start.set()
        messages = [decode(received.get(timeout=LIMIT_S), PairMessage) for _ in range(30)]
    assert [message.seq for message in messages] == list(range(1, 31))
    assert np.array_equal([message.q for message in messages], walk.q)


@pytest.fixture(scope="module")
def ended(tmp_path_factory, free_endpoint) -> Iterator[ZenohSession]:
    """Yield a client of a sampler whose 1,200 pairs are all stored."""
    config = small_arm(tmp_path_factory.mktemp("ended"), free_endpoint())
    walk = Walk(config.robot, 1200, step_deg=1.01)
    with running(config, walk.sources()) as bus:
        status_when(bus, lambda status: status.state == "ended")
        yield bus


def test_the_history_is_served_after_the_sources_ended(ended) -> None:
    pairs: list[PairMessage] = []
    while True:
        reply = decode(ended.ask_one(f"{KEYS.pairs}?from={len(pairs) + 1}"), PairsReply)
        pairs += reply.pairs
        if len(pairs) == reply.last_seq:
            break
        assert len(reply.pairs) == 1000
    assert [pair.seq for pair in pairs] == list(range(1, 1201))


def test_a_range_of_the_history_includes_both_bounds(ended) -> None:
    reply = decode(ended.ask_one(f"{KEYS.pairs}?from=7;to=9"), PairsReply)
    assert ([pair.seq for pair in reply.pairs], reply.last_seq) == ([7, 8, 9], 1200)


def test_history_beyond_last_pair_is_empty(ended) -> None:
    reply = decode(ended.ask_one(f"{KEYS.pairs}?from=1201"), PairsReply)
    assert (reply.pairs, reply.last_seq) == ([], 1200)


def test_history_is_served_as_messagepack_on_request(ended) -> None:
    payload = ended.ask_one(f"{KEYS.pairs}?from=3;to=3", encoding=MSGPACK)
    assert msgspec.msgpack.decode(payload)["pairs"][0]["seq"] == 3


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ("from=0", "from='0' is not a sequence number"),
        ("from=first", "from='first' is not a sequence number"),
        ("to=-3", "to='-3' is not a sequence number"),
        (f"from={10**30}", "is not a sequence number"),
        ("from=9;to=3", "from=9 is after to=3"),
        ("since=3", "unknown parameter 'since'. Known are: from, to"),
    ],
)
def test_a_bad_range_is_refused(ended, parameters, message) -> None:
    with pytest.raises(RequestError, match=message):
        ended.ask_one(f"{KEYS.pairs}?{parameters}")


def test_paused_sampler_rejects_frames_then_starts_new_segment(config) -> None:
    walk = Walk(config.robot, 12)
    gates = [threading.Event() for _ in range(2)]
    fixes = [*walk.fixes[:4], gates[0], *walk.fixes[4:8], gates[1], *walk.fixes[8:]]
    with running(config, walk.sources(fixes=fixes)) as bus:
        status_when(bus, lambda status: status.frames == 4)
        command(bus, "pause")
        gates[0].set()
        paused = status_when(bus, lambda status: status.frames == 8)
        command(bus, "resume")
        gates[1].set()
        status_when(bus, lambda status: status.state == "ended")
        pairs = decode(bus.ask_one(KEYS.pairs), PairsReply).pairs
    assert (paused.state, paused.rejected) == ("paused", {"paused": 4})
    assert [pair.segment for pair in pairs] == [1] * 4 + [2] * 4


class StoppedClock(SystemClock):
    def __init__(self, t: float) -> None:
        self._t = t

    def now(self) -> float:
        return self._t


def test_frame_taken_before_resume_makes_no_pair(config) -> None:
    walk = Walk(config.robot, 12)
    gate = threading.Event()
    scripted = walk.sources(fixes=[*walk.fixes[:4], gate, *walk.fixes[4:]])
    with running(config, replace(scripted, clock=StoppedClock(walk.t[7]))) as bus:
        status_when(bus, lambda status: status.frames == 4)
        command(bus, "pause")
        command(bus, "resume")
        gate.set()
        ended = status_when(bus, lambda status: status.state == "ended")
    assert (ended.pairs, ended.rejected) == (8, {"paused": 4})


def test_accept_turns_is_refused_without_lost_turn_count(ended) -> None:
    with pytest.raises(RequestError, match="no joint has lost its turn count"):
        command(ended, "accept_turns")


def test_learner_command_is_refused_with_its_address(ended) -> None:
    with pytest.raises(RequestError, match=r"the sampler has nothing to do with checkpoint.*/command/learner"):
        command(ended, "checkpoint")


def test_unknown_command_is_refused(ended) -> None:
    with pytest.raises(RequestError, match="command: 'dance' is unknown, known are: pause, resume"):
        ended.ask_one(KEYS.command("sampler"), b'{"command": "dance"}')


def test_malformed_json_command_is_refused(ended) -> None:
    with pytest.raises(RequestError, match="not a CommandRequest"):
        ended.ask_one(KEYS.command("sampler"), b"{")


def test_the_simulations_tool_is_changed_on_request(config) -> None:
    world = World(config.robot.chain)
    with running(config, simulated(Walk(config.robot, 1).sources(), world)) as bus:
        bus.ask_one(KEYS.simulation, b'{"tool": [0.1, 0, 0.35]}')
    assert world.tools == [(0.1, 0.0, 0.35)]


def test_simulation_returns_ground_truth_to_empty_request(config) -> None:
    with running(config, simulated(Walk(config.robot, 1).sources(), World(config.robot.chain))) as bus:
        truth = json.loads(bus.ask_one(KEYS.simulation))
    assert np.array_equal(truth["fixed"], config.robot.chain.fixed)
    assert np.array_equal(truth["axes"], config.robot.chain.axes)


@pytest.mark.parametrize("request_", [b'{"tool": [0, 0, 80]}', b'{"tool": [0, 1]}', b'{"tol": [0, 0, 0]}', b"?"])
def test_a_tool_that_cannot_be_is_refused(config, request_) -> None:
    world = World(config.robot.chain)
    with running(config, simulated(Walk(config.robot, 1).sources(), world)) as bus, pytest.raises(RequestError):
        bus.ask_one(KEYS.simulation, request_)
    assert world.tools == []


def test_ground_truth_is_unavailable_without_simulation(ended) -> None:
    with pytest.raises(BusError, match="nothing answers under bodyschema/arm/simulation"):
        ended.ask_one(KEYS.simulation)


def test_picture_is_served_after_first_frame(config) -> None:
    pictures: list[bytes] = []
    sources = replace(Walk(config.robot, 1).sources(), picture=lambda: pictures[-1] if pictures else None)
    with running(config, sources) as bus:
        with pytest.raises(RequestError, match="no image has come yet"):
            bus.ask_one(KEYS.picture)
        pictures.append(b"\xff\xd8jpeg")
        assert bus.ask_one(KEYS.picture) == pictures[0]


def test_silent_sources_are_reported(config, monkeypatch) -> None:
    monkeypatch.setattr("bodyschema.interfaces.waits.Waits.silent_after_s", 0.0)
    held = threading.Event()
    sources = Sources(Scripted([held], config.robot.joints), Scripted([held]), SystemClock())
    with running(config, sources) as bus:
        status = status_when(bus, lambda status: bool(status.health))
    assert [sentence.split(" for ")[0] for sentence in status.health] == [
        "nothing has come from the encoders",
        "nothing has come from the cameras",
    ]


# --- how sure the time is


def test_frames_refused_for_one_reason_are_a_complaint(config) -> None:
    walk, held = Walk(config.robot, 40), threading.Event()
    misses = [MarkerMiss(fix.t, Reason.SIZE_MISMATCH) for fix in walk.fixes]
    with running(config, walk.sources(fixes=[*misses, held])) as bus:
        status = status_when(bus, lambda status: bool(status.health))
        held.set()
    assert status.health == [f"40 of the last 40 frames were rejected: sizes differ. {REMEDIES[Reason.SIZE_MISMATCH]}"]


def test_reading_time_uncertainty_rejects_fast_motion(config) -> None:
    walk = Walk(config.robot, 20)
    late = [replace(reading, t_sigma=0.01) for reading in walk.readings]
    pairs, status = sample(config, walk.sources(readings=late, fixes=walk.fixes[2:-2]))
    assert (pairs, status.rejected) == ([], {"late_joints": 16})
    sure = [replace(reading, t_sigma=1e-4) for reading in walk.readings]
    assert len(sample(config, walk.sources(readings=sure, fixes=walk.fixes[2:-2]))[0]) == 16


def uncertain(walk: Walk, t_sigma: float) -> list[MarkerFix]:
    return [replace(fix, t_sigma=t_sigma) for fix in walk.fixes[2:-2]]


def test_frame_time_uncertainty_rejects_fast_motion(config) -> None:
    walk = Walk(config.robot, 20)  # 45°/s
    pairs, status = sample(config, walk.sources(fixes=uncertain(walk, 0.01)))
    assert (pairs, status.rejected) == ([], {"moving": 16})


def test_small_frame_time_uncertainty_accepts_fast_motion(config) -> None:
    walk = Walk(config.robot, 20)
    pairs, _ = sample(config, walk.sources(fixes=uncertain(walk, 0.001)))
    assert len(pairs) == 16


@pytest.mark.parametrize("column", ["q", "x", "t", "segment"])
def test_a_changed_pair_stops_no_sampler(config, column) -> None:
    walk = Walk(config.robot, 20)
    sample(config, walk.sources())
    with contextlib.closing(sqlite3.connect(config.store_file)) as connection:
        value = f"'x' || {column}" if column in "qx" else f"{column} + 1"
        connection.execute(f"UPDATE pairs SET {column} = {value} WHERE seq = 7")
        connection.commit()
    pairs, status = sample(config, walk.sources())
    assert status.unreadable == 1
    assert any("cannot be read" in text and "(number 7)" in text for text in status.health)
    assert [pair.seq for pair in pairs] == [number for number in range(1, status.pairs + 1) if number != 7]
    assert status.pairs > 20
