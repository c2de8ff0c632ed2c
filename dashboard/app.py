"""HTTP routes of the page."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import msgspec
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware import Middleware
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from bodyschema.daemon.service.local_web import HEADERS, host_refusal
from bodyschema.daemon.transport.wire import CommandReply, decode, encode
from bodyschema.dashboard.documents import Process
from bodyschema.dashboard.hub import Follower, Hub, HubFullError
from bodyschema.interfaces.errors import BusError, RequestError

if TYPE_CHECKING:
    from bodyschema.dashboard.diagnosing import Diagnoses
    from bodyschema.dashboard.shapes import Body
    from bodyschema.dashboard.watch import ProcessFollower

_READING = ("GET", "HEAD")
_HEADERS = HEADERS | {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
}


class Guard:
    """ASGI middleware that refuses requests that are not from this page, and adds headers that isolate the page."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                if scope["path"].startswith("/static/"):
                    headers.setdefault("Cache-Control", "no-cache")  # a browser keeps them, but checks each time
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        said = refusal(scope["method"], Headers(scope=scope))
        answer = self._app if said is None else JSONResponse({"error": said}, status_code=403)
        await answer(scope, receive, send_guarded)


def refusal(method: str, headers: Headers) -> str | None:
    """Return the reason to refuse a request; None if it is valid."""
    hosts = headers.getlist("host")
    if (said := host_refusal(hosts)) is not None:
        return said
    origins = headers.getlist("origin")
    if not origins and method in _READING:
        return None
    if origins != [f"http://{hosts[0]}"]:
        return "only this page itself may ask for that: the header Origin is another's, or missing"
    return None


STATIC = Path(__file__).parent / "static"


class AppSettings:
    largest_body: int = 4096  # bytes of a request
    # Interval of keep-alive comments to an idle browser, so that proxies do not close the connection.
    heartbeat_s: float = 10.0
    retry_ms: int = 1000  # delay after which a browser reconnects
    gzip_level: int = 5  # over a tunnel the page takes a quarter; higher levels take thrice the time for 3 % less
    # Requests for shapes that take a thread at once: reading meshes takes minutes, and the others need threads too.
    max_for_shapes: int = 2
    max_digits: int = 9  # of a mesh's number


_JSON, _EVENTS, _BYTES = "application/json", "text/event-stream", "application/octet-stream"
# The report is one file with its own style, and no script.
_REPORT_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors 'none'; sandbox"

Endpoint = Callable[[Request], Awaitable[Response]]


class PageCommand(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Command of a button of the page; reset and torque are not available."""

    process: Process
    command: Literal["pause", "resume", "tool_changed", "rollback"]


class _Endpoints:
    """Endpoints of the page's routes."""

    def __init__(self, hub: Hub, processes: ProcessFollower, diagnoses: Diagnoses, shapes: Body) -> None:
        self._hub, self._processes, self._diagnoses, self._shapes = hub, processes, diagnoses, shapes
        self._for_shapes = asyncio.Semaphore(AppSettings.max_for_shapes)

    async def index(self, _: Request) -> Response:
        return FileResponse(STATIC / "index.html")

    async def state(self, _: Request) -> Response:
        return Response(self._hub.all(), media_type=_JSON)

    async def events(self, request: Request) -> Response:
        if request.method == "HEAD":  # otherwise the answer would never end
            return Response(media_type=_EVENTS)
        try:
            return _EventStream(self._hub, self._hub.follow())
        except HubFullError as error:
            return JSONResponse({"error": str(error)}, status_code=503)

    async def command(self, request: Request) -> Response:
        asked = decode(await _body(request), PageCommand)
        message = await run_in_threadpool(self._processes.command, asked.process, asked.command)
        return Response(encode(CommandReply(asked.command, message)), media_type=_JSON)

    async def picture(self, _: Request) -> Response:
        try:
            return Response(await run_in_threadpool(self._processes.picture), media_type="image/jpeg")
        except (BusError, RequestError):  # the page hides its panel
            return Response(status_code=204)

    async def body(self, _: Request) -> Response:
        async with self._for_shapes:
            document = await run_in_threadpool(self._shapes.document)
        return Response(encode(document), media_type=_JSON)

    async def mesh(self, request: Request) -> Response:
        number = request.path_params["number"]
        if not (number.isascii() and number.isdigit() and len(number) <= AppSettings.max_digits):
            return Response(status_code=404)
        async with self._for_shapes:
            found = await run_in_threadpool(self._shapes.mesh, int(number))
        return Response(found or b"", status_code=404 if found is None else 200, media_type=_BYTES)

    async def diagnose(self, _: Request) -> Response:
        return JSONResponse({"number": await run_in_threadpool(self._diagnoses.start)}, status_code=202)

    async def stop_diagnosing(self, _: Request) -> Response:
        await run_in_threadpool(self._diagnoses.stop)
        return Response(status_code=204)

    async def report(self, _: Request) -> Response:
        page = await run_in_threadpool(self._diagnoses.report)
        if page is None:
            return JSONResponse({"error": "there is no report yet. Press `Diagnose now`"}, status_code=404)
        return Response(page, media_type="text/html", headers={"Content-Security-Policy": _REPORT_POLICY})


def application(hub: Hub, processes: ProcessFollower, diagnoses: Diagnoses, shapes: Body) -> Starlette:
    """Return the page's application on the documents of `hub`."""
    page = _Endpoints(hub, processes, diagnoses, shapes)
    routes = [
        Route("/", page.index),
        Route("/api/state", page.state),
        Route("/api/events", page.events),
        Route("/api/command", _explained(page.command), methods=["POST"]),
        Route("/api/picture", page.picture),
        Route("/api/body", page.body),
        Route("/api/body/{number}", page.mesh),
        Route("/api/diagnosis", _explained(page.diagnose), methods=["POST"]),
        Route("/api/diagnosis", _explained(page.stop_diagnosing), methods=["DELETE"]),
        Route("/report", page.report),
        Mount("/static", StaticFiles(directory=STATIC)),
    ]
    packed = Middleware(GZipMiddleware, compresslevel=AppSettings.gzip_level)
    app = Starlette(routes=routes, middleware=[Middleware(Guard), packed])
    app.router.redirect_slashes = False
    return app


def _explained(endpoint: Endpoint) -> Endpoint:
    """Return the endpoint with our errors reported as JSON."""

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
        if len(body) > AppSettings.largest_body:
            raise RequestError(f"send at most {AppSettings.largest_body} bytes")
    return body


class _EventStream(StreamingResponse):
    """Server-sent events: each new document under its topic, until the hub closes or the browser disconnects."""

    def __init__(self, hub: Hub, follower: Follower) -> None:
        super().__init__(_events(hub, follower), media_type=_EVENTS)
        self._hub, self._follower = hub, follower

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._hub.unfollow(self._follower)


async def _events(hub: Hub, follower: Follower) -> AsyncIterator[bytes]:
    yield f"retry: {AppSettings.retry_ms}\n\n".encode()
    while True:
        news = await follower.take(AppSettings.heartbeat_s)
        if not news:
            yield b": still here\n\n"
        for topic, document in news.items():
            yield b"event: %s\ndata: %s\n\n" % (topic.encode(), document)
        if hub.closed:
            return
