"""Restore a learner from its newest checkpoint, else from the previous one, else start without data."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

from bodyschema.daemon.learner.checkpoint import CheckpointError, generations, read_checkpoint, set_aside
from bodyschema.learning.online_learner import OnlineLearner
from bodyschema.learning.state import StateError
from kbmaps import KBMapsError

log = logging.getLogger(__name__)

# Exceptions of a checkpoint whose checksum is right but whose contents do not fit.
DOES_NOT_FIT = (ArithmeticError, LookupError, TypeError, ValueError)


def go_on(new: Callable[[], OnlineLearner], checkpoint: Path, robot: str) -> tuple[OnlineLearner, str | None]:
    """Restore the learner from the newest usable checkpoint.

    Args:
        new: creates a learner without data.
        checkpoint: the newest; an unusable one is kept next to it under another name.

    Returns:
        The learner, and a message about what was wrong, or None.

    Raises:
        CheckpointError: an unusable checkpoint cannot be moved aside.
    """
    said: list[str] = []
    for file in generations(checkpoint):
        learning = new()
        try:
            state = read_checkpoint(file, robot=robot)
            if state is None:
                continue
            learning.restore(state)
        except (CheckpointError, StateError, KBMapsError, *DOES_NOT_FIT) as error:
            unfit = isinstance(error, DOES_NOT_FIT)
            why = f"the checkpoint's parts do not fit: {error!r}" if unfit else str(error)
            said.append(f"{why}. It was kept as {set_aside(file)}")
            continue
        pairs = learning.counters.pairs
        log.info("went on from %s with %d pairs", file, pairs)
        return learning, _told([*said, f"the learner went on from {file} with {pairs} pairs"]) if said else None
    return new(), _told([*said, "the learner learns again from the sampler's history"]) if said else None


def _told(said: list[str]) -> str:
    text = "; ".join(said)
    log.error("%s", text)
    return text
