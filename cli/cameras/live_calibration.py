"""Run `calibrate cameras` on the robot's own cameras: take views while a person moves the board, until they suffice."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from bodyschema.cli.cameras.calibration import Tell, pair_in
from bodyschema.daemon.sampler.reconnect import ReconnectingSource
from bodyschema.interfaces.errors import SourceEnded, SourceError
from bodyschema.interfaces.protocols import Clock, StereoEyes
from bodyschema.interfaces.waits import Waits
from bodyschema.vision.calibration.calibrate import Calibrated
from bodyschema.vision.calibration.check import Check, check
from bodyschema.vision.calibration.gather import Gathered, require_both
from bodyschema.vision.calibration.guidance import Coverage, cell_counts
from bodyschema.vision.calibration.image_pairs import ImagePair
from bodyschema.vision.calibration.live import LiveViews, Look, Outcome
from bodyschema.vision.calibration.settings import ViewSettings
from bodyschema.vision.calibration.view import Eye, all_px, image_of
from bodyschema.vision.rig.stereo_rig import CalibrationError

# Number of further views taken after a refused calibration before the next try.
MORE_VIEWS = 4


@dataclass(frozen=True)
class Shown:
    """Feedback for the person who holds the board."""

    coverage: Coverage  # coverage of the views
    views: int  # number of views taken
    look: Look | None = None  # the last pair of images; None before any, and while the cameras are lost
    trouble: tuple[str, ...] = ()  # faults of the cameras, with the remedies
    refusal: str = ""  # reason why the last calibration was not good enough
    doing: str = ""  # present computation; empty while views are taken

    @property
    def next_step(self) -> str:
        """Advice on the next view."""
        missing = self.coverage.missing()
        if missing:
            return missing[0]
        return f"{MORE_VIEWS} more views, tilted and anywhere" if self.refusal else "nothing is missing"


Show = Callable[[Shown], None]


class HealthyEyes(StereoEyes, Protocol):
    """Eyes that report their faults; see `bodyschema.vision.cameras.live.LiveEyes`."""

    @property
    def health(self) -> tuple[str, ...]: ...


def _named(image_size_px: tuple[int, int], serials: tuple[str, ...]) -> str:
    return f"{' and '.join(serials)} with {'x'.join(map(str, image_size_px))} pixels"


class LiveCalibration:
    """Collector of views until none is missing and the calibration is good enough, or until `stop`."""

    def __init__(
        self,
        eyes: HealthyEyes,
        views: LiveViews,  # empty collection of views of the board
        # calibrates from views and serials; raises CalibrationError if the result is not good enough
        calibrated: Callable[[Gathered, tuple[str, ...], Tell], Calibrated],
        show: Show,  # called for every pair of images, and with the fault if there are none
        clock: Clock,
        # called with the images of every view taken and its number, from 1 on
        keep: Callable[[ImagePair, int], None] = lambda _pair, _number: None,
    ) -> None:
        self._eyes, self._calibrated, self._show, self._keep = eyes, calibrated, show, keep
        self._source = ReconnectingSource(eyes, "the cameras", clock, require=self._require_same)
        self._first: tuple[tuple[int, int], tuple[str, ...]] | None = None
        self._views = views
        self._refusal = ""
        self._next_try = 0
        self._stopping = False

    def stop(self) -> None:
        """End the collection of views, so that `run` calibrates from those so far. Only sets a flag."""
        self._stopping = True

    def run(self) -> tuple[Gathered, Calibrated]:
        """Gather views until their calibration is good enough; return both.

        Raises:
            CalibrationError: the images ended, or `stop` was called, before it was good enough; the message has the
                reasons.
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

    def _require_same(self) -> None:
        """Raise SourceError if cameras or image size have changed since the first opening."""
        these = self._eyes.image_size_px, self._eyes.serials
        self._first = self._first or these
        if these != self._first:
            raise SourceError(f"these are {_named(*these)}, the views are of {_named(*self._first)}. Plug those in")

    def _look(self) -> Look | None:
        frame = self._source.read(Waits.read_s)
        if frame is None:
            if self._source.trouble is not None:
                self._views.forget()
            return None
        return self._views.look(frame)

    def _tried(self) -> Calibrated | None:
        """Return the calibration if the views cover enough and it is good enough, otherwise None."""
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
    """Check the calibration in a file with one view of a still board by both eyes.

    Args:
        eyes: closed cameras; they are closed again.
        longest_s: longest wait for the board [s].

    Raises:
        ConfigError: the file is damaged.
        CalibrationError: they do not see it in time.
        SourceError: they cannot be opened, or are not the calibrated ones.
    """
    rig, last = pair_in(calibration), ""
    until = clock.now() + longest_s

    def require() -> None:
        rig.require(eyes.image_size_px, eyes.serials)

    with ReconnectingSource(eyes, "the cameras", clock, require=require) as source, suppress(SourceEnded):
        while clock.now() < until:
            frame = source.read(Waits.read_s)
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


_DONE, _OPEN = ("✓", "green"), ("·", "yellow")


def now_text(shown: Shown) -> str:
    """Return a sentence on the outcome of the last pair of images."""
    look = shown.look
    if shown.doing:
        return shown.doing
    if look is None:
        return "no images"
    match look.outcome:
        case Outcome.TAKEN:
            return f"taken: view {shown.views}"
        case Outcome.MOVING:
            return "hold it still"
        case Outcome.KNOWN:
            return "there is a view like this one: move or tilt the board"
        case Outcome.UNSEEN:
            named = len(shown.coverage.eyes) > 1
            return "; ".join(f"{f'{each.eye} eye: ' if named else ''}{each.fault.text}" for each in look.unusable)


def screen(shown: Shown, heading: str) -> Group:
    """Return the feedback as a screen for 80 columns and 24 lines."""
    coverage = shown.coverage
    wanted = max(ViewSettings.wanted_views, coverage.whole_views)
    count = f"{coverage.whole_views} of {wanted} views, {coverage.progress:.0%}"
    parts = Table.grid(padding=(0, 4))
    for _ in range(len(coverage.eyes) + 2):
        parts.add_column(no_wrap=True)
    titles = (*(image_of(eye, coverage.eyes) for eye in coverage.eyes), "tilted, edge away", "distance")
    parts.add_row(*(Text(title, style="bold") for title in titles))
    parts.add_row(*(_cells(coverage, shown.look, eye) for eye in coverage.eyes), _tilts(coverage), _distances(coverage))
    texts = [
        Text(f"{heading}: {count}", style="bold"),
        Text(""),
        Text(f"Next: {shown.next_step}", style="bold cyan"),
        Text(f"Now:  {now_text(shown)}", style="green" if _is_taken(shown.look) else ""),
        Text(""),
        parts,
        Text(""),
        *(Text(trouble, style="yellow") for trouble in shown.trouble),
    ]
    if shown.refusal:
        texts.append(Text(f"Not good enough yet: {shown.refusal}", style="yellow"))
    texts.append(Text("█ covered   ○ the board is here   Ctrl-C: calibrate with what there is", style="dim"))
    return Group(*texts)


def _is_taken(look: Look | None) -> bool:
    return look is not None and look.outcome is Outcome.TAKEN


def _cells(coverage: Coverage, look: Look | None, eye: Eye) -> Table:
    """Return a table of the image's nine cells: those covered so far, and those that contain the board now."""
    table = Table.grid()
    here = None
    if look is not None and look.view.eye(eye) is not None:
        here = cell_counts(all_px([look.view], eye), look.pair.size_px) > 0
    for row, covered in enumerate(coverage.covered(eye).tolist()):
        line = Text()
        for column, is_covered in enumerate(covered):
            is_here = here is not None and bool(here[row, column])
            line.append("█" if is_covered else "·", style="green" if is_covered else "yellow")
            line.append("○ " if is_here else "  ", style="bold cyan")
        table.add_row(line)
    return table


def _tilts(coverage: Coverage) -> Table:
    table = Table.grid(padding=(0, 2))
    for edge, count in coverage.tilted().items():
        done = count >= ViewSettings.tilted_each_way
        table.add_row(
            edge,
            Text(
                f"{min(count, ViewSettings.tilted_each_way)}/{ViewSettings.tilted_each_way}",
                style=(_DONE if done else _OPEN)[1],
            ),
        )
    return table


def _distances(coverage: Coverage) -> Table:
    table = Table.grid(padding=(0, 2))
    for name, done in (("near", coverage.has_near), ("far", coverage.has_far)):
        table.add_row(name, Text(*(_DONE if done else _OPEN)))
    return table


class Lines:
    """The same feedback as lines: each view and each complaint at once, other changes every few seconds."""

    def __init__(self, say: Callable[[str], None], clock: Clock) -> None:
        self._say, self._clock = say, clock
        self._next_s = 0.0
        self._said: set[str] = set()  # since the last view
        self._complaints: set[str] = set()
        self._last_step = ""

    def __call__(self, shown: Shown) -> None:
        """Print the news."""
        for text in (shown.refusal and f"not good enough yet: {shown.refusal}", *shown.trouble):
            self._once(text, self._complaints)
        if _is_taken(shown.look) or (shown.next_step != self._last_step and not shown.doing):
            self._last_step = shown.next_step
            progress = f"{shown.coverage.whole_views} views, {shown.coverage.progress:.0%}. Next: {shown.next_step}"
            self._say(f"{now_text(shown)}. {progress}" if _is_taken(shown.look) else progress)
            self._said.clear()
        elif shown.doing or (shown.look is not None and self._clock.now() >= self._next_s):
            self._next_s = self._clock.now() + Waits.line_every_s
            self._once(now_text(shown), self._said)

    def _once(self, text: str, shown: set[str]) -> None:
        if text and text not in shown:
            shown.add(text)
            self._say(text)


@contextmanager
def guidance_on(console: Console, heading: str, clock: Clock) -> Iterator[Show]:
    """Yield a function that redraws a screen on a terminal and prints lines elsewhere."""
    if not console.is_terminal:
        yield Lines(lambda text: console.print(text, markup=False, highlight=False, soft_wrap=True), clock)
        return
    with Live(console=console, auto_refresh=False, transient=True) as live:
        yield lambda shown: live.update(screen(shown, heading), refresh=True)
