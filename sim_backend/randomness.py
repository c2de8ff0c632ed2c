"""Independent random streams from one seed, so that drawing more from one never shifts another."""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class Stream(IntEnum):
    """Purpose of a random stream."""

    ERRORS = 1
    ENCODERS = 2
    WAYPOINTS = 3
    BACKGROUND = 4
    IMAGE_NOISE = 5


def generator(seed: int, stream: Stream, *index: int) -> np.random.Generator:
    """Return the generator of one stream and, if an index is given, of one frame."""
    return np.random.default_rng([seed, int(stream), *index])
