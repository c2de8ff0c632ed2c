"""The one place where the daemon touches zenoh: sessions that are always closed, handlers that always answer.

A Python callback that is never undeclared keeps the process from exiting, so every session here lives in a `with`.
"""

from __future__ import annotations

import json
import logging
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

import zenoh
import zenoh.ext

from interfaces.errors import BodyschemaError, BusError, RequestError

from .wire import JSON, MSGPACK, ErrorReply, decode, encode

log = logging.getLogger(__name__)

LEASE_MS = 2000
FIRST_TRY_MS = 100  # how long opening waits for a peer that is not there; trying goes on in the background
ACCEPT_LIMIT_S = 1.0
OPEN_TIMEOUT_S = 5.0
# What clients call a payload when nobody told them: taken for JSON.
PLAIN = ("zenoh/", "text/")
RETRY_MS = {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2}


@dataclass(frozen=True, slots=True)
class Request:
    """One query, taken apart.

    Attributes:
        parameters: what stands after the `?` of the key.
        encoding: JSON or MSGPACK, which the reply has to use too.
    """

    parameters: dict[str, str]
    payload: bytes
    encoding: str


@dataclass(frozen=True, slots=True)
class Reply:
    """One answer, taken apart: `error` says what was wrong with the request, or is None."""

    payload: bytes
    error: str | None


class Bus:
    """A zenoh session of ours.

    Use as a context manager; leaving it undeclares everything and ends the handler threads.
    """

    def __init__(
        self,
        *,
        listen: str | None = None,
        connect: str | None = None,
        client: bool = False,
        open_timeout_s: float = OPEN_TIMEOUT_S,
    ) -> None:
        """A session that listens on `listen` and, when there is somebody, talks to `connect`.

        Args:
            client: connect at once or fail; otherwise go on trying in the background.
            open_timeout_s: how long who takes the connection may need to speak zenoh.
        """
        self._listen, self._connect, self._client = listen, connect, client
        self._open_timeout_s = open_timeout_s
        self._session: zenoh.Session | None = None
        self._declared: list[object] = []  # a token that nobody holds is undeclared

    def __enter__(self) -> Self:
        try:
            self._session = zenoh.open(self._config())
        except zenoh.ZError as error:
            raise BusError(self._explain(str(error))) from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._session is not None:
            self._session.close()
            self._session = None
            self._declared.clear()

    def publisher(self, key: str, *, cache: int = 0) -> Callable[[bytes], None]:
        """A function that publishes JSON under `key`; with `cache`, late subscribers can ask for the last so many."""
        if not cache:
            plain = self._open.declare_publisher(key, encoding=zenoh.Encoding(JSON))
            return plain.put
        advanced = zenoh.ext.declare_advanced_publisher(
            self._open,
            key,
            encoding=zenoh.Encoding(JSON),
            cache=zenoh.ext.CacheConfig(cache),
            publisher_detection=True,
        )
        return advanced.put

    def subscribe(self, key: str, handler: Callable[[bytes], None]) -> None:
        """Call `handler` with the payload of every publication under `key`, in a thread of the session's own."""

        def receive(sample: zenoh.Sample) -> None:
            try:
                handler(sample.payload.to_bytes())
            except Exception:
                log.exception("a message under %s could not be taken", key)

        self._declared.append(self._open.declare_subscriber(key, receive))

    def answer(self, key: str, handler: Callable[[Request], bytes], *, encoding: str | None = None) -> None:
        """Answer queries under `key`; what `handler` raises goes back as an error reply.

        Args:
            encoding: of the answers; None: the one that the request has.
        """

        def receive(query: zenoh.Query) -> None:
            with query:
                self._reply(key, query, handler, encoding)

        self._declared.append(self._open.declare_queryable(key, receive, complete=True))

    def token(self, key: str) -> None:
        """Be alive under `key` until the session ends."""
        self._declared.append(self._open.liveliness().declare_token(key))

    def watch(self, key: str, changed: Callable[[bool], None]) -> None:
        """Call `changed` with True when somebody comes alive under `key`, and False when he is gone."""

        def receive(sample: zenoh.Sample) -> None:
            changed(sample.kind == zenoh.SampleKind.PUT)

        self._declared.append(self._open.liveliness().declare_subscriber(key, receive, history=True))

    def alive(self, key: str, *, timeout_s: float = 2.0) -> bool:
        """Whether somebody is alive under `key`, which this session does not watch too.

        zenoh answers from what a watch of the same session has heard so far, which may be nothing yet.
        """
        return any(reply.ok is not None for reply in self._open.liveliness().get(key, timeout=timeout_s))

    def ask(self, key: str, payload: bytes = b"", *, encoding: str = JSON, timeout_s: float = 5.0) -> list[Reply]:
        """All replies to a query; none when nobody answers under `key`."""
        replies = self._open.get(key, payload=payload, encoding=zenoh.Encoding(encoding), timeout=timeout_s)
        return [_taken_apart(reply) for reply in replies]

    def ask_one(self, key: str, payload: bytes = b"", *, encoding: str = JSON, timeout_s: float = 5.0) -> bytes:
        """The one reply to a query.

        Raises:
            BusError: nobody answers under this key, or not in time.
            RequestError: the request was refused.
        """
        replies = self.ask(key, payload, encoding=encoding, timeout_s=timeout_s)
        if not replies:
            process = "sampler" if key.split("/")[-1].startswith(("sampler", "pairs", "simulation")) else "learner"
            raise BusError(
                f"nobody answers under {key}. Is the {process} running? Start it with `bodyschema {process}`"
            )
        if replies[0].error is not None:
            raise RequestError(replies[0].error)
        return replies[0].payload

    @property
    def _open(self) -> zenoh.Session:
        if self._session is None:
            raise BusError("the zenoh session is not open; use the bus in a with statement")
        return self._session

    def _config(self) -> zenoh.Config:
        config = zenoh.Config()
        settings: dict[str, Any] = {
            "mode": "client" if self._client else "peer",
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "listen/endpoints": [self._listen] if self._listen else [],
            "scouting/delay": FIRST_TRY_MS,
            "connect/endpoints": [self._connect] if self._connect else [],
            "connect/retry": RETRY_MS,
            "timestamping/enabled": True,
            "transport/link/tx/lease": LEASE_MS,
            "transport/unicast/open_timeout": round(1e3 * self._open_timeout_s),
        }
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        return config

    def _explain(self, message: str) -> str:
        if self._client and _accepts(self._connect or ""):
            return (
                f"somebody listens on {self._connect} but does not answer: it is stopped, very busy, or no bodyschema. "
                "`ps` shows what it is"
            )
        if self._client:
            return (
                f"nobody listens on {self._connect}. Start the daemon with `bodyschema run`, "
                "or mend the table [zenoh] of robot.toml"
            )
        if "in use" in message:
            return (
                f"the port of {self._listen} is in use. Stop the other bodyschema, "
                "or give another endpoint in the table [zenoh] of robot.toml"
            )
        return f"cannot open zenoh on {self._listen}: {message.split(' at /')[0]}. Mend the table [zenoh] of robot.toml"

    def _reply(
        self, key: str, query: zenoh.Query, handler: Callable[[Request], bytes], answer_encoding: str | None
    ) -> None:
        asked = str(query.encoding) if query.encoding is not None else JSON
        encoding = MSGPACK if asked.startswith(MSGPACK) else JSON
        if not asked.startswith((JSON, MSGPACK, *PLAIN)):
            said = f"the encoding {asked} is unknown; known are {JSON} and {MSGPACK}"
            query.reply_err(encode(ErrorReply(said), encoding), encoding=zenoh.Encoding(encoding))
            return
        payload = query.payload.to_bytes() if query.payload is not None else b""
        parameters = dict(_parameters(str(query.parameters)))
        try:
            answer = handler(Request(parameters, payload, encoding))
        except BodyschemaError as error:
            query.reply_err(encode(ErrorReply(str(error)), encoding), encoding=zenoh.Encoding(encoding))
        except Exception as error:
            log.exception("a query under %s failed", key)
            text = f"internal error, please report it: {type(error).__name__}: {error}"
            query.reply_err(encode(ErrorReply(text), encoding), encoding=zenoh.Encoding(encoding))
        else:
            query.reply(key, answer, encoding=zenoh.Encoding(answer_encoding or encoding))


@contextmanager
def client(endpoint: str, open_timeout_s: float = OPEN_TIMEOUT_S) -> Iterator[Bus]:
    """A short-lived session to the process that listens on `endpoint`; BusError when there is none."""
    with Bus(connect=endpoint, client=True, open_timeout_s=open_timeout_s) as bus:
        yield bus


def is_alive(endpoint: str, token: str, *, open_timeout_s: float = OPEN_TIMEOUT_S) -> bool:
    """Whether somebody listens on `endpoint` and has declared the liveliness token."""
    try:
        with client(endpoint, open_timeout_s) as bus:
            return bus.alive(token)
    except BusError:
        return False


def _parameters(text: str) -> Iterator[tuple[str, str]]:
    for part in text.split(";"):
        name, _, value = part.partition("=")
        if name:
            yield name, value


def _taken_apart(reply: zenoh.Reply) -> Reply:
    if reply.ok is not None:
        return Reply(reply.ok.payload.to_bytes(), None)
    assert reply.err is not None
    payload = reply.err.payload.to_bytes()
    if payload == b"Timeout":
        return Reply(payload, "no answer in time; the process may be stopped or very busy")
    try:
        return Reply(payload, decode(payload, ErrorReply, str(reply.err.encoding)).error)
    except RequestError:
        return Reply(payload, payload.decode(errors="replace"))


def _accepts(endpoint: str) -> bool:
    """Whether a connection to a TCP endpoint is taken, be it by a process that never answers."""
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    if protocol != "tcp" or not port.isdigit():
        return False
    try:
        with socket.create_connection((host.strip("[]"), int(port)), ACCEPT_LIMIT_S):
            return True
    except OSError:
        return False
