"""The page's addresses under arbitrary requests: each gets the intended answer at once."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator, MutableMapping
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

pytest.importorskip("starlette")

from bodyschema.dashboard.app import application
from bodyschema.dashboard.documents import BodyDocument
from bodyschema.dashboard.hub import Hub
from bodyschema.interfaces.errors import BusError, RequestError

LIMIT_S = 500.0
HOST = b"127.0.0.1:8420"
PATHS = ["/", "/api/state", "/api/events", "/api/command", "/api/diagnosis", "/report", "/static/style.css", "/static/"]
PATHS += ["/api/body", "/api/body/0"]
MEANT = {200, 206, 304, 400, 403, 404, 405, 416, 503}

paths = st.sampled_from(PATHS) | st.text(max_size=30).map("/{}".format) | st.text(max_size=30).map("/static/{}".format)
paths |= st.text(max_size=30).map("/api/body/{}".format)
methods = st.sampled_from(["GET", "HEAD", "POST", "DELETE", "PUT", "OPTIONS", "PATCH"]) | st.text("ABC", max_size=9)
names = st.sampled_from([b"host", b"origin", b"content-type", b"range", b"if-none-match", b"if-modified-since"])
values = st.sampled_from([HOST, b"http://" + HOST, b"application/json", b"bytes=0-1", b"evil.example"])
headers = st.lists(st.tuples(names | st.binary(max_size=9), values | st.binary(max_size=20)), max_size=5)
own = st.just([(b"host", HOST), (b"origin", b"http://" + HOST), (b"content-type", b"application/json")])
bodies = st.sampled_from([b'{"process": "sampler", "command": "pause"}', b"[" * 5000]) | st.binary(max_size=60)


@pytest.fixture(scope="module", autouse=True)
def short_heartbeat() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("bodyschema.dashboard.app.AppSettings.heartbeat_s", 0.01)
        yield


class Refusing:
    """Processes that do not answer, and diagnoses that may not start."""

    def command(self, *_: str) -> str:
        raise BusError("nobody listens")

    def start(self) -> int:
        raise RequestError("one is running")

    def stop(self) -> None:
        raise RequestError("none is running")

    def report(self) -> bytes | None:
        return None


class NoShapes:
    """A robot without links."""

    def document(self) -> BodyDocument:
        return BodyDocument([], [], [], [], None, [])

    def mesh(self, number: int) -> bytes | None:
        return None


async def status_of(method: str, path: str, asked: list[tuple[bytes, bytes]], body: bytes) -> int:
    hub = Hub()
    hub.close()  # else the stream of events never ends
    said: list[MutableMapping[str, Any]] = []
    left = [{"type": "http.request", "body": body, "more_body": False}]

    async def receive() -> dict[str, Any]:
        if not left:
            await asyncio.sleep(LIMIT_S)  # a browser that stays
        return left.pop()

    async def send(message: MutableMapping[str, Any]) -> None:
        said.append(message)

    scope = {"type": "http", "http_version": "1.1", "method": method, "path": path, "headers": asked}
    scope |= {"raw_path": path.encode(errors="replace"), "query_string": b"", "root_path": "", "scheme": "http"}
    scope |= {"client": ("127.0.0.1", 1), "server": ("127.0.0.1", 8420), "asgi": {"version": "3.0"}}
    await asyncio.wait_for(application(hub, Refusing(), Refusing(), NoShapes())(scope, receive, send), LIMIT_S)
    return said[0]["status"]


@given(method=methods, path=paths, asked=own | headers, more=headers, body=bodies)
@example(method="GET", path="/static/../app.py", asked=[(b"host", HOST)], more=[], body=b"")
@example(method="GET", path="/static/\0", asked=[(b"host", HOST)], more=[], body=b"")
@example(method="GET", path="/static/" + 300 * "a", asked=[(b"host", HOST)], more=[], body=b"")
@example(method="GET", path="/static/style.css", asked=[(b"host", HOST)], more=[(b"range", b"bytes=9-1,-")], body=b"")
def test_no_request_ends_in_an_error_of_ours(method, path, asked, more, body) -> None:
    status = asyncio.run(status_of(method, path, asked + more, body))
    assert status in MEANT
