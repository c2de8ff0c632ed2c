"""Find the first pair with the present tool, from the learner's checkpoint next to the store."""

from __future__ import annotations

from pathlib import Path

from bodyschema.daemon.learner.checkpoint import CheckpointError, read_checkpoint
from bodyschema.recordings.files import StoredPairs


def first_pair(pairs: StoredPairs, checkpoint: Path, robot: str) -> int:
    """Return the row, from 1, of the first pair with the present tool.

    Returns 1 if no learner of these pairs has left a checkpoint.

    Pairs from before a `reset_to_prior` do not count as pairs with the present tool.
    """
    try:
        state = read_checkpoint(checkpoint, robot=robot)
    except CheckpointError:  # the learner reports it; the recording can be calibrated without
        return 1
    if state is None or state.header.counters.store != pairs.store:
        return 1
    counters = state.header.counters
    number = counters.last_seq - counters.since_change + 1
    return sum(each < number for each in pairs.numbers) + 1
