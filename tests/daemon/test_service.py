"""Notifications to systemd: readiness, watchdog and status."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from bodyschema.daemon.service.notify import Notifier, NotifySettings
from bodyschema.daemon.service.service import Service, _Settings, with_health
from bodyschema.interfaces.clock import SystemClock

WATCHDOG_S = 8.0
LOOPS = ("encoders", "frames")


class HandClock(SystemClock):
    """A clock that is moved by hand."""

    time = 100.0

    def now(self) -> float:
        return self.time


class Heard:
    """A socket that receives systemd's notifications."""

    def __init__(self, address: str) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(address)
        self.socket.setblocking(False)

    def all(self) -> list[str]:
        said: list[str] = []
        while True:
            try:
                said.append(self.socket.recv(4096).decode())
            except BlockingIOError:
                return said


@pytest.fixture
def systemd(tmp_path: Path) -> Iterator[Heard]:
    heard = Heard(str(tmp_path / "notify"))
    yield heard
    heard.socket.close()


@pytest.fixture
def clock() -> HandClock:
    return HandClock()


@pytest.fixture
def service(systemd: Heard, tmp_path: Path, clock: HandClock) -> Service:
    return Service(Notifier(str(tmp_path / "notify"), WATCHDOG_S), LOOPS, clock)


def a_round_of(service: Service, clock: HandClock, *loops: str) -> None:
    clock.time += WATCHDOG_S / _Settings.signs_per_watchdog
    for loop in loops:
        service.beat(loop)


def test_watchdog_is_fed_while_all_loops_run(service, clock, systemd) -> None:
    for _ in range(3):
        a_round_of(service, clock, *LOOPS)
    assert systemd.all() == ["WATCHDOG=1"] * 3


@pytest.mark.parametrize("hanging", LOOPS)
def test_one_loop_that_hangs_starves_the_watchdog(service, clock, systemd, hanging) -> None:
    for _ in range(100):
        a_round_of(service, clock, *(loop for loop in LOOPS if loop != hanging))
    assert systemd.all() == []


def test_frequent_loops_feed_watchdog_only_when_needed(service, clock, systemd) -> None:
    for _ in range(1000):
        clock.time += 0.002
        for loop in LOOPS:
            service.beat(loop)
    assert len(systemd.all()) == 1  # in 2 s of the watchdog's 8


def test_finished_loop_does_not_starve_watchdog(service, clock, systemd) -> None:
    service.remove_loop("encoders")
    a_round_of(service, clock, "frames")
    assert systemd.all() == ["WATCHDOG=1"]


def test_ready_is_notified_once(service, systemd) -> None:
    service.ready()
    service.ready()
    assert systemd.all() == ["READY=1"]


def test_a_start_that_works_is_given_more_time(systemd, tmp_path) -> None:
    notifier = Notifier(str(tmp_path / "notify"))
    for _ in range(100):
        notifier.starting()
    assert systemd.all() == [f"EXTEND_TIMEOUT_USEC={NotifySettings.start_limit_s}000000"]


def test_reload_notifies_start_time_and_ready(service, systemd) -> None:
    service.reload_and_report(lambda: "nothing changed")
    first, last = systemd.all()
    assert first.startswith("RELOADING=1\nMONOTONIC_USEC=")
    assert last == "READY=1"


def test_status_is_one_line_sent_on_change(service, systemd) -> None:
    for line in ("running, 2 samples", "running, 2 samples", "the disk\nis full"):
        service.report_status(line)
    assert systemd.all() == ["STATUS=running, 2 samples", "STATUS=the disk is full"]


def test_status_shows_first_of_several_problems() -> None:
    assert with_health("running", []) == "running"
    assert with_health("running", ["the cameras are lost", "the disk is full"]) == (
        "running. the cameras are lost (and 1 more)"
    )


def test_abstract_socket_is_notified(clock) -> None:
    name = f"bodyschema-test-{os.getpid()}"
    heard = Heard(f"\0{name}")
    Notifier(f"@{name}").ready()
    assert heard.all() == ["READY=1"]
    heard.socket.close()


def test_systemd_variables_are_removed_from_environment(tmp_path) -> None:
    environment = {"NOTIFY_SOCKET": "/run/n", "WATCHDOG_USEC": "20000000", "WATCHDOG_PID": str(os.getpid()), "A": "b"}
    notifier = Notifier.of_environment(environment)
    assert (environment, notifier.watchdog_s, notifier.is_connected) == ({"A": "b"}, 20.0, True)


@pytest.mark.parametrize(
    "environment",
    [
        {},
        {"WATCHDOG_USEC": "20000000"},
        {"NOTIFY_SOCKET": "/run/n", "WATCHDOG_USEC": "20000000", "WATCHDOG_PID": "1"},
        {"NOTIFY_SOCKET": "/run/n", "WATCHDOG_USEC": "soon"},
    ],
)
def test_watchdog_without_socket_or_own_pid_is_ignored(environment) -> None:
    assert Notifier.of_environment(environment).watchdog_s is None


def test_unreachable_systemd_is_logged_once(tmp_path, caplog) -> None:
    notifier = Notifier(str(tmp_path / "gone"))
    notifier.ready()
    notifier.feed_watchdog()
    assert [record.getMessage() for record in caplog.records] == [
        "cannot notify systemd of READY: No such file or directory"
    ]


# --- devices that come back under another number


class Permissions:
    """Stub for systemd's permission to open devices."""

    granted = True

    def __call__(self, device: str) -> bool:
        return self.granted


@pytest.fixture
def plugged(tmp_path: Path) -> Path:
    device = tmp_path / "ttyUSB1"
    device.touch()
    return device


@pytest.fixture
def permissions() -> Permissions:
    return Permissions()


@pytest.fixture
def owner(systemd: Heard, clock: HandClock, plugged: Path, permissions: Permissions) -> Service:
    notifier = Notifier(systemd.socket.getsockname())
    return Service(notifier, LOOPS, clock, devices=[str(plugged)], may_open=permissions)


def test_openable_device_is_not_forbidden(owner) -> None:
    assert owner.forbidden() is None


def test_persistently_unopenable_device_is_forbidden(owner, clock, permissions, plugged) -> None:
    permissions.granted = False
    assert owner.forbidden() is None  # its group may come yet
    clock.time += _Settings.settled_s
    assert owner.forbidden() == str(plugged)


def test_device_permitted_late_is_not_forbidden(owner, clock, permissions) -> None:
    permissions.granted = False
    owner.forbidden()
    clock.time += _Settings.settled_s
    permissions.granted = True
    assert owner.forbidden() is None
    permissions.granted = False
    assert owner.forbidden() is None


def test_absent_device_is_not_forbidden(owner, clock, permissions, plugged) -> None:
    plugged.unlink()
    permissions.granted = False
    owner.forbidden()
    clock.time += 1000.0
    assert owner.forbidden() is None


def test_outside_of_systemd_nothing_is_forbidden(clock, plugged, permissions) -> None:
    permissions.granted = False
    process = Service(Notifier(), LOOPS, clock, devices=[str(plugged)], may_open=permissions)
    process.forbidden()
    clock.time += 1000.0
    assert process.forbidden() is None
