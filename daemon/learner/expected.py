"""Publish on a topic where the marker is expected now."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from bodyschema.daemon.sampler.reconnect import ReconnectingSource
from bodyschema.daemon.sampler.sources import MarkerTopic, StampedJoints
from bodyschema.interfaces.errors import SourceError
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.records import JointReading
from bodyschema.learning.snapshot import NoFrameError, Snapshot

log = logging.getLogger(__name__)

READ_TIMEOUT_S = 0.2
RETRY_S = 1.0


class ExpectedMarker:
    """Follows the encoders, and publishes the current model's prediction for them.

    Nothing is published before there is a model. For subscribers that receive no sigma, nothing is published outside
    the support of the data either.

    Attributes:
        published: number of positions so far.
    """

    def __init__(
        self, joints: StampedJoints, topic: MarkerTopic, snapshot: Callable[[], Snapshot], clock: Clock
    ) -> None:
        """Store the settings; nothing is opened yet.

        Args:
            snapshot: returns the current model.
        """
        self._joints, self._topic, self._snapshot, self._clock = joints, topic, snapshot, clock
        self._stop = threading.Event()
        self._due = clock.now()
        self.published = 0

    @contextmanager
    def publishing(self) -> Iterator[None]:
        """Publish from here to the end of the with statement; wait for a robot that is not there yet."""
        thread = threading.Thread(target=self._run, name="expected_marker")
        thread.start()
        try:
            yield
        finally:
            self._stop.set()
            thread.join()

    def take(self, reading: JointReading) -> None:
        """Publish the expected position at this reading, if one is due."""
        if self._clock.now() < self._due or self._joints.stamp_ns is None:
            return
        try:
            prediction = self._snapshot().predict(reading.q[None])
        except NoFrameError:
            return
        if not (self._topic.has_sigma or prediction.in_support[0]):
            return
        self._due = max(self._due + self._topic.period_s, self._clock.now())
        self._topic.publish(self._joints.stamp_ns, prediction.x[0], prediction.sigma[0])
        self.published += 1

    def _run(self) -> None:
        said = False
        while not self._stop.is_set():
            try:
                with ExitStack() as stack:
                    stack.enter_context(self._topic)
                    self._follow(
                        stack.enter_context(ReconnectingSource(self._joints, "the robot's joints", self._clock))
                    )
            except SourceError as error:
                if not said:
                    log.warning("the expected marker position is not published: %s; trying again", error)
                said = True
                self._stop.wait(RETRY_S)

    def _follow(self, joints: ReconnectingSource[JointReading]) -> None:
        while not self._stop.is_set():
            reading = joints.read(READ_TIMEOUT_S)
            if reading is not None:
                self.take(reading)
