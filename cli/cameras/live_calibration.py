"""Calibrating the robot's own cameras: views are taken while a person moves the board, until it is good enough."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

from bodyschema.daemon.sampler.reconnect import ReconnectingSource
from bodyschema.interfaces.errors import SourceEnded, SourceError
from bodyschema.interfaces.protocols import Clock, StereoEyes
from bodyschema.interfaces.records import StereoFrame
from bodyschema.interfaces.waits import READ_S
from bodyschema.vision.calibration.calibrate import Calibrated
from bodyschema.vision.calibration.check import Check, check
from bodyschema.vision.calibration.gather import Gathered, require_both
from bodyschema.vision.calibration.guidance import Coverage
from bodyschema.vision.calibration.images import ImagePair
from bodyschema.vision.calibration.live import LiveViews, Look, Outcome
from bodyschema.vision.rig.stereo_rig import CalibrationError

from .calibration import Tell, pair_in

# Number of further views taken after a refused calibration before the next try.
MORE_VIEWS = 4


@dataclass(frozen=True)
class Shown:
    """Feedback for the person who holds the board.

    Attributes:
        coverage: what the views cover. views: how many were taken.
        look: the last pair of images; None before any, and while the cameras are lost.
        trouble: what is wrong with the cameras, and what to do.
        refusal: why the calibration was not good enough, when it was last tried.
        doing: what takes its time; empty while views are taken.
    """

    coverage: Coverage
    views: int
    look: Look | None = None
    trouble: tuple[str, ...] = ()
    refusal: str = ""
    doing: str = ""

    @property
    def wish(self) -> str:
        """Advice on what to show next."""
        missing = self.coverage.missing()
        if missing:
            return missing[0]
        return f"{MORE_VIEWS} more views, tilted and anywhere" if self.refusal else "nothing is missing"


Show = Callable[[Shown], None]


class HealthyEyes(StereoEyes, Protocol):
    """Eyes that report their faults; see `bodyschema.vision.cameras.live.LiveEyes`."""

    @property
    def health(self) -> tuple[str, ...]: ...


Require = Callable[[tuple[int, int], tuple[str, ...]], None]


class RequiredEyes:
    """Cameras that must satisfy a requirement each time they are opened."""

    def __init__(self, eyes: StereoEyes, require: Require) -> None:
        """Store the arguments; open nothing yet.

        Args:
            require: called with image size and serials; raises SourceError if others are required.
        """
        self._eyes, self._require = eyes, require

    def __enter__(self) -> Self:
        self._eyes.__enter__()
        try:
            self._require(self._eyes.image_size_px, self._eyes.serials)
        except BaseException:
            self._eyes.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._eyes.__exit__(kind, error, trace)

    def read(self, timeout_s: float) -> StereoFrame | None:
        """Return the next frame; see `StereoEyes.read`."""
        return self._eyes.read(timeout_s)


class SameAsFirst:
    """Requirement that cameras and image size stay the same for all views of a calibration."""

    def __init__(self) -> None:
        self._first: tuple[tuple[int, int], tuple[str, ...]] | None = None

    def __call__(self, image_size_px: tuple[int, int], serials: tuple[str, ...]) -> None:
        """Raise SourceError if image size or serials differ from the first call."""
        self._first = self._first or (image_size_px, serials)
        if (image_size_px, serials) != self._first:
            these, first = _named(image_size_px, serials), _named(*self._first)
            raise SourceError(f"these are {these}, the views are of {first}. Plug those in")


def _named(image_size_px: tuple[int, int], serials: tuple[str, ...]) -> str:
    return f"{' and '.join(serials)} with {'x'.join(map(str, image_size_px))} pixels"


class LiveCalibration:
    """Takes views until nothing is missing and the calibration is good enough, or until `stop`."""

    def __init__(
        self,
        eyes: HealthyEyes,
        views: LiveViews,
        calibrated: Callable[[Gathered, tuple[str, ...], Tell], Calibrated],
        show: Show,
        clock: Clock,
        keep: Callable[[ImagePair, int], None] = lambda _pair, _number: None,
    ) -> None:
        """Store the arguments; open nothing yet.

        Args:
            views: empty collection of views of the board.
            calibrated: calibrates from views and serials; raises CalibrationError if the result is not good enough.
            show: called for every pair of images, and with the trouble while there are none.
            keep: called with the images of every view taken and its number, from 1 on.
        """
        self._eyes, self._calibrated, self._show, self._keep = eyes, calibrated, show, keep
        self._source = ReconnectingSource(RequiredEyes(eyes, SameAsFirst()), "the cameras", clock)
        self._views = views
        self._refusal = ""
        self._next_try = 0
        self._stopping = False

    def stop(self) -> None:
        """End the collection of views, so that `run` calibrates from those it has. Sets a flag only."""
        self._stopping = True

    def run(self) -> tuple[Gathered, Calibrated]:
        """Gather views until their calibration is good enough; return both.

        Raises:
            CalibrationError: the images ended or `stop` was called before it was good enough; with the reasons.
            SourceError: the cameras cannot be opened.
        """
        with self._source, suppress(SourceEnded):
            self._tell(None)
            while not self._stopping:
                look = self._look()
                self._tell(look)
                if look is not None and look.outcome is Outcome.TAKEN:
                    self._keep(look.pair, len(self._views.found.views))
                    if (result := self._tried()) is not None:
                        return self._views.found, result
        require_both(self._views.found)
        return self._views.found, self._calibration()

    def _look(self) -> Look | None:
        frame = self._source.read(READ_S)
        if frame is None:
            if self._source.trouble is not None:
                self._views.forget()
            return None
        return self._views.look(frame)

    def _tried(self) -> Calibrated | None:
        """Return the calibration if the views cover enough and it is good enough; else None."""
        if len(self._views.found.views) < self._next_try or self._views.coverage.missing():
            return None
        try:
            return self._calibration()
        except CalibrationError as error:
            self._refusal, self._next_try = str(error), len(self._views.found.views) + MORE_VIEWS
            return None

    def _calibration(self) -> Calibrated:
        return self._calibrated(self._views.found, self._eyes.serials, lambda text: self._tell(None, text))

    def _tell(self, look: Look | None, doing: str = "") -> None:
        trouble = self._eyes.health if self._source.trouble is None else (self._source.trouble,)
        views = self._views
        self._show(Shown(views.coverage, len(views.found.views), look, trouble, self._refusal, doing))


def checked_live(
    eyes: HealthyEyes, calibration: Path, views: LiveViews, show: Show, clock: Clock, longest_s: float
) -> Check:
    """One look of both eyes at the board, held still, with the calibration in a file.

    Args:
        eyes: cameras that are not open; they are closed again.
        longest_s: how long the board is waited for [s].

    Raises:
        ConfigError: the file is damaged.
        CalibrationError: they do not see it in time.
        SourceError: they cannot be opened, or are not the calibrated ones.
    """
    rig, last = pair_in(calibration), ""
    until = clock.now() + longest_s
    with ReconnectingSource(RequiredEyes(eyes, rig.require), "the cameras", clock) as source, suppress(SourceEnded):
        while clock.now() < until:
            frame = source.read(READ_S)
            look = None if frame is None else views.look(frame)
            trouble = eyes.health if source.trouble is None else (source.trouble,)
            show(Shown(views.coverage, 0, look, trouble))
            if look is not None and look.outcome is Outcome.TAKEN and look.view.is_stereo:
                return check(rig, look.view, views.found.board)
            last = "; ".join(f"{each.eye}: {each.fault.text}" for each in look.unusable) if look is not None else last
    raise CalibrationError(
        f"both eyes did not see the board held still{f' ({last})' if last else ''}. Hold it into the middle of both "
        "images"
    )
