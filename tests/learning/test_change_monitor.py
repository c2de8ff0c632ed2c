"""Comparison of the learner with an earlier model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from guided_arm import NOW_AND_THEN, built_chain, measured, new_learning, path, teach

from bodyschema.interfaces.records import Pair, frozen_array
from bodyschema.learning.changes.monitor import ChangeMonitor, MonitorSettings

COARSE_RAD = np.radians(1.0)


def test_monitor_keeps_bounded_pairs_without_a_model() -> None:
    watch, cov = ChangeMonitor(), frozen_array(np.eye(3))
    for seq in range(1, MonitorSettings.max_watched + 200):
        watch.add(
            Pair("simulated", seq, 1, 0.0, "", frozen_array(np.zeros(2)), frozen_array(np.zeros(3)), cov), kept=True
        )
    assert 0 < watch.monitored_count <= MonitorSettings.max_watched


@pytest.mark.parametrize(
    ("seed", "seen"), [(0, 150), *(pytest.param(seed, 600, marks=pytest.mark.soak) for seed in range(6))]
)
def test_joints_that_are_read_coarsely_are_no_change(seed: int, seen: int) -> None:
    """Ticks of a degree move the predicted marker by far more than the camera is said to err."""
    rng = np.random.default_rng([seed, 5])
    q = path(rng, seen)
    learning = new_learning()
    pairs = measured(built_chain(rng), q, rng, sigma_m=0.0002)
    read = [replace(pair, q=frozen_array(COARSE_RAD * np.round(pair.q / COARSE_RAD))) for pair in pairs]
    teach(learning, read, every=NOW_AND_THEN)
    assert learning.counters.changes == 0
