from __future__ import annotations

import select
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from queue import Queue

import pytest

from bodyschema.cli.hardware.doctor import zenoh_check
from bodyschema.daemon.transport.identity import Route
from bodyschema.daemon.transport.session import Request, ZenohSession, client, unreachable
from bodyschema.daemon.transport.wire import JSON, MSGPACK, ErrorReply, decode
from bodyschema.interfaces.errors import BusError, RequestError

LIMIT_S = 500.0
KEY = "bodyschema/arm/status/sampler"


@pytest.fixture
def server(endpoint: str) -> Iterator[ZenohSession]:
    with ZenohSession(listen=endpoint) as bus:
        yield bus


@pytest.fixture
def asking(server: ZenohSession, endpoint: str) -> Iterator[ZenohSession]:
    with client(endpoint) as bus:
        yield bus


def test_query_returns_the_handler_s_result(server, asking) -> None:
    server.answer(KEY, lambda request: b"<" + request.payload + b">")
    assert asking.ask_one(KEY, b"hello") == b"<hello>"


def test_a_handler_sees_parameters_and_encoding(server, asking) -> None:
    seen: list[Request] = []
    server.answer(KEY, lambda request: seen.append(request) or b"")
    asking.ask_one(f"{KEY}?from=1;to=20", encoding=MSGPACK)
    assert seen == [Request({"from": "1", "to": "20"}, b"", MSGPACK)]


def test_json_is_spoken_unless_asked_otherwise(server, asking) -> None:
    seen: list[str] = []
    server.answer(KEY, lambda request: seen.append(request.encoding) or b"")
    asking.ask_one(KEY)
    assert seen == [JSON]


def refuse(_request: Request) -> bytes:
    raise RequestError("q has 3 numbers; this robot has 7 joints")


def break_down(_request: Request) -> bytes:
    raise ZeroDivisionError("a bug")


def test_refused_request_returns_reason_as_error(server, asking) -> None:
    server.answer(KEY, refuse)
    with pytest.raises(RequestError, match="q has 3 numbers; this robot has 7 joints"):
        asking.ask_one(KEY)


def test_error_uses_encoding_of_the_request(server, asking) -> None:
    server.answer(KEY, refuse)
    reply = next(iter(asking._open.get(KEY, encoding=MSGPACK)))
    assert decode(reply.err.payload.to_bytes(), ErrorReply, MSGPACK).error.startswith("q has 3 numbers")


def test_unknown_encoding_is_refused_by_name(server, asking) -> None:
    server.answer(KEY, lambda request: request.payload)
    with pytest.raises(RequestError, match="encoding application/x-msgpack is unknown; known are application/json"):
        asking.ask_one(KEY, encoding="application/x-msgpack")


def test_handler_exception_is_returned_as_error(server, asking) -> None:
    server.answer(KEY, break_down)
    with pytest.raises(RequestError, match="please report it: ZeroDivisionError: a bug"):
        asking.ask_one(KEY)


@pytest.mark.parametrize("quick", [False, True])
def test_a_subscriber_with_a_bug_goes_on_receiving(server, asking, quick: bool) -> None:
    received: Queue[bytes] = Queue()

    def take(payload: bytes) -> None:
        received.put(payload)
        raise ZeroDivisionError("a bug")

    asking.subscribe(KEY, take, quick=quick)
    server.answer("bodyschema/arm/ready", lambda _request: b"")
    publish = server.publisher(KEY)
    asking.ask_one("bodyschema/arm/ready")  # the subscription has arrived before this
    publish(b"1")
    publish(b"2")
    assert [received.get(timeout=LIMIT_S), received.get(timeout=LIMIT_S)] == [b"1", b"2"]


STOPPED = """
import os, signal, sys, time
from bodyschema.daemon.transport.session import ZenohSession
with ZenohSession(connect=sys.argv[1]) as bus:
    bus.subscribe(sys.argv[2], lambda payload: (print("heard", flush=True), os.kill(os.getpid(), signal.SIGSTOP)))
    time.sleep(3600)
"""


FOR_EVER = {"transport/link/tx/queue/congestion_control/block/wait_before_close": 10**12}


def test_a_stopped_subscriber_holds_up_no_publication(endpoint) -> None:
    last, deadline = threading.Event(), time.monotonic() + LIMIT_S
    with (
        ZenohSession(listen=endpoint, settings=FOR_EVER) as bus,
        client(endpoint) as well,
        subprocess.Popen([sys.executable, "-c", STOPPED, endpoint, KEY], stdout=subprocess.PIPE) as stopped,
    ):
        publish = bus.publisher(KEY, cache=1)
        try:
            while not select.select([stopped.stdout], [], [], 0.05)[0]:
                publish(b"first")
            well.subscribe(KEY, lambda payload: last.set() if payload == b"last" else None, quick=True)
            for _ in range(100):
                publish(bytes(100_000))  # more than all buffers on the way hold
            while not last.wait(0.05) and time.monotonic() < deadline:
                publish(b"last")
            assert last.is_set()
            assert stopped.poll() is None
        finally:
            stopped.kill()


def test_unanswered_query_names_process_to_start(asking) -> None:
    with pytest.raises(BusError, match=r"Is the sampler running\? Start it with `bodyschema run sampler`"):
        asking.ask_one(KEY)


@pytest.mark.parametrize("address", ["127.0.0.1:65536", f"{'a' * 64}.org:7447", "a..org:7447"])
def test_nothing_listens_on_an_impossible_address(address) -> None:
    route = Route((f"tcp/{address}",))
    assert unreachable(route).startswith(f"nothing listens on tcp/{address}")
    assert "is free" in zenoh_check("sampler", route, "x/alive").said


def test_the_learners_keys_name_the_learner(asking) -> None:
    with pytest.raises(BusError, match="Start it with `bodyschema run learner`"):
        asking.ask_one("bodyschema/arm/predict")


def test_late_answer_is_a_request_error(server, asking) -> None:
    done = threading.Event()
    server.answer(KEY, lambda _request: b"" if done.wait(LIMIT_S) else b"late")
    with pytest.raises(RequestError, match="no answer in time"):
        asking.ask_one(KEY, timeout_s=0.1)
    done.set()


def test_client_without_server_reports_nothing_listening(endpoint) -> None:
    with pytest.raises(BusError, match=f"nothing listens on {endpoint}. Start the daemon"), client(endpoint):
        pass


def test_port_in_use_is_reported_with_remedy(server, endpoint) -> None:
    second = ZenohSession(listen=endpoint)
    with pytest.raises(BusError, match=f"the port of {endpoint} is in use.*another endpoint in the table"), second:
        pass


def test_an_endpoint_that_cannot_be_is_named() -> None:
    with pytest.raises(BusError, match=r"cannot open zenoh on carrier/pigeon.*Fix the table \[zenoh\]"):
        ZenohSession(listen="carrier/pigeon").__enter__()


def test_alive_process_is_found(server, asking) -> None:
    server.token("bodyschema/arm/alive/sampler")
    assert asking.alive("bodyschema/arm/alive/sampler", timeout_s=LIMIT_S)
    assert not asking.alive("bodyschema/arm/alive/learner", timeout_s=LIMIT_S)


def test_watcher_is_notified_of_already_alive_process(server, asking) -> None:
    server.token("bodyschema/arm/alive/sampler")
    changes: Queue[bool] = Queue()
    asking.watch("bodyschema/arm/alive/sampler", changes.put)
    assert changes.get(timeout=LIMIT_S)


def test_ended_process_is_no_longer_alive(endpoint) -> None:
    changes: Queue[bool] = Queue()
    with ZenohSession(listen=endpoint) as server:
        server.token("bodyschema/arm/alive/sampler")
        with client(endpoint) as asking:
            asking.watch("bodyschema/arm/alive/sampler", changes.put)
            assert changes.get(timeout=LIMIT_S)
            server.__exit__(None, None, None)
            assert not changes.get(timeout=LIMIT_S)


def test_subscriber_linked_twice_receives_each_message_once(endpoint, free_endpoint) -> None:
    meeting = free_endpoint()
    heard: Queue[bytes] = Queue()
    behind = {"mode": "router"}
    with (
        ZenohSession(listen=meeting, settings=behind),
        ZenohSession(listen=endpoint, connect=meeting, settings=behind) as process,
        ZenohSession(connect=Route((endpoint, meeting))) as onlooker,
    ):
        say = process.publisher("said")
        onlooker.subscribe("said", heard.put)
        while heard.empty() or len(onlooker._session.info.routers_zid()) < 2:
            say(b"first")
        said = [b"%d" % k for k in range(500)]
        for word in said:
            say(word)
        words: list[bytes] = []
        while not words or words[-1] != said[-1]:
            words.append(heard.get(timeout=LIMIT_S))
    assert [word for word in words if word != b"first"] == said


def test_closed_session_raises_not_open(endpoint) -> None:
    with pytest.raises(BusError, match="not open"):
        ZenohSession(listen=endpoint).publisher(KEY)


def test_process_exits_with_handlers_still_declared(endpoint) -> None:
    code = (
        "import sys; from bodyschema.daemon.transport.session import ZenohSession\n"
        "with ZenohSession(listen=sys.argv[1]) as bus:\n"
        "    bus.answer('a/b', lambda r: b''); bus.subscribe('a/c', print); bus.watch('a/d', print)\n"
        "    raise SystemExit(7)"
    )
    done = subprocess.run([sys.executable, "-c", code, endpoint], timeout=LIMIT_S, check=False)
    assert done.returncode == 7
