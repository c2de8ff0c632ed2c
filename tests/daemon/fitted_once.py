"""Calibrations that are fitted once: several tests ask one command for the same pairs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bodyschema.calibration.rigid_chain import Calibration
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription

_fitted: dict[tuple[Any, ...], Calibration] = {}
_of = Calibration.of


def _bytes(array: np.ndarray | None) -> bytes | None:
    return None if array is None else array.tobytes()


def fitted(robot: RobotDescription, recording: Recording, **settings: Any) -> Calibration:
    """Return the calibration, fitted unless the same pairs of the same robot were."""
    arrays = (recording.q, recording.x, recording.cov, recording.orientation, robot.chain.fixed, robot.chain.axes)
    key = (*map(_bytes, arrays), repr((robot.robot, robot.camera)), *sorted(settings.items()))
    if key not in _fitted:
        _fitted[key] = _of(robot, recording, **settings)
    return _fitted[key]


@pytest.fixture(autouse=True)
def fitted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Calibration, "of", fitted)
