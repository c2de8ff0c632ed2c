"""The exceptions of everything that is not the maths (`kbmaps` has a tree of its own).

BodyschemaError
├── ConfigError         a file of ours is wrong: names file, line, key and remedy
│   └── RobotError      robot.toml and URDF do not fit each other
├── RecordingError      a recording cannot be read: names line and column
├── SourceError         an encoder chain or a camera
│   ├── SourceEnded     there will be no more readings (a recording is through)
│   └── SourceLost      the device went away; opening it again may help
├── StoreError          the pair store: foreign or damaged
│   └── StoreUnwritable the disk is full, read-only or failing: trying again later may help
├── BusError            zenoh: port in use, nobody there, time-out
└── RequestError        a query that cannot be answered: says what is wrong with it
"""

from __future__ import annotations


class BodyschemaError(Exception):
    """Root of the tree. The message says what was wrong, where, and what to do."""


class ConfigError(BodyschemaError):
    """A configuration file is wrong."""

    def __init__(self, what: str, *, file: object = None, line: int | None = None, remedy: str = "") -> None:
        self.what, self.file, self.line, self.remedy = what, file, line, remedy
        place = "" if file is None else f"{file}{'' if line is None else f', line {line}'}: "
        super().__init__(f"{place}{what}{f'. {remedy}' if remedy else ''}")


class RobotError(ConfigError):
    """robot.toml and URDF do not fit each other."""


class RecordingError(BodyschemaError):
    """A recording cannot be read."""

    def __init__(
        self, what: str, *, file: object, line: int | None = None, column: str | None = None, remedy: str = ""
    ) -> None:
        self.what, self.file, self.line, self.column, self.remedy = what, file, line, column, remedy
        place = f"{file}"
        if line is not None:
            place += f", line {line}"
        if column is not None:
            place += f", column {column}"
        super().__init__(f"{place}: {what}{f'. {remedy}' if remedy else ''}")


class SourceError(BodyschemaError):
    """An encoder chain or a camera failed."""


class SourceEnded(SourceError):
    """There will be no more readings."""


class SourceLost(SourceError):
    """The device went away; opening it again may help, from `retry_s` on where the source knows that it is cheap.

    `brief` is the message in a sentence, where that has a table.
    """

    def __init__(self, message: str = "", *, retry_s: float | None = None, brief: str = "") -> None:
        self.retry_s, self.brief = retry_s, brief or message
        super().__init__(message)


class StoreError(BodyschemaError):
    """The pair store is full, read-only, foreign or damaged."""


class StoreUnwritable(StoreError):
    """The disk takes nothing now; trying again later may help."""


class BusError(BodyschemaError):
    """zenoh: a port in use, nobody there, a time-out."""


class RequestError(BodyschemaError):
    """A query that cannot be answered; nothing was changed."""
