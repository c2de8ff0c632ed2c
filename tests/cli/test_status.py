from __future__ import annotations

import io
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest
from rich.console import Console
from scripted_sources import Walk
from small_arm import write_small_arm
from told_statuses import LEARNER, SAMPLER

from bodyschema.cli.main import app
from bodyschema.cli.terminal.status_view import ProcessStates, Watcher, as_json, screen
from bodyschema.daemon.client_config import ClientConfig
from bodyschema.daemon.config import Config
from bodyschema.daemon.sampler.devices import session_of
from bodyschema.daemon.sampler.sampler import Sampler
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import ZenohSession
from bodyschema.interfaces.clock import SystemClock
from bodyschema.recordings.store.store import PairStore

LIMIT_S = 500.0


@pytest.fixture
def config(tmp_path: Path, free_endpoint) -> Config:
    tables = f'[zenoh]\nsampler = "{free_endpoint()}"\nlearner = "{free_endpoint()}"\n[daemon]\nstate_dir = "state"\n'
    return Config.load(write_small_arm(tmp_path, tables), {})


def shown(seen: ProcessStates, config: Config) -> str:
    console = Console(file=io.StringIO(), width=80)
    console.print(screen(seen, ClientConfig.load(config.file, {})))
    return console.file.getvalue()


@contextmanager
def sampler_running(config: Config) -> Iterator[None]:
    with (
        PairStore(config.store_file, session_of(config, SystemClock())) as store,
        ZenohSession(listen=config.tables.zenoh.sampler) as bus,
    ):
        sampler = Sampler(config, Walk(config.robot, 20).sources(), bus, store)
        thread = threading.Thread(target=sampler.run)
        thread.start()
        with ZenohSession(connect=config.tables.zenoh.sampler, client=True) as waiting:
            up = threading.Event()
            waiting.watch(Keys("arm").alive("sampler"), lambda _alive: up.set())
            assert up.wait(LIMIT_S)
        try:
            yield
        finally:
            sampler.stop()
            thread.join(LIMIT_S)


@pytest.mark.parametrize(
    "said",
    [
        "sampler of arm is paused, up for 1 min 15 s",
        "700, 29.9/s; readings 120/s",
        "612 in 3 segments, 12.3/s",
        "rejected 80 hardly any motion since the last sample, 8 at the border",
        "! the disk is nearly full",
        "-29° … +29°",
        "learner of arm is learning, up for 1 h 06 min",
        "prior 40.1 mm, exact 2.0 mm",
        "exact, model 6b6f",
        "none yet",
        "missed by: prior 40.1 mm, exact 2.0 mm mean of the last 50, measurement noise included",
        "expected 6.9 mm where data is, 4.7 mm over all joints' ranges",
        "4120 stored and not learnt yet; the newest learnt is 2 min 17 s old",
        "`bodyschema command rollback` goes back to the model before it",
        "change undecided at sample 601 (598 to 602), marker moved by 10.4 mm (found); 12",
        "tool 61%, joint shoulder 38%",
        "enough? no: 300 more samples like these take 17% off the error beyond noise",
        "300 of moving shoulder over its range: 50%",
        "camera on base_link [mm] -11 ± 11 +20 ± 33 +10 ± 43",
        "zeros to add shoulder +3.7 ± 3.5°",
        "kept at nominal waist: no motion shows its zero",
    ],
)
def test_the_screen_shows_both_processes(config, said) -> None:
    assert said in " ".join(shown(ProcessStates(SAMPLER, LEARNER), config).split())


def test_one_segment_is_not_said_to_be_several(config) -> None:
    assert "612 in 1 segment, " in shown(ProcessStates(msgspec.structs.replace(SAMPLER, segment=1), None), config)


def test_user_reported_tool_change_is_shown_as_reported(config) -> None:
    change = msgspec.structs.replace(
        LEARNER.last_change, found=False, kind="tool", earliest_seq=601, latest_seq=601, moved_m=None
    )
    text = " ".join(shown(ProcessStates(None, msgspec.structs.replace(LEARNER, last_change=change)), config).split())
    assert "change tool at sample 601 (told); 12 samples since" in text


def test_rolled_back_change_is_not_in_force(config) -> None:
    learner = msgspec.structs.replace(LEARNER, changes=2, last_change=None, pairs_since_change=600)
    assert "change none in force of 2 reported or detected; 600 samples count" in " ".join(
        shown(ProcessStates(None, learner), config).split()
    )


def test_silent_process_is_named_with_its_start_command(config) -> None:
    text = " ".join(shown(ProcessStates(SAMPLER, None), config).split())
    assert f"learner does not answer on {config.tables.zenoh.learner}. Start it with `bodyschema run learner`" in text


def test_json_has_null_for_a_missing_process() -> None:
    seen = json.loads(as_json(ProcessStates(SAMPLER, None)))
    assert (seen["sampler"]["pairs"], seen["learner"]) == (612, None)


def test_the_watcher_finds_a_process_that_comes_later(config) -> None:
    with Watcher(ClientConfig.load(config.file, {})) as watcher:
        assert watcher.look().nobody
        with sampler_running(config):
            seen = watcher.look()
        assert seen.sampler is not None
        assert seen.learner is None


def test_the_watcher_sees_a_process_go(config) -> None:
    with Watcher(ClientConfig.load(config.file, {})) as watcher:
        with sampler_running(config):
            assert not watcher.look().nobody
        assert watcher.look().nobody


def status(config: Config, *options: str) -> None:
    app(["status", "--robot", str(config.file), *options], exit_on_error=False, result_action="return_value")


def test_status_exits_1_when_no_process_answers(config) -> None:
    with pytest.raises(SystemExit) as ended:
        status(config)
    assert ended.value.code == 1


def test_json_shows_a_sampler_without_learner(config, capsys) -> None:
    with sampler_running(config):
        status(config, "--json")
    seen = json.loads(capsys.readouterr().out)
    assert (seen["sampler"]["robot"], seen["learner"]) == ("arm", None)
