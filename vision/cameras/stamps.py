"""Choose between a camera's own timestamps, if they are plausible, and the images' arrival times."""

from __future__ import annotations

import math
from itertools import pairwise


class _Settings:
    trial_frames = 3  # checked before the first is returned
    longest_delay_s = 1.0  # from the kernel's stamp to the arrival
    kernel_sigma_s = 1e-3
    arrival_sigma_s = 0.02  # of arrival times: decoding, scheduling, a busy bus


class Stamps:
    """Choice at the start between the kernel's timestamps and the arrival times, with strictly increasing times.

    The kernel stamps frames of USB cameras with CLOCK_MONOTONIC. Other drivers, and uvcvideo with clock=REALTIME, give
    zero or the wall clock's time.

    Attributes:
        source: "kernel" or "arrival"; None until decided.
        sigma_s: 1-sigma of the timestamps [s].
    """

    def __init__(self) -> None:
        self._seen: list[tuple[float, float]] = []
        self._last = -math.inf
        self.source: str | None = None
        self.rejected = 0

    @property
    def sigma_s(self) -> float:
        """1-sigma of the timestamps [s]."""
        return _Settings.kernel_sigma_s if self.source == "kernel" else _Settings.arrival_sigma_s

    def stamp(self, kernel_s: float, arrival_s: float) -> float | None:
        """Return the time of a frame [s]; None for the first ones, and for one with an implausible timestamp.

        Args:
            kernel_s: the driver's timestamp [s], monotonic.
            arrival_s: time at which the frame was handed over [s], monotonic.
        """
        if self.source is None:
            self._seen.append((kernel_s, arrival_s))
            if len(self._seen) < _Settings.trial_frames:
                return None
            self.source = "kernel" if self._are_plausible() else "arrival"
        t = kernel_s if self.source == "kernel" else arrival_s
        if t <= self._last or (self.source == "kernel" and not _near(kernel_s, arrival_s)):
            self.rejected += 1
            return None
        self._last = t
        return t

    def _are_plausible(self) -> bool:
        stamps = [kernel for kernel, _ in self._seen]
        increasing = all(later > earlier for earlier, later in pairwise(stamps))
        return increasing and all(_near(kernel, arrival) for kernel, arrival in self._seen)


def _near(kernel_s: float, arrival_s: float) -> bool:
    return kernel_s > 0 and -_Settings.kernel_sigma_s <= arrival_s - kernel_s < _Settings.longest_delay_s
