"""The page's addresses."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Literal, Protocol

import msgspec
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import Receive, Scope, Send

from bodyschema.daemon.command_names import CommandName
from bodyschema.daemon.wire import CommandReply, decode, encode
from bodyschema.interfaces.errors import BusError, RequestError

from .documents import Process
from .guard import Guard
from .hub import Follower, Hub, HubFullError

STATIC = Path(__file__).parent / "static"
LARGEST_BODY = 4096
# Said to an idle browser, so that whoever is between them does not think that it is over.
HEARTBEAT_S = 10.0
# How soon a browser asks again.
RETRY_MS = 1000
_JSON, _EVENTS = "application/json", "text/event-stream"
# The report is one file with its own style, and no script.
_REPORT_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors 'none'; sandbox"

Endpoint = Callable[[Request], Awaitable[Response]]


class PageCommand(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a button of the page may tell a process; resetting and torque are not among them."""

    process: Process
    command: Literal["pause", "resume", "tool_changed"]


class Commands(Protocol):
    """Tells processes what to do."""

    def command(self, process: Process, name: CommandName) -> str:
        """Its words; BusError when it does not answer, RequestError when it refuses."""
        ...


class Diagnosing(Protocol):
    """Diagnoses, one after the other."""

    def start(self) -> int:
        """Begin one, its number; RequestError when one is running."""
        ...

    def stop(self) -> None:
        """End the one that runs; RequestError when none does."""
        ...

    def report(self) -> bytes | None:
        """The last one's page; None while there is none."""
        ...


def application(hub: Hub, commands: Commands, diagnoses: Diagnosing) -> Starlette:
    """The page over what is in `hub`."""

    async def index(_: Request) -> Response:
        return FileResponse(STATIC / "index.html")

    async def state(_: Request) -> Response:
        return Response(hub.all(), media_type=_JSON)

    async def events(request: Request) -> Response:
        if request.method == "HEAD":  # an answer that would never end
            return Response(media_type=_EVENTS)
        try:
            return _EventStream(hub, hub.follow())
        except HubFullError as error:
            return JSONResponse({"error": str(error)}, status_code=503)

    async def command(request: Request) -> Response:
        asked = decode(await _body(request), PageCommand)
        message = await run_in_threadpool(commands.command, asked.process, asked.command)
        return Response(encode(CommandReply(asked.command, message)), media_type=_JSON)

    async def diagnose(_: Request) -> Response:
        return JSONResponse({"number": await run_in_threadpool(diagnoses.start)}, status_code=202)

    async def stop_diagnosing(_: Request) -> Response:
        await run_in_threadpool(diagnoses.stop)
        return Response(status_code=204)

    async def report(_: Request) -> Response:
        page = await run_in_threadpool(diagnoses.report)
        if page is None:
            return JSONResponse({"error": "there is no report yet. Press `Diagnose now`"}, status_code=404)
        return Response(page, media_type="text/html", headers={"Content-Security-Policy": _REPORT_POLICY})

    routes = [
        Route("/", index),
        Route("/api/state", state),
        Route("/api/events", events),
        Route("/api/command", _explained(command), methods=["POST"]),
        Route("/api/diagnosis", _explained(diagnose), methods=["POST"]),
        Route("/api/diagnosis", _explained(stop_diagnosing), methods=["DELETE"]),
        Route("/report", report),
        Mount("/static", StaticFiles(directory=STATIC)),
    ]
    return Starlette(routes=routes, middleware=[Middleware(Guard)])


def _explained(endpoint: Endpoint) -> Endpoint:
    """The endpoint, with errors of ours told as JSON."""

    async def explained(request: Request) -> Response:
        try:
            return await endpoint(request)
        except RequestError as error:
            return JSONResponse({"error": str(error)}, status_code=400)
        except BusError as error:
            return JSONResponse({"error": str(error)}, status_code=503)

    return explained


async def _body(request: Request) -> bytes:
    if request.headers.get("content-type", "").split(";")[0] != _JSON:
        raise RequestError(f"send {_JSON}")
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > LARGEST_BODY:
            raise RequestError(f"send at most {LARGEST_BODY} bytes")
    return body


class _EventStream(StreamingResponse):
    """Server-sent events: each new document under its topic, until the hub is closed or the browser has gone."""

    def __init__(self, hub: Hub, follower: Follower) -> None:
        super().__init__(_events(hub, follower), media_type=_EVENTS)
        self._hub, self._follower = hub, follower

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._hub.leave(self._follower)


async def _events(hub: Hub, follower: Follower) -> AsyncIterator[bytes]:
    yield f"retry: {RETRY_MS}\n\n".encode()
    while True:
        news = await follower.take(HEARTBEAT_S)
        if not news:
            yield b": still here\n\n"
        for topic, document in news.items():
            yield b"event: %s\ndata: %s\n\n" % (topic.encode(), document)
        if hub.closed:
            return
