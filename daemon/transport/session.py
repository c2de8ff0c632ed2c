"""Access to zenoh for the daemon: sessions that are always closed, handlers that always answer.

A Python callback that is never undeclared keeps the process from exiting, so every session here is used in a `with`.
"""

from __future__ import annotations

import contextlib
import json
import logging
import queue
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Self

import zenoh
import zenoh.ext

from bodyschema.daemon.transport.identity import Route
from bodyschema.daemon.transport.query_limiter import QueryLimiter
from bodyschema.daemon.transport.wire import JSON, MSGPACK, ErrorReply, decode, encode
from bodyschema.interfaces.errors import BodyschemaError, BusError, RequestError

log = logging.getLogger(__name__)


class SessionSettings:
    lease_ms: int = 2000  # a peer that is silent for so long is gone
    first_try_ms: int = 100  # how long opening waits for an absent peer; connecting goes on in the background
    open_timeout_s: float = 5.0  # how long opening waits for another process
    # Limits of messages that zenoh reassembles: the largest model with orientation for a client, pairs for a process.
    largest_reply_bytes, largest_message_bytes = 2**26, 2**23
    max_refusals: int = 1000  # refusals waiting to be sent; beyond them a query ends without an answer
    accept_limit_s: float = 1.0  # how long an endpoint is waited for to accept a connection


# Default encodings of clients that set none; treated as JSON.
PLAIN = ("zenoh/", "text/")


@dataclass(frozen=True, slots=True)
class Request:
    """One query, decoded."""

    parameters: dict[str, str]  # the part of the key after the `?`
    payload: bytes
    encoding: str  # JSON or MSGPACK; the reply has to use the same


@dataclass(frozen=True, slots=True)
class Reply:
    """One answer, decoded: `error` is the fault of the request, or None."""

    payload: bytes
    error: str | None


class ZenohSession:
    """A zenoh session of this process.

    Use as a context manager; leaving it undeclares everything and ends the handler threads.
    """

    def __init__(
        self,
        *,
        listen: str | None = None,
        connect: str | Route | None = None,
        client: bool = False,  # connect at once or fail; otherwise keep trying in the background
        # further zenoh configuration, as returned by `Config.zenoh_settings` for a process
        settings: Mapping[str, Any] | None = None,
        # time allowed for the process that accepts the connection to speak zenoh
        open_timeout_s: float = SessionSettings.open_timeout_s,
    ) -> None:
        """Open a session that listens on `listen` and connects to `connect` if a process listens there."""
        self._listen, self._client, self._settings = listen, client, dict(settings or {})
        self._route = Route((connect,)) if isinstance(connect, str) else connect
        self._open_timeout_s = open_timeout_s
        self._session: zenoh.Session | None = None
        self._declared: list[object] = []  # a token without a reference is undeclared
        self._limiters: list[QueryLimiter[zenoh.Query]] = []
        self._threads: list[threading.Thread] = []
        self._refusals: queue.Queue[tuple[zenoh.Query, str] | None] = queue.Queue(SessionSettings.max_refusals)

    def __enter__(self) -> Self:
        try:
            self._session = zenoh.open(self._config())
        except zenoh.ZError as error:
            raise BusError(self._explain(str(error))) from error
        return self

    def __exit__(self, *_: object) -> None:
        if self._session is not None:
            self._session.close()
            self._session = None
            self._declared.clear()
            self._end_threads()

    def publisher(self, key: str, *, cache: int = 0) -> Callable[[bytes], None]:
        """Return a function that publishes JSON under `key`; late subscribers can ask for the last `cache` messages."""
        if not cache:
            plain = self._open.declare_publisher(key, encoding=zenoh.Encoding(JSON))
            return plain.put
        advanced = zenoh.ext.declare_advanced_publisher(
            self._open, key, encoding=zenoh.Encoding(JSON), cache=zenoh.ext.CacheConfig(cache), publisher_detection=True
        )
        return advanced.put

    def subscribe(self, key: str, handler: Callable[[bytes], None], *, quick: bool = False) -> None:
        """Call `handler` with the payload of every publication under `key`, in a thread of the session.

        Args:
            quick: True if the handler only stores the payload. It then gets no thread of its own, because each further
                thread that needs the interpreter for every message slows down all others.
        """

        def receive(sample: zenoh.Sample) -> None:
            try:
                handler(sample.payload.to_bytes())
            except Exception:
                log.exception("a message under %s could not be taken", key)

        received = zenoh.handlers.Callback(receive, indirect=not quick)
        self._declared.append(self._open.declare_subscriber(key, received))

    def answer(self, key: str, handler: Callable[[Request], bytes], *, encoding: str | None = None) -> None:
        """Answer queries under `key`; exceptions of `handler` are returned as error replies.

        Args:
            encoding: encoding of the answers; None: that of the request.
        """

        limiter: QueryLimiter[zenoh.Query] = QueryLimiter()

        def receive(query: zenoh.Query) -> None:
            try:
                limiter.admit(_source(query), 0 if query.payload is None else len(query.payload), query)
            except RequestError as error:
                try:
                    self._refusals.put_nowait((query, str(error)))
                except queue.Full:
                    query.drop()

        if not self._threads:
            self._start(self._refuse)
        self._limiters.append(limiter)
        self._start(lambda: self._answer(key, limiter, handler, encoding))
        # Runs in zenoh's own thread, which only queues the query.
        received = zenoh.handlers.Callback(receive, indirect=False)
        self._declared.append(self._open.declare_queryable(key, received, complete=True))

    def token(self, key: str) -> None:
        """Declare a liveliness token under `key` until the session ends."""
        self._declared.append(self._open.liveliness().declare_token(key))

    def watch(self, key: str, changed: Callable[[bool], None]) -> None:
        """Call `changed` with True when a token under `key` appears, and False when it disappears."""

        def receive(sample: zenoh.Sample) -> None:
            changed(sample.kind == zenoh.SampleKind.PUT)

        self._declared.append(self._open.liveliness().declare_subscriber(key, receive, history=True))

    def alive(self, key: str, *, timeout_s: float = 2.0) -> list[str]:
        """Return the live keys that match this one, except those that this session also watches.

        zenoh answers from the part that a watch of the same session has received so far, which may still be nothing.
        """
        replies = self._open.liveliness().get(key, timeout=timeout_s)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]

    def ask(self, key: str, payload: bytes = b"", *, encoding: str = JSON, timeout_s: float = 5.0) -> list[Reply]:
        """Return all replies to a query; an empty list if there is no answer under `key`."""
        source = zenoh.SourceInfo(self._open.id, 0)
        said = zenoh.Encoding(encoding)
        replies = self._open.get(key, payload=payload, encoding=said, timeout=timeout_s, source_info=source)
        return [_unpacked_reply(reply) for reply in replies]

    def ask_one(self, key: str, payload: bytes = b"", *, encoding: str = JSON, timeout_s: float = 5.0) -> bytes:
        """Return the one reply to a query.

        Raises:
            BusError: there is no answer under this key, or not in time.
            RequestError: the request was refused.
        """
        replies = self.ask(key, payload, encoding=encoding, timeout_s=timeout_s)
        if not replies:
            process = "sampler" if key.split("/")[-1].startswith(("sampler", "pairs", "simulation")) else "learner"
            if self._route is not None and self._route.secured:
                raise BusError(
                    f"nothing answers under {key}: the {process} does not run, or your certificate or name has no role "
                    "that may ask this (docs/security.md)"
                )
            raise BusError(
                f"nothing answers under {key}. Is the {process} running? Start it with `bodyschema run {process}`"
            )
        if replies[0].error is not None:
            raise RequestError(replies[0].error)
        return replies[0].payload

    @property
    def _open(self) -> zenoh.Session:
        if self._session is None:
            raise BusError("the zenoh session is not open; use it in a with statement")
        return self._session

    def _config(self) -> zenoh.Config:
        config = zenoh.Config()
        # A peer linked to a process and to the router would receive everything twice.
        is_linked_twice = self._route is not None and len(self._route.endpoints) > 1
        largest_bytes = SessionSettings.largest_reply_bytes if self._client else SessionSettings.largest_message_bytes
        settings: dict[str, Any] = {
            "mode": "client" if self._client else "router" if is_linked_twice else "peer",
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "listen/endpoints": [self._listen] if self._listen else [],
            "scouting/delay": SessionSettings.first_try_ms,
            "connect/endpoints": list(self._route.endpoints) if self._route else [],
            "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2},
            "timestamping/enabled": True,
            "transport/link/tx/lease": SessionSettings.lease_ms,
            "transport/link/rx/max_message_size": largest_bytes,
            "transport/unicast/open_timeout": round(1e3 * self._open_timeout_s),
        }
        if self._route is not None and self._route.identity is not None:
            settings |= self._route.identity.settings()
        for key, value in (settings | self._settings).items():
            config.insert_json5(key, json.dumps(value))
        return config

    def _explain(self, message: str) -> str:
        if self._client and self._route is not None:
            return unreachable(self._route)
        listen = self._listen or " or ".join(self._settings.get("listen/endpoints", ())) or "nothing"
        if "in use" in message:
            return (
                f"the port of {listen} is in use. Stop the other bodyschema, "
                "or give another endpoint in the table [zenoh] of robot.toml"
            )
        return f"cannot open zenoh on {listen}: {message.split(' at /')[0]}. Fix the table [zenoh] of robot.toml"

    def _start(self, work: Callable[[], None]) -> None:
        thread = threading.Thread(target=work, name="answers")
        self._threads.append(thread)
        thread.start()

    def _end_threads(self) -> None:
        """End the handler threads after the session was closed and nothing more can arrive."""
        for limiter in self._limiters:
            limiter.close()
        if self._threads:
            self._refusals.put(None)
        for thread in self._threads:
            thread.join()
        self._limiters.clear()
        self._threads.clear()

    def _refuse(self) -> None:
        """Refuse queries beyond the limits, in a separate thread, since a client that does not listen blocks it."""
        while (refused := self._refusals.get()) is not None:
            with contextlib.suppress(zenoh.ZError), refused[0]:  # a closed session cannot answer
                _reply_error(*refused)
            del refused  # a query that is referenced is not yet answered

    def _answer(
        self, key: str, limiter: QueryLimiter[zenoh.Query], handler: Callable[[Request], bytes], encoding: str | None
    ) -> None:
        while (taken := limiter.take()) is not None:
            query, refused = taken
            with contextlib.suppress(zenoh.ZError), query:  # a closed session cannot answer
                if refused is None:
                    self._reply(key, query, handler, encoding)
                else:
                    _reply_error(query, str(refused))
            del query, taken  # a query that is referenced is not yet answered

    def _reply(
        self, key: str, query: zenoh.Query, handler: Callable[[Request], bytes], answer_encoding: str | None
    ) -> None:
        asked, encoding = _encodings(query)
        if not asked.startswith((JSON, MSGPACK, *PLAIN)):
            _reply_error(query, f"the encoding {asked} is unknown; known are {JSON} and {MSGPACK}")
            return
        payload = query.payload.to_bytes() if query.payload is not None else b""
        parts = (part.partition("=") for part in str(query.parameters).split(";"))
        parameters = {name: value for name, _, value in parts if name}
        try:
            answer = handler(Request(parameters, payload, encoding))
        except BodyschemaError as error:
            _reply_error(query, str(error))
        except Exception as error:
            log.exception("a query under %s failed", key)
            _reply_error(query, f"internal error, please report it: {type(error).__name__}: {error}")
        else:
            query.reply(key, answer, encoding=zenoh.Encoding(answer_encoding or encoding))


def _encodings(query: zenoh.Query) -> tuple[str, str]:
    """Return the name of the query's encoding, and which of ours an answer uses."""
    asked = str(query.encoding) if query.encoding is not None else JSON
    return asked, MSGPACK if asked.startswith(MSGPACK) else JSON


def _reply_error(query: zenoh.Query, text: str, longest: int = 2000) -> None:
    _, encoding = _encodings(query)
    shortened = text if len(text) <= longest else f"{text[:longest]}..."  # may quote the request
    query.reply_err(encode(ErrorReply(shortened), encoding), encoding=zenoh.Encoding(encoding))


def _source(query: zenoh.Query) -> str:
    """Return the id of the querying session, if the query has one."""
    return "" if query.source_info is None else str(query.source_info.source_id.zid)


@contextmanager
def client(route: str | Route, open_timeout_s: float = SessionSettings.open_timeout_s) -> Iterator[ZenohSession]:
    """Open a short-lived session to a process; raise BusError if it cannot be reached."""
    with ZenohSession(connect=route, client=True, open_timeout_s=open_timeout_s) as bus:
        yield bus


def is_alive(endpoint: str | Route, token: str, *, open_timeout_s: float = SessionSettings.open_timeout_s) -> bool:
    """Return True if a process listens on `endpoint` and has declared the liveliness token."""
    try:
        with client(endpoint, open_timeout_s) as bus:
            return bool(bus.alive(token))
    except BusError:
        return False


def _unpacked_reply(reply: zenoh.Reply) -> Reply:
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


def unreachable(route: Route) -> str:
    """Return the reason why none of a route's endpoints could be reached."""
    last = route.endpoints[-1]
    if not accepts(last):
        return (
            f"nothing listens on {route}. Start the daemon with `bodyschema run`, "
            "or fix the table [zenoh] of robot.toml"
        )
    if route.secured:
        return (
            f"{last} is there, but the connection was refused: your certificate or password is not accepted there, "
            "or its certificate is not for that name or not of your authority. docs/security.md shows how to look"
        )
    return (
        f"a program listens on {last} but does not answer: it is stopped, very busy, or not bodyschema. "
        "`ps` shows what it is"
    )


def accepts(endpoint: str, within_s: float = SessionSettings.accept_limit_s) -> bool:
    """Return True if a TCP endpoint accepts connections, even from a process that never answers."""
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    if protocol not in ("tcp", "tls") or not port.isdigit():
        return False
    try:
        with socket.create_connection((host.strip("[]"), int(port)), within_s):
            return True
    except (OSError, OverflowError, UnicodeError):  # a port above 65535, a name with a part above 63 characters
        return False
