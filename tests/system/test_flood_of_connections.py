"""More connections than there are file descriptors."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable
from pathlib import Path

import pytest
from two_processes import expect_each_pair_learnt_once, learner_with, running, sampler_with, write_robot

MANY = 150


@pytest.mark.soak
def test_both_processes_outlive_a_flood_of_connections(tmp_path: Path, free_endpoint: Callable[[], str]) -> None:
    config = write_robot(tmp_path, free_endpoint)
    few = ("prlimit", "--nofile=64:64")
    with running(config, "sampler", prefix=few) as sampler, running(config, "learner", prefix=few) as learner:
        pairs = learner_with(config, 100).last_seq
        with contextlib.ExitStack() as flood:
            for endpoint in (config.tables.zenoh.sampler, config.tables.zenoh.learner):
                host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
                for _ in range(MANY):
                    flood.enter_context(socket.create_connection((host, int(port)), timeout=300.0))
        sampler_with(config, pairs + 200)
        expect_each_pair_learnt_once(config)
        assert (sampler.poll(), learner.poll()) == (None, None)
