"""Filter of HTTP requests: they must name this machine, and changes must come from this page.

A web page from elsewhere can make a browser send requests, but it cannot choose the header Origin.
"""

from __future__ import annotations

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from bodyschema.daemon.service.local_web import HEADERS, host_refusal

_READING = ("GET", "HEAD")
_HEADERS = HEADERS | {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
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
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        said = refusal(scope["method"], Headers(scope=scope))
        answer = self._app if said is None else JSONResponse({"error": said}, status_code=403)
        await answer(scope, receive, send_guarded)


def refusal(method: str, headers: Headers) -> str | None:
    """Return the problem of a request, in words; None if it is valid."""
    hosts = headers.getlist("host")
    if (said := host_refusal(hosts)) is not None:
        return said
    origins = headers.getlist("origin")
    if not origins and method in _READING:
        return None
    if origins != [f"http://{hosts[0]}"]:
        return "only this page itself may ask for that: the header Origin is another's, or missing"
    return None
