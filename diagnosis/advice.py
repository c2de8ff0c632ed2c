"""What to do about what was found, and what to measure next where something is still open."""

from __future__ import annotations

from .diagnosis import Diagnosis


def advice(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Sentences."""
    del diagnosis
    return ()
