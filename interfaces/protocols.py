"""The capabilities shared by hardware, simulation and recordings. Each has a contract test in tests/contracts."""

from __future__ import annotations

from types import TracebackType
from typing import TYPE_CHECKING, Protocol, Self, runtime_checkable

if TYPE_CHECKING:  # a client that only asks loads no NumPy
    from .camera import StereoCalibration
    from .records import JointReading, MarkerFix, MarkerMiss, StereoFrame


class Clock(Protocol):
    """Source of timestamps."""

    def now(self) -> float:
        """Return the monotonic time [s], the clock of all readings and frames."""
        ...

    def utc(self) -> str:
        """Return the wall-clock time, ISO 8601 in UTC."""
        ...


class Source(Protocol):
    """Something that is opened, read and closed, and may be opened again.

    `__enter__` opens it, never `__init__`. Closing it again does no harm. Reading a source that is not open raises
    SourceError. Time keeps increasing when a source is closed and opened again.
    """

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None: ...


@runtime_checkable
class JointSource(Source, Protocol):
    """Joint encoders."""

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints in the order of `q`."""
        ...

    def read(self, timeout_s: float) -> JointReading | None:
        """Return the next reading, in strictly increasing time; None if none arrives within `timeout_s`.

        Raises:
            SourceEnded: there will be no more.
            SourceLost: the device went away.
        """


@runtime_checkable
class StereoEyes(Source, Protocol):
    """One or two eyes, in one camera or two. Their images are neither calibrated nor rectified."""

    @property
    def image_size_px(self) -> tuple[int, int]:
        """Width and height of each eye's image."""
        ...

    @property
    def serials(self) -> tuple[str, ...]:
        """Identifiers of the eyes' devices, left first: serial number, path or file name."""
        ...

    def read(self, timeout_s: float) -> StereoFrame | None:
        """Return the next pair of images, in strictly increasing time; None if none arrives within `timeout_s`.

        Raises:
            SourceEnded: there will be no more.
            SourceLost: a device went away.
        """


@runtime_checkable
class StereoCamera(Source, Protocol):
    """One or two calibrated eyes on one clock with the encoders; their images are rectified."""

    @property
    def calibration(self) -> StereoCalibration:
        """The calibration the images belong to."""
        ...

    def read(self, timeout_s: float) -> StereoFrame | None:
        """Return the next frame, in strictly increasing time; None if none arrives within `timeout_s`.

        Raises:
            SourceEnded: there will be no more.
            SourceLost: the device went away.
        """


@runtime_checkable
class MarkerSource(Source, Protocol):
    """The marker's position: a tracked camera, or a recording."""

    def read(self, timeout_s: float) -> MarkerFix | MarkerMiss | None:
        """Return the next fix, or the reason for a missing one, in strictly increasing time; None after `timeout_s`.

        Raises:
            SourceEnded: there will be no more.
            SourceLost: the device went away.
        """
