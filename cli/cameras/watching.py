"""Watch cameras: encode each picture and pass it on."""

from __future__ import annotations

import itertools
import logging
import math
import threading
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Protocol, Self

from bodyschema.daemon.service.local_web import HEADERS, LOOPBACK, host_refusal
from bodyschema.interfaces.errors import ConfigError, SourceEnded
from bodyschema.interfaces.protocols import Source
from bodyschema.interfaces.records import ImageArray
from bodyschema.interfaces.whole_files import raising_write_errors
from bodyschema.vision.image_file import jpeg


class Pictures(Source, Protocol):
    """Pictures of cameras; see `bodyschema.vision.cameras.watched.WatchedCamera`."""

    def read(self, timeout_s: float) -> ImageArray | None: ...


class Watching:
    """Reader of pictures until a stop is requested, there are no more, or enough were shown."""

    def __init__(
        self, pictures: Pictures, show: Callable[[bytes], None], *, every_s: float = 0.0, count: int | None = None
    ) -> None:
        """Store the settings; the caller of `step` opens `pictures`."""
        self._pictures, self._show, self._every_s = pictures, show, every_s
        self._left = math.inf if count is None else count
        self._next_s = -math.inf
        self._stopping = False

    @classmethod
    def into(cls, folder: Path, pictures: Pictures, *, every_s: float, count: int | None) -> Self:
        """Write pictures into files 000001.jpg and so on; raise ConfigError if the folder cannot be created."""
        with raising_write_errors(folder, what="made", remedy="Give another --out"):
            folder.mkdir(parents=True, exist_ok=True)
        numbers = itertools.count(1)
        return cls(
            pictures, lambda jpeg: _write(folder / f"{next(numbers):06}.jpg", jpeg), every_s=every_s, count=count
        )

    def stop(self) -> None:
        """Request that `step` ends. Only sets a flag."""
        self._stopping = True

    def step(self, timeout_s: float) -> bool:
        """Show the next picture, if one arrives in time; return False if there will be no more."""
        if self._stopping or self._left <= 0:
            return False
        try:
            picture = self._pictures.read(timeout_s)
        except SourceEnded:
            return False
        now = time.monotonic()
        if picture is not None and now >= self._next_s:
            self._next_s = now + self._every_s
            self._left -= 1
            self._show(jpeg(picture))
        return True


def _write(file: Path, data: bytes) -> None:
    with raising_write_errors(file, remedy="Give another --out"):
        file.write_bytes(data)


log = logging.getLogger(__name__)

BOUNDARY = "picture"


class _Settings:
    max_viewers: int = 32  # each browser that shows the pictures has its own thread here
    end_check_s: float = 0.05  # how often the server looks for its end


PAGE = b"<!doctype html><title>bodyschema</title><body style='margin:0;background:#111'><img src=/stream width=100%>"
POLICY = "default-src 'none'; img-src 'self'; style-src 'unsafe-inline'; frame-ancestors 'none'"


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:  # noqa: ARG002
        """Log why a request failed; a closed browser causes no traceback on the terminal."""
        log.debug("a request for pictures failed", exc_info=True)


class MjpegServer:
    """Server of the newest picture to its viewers. A slow viewer misses pictures and delays no other."""

    def __init__(self, port: int) -> None:
        """Prepare without listening yet; port 0 selects a free one."""
        self._port = port
        self._newest: bytes | None = None
        self._number = 0
        self._changed = threading.Condition()
        self._is_closing = False
        self._viewers = threading.BoundedSemaphore(_Settings.max_viewers)
        self._server: _Server | None = None

    def __enter__(self) -> Self:
        try:
            self._server = _Server((LOOPBACK, self._port), self._handler())
        except OSError as error:
            remedy = "Give another --port, or --port 0 for one that is free"
            raise ConfigError(f"port {self._port} cannot be used: {error.strerror}", remedy=remedy) from error
        serve = self._server.serve_forever
        threading.Thread(target=serve, args=(_Settings.end_check_s,), name="pictures", daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._is_closing = True
            self._changed.notify_all()
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()
            self._server = None

    @property
    def address(self) -> str:
        """Address to open in the browser."""
        port = self._port if self._server is None else self._server.server_address[1]
        return f"http://{LOOPBACK}:{port}/"

    def show(self, jpeg: bytes) -> None:
        """Publish the newest picture."""
        with self._changed:
            self._newest, self._number = jpeg, self._number + 1
            self._changed.notify_all()

    def _after(self, number: int) -> tuple[int, bytes] | None:
        """Return a picture newer than `number`, and its number; None when the server ends."""
        with self._changed:
            self._changed.wait_for(lambda: self._is_closing or self._number > number)
            if self._is_closing or self._newest is None:
                return None
            return self._number, self._newest

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        server = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                refusal = host_refusal(self.headers.get_all("Host", []))
                if refusal is not None:
                    self._say(403, refusal)
                elif self.path == "/":
                    self._send(200, "text/html; charset=utf-8", PAGE)
                elif self.path != "/stream":
                    self._say(404, "there is nothing here. The pictures are at /")
                elif not server._viewers.acquire(blocking=False):
                    self._say(503, f"{_Settings.max_viewers} browsers look on already. Close one")
                else:
                    try:
                        self._stream()
                    finally:
                        server._viewers.release()

            def log_message(self, format: str, *args: object) -> None:
                """Log nothing: there is a request for each browser."""

            def end_headers(self) -> None:
                for name, value in (HEADERS | {"Content-Security-Policy": POLICY}).items():
                    self.send_header(name, value)
                super().end_headers()

            def _say(self, status: int, text: str) -> None:
                self._send(status, "text/plain; charset=utf-8", f"{text}\n".encode())

            def _send(self, status: int, kind: str, body: bytes) -> None:
                self.send_response(status)
                self.send_header("Content-Type", kind)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def _stream(self) -> None:
                self.send_response(200)
                self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={BOUNDARY}")
                self.end_headers()
                number = 0
                try:
                    while (found := server._after(number)) is not None:
                        number, jpeg = found
                        head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                        self.wfile.write(head.encode() + jpeg + b"\r\n")
                except OSError:
                    return  # the browser has gone

        return Handler
