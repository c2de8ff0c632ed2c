"""Aim the head at the hand, by the learnt model where it is accurate there, otherwise by the nominal one."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Self

import numpy as np

from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import ZenohSession
from bodyschema.daemon.transport.wire import JointsRequest, PredictReply, decode, encode
from bodyschema.interfaces.errors import BusError, ConfigError, RequestError
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.records import FloatArray
from bodyschema.interfaces.waits import Waits
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.pointing import Pointing

from .sources import GazeMode, Sources

log = logging.getLogger(__name__)


class _Settings:
    period_s: float = 0.04  # of a new aim for the head
    gain: float = 0.5  # fraction of a step towards the centre; the head follows with a delay
    good_m: float = 0.02  # a learnt model with a larger uncertainty at the hand is not used
    predict_s: float = 0.2  # how long the head waits for the learner


Predict = Callable[[bytes], bytes]
"""Asks the learner: a `JointsRequest`, and its `PredictReply`; BusError or RequestError without an answer."""


class HandModel:
    """Hand position in the measurement frame, by the best available model."""

    def __init__(self, robot: RobotDescription, predict: Predict, clock: Clock) -> None:
        self._chain, self._predict, self._clock = robot.chain, predict, clock
        self._ask_s = -math.inf
        self.source = "nominal"  # learnt or nominal: the model used last

    def positions(self, q: FloatArray) -> FloatArray:
        """Return marker positions (n, 3) [m] at q (n, d) [rad], all by one model, which the first row selects."""
        learnt = self._from_learner(q) if self._clock.now() >= self._ask_s else None
        source = "nominal" if learnt is None else "learnt"
        if source != self.source:
            log.info("the gaze goes by the %s model", source)
            self.source = source
        return self._chain.positions(q) if learnt is None else learnt

    def _from_learner(self, q: FloatArray) -> FloatArray | None:
        try:
            reply = decode(self._predict(encode(JointsRequest(q.tolist()))), PredictReply)
        except (BusError, RequestError):
            self._ask_s = self._clock.now() + Waits.retry_s
            return None
        x = np.array(reply.x)
        is_good = reply.in_support[:1] == [True] and max(reply.sigma[0]) <= _Settings.good_m
        return x if is_good and x.shape == (len(q), 3) and np.isfinite(x).all() else None


class GazeLoop:
    """Loop that aims the head in a separate thread. If it fails, the target expires and the head stands still."""

    def __init__(self, robot: RobotDescription, head: GazeMode, model: HandModel) -> None:
        """Store the settings; nothing is started yet.

        Raises:
            ConfigError: [camera] does not describe a stereo pair.
        """
        if robot.calibration is None:
            raise ConfigError(
                "gaze needs to know how the cameras see", file=robot.file, remedy="Describe the stereo pair in [camera]"
            )
        self._head, self._model = head, model
        self._places = [robot.joints.index(joint) for joint in head.head]
        self._pointing = Pointing(robot.calibration, self._places, head.lower, head.upper)
        self._told_s = -math.inf
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="gaze")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        self._thread.join()

    def look(self) -> None:
        """Aim the head once, if there is a newer reading."""
        pose = self._head.pose
        if pose is None or pose[0] <= self._told_s:
            return
        self._told_s, q = pose
        step = self._pointing.step(q[None], self._model.positions)[0]
        self._head.aim(self._told_s, self._pointing.clipped(q[self._places] + _Settings.gain * step))

    def _run(self) -> None:
        try:
            while not self._ending.wait(_Settings.period_s):
                self.look()
        except Exception:
            log.exception("the gaze failed; the head stands still")


def gaze_of(robot: RobotDescription, sources: Sources, bus: ZenohSession, wall: Clock) -> GazeLoop | None:
    """Return the gaze loop of a robot with a head, with its calibrated cameras; None if it has none."""
    if sources.head is None:
        return None
    key = Keys(robot.name).predict
    if sources.calibration is not None:
        robot = replace(robot, calibration=sources.calibration)
    model = HandModel(robot, lambda payload: bus.ask_one(key, payload, timeout_s=_Settings.predict_s), wall)
    return GazeLoop(robot, sources.head, model)
