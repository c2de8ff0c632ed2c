from __future__ import annotations

import numpy as np

from bodyschema.learning.replay_memory import RUN, PairMemory


def filled(pairs: int, capacity: int) -> PairMemory:
    memory = PairMemory(1, capacity)
    for k in range(pairs):
        memory.append(np.array([[k]]), np.zeros((1, 3)))
    return memory


def test_few_remembered_pairs_are_all_sampled() -> None:
    q, *_ = filled(80, 1000).spread_before(70, 100)
    np.testing.assert_array_equal(q[:, 0], np.arange(70))


def test_many_pairs_are_sampled_as_runs_of_neighbours() -> None:
    q, *_ = filled(5000, 4000).spread_before(4500, 100)
    runs = q[:, 0].reshape(-1, RUN)
    assert (runs[0, 0], runs[-1, -1]) == (1000, 4499)
    np.testing.assert_array_equal(np.diff(runs, axis=1), 1)


def test_sample_has_no_more_pairs_than_requested() -> None:
    assert len(filled(500, 500).spread_before(500, RUN // 2)[0]) == RUN // 2
