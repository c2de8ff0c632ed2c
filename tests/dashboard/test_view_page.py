"""The page's addresses, without a browser: answers and refusals."""

from __future__ import annotations

import asyncio
import re
import threading
from dataclasses import dataclass, field
from typing import Any

import pytest

httpx = pytest.importorskip("httpx")
pytest.importorskip("starlette")

from bodyschema.dashboard.app import STATIC, AppSettings, application  # noqa: E402
from bodyschema.dashboard.documents import BodyDocument  # noqa: E402
from bodyschema.dashboard.hub import MOST_FOLLOWERS, Hub  # noqa: E402
from bodyschema.interfaces.errors import BusError, RequestError  # noqa: E402

HERE = "http://127.0.0.1:8420"
PAUSE = {"process": "sampler", "command": "pause"}
ADDRESSES = ["/", "/api/state", "/api/events", "/api/picture", "/report", "/static/style.css", "/static/js/main.js"]
ADDRESSES += ["/api/body", "/api/body/0"]
LIMIT_S = 300.0


@dataclass
class Processes:
    """Stub of both processes and the diagnoses that records its commands."""

    told: list[tuple[str, ...]] = field(default_factory=list)
    error: Exception | None = None
    page: bytes | None = None
    jpeg: bytes | None = None

    def picture(self) -> bytes:
        if self.jpeg is None:
            raise BusError("nothing answers")
        return self.jpeg

    def document(self) -> BodyDocument:
        return BodyDocument(["base"], [[]], [], [], None, ["Missing meshes: <b>a</b>."])

    def mesh(self, number: int) -> bytes | None:
        return b"mesh" if number == 0 else None

    def command(self, process: str, name: str) -> str:
        self._note(process, name)
        return "no samples are accepted until resume"

    def start(self) -> int:
        self._note("start")
        return 3

    def stop(self) -> None:
        self._note("stop")

    def report(self) -> bytes | None:
        return self.page

    def _note(self, *words: str) -> None:
        if self.error is not None:
            raise self.error
        self.told.append(words)


@pytest.fixture
def processes() -> Processes:
    return Processes()


@pytest.fixture
def hub() -> Hub:
    hub = Hub()
    hub.put("robot", {"robot": "arm"})
    return hub


@pytest.fixture
def ask(hub: Hub, processes: Processes):
    def asked(method: str, address: str, headers: dict[str, str] | None = None, **more: Any):
        async def once():
            transport = httpx.ASGITransport(app=application(hub, processes, processes, processes))
            async with httpx.AsyncClient(transport=transport, base_url=HERE) as client:
                own = {"Origin": HERE} if method not in ("GET", "HEAD") else {}
                return await client.request(method, address, headers=own | (headers or {}), **more)

        return asyncio.run(once())

    return asked


def test_button_command_reaches_process_and_returns_answer(ask, processes) -> None:
    answer = ask("POST", "/api/command", json=PAUSE)
    assert (answer.status_code, answer.json()["message"]) == (200, "no samples are accepted until resume")
    assert processes.told == [("sampler", "pause")]


def test_a_change_is_rolled_back_by_a_button(ask, processes) -> None:
    assert ask("POST", "/api/command", json={"process": "learner", "command": "rollback"}).status_code == 200
    assert processes.told == [("learner", "rollback")]


def test_available_camera_picture_is_served(ask, processes) -> None:
    assert ask("GET", "/api/picture").status_code == 204
    processes.jpeg = b"jpeg"
    answer = ask("GET", "/api/picture")
    assert (answer.content, answer.headers["content-type"]) == (b"jpeg", "image/jpeg")


def test_the_robot_s_shapes_are_served_by_number(ask) -> None:
    assert ask("GET", "/api/body").json()["said"] == ["Missing meshes: <b>a</b>."]
    answer = ask("GET", "/api/body/0")
    assert (answer.content, answer.headers["content-type"]) == (b"mesh", "application/octet-stream")
    others = ("1", "-1", "99999999999999999999", "9" * 5000, "\u0663", "a.stl", "..%2f..%2fetc%2fpasswd")
    for other in (*others, "%2fetc%2fpasswd", ""):
        assert ask("GET", f"/api/body/{other}").status_code == 404, other


class SlowShapes(Processes):
    """Stub whose shapes are being read until `read` is set."""

    def __init__(self) -> None:
        super().__init__()
        self.read = threading.Event()

    def document(self) -> BodyDocument:
        assert self.read.wait(LIMIT_S)
        return super().document()

    def mesh(self, number: int) -> bytes | None:
        assert self.read.wait(LIMIT_S)
        return super().mesh(number)


def test_waiting_for_shapes_blocks_no_other_request(hub, processes) -> None:
    shapes = SlowShapes()

    async def asked() -> tuple[list[int], list[int]]:
        transport = httpx.ASGITransport(app=application(hub, processes, processes, shapes))
        async with httpx.AsyncClient(transport=transport, base_url=HERE, headers={"Origin": HERE}) as client:
            waiting = [asyncio.create_task(client.get(f"/api/body{each}")) for each in 30 * ["", "/0"]]
            try:
                async with asyncio.timeout(LIMIT_S):
                    others = [await client.get("/static/style.css"), await client.post("/api/command", json=PAUSE)]
            finally:
                shapes.read.set()
                late = await asyncio.gather(*waiting)
        return [each.status_code for each in others], [each.status_code for each in late]

    assert asyncio.run(asked()) == ([200, 200], 60 * [200])


def test_the_page_is_packed_on_its_way(ask) -> None:
    plain, packed = (
        ask("GET", "/static/vendor/three.core.min.js", {"Accept-Encoding": way}) for way in ("identity", "gzip")
    )
    assert packed.content == plain.content
    assert int(packed.headers.get("content-length", 0)) < len(plain.content) / 3
    again = ask("GET", "/static/style.css", {"If-None-Match": ask("GET", "/static/style.css").headers["etag"]})
    assert (again.status_code, again.headers["cache-control"]) == (304, "no-cache")


@pytest.mark.parametrize("address", ADDRESSES)
@pytest.mark.parametrize("host", ["evil.example", "evil.example:8420", "127.0.0.1.evil.example", "localhost@evil", ""])
def test_who_asks_for_another_host_is_refused_everywhere(ask, address: str, host: str) -> None:
    """Check the case of DNS rebinding, when another site's name resolves to this server."""
    assert ask("GET", address, {"Host": host}).status_code == 403


@pytest.mark.parametrize("host", ["127.0.0.1:8420", "localhost:9000", "LOCALHOST", "[::1]:8420"])
def test_local_host_names_are_accepted_on_any_port(ask, host: str) -> None:
    assert ask("GET", "/", {"Host": host}).status_code == 200


@pytest.mark.parametrize(
    ("method", "address"), [("POST", "/api/command"), ("POST", "/api/diagnosis"), ("DELETE", "/api/diagnosis")]
)
@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "null", "https://127.0.0.1:8420", "http://127.0.0.1:9999", "http://localhost:8420"],
)
def test_another_page_s_button_does_nothing(ask, processes, method: str, address: str, origin: str) -> None:
    assert ask(method, address, {"Origin": origin}, json=PAUSE).status_code == 403
    assert processes.told == []


def test_a_command_without_an_origin_does_nothing(hub, processes) -> None:
    async def post() -> int:
        transport = httpx.ASGITransport(app=application(hub, processes, processes, processes))
        async with httpx.AsyncClient(transport=transport, base_url=HERE) as client:
            return (await client.post("/api/command", json=PAUSE)).status_code

    assert asyncio.run(post()) == 403
    assert processes.told == []


@pytest.mark.parametrize("address", ADDRESSES)
def test_another_page_may_not_read_here_either(ask, address: str) -> None:
    assert ask("GET", address, {"Origin": "http://evil.example"}).status_code == 403


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"pause",
        b'{"process": "learner", "command": "reset_to_prior"}',
        b'{"process": "sampler", "command": "zero_force_off"}',
        b'{"process": "camera", "command": "pause"}',
        b'{"process": "sampler", "command": "pause", "also": 1}',
        b'{"process": "sampler", "command": "pause"}' + b" " * AppSettings.largest_body,
    ],
)
def test_unknown_command_is_refused_without_effect(ask, processes, body: bytes) -> None:
    answer = ask("POST", "/api/command", {"Content-Type": "application/json"}, content=body)
    assert answer.status_code == 400
    assert answer.json()["error"]
    assert processes.told == []


def test_a_form_s_encoding_is_refused(ask, processes) -> None:
    """A page from elsewhere can send forms without asking first."""
    answer = ask("POST", "/api/command", {"Content-Type": "text/plain"}, content=b'{"process":"sampler"}')
    assert (answer.status_code, processes.told) == (400, [])


@pytest.mark.parametrize(("error", "code"), [(BusError("nobody answers"), 503), (RequestError("not now"), 400)])
def test_refusal_of_process_is_reported(ask, processes, error: Exception, code: int) -> None:
    processes.error = error
    answer = ask("POST", "/api/command", json=PAUSE)
    assert (answer.status_code, answer.json()) == (code, {"error": str(error)})


def test_a_diagnosis_is_begun_and_stopped(ask, processes) -> None:
    assert ask("POST", "/api/diagnosis").json() == {"number": 3}
    assert ask("DELETE", "/api/diagnosis").status_code == 204
    assert processes.told == [("start",), ("stop",)]


def test_a_second_diagnosis_is_told_to_wait(ask, processes) -> None:
    processes.error = RequestError("a diagnosis is running")
    assert ask("POST", "/api/diagnosis").json() == {"error": "a diagnosis is running"}


def test_a_report_is_served_without_any_script(ask, processes) -> None:
    processes.page = b"<!doctype html><title>report</title>"
    answer = ask("GET", "/report")
    assert answer.content == processes.page
    policy = answer.headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "script-src" not in policy
    assert "sandbox" in policy


def test_before_any_diagnosis_there_is_no_report(ask) -> None:
    assert ask("GET", "/report").status_code == 404


def test_path_outside_folder_is_not_found(ask) -> None:
    for path in ("/static/../app.py", "/static/%2e%2e/app.py", "/static/js/..%2f..%2f..%2fapp.py"):
        assert ask("GET", path).status_code == 404


def test_the_page_may_load_from_here_alone(ask) -> None:
    policy = ask("GET", "/").headers["Content-Security-Policy"]
    assert policy.startswith("default-src 'none'; script-src 'self'")
    assert "unsafe" not in policy
    assert "blob:" not in policy
    assert "frame-ancestors 'none'" in policy


def test_a_browser_gets_every_document_at_first(ask, hub) -> None:
    hub.put("sampler", {"answers": False})
    hub.close()
    answer = ask("GET", "/api/events")
    assert answer.headers["content-type"].startswith("text/event-stream")
    assert 'event: robot\ndata: {"robot":"arm"}\n\n' in answer.text
    assert 'event: sampler\ndata: {"answers":false}\n\n' in answer.text


def test_all_documents_are_one_object_for_programs(ask, hub) -> None:
    hub.put("outlook", None)
    assert ask("GET", "/api/state").json() == {"robot": {"robot": "arm"}, "outlook": None}


async def opened_streams(hub: Hub, count: int) -> list[int]:
    """Return the status codes of `count` event streams requested at the same time and kept open for a while."""
    app, codes, enough = application(hub, Processes(), Processes(), Processes()), [], asyncio.Event()

    async def send(message: dict[str, Any]) -> None:
        if message["type"] == "http.response.start":
            codes.append(message["status"])
            if len(codes) == count:
                enough.set()

    async def receive() -> dict[str, str]:
        await enough.wait()
        return {"type": "http.disconnect"}

    scope = {"type": "http", "method": "GET", "path": "/api/events", "headers": [(b"host", b"localhost")]}
    async with asyncio.timeout(60.0), asyncio.TaskGroup() as tasks:
        for _ in range(count):
            tasks.create_task(app(scope | {"query_string": b""}, receive, send))  # pyright: ignore[reportArgumentType]
    return sorted(codes)


def test_too_many_pages_at_once_are_refused(hub) -> None:
    assert asyncio.run(opened_streams(hub, MOST_FOLLOWERS + 3)) == [200] * MOST_FOLLOWERS + [503] * 3


def test_pages_that_closed_make_room_again(hub) -> None:
    for _ in range(2):
        assert asyncio.run(opened_streams(hub, MOST_FOLLOWERS)) == [200] * MOST_FOLLOWERS


def test_a_head_request_takes_no_page_s_place(ask, hub) -> None:
    for _ in range(MOST_FOLLOWERS + 1):
        assert ask("HEAD", "/api/events").status_code == 200


def test_slow_browser_gets_only_newest_documents(hub) -> None:
    async def follow() -> dict[str, bytes]:
        follower = hub.follow()
        for number in range(100):
            hub.put("series", number)
        return await follower.take(10.0)

    assert asyncio.run(follow()) == {"robot": b'{"robot":"arm"}', "series": b"99"}


def test_what_did_not_change_is_not_sent_again(hub) -> None:
    async def follow() -> dict[str, bytes]:
        follower = hub.follow()
        await follower.take(10.0)
        hub.put("robot", {"robot": "arm"})
        return await follower.take(0.01)

    assert asyncio.run(follow()) == {}


PAGE = (STATIC / "index.html").read_text(encoding="utf-8")
KINDS = (".html", ".css", ".js")
OURS = sorted(file for file in STATIC.rglob("*") if file.suffix in KINDS and "vendor" not in file.parts)


def test_page_has_every_element_scripts_need() -> None:
    asked = {
        name
        for file in OURS
        for name in re.findall(r'(?:byId|text|Chart)\("([a-z-]+)"', file.read_text(encoding="utf-8"))
    }
    assert asked - set(re.findall(r'id="([a-z-]+)"', PAGE)) == set()
    assert len(asked) > 30


@pytest.mark.parametrize("file", OURS, ids=lambda file: file.name)
def test_nothing_is_loaded_from_a_network(file) -> None:
    found = re.findall(r"""["'(]((?:https?:)?//[^"')]*)""", file.read_text(encoding="utf-8"))
    assert [address for address in found if address != "http://www.w3.org/2000/svg"] == []


def test_text_from_outside_is_never_taken_for_html() -> None:
    for file in OURS:
        assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\b", file.read_text())


@pytest.mark.parametrize("name", ["uPlot", "three"])
def test_what_is_vendored_comes_with_its_licence(name: str) -> None:
    assert "MIT" in (STATIC / "vendor" / f"{name}.LICENSE").read_text(encoding="utf-8")
    assert list((STATIC / "vendor").glob(f"{name}.*.js"))


def test_what_is_vendored_asks_for_itself_alone() -> None:
    for file in (STATIC / "vendor").glob("three.*.js"):
        text = file.read_text(encoding="utf-8")
        assert set(re.findall(r'from"([^"]*)"', text)) <= {"./three.core.min.js"}
        assert not re.search(r"\beval\(|new Function\(|new Worker\(", text)
