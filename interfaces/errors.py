"""Exceptions of all packages except `kbmaps`, which has its own.

BodyschemaError
├── ConfigError         a configuration file is wrong: names file, line, key and remedy
│   └── RobotError      robot.toml and URDF do not fit each other
├── RecordingError      a recording cannot be read: names line and column
├── SourceError         an encoder chain or a camera failed
│   ├── SourceEnded     there will be no more readings (end of a recording)
│   └── SourceLost      the device was lost; opening it again may help
├── StoreError          the pair store: foreign or damaged
│   └── StoreUnwritable the disk is full, read-only or failing: trying again later may help
├── BusError            zenoh: port in use, no peer, time-out
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
    """The device was lost. Opening it again may help, after `retry_s` if the source knows that this is cheap.

    `brief` is the message in one sentence, if the full message contains a table.
    """

    def __init__(self, message: str = "", *, retry_s: float | None = None, brief: str = "") -> None:
        self.retry_s, self.brief = retry_s, brief or message
        super().__init__(message)


class StoreError(BodyschemaError):
    """The pair store is full, read-only, foreign or damaged."""


class StoreUnwritable(StoreError):
    """The disk accepts no data now; trying again later may help."""


class BusError(BodyschemaError):
    """zenoh: a port in use, no peer, a time-out."""


class RequestError(BodyschemaError):
    """A query that cannot be answered; nothing was changed."""
