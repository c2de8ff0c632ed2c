"""What the learner holds against an earlier model."""

from __future__ import annotations

import numpy as np

from daemon.learning.watch import MOST_WATCHED, Watch
from interfaces.records import Pair, frozen_array


def test_where_no_model_comes_the_newest_pairs_alone_are_kept() -> None:
    watch, cov = Watch(), frozen_array(np.eye(3))
    for seq in range(1, MOST_WATCHED + 200):
        watch.add(
            Pair("simulated", seq, 1, 0.0, "", frozen_array(np.zeros(2)), frozen_array(np.zeros(3)), cov), kept=True
        )
    assert 0 < watch.held <= MOST_WATCHED
