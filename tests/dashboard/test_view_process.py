"""The page as a process beside the working ones."""

from __future__ import annotations

import http.client
import socket
import time
from pathlib import Path

import pytest
from small_arm import write_small_arm

from bodyschema.cli.commands.run.view import shown
from bodyschema.cli.main import app
from bodyschema.interfaces import extras
from bodyschema.interfaces.errors import ConfigError

pytest.importorskip("uvicorn")
LIMIT_S = 500.0


@pytest.fixture
def robot(tmp_path: Path, free_endpoint) -> Path:
    tables = f'[zenoh]\nsampler = "{free_endpoint()}"\nlearner = "{free_endpoint()}"\n'
    return write_small_arm(tmp_path, tables)


def page(port: int) -> str | None:
    """Return the page; None while the server does not answer."""
    connection = http.client.HTTPConnection("127.0.0.1", port)
    try:
        connection.request("GET", "/")
        return connection.getresponse().read().decode()
    except OSError:
        return None
    finally:
        connection.close()


def test_page_lives_as_long_as_its_process(robot: Path, endpoint: str) -> None:
    port, deadline = int(endpoint.rpartition(":")[2]), time.monotonic() + LIMIT_S
    with shown(robot, port):
        while (found := page(port)) is None:
            assert time.monotonic() < deadline
            time.sleep(0.05)
    assert "<title>bodyschema</title>" in found
    assert page(port) is None


@pytest.mark.soak
def test_taken_port_does_not_disturb_shown_process(robot: Path, caplog) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken, shown(robot, taken.getsockname()[1]) as process:
        process.wait(LIMIT_S)
    assert "the page had ended with exit code 1" in caplog.text


@pytest.mark.parametrize("command", [["view"], ["run", "learner", "--view"], ["run", "--view"]])
def test_without_the_extra_the_error_names_it(robot: Path, command: list[str], monkeypatch) -> None:
    monkeypatch.setitem(extras.MODULES, "view", ("no_such_library",))
    with pytest.raises(ConfigError, match=r"bodyschema\[view\]"):
        app([*command, "--robot", str(robot)], result_action="return_value")
