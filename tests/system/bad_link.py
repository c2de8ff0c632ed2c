"""A TCP connection that is slow, silent or cut, between two processes unaware of it."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from types import TracebackType
from typing import Self

CHUNK = 4096


class BadLink:
    """TCP proxy to `endpoint` with adjustable delay and bandwidth.

    Attributes:
        endpoint: address on which it listens, in zenoh's notation.
        delay_s: delay of each piece of data.
        bytes_per_s: limit of the bandwidth; None for none.
    """

    def __init__(self, to: str) -> None:
        self._to = int(to.rpartition(":")[2])
        self.delay_s, self.bytes_per_s = 0.0, None
        self._passing = asyncio.Event()
        self._passing.set()
        self._connections: set[asyncio.Task[None]] = set()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="link")
        self._server: asyncio.Server | None = None
        self.endpoint = ""

    def __enter__(self) -> Self:
        self._thread.start()
        self._server = asyncio.run_coroutine_threadsafe(self._listen(), self._loop).result()
        self.endpoint = f"tcp/127.0.0.1:{self._server.sockets[0].getsockname()[1]}"
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        asyncio.run_coroutine_threadsafe(self._end(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def part(self) -> None:
        """Pass nothing on until `meet`, without an error, as when a cable is pulled somewhere between."""
        self._loop.call_soon_threadsafe(self._passing.clear)

    def meet(self) -> None:
        """Pass on what came, and what comes."""
        self._loop.call_soon_threadsafe(self._passing.set)

    def cut(self) -> None:
        """End the connections that there are; new ones are taken."""
        self._loop.call_soon_threadsafe(self._cut)

    def _cut(self) -> None:
        for connection in self._connections:
            connection.cancel()

    async def _listen(self) -> asyncio.Server:
        return await asyncio.start_server(self._connected, "127.0.0.1", 0)

    async def _end(self) -> None:
        assert self._server is not None
        self._server.close()
        self._cut()
        await asyncio.gather(*self._connections, return_exceptions=True)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._connections.add(task)
        with contextlib.suppress(OSError, asyncio.CancelledError):
            await self._passing.wait()
            there, onward = await asyncio.open_connection("127.0.0.1", self._to)
            try:
                async with asyncio.TaskGroup() as both:
                    both.create_task(self._pass(reader, onward))
                    both.create_task(self._pass(there, writer))
            except* (OSError, EOFError):
                pass
            finally:
                onward.close()
        writer.close()
        self._connections.discard(task)

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        due: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(1024)
        sending = asyncio.create_task(self._send(due, writer))
        try:
            while piece := await reader.read(CHUNK):
                await due.put((self._loop.time() + self.delay_s, piece))
            raise EOFError
        finally:
            sending.cancel()

    async def _send(self, due: asyncio.Queue[tuple[float, bytes]], writer: asyncio.StreamWriter) -> None:
        while True:
            at, piece = await due.get()
            await asyncio.sleep(max(at - self._loop.time(), 0.0))
            if self.bytes_per_s is not None:
                await asyncio.sleep(len(piece) / self.bytes_per_s)
            await self._passing.wait()
            writer.write(piece)
            await writer.drain()
