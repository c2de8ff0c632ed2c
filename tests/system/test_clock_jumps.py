"""The wall clock jumps under working processes: only times written in UTC follow it."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from failing_disk import FailingDisk
from two_processes import expect_each_pair_learnt_once, learner_with, running, sampler_with, write_robot

from bodyschema.recordings.store.store import PairReader

HOUR_S, YEAR_S = 3600, 31_557_600
# Ahead, back before the start, years ahead as from a dead battery to the time of the network, and right again.
JUMPS_S = (HOUR_S, -HOUR_S, 20 * YEAR_S, -40 * YEAR_S, 0)
BETWEEN = 12


@pytest.mark.soak
@pytest.mark.parametrize("jumping", [("sampler",), ("learner",), ("sampler", "learner")], ids="-and-".join)
def test_wall_clock_jumps_keep_pairs_and_order(tmp_path, free_endpoint, disk_shim, jumping) -> None:
    config = write_robot(tmp_path, free_endpoint)
    disk = FailingDisk(config.state_dir, disk_shim)
    environments = {name: disk.environment if name in jumping else {} for name in ("sampler", "learner")}
    with (
        running(config, "sampler", environment=environments["sampler"]),
        running(config, "learner", environment=environments["learner"]),
    ):
        done = learner_with(config, BETWEEN)
        uptime_s, begun = done.uptime_s, datetime.now(UTC)
        for jump_s in JUMPS_S:
            disk.move_clock(jump_s)
            done = learner_with(config, done.last_seq + BETWEEN)
        learner, sampler = expect_each_pair_learnt_once(config), sampler_with(config, 0)
        passed_s = (datetime.now(UTC) - begun).total_seconds()
    assert uptime_s < learner.uptime_s < uptime_s + passed_s + 1.0
    assert 0.0 < sampler.uptime_s < HOUR_S
    assert learner.checkpoint_age_s is None or 0.0 <= learner.checkpoint_age_s < passed_s + 1.0
    with PairReader(config.store_file) as store:
        pairs = store.read()
    assert (np.diff([pair.t for pair in pairs]) > 0).all()
    told = [datetime.fromisoformat(pair.utc) - begun for pair in pairs]
    followed = {jump_s for jump_s in JUMPS_S for ahead in told if near(ahead, jump_s)}
    assert followed == (set(JUMPS_S) if "sampler" in jumping else {0})


def near(ahead: timedelta, jump_s: float) -> bool:
    return abs(ahead.total_seconds() - jump_s) < HOUR_S / 4
