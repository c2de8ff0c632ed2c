"""HTTP server of the page on loopback."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable

import uvicorn

from bodyschema.daemon.config import Config
from bodyschema.daemon.service.local_web import LOOPBACK
from bodyschema.daemon.service.signals import on_termination
from bodyschema.interfaces.errors import ConfigError

from .app import application
from .diagnosing import Diagnoses
from .hub import Hub
from .shapes import Body
from .watch import ProcessFollower


class _Settings:
    max_connections: int = 100  # at once
    end_limit_s: int = 3  # how long open requests may take to end


class _Server(uvicorn.Server):
    """Server that ends the event streams first: a browser holds them open for ever."""

    def __init__(self, config: uvicorn.Config, hub: Hub) -> None:
        super().__init__(config)
        self._hub = hub

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Close the hub, then shut down."""
        self._hub.close()
        await super().shutdown(sockets)

    def stop(self) -> None:
        """End `serve`. Sets a flag only, so that a signal handler may call it."""
        self.should_exit = True


def serve(config: Config, port: int, ready: Callable[[str], None]) -> None:
    """Serve the page of one robot until SIGTERM or Ctrl-C.

    Args:
        port: port on loopback; 0 for any free one.

    Raises:
        ConfigError: the port cannot be used.
    """
    with listening(port) as listener:
        hub = Hub()
        with (
            Body(config.robot) as body,
            ProcessFollower(config, hub) as watch,
            Diagnoses(
                config.file, config.robot.joints, watch.history, lambda document: hub.put("diagnosis", document)
            ) as diagnoses,
        ):
            settings = uvicorn.Config(
                application(hub, watch, diagnoses, body),
                http="h11",
                ws="none",
                lifespan="off",
                access_log=False,
                log_config=None,
                server_header=False,
                proxy_headers=False,
                limit_concurrency=_Settings.max_connections,
                timeout_graceful_shutdown=_Settings.end_limit_s,
            )
            logging.getLogger("uvicorn").setLevel(logging.WARNING)
            server = _Server(settings, hub)
            with on_termination(server.stop):
                ready(f"http://{LOOPBACK}:{listener.getsockname()[1]}/")
                asyncio.run(server.serve(sockets=[listener]))


def listening(port: int) -> socket.socket:
    """Return a socket on loopback; raise ConfigError if the port cannot be used."""
    try:
        return socket.create_server((LOOPBACK, port))
    except OSError as error:
        remedy = "Give another --port, or --port 0 for one that is free"
        raise ConfigError(f"port {port} cannot be used: {error.strerror}", remedy=remedy) from error
