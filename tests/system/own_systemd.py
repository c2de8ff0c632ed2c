"""A systemd as PID 1 of its own namespaces: it starts units as on a machine, and changes nothing outside."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

BOOT = Path(__file__).with_name("boot_machine.sh")
SYSTEMD, UNITS = Path("/lib/systemd/systemd"), Path("/lib/systemd/system")
FOLDER = Path("/etc/systemd/system")
# Targets of a boot, without anything that touches devices, clocks or file systems.
TARGETS = ("basic", "local-fs", "multi-user", "network", "network-online", "paths", "shutdown", "slices", "sockets")
JOURNAL = ("systemd-journald.service", "systemd-journald.socket", "systemd-journald-dev-log.socket")
COPIED = (*(f"{target}.target" for target in (*TARGETS, "swap", "sysinit", "timers")), *JOURNAL)
# The router's address appears as late as on a machine with a slow network.
SLOW_NETWORK = """[Unit]
Before=network-online.target
[Service]
Type=oneshot
RemainAfterExit=yes
ExecStart=/bin/sleep 3
ExecStart=/bin/sh -c 'ip address add 192.0.2.10/24 dev lo'
"""
MACHINE = f"[Unit]\nWants={' '.join(JOURNAL)}\nRequires=multi-user.target\nAfter=multi-user.target\nAllowIsolate=yes\n"
# Nothing runs but the journal, as before a boot.
QUIET = f"[Unit]\nWants={' '.join(JOURNAL)}\nAllowIsolate=yes\n"
NAMESPACES = ("--mount", "--pid", "--cgroup", "--uts", "--ipc", "--net")
LIMIT_S = 300.0  # only ends a test that would never end


def unified() -> Path | None:
    """Return the folder of the cgroup2 hierarchy."""
    mounts = (line.split() for line in Path("/proc/mounts").read_text().splitlines())
    return next((Path(at) for _, at, kind, *_ in mounts if kind == "cgroup2"), None)


def missing_here() -> str | None:
    """Return why no systemd can be started on this machine and how to change that; None where it can."""
    if os.geteuid() != 0:
        return "not root; to run it: sudo .venv/bin/python -m pytest -m soak tests/system/test_systemd.py"
    if not SYSTEMD.exists() or any(shutil.which(tool) is None for tool in ("systemctl", "unshare", "nsenter", "ip")):
        return "no systemd, unshare, nsenter or ip; to run it: apt-get install systemd util-linux iproute2"
    if unified() is None:
        return "no cgroup2; to run it: mount -t cgroup2 none /sys/fs/cgroup"
    if Path(sys.prefix).is_relative_to("/tmp"):
        return "units with a /tmp of their own do not see a checkout in /tmp; to run it: clone it elsewhere"
    tried = ["unshare", "--fork", *NAMESPACES, "sh", "-c", "mount --make-rprivate / && mount -t cgroup2 none /mnt"]
    done = subprocess.run(tried, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    if done.returncode != 0:
        return f"no namespaces ({done.stderr.strip()}); to run it: outside a container, or in one with --privileged"
    return None


class Machine:
    """A systemd with its own /etc, /var, /run, /dev, processes, network and cgroups."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        for name in ("own", "none", "units/network-online.target.wants"):
            (folder / name).mkdir(parents=True)
        for unit in COPIED:
            shutil.copy(UNITS / unit, folder / "units")
        for unit, text in (
            ("machine.target", MACHINE),
            ("quiet.target", QUIET),
            ("slow-network.service", SLOW_NETWORK),
        ):
            (folder / "units" / unit).write_text(text)
        (folder / "units/network-online.target.wants/slow-network.service").symlink_to("../slow-network.service")
        self._log = folder / "systemd.log"
        hierarchy = unified()
        assert hierarchy is not None
        self._cgroup = hierarchy / f"bodyschema-test-{os.getpid()}"

    def __enter__(self) -> Self:
        self._cgroup.mkdir()
        enter = ["sh", "-c", 'echo $$ > "$0/cgroup.procs" && exec "$@"', str(self._cgroup)]
        boot = ["unshare", "--fork", "--kill-child", *NAMESPACES, "bash", str(BOOT), str(self.folder), str(SYSTEMD)]
        with self._log.open("wb") as log:
            self._unshare = subprocess.Popen([*enter, *boot], stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        try:
            self.until(lambda: self._is_up() and self.is_active("machine.target"))
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end()

    def run(self, *words: object, check: bool = True) -> subprocess.CompletedProcess[str]:
        """Run a command as root on the machine."""
        enter = ["nsenter", f"--target={self._first()}", *NAMESPACES, "--"]
        variables = ["env", f"SYSTEMD_UNIT_PATH={FOLDER}:{self.folder}/units"]
        command = [*enter, *variables, *map(str, words)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False)
        assert done.returncode == 0 or not check, f"{words}: {done.stdout}{done.stderr}{self.journal()[-4000:]}"
        return done

    def systemctl(self, *words: object) -> str:
        return self.run("systemctl", "--no-pager", *words).stdout.strip()

    def show(self, unit: str, key: str) -> str:
        """Return a property of a unit."""
        return self.systemctl("show", "--value", "--property", key, unit)

    def is_active(self, unit: str) -> bool:
        return self.run("systemctl", "is-active", unit, check=False).stdout.strip() == "active"

    def has(self, file: str) -> bool:
        return self.run("test", "-s", file, check=False).returncode == 0

    def drop_in(self, unit: str, text: str) -> None:
        """Write a drop-in, as `systemctl edit` does."""
        file = FOLDER / f"{unit}.d" / "zz-test.conf"
        self.run("sh", "-c", 'mkdir -p "$(dirname "$0")" && printf %s "$1" > "$0"', file, text)
        self.systemctl("daemon-reload")

    def journal(self, unit: str = "") -> str:
        of_unit = ["--unit", unit] if unit else []
        return self.run("journalctl", "--no-pager", *of_unit, check=False).stdout

    def until(self, holds: Callable[[], bool]) -> None:
        limit = time.monotonic() + LIMIT_S
        while not holds():
            assert self._unshare.poll() is None, self._log.read_text()
            assert time.monotonic() < limit, self.journal()[-4000:]
            time.sleep(0.1)

    def _first(self) -> str:
        """Return the PID of its PID 1 as seen from outside; empty where it does not run."""
        return Path(f"/proc/{self._unshare.pid}/task/{self._unshare.pid}/children").read_text().strip()

    def _is_up(self) -> bool:
        first = self._first()
        return first != "" and Path(f"/proc/{first}/comm").read_text() == "systemd\n"

    def _end(self) -> None:
        (self._cgroup / "cgroup.kill").write_text("1")
        self._unshare.wait()
        limit = time.monotonic() + LIMIT_S
        while "populated 1" in (self._cgroup / "cgroup.events").read_text():
            assert time.monotonic() < limit
            time.sleep(0.05)
        for folder in sorted(self._cgroup.rglob("*/"), reverse=True):
            folder.rmdir()
        self._cgroup.rmdir()
