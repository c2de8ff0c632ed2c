"""Since when an arm has had the tool that it has now, as far as the learner beside its store knows."""

from __future__ import annotations

from pathlib import Path

from .checkpoint import CheckpointError, read_checkpoint
from .recordings import StoredPairs


def first_pair(pairs: StoredPairs, checkpoint: Path, robot: str) -> int:
    """Return the row, from 1, of the first pair with the present tool.

    1 where no learner of these pairs left a checkpoint to tell.

    Pairs from before a `reset_to_prior` are not among those with the present tool either.
    """
    try:
        state = read_checkpoint(checkpoint, robot=robot)
    except CheckpointError:  # the learner's to complain of; the recording can be calibrated without
        return 1
    if state is None or state.header.counters.store != pairs.store:
        return 1
    counters = state.header.counters
    number = counters.last_seq - counters.since_change + 1
    return sum(each < number for each in pairs.numbers) + 1
