"""With which questions the positions of a bus are read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from .bus import Bus, Request

ATTEMPTS = 5  # where one servo of six loses every twentieth answer, all five fail for one in 700 openings


@dataclass(frozen=True, slots=True)
class Way:
    """One way to read a group of servos.

    Attributes:
        name: for people.
        requests: its questions.
        complaint: what is wrong when the group does not answer to it, though all its servos should; None: some do not
            know it.
    """

    name: str
    requests: tuple[Request, ...]
    complaint: str | None = None


class Plan:
    """The way in which each group of servos of a bus is read: the quickest that all of the group answer to."""

    def __init__(self, bus: Bus, groups: Sequence[Sequence[Way]]) -> None:
        """Try each group's ways, several times each, but for the last, which is taken as it is.

        Args:
            groups: of each the ways, the quickest first.
        """
        self._bus, self._groups = bus, groups
        self._taken = [self._first_answered(ways, ATTEMPTS) for ways in groups]

    @property
    def requests(self) -> list[Request]:
        """The questions of one reading."""
        return [request for way in self._ways for request in way.requests]

    @property
    def name(self) -> str:
        """The ways that are taken, for people."""
        return ", ".join(dict.fromkeys(way.name for way in self._ways))

    @property
    def complaints(self) -> list[str]:
        """What is wrong where a slower way is taken than the servos know."""
        slower = [way for ways, taken in zip(self._groups, self._taken, strict=True) for way in ways[:taken]]
        return [way.complaint for way in slower if way.complaint is not None]

    def improve(self) -> bool:
        """Try the quicker ways of each group once; return True when one is taken from now on."""
        before = self._taken
        pairs = zip(self._groups, self._taken, strict=True)
        self._taken = [self._first_answered(ways[: taken + 1], 1) for ways, taken in pairs]
        return self._taken != before

    @property
    def _ways(self) -> list[Way]:
        return [ways[taken] for ways, taken in zip(self._groups, self._taken, strict=True)]

    def _first_answered(self, ways: Sequence[Way], attempts: int) -> int:
        for place, way in enumerate(ways[:-1]):
            if any(self._is_answered(way) for _ in range(attempts)):
                return place
        return len(ways) - 1

    def _is_answered(self, way: Way) -> bool:
        return all(self._bus.ask(request).trouble is None for request in way.requests)
