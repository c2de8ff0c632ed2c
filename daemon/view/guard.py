"""Who may ask for what: requests to this machine by name, changes from this page alone.

A web page from elsewhere can make a browser ask a server on loopback. It cannot choose the header Host (but by DNS
rebinding, which shows there) nor Origin.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

_LOOPBACK = re.compile(r"(localhost|127\.0\.0\.1|\[::1\])(:[0-9]{1,5})?", re.IGNORECASE)
_READING = ("GET", "HEAD")
_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


class Guard:
    """ASGI middleware that refuses what this page would not ask, and adds headers that bind the page to itself."""

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
    """What is wrong with a request, for a person; None when nothing is."""
    host = _only(headers.getlist("host"))
    if host is None or not _LOOPBACK.fullmatch(host):
        return f"this page is for {'nobody' if host is None else host!r}: ask 127.0.0.1 or localhost (docs/view.md)"
    origins = headers.getlist("origin")
    if not origins and method in _READING:
        return None
    if _only(origins) != f"http://{host}":
        return "only this page itself may ask for that: the header Origin is another's, or missing"
    return None


def _only(values: Iterable[str]) -> str | None:
    found = list(values)
    return found[0] if len(found) == 1 else None
