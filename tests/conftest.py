"""Fixtures of more than one folder."""

from __future__ import annotations

import gc
import os
import subprocess
import tempfile
from collections.abc import Callable, Generator, Iterable, Iterator
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when numpy is imported; more threads only spin

import free_ports
import pytest
import warm
from _pytest.doctest import DoctestModule
from _pytest.mark import ParameterSet
from hypothesis import HealthCheck, settings
from hypothesis.internal.conjecture import providers
from skip_remedies import Report, with_remedy

from benchmarks.tables import OPTION

# No time limits: a busy machine is no failure. The same examples in every run, so that a red test is red again;
# `make soak` generates other and more examples (its profile), and keeps failures in .hypothesis.
TIMELESS = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("suite", TIMELESS, derandomize=True, max_examples=6)
settings.register_profile("soak", TIMELESS, print_blob=True, max_examples=300)
settings.load_profile("suite")
# Hypothesis takes constants out of every module imported so far: other ones in each worker, and a second to find them.
providers._get_local_constants = providers.Constants

IN_MEMORY = "/dev/shm"
ROOM_BYTES = 4e9  # ten times what a run leaves behind


def has_room() -> bool:
    """Return True where temporary files may lie in memory: there is enough of it, and programs run from there."""
    try:
        disk = os.statvfs(IN_MEMORY)
    except OSError:
        return False
    return disk.f_bavail * disk.f_frsize > ROOM_BYTES and not disk.f_flag & os.ST_NOEXEC


ALL_SOAK = "\npytestmark = pytest.mark.soak"
QUICK = ("kbmaps/", "tests/interfaces/", "tests/kbmaps/")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option of benchmarks that writes tables for docs/results."""
    parser.addoption(OPTION, type=Path, metavar="FOLDER", help="write each table to a file there")


def pytest_configure(config: pytest.Config) -> None:
    """Keep temporary files in memory: each pair is written through to a disk, which takes 5 ms. Soak tests have one."""
    if config.option.markexpr == "not soak" and has_room():
        os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", IN_MEMORY)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Generator[None, Report, Report]:
    return with_remedy((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Generator[None, Report, Report]:
    return with_remedy((yield))


@pytest.hookimpl(wrapper=True)
def pytest_collect_file() -> Generator[None, list[pytest.Collector], list[pytest.Collector]]:
    """Look for doctests in the package only: among the tests there are none, and the search takes a second."""
    return [collector for collector in (yield) if not isinstance(collector, DoctestModule)]


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_setupnodes() -> None:
    """Start the process that forks all others once, not once in each worker."""
    warm.start()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Return three workers for two processors: half of the tests wait for processes, clocks or disks."""
    return (3 * len(os.sched_getaffinity(0)) + 1) // 2


def leaves_soak_out(config: pytest.Config) -> bool:
    return config.option.markexpr == "not soak" and not any("::" in argument for argument in config.args)


def is_soak(marks: Iterable[pytest.Mark]) -> bool:
    return any(mark.name == "soak" for mark in marks)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Import no file of soak tests alone where they are left out: what they need takes a second in each worker."""
    if collection_path.name.startswith("test_") and collection_path.suffix == ".py" and leaves_soak_out(config):
        return True if ALL_SOAK in collection_path.read_text(encoding="utf-8") else None
    return None


def pytest_pycollect_makeitem(collector: pytest.Collector, obj: object) -> list[pytest.Item] | None:
    """Make no items of soak tests that are left out and were not named: a third of all, and thousands of parameters."""
    left_out = callable(obj) and leaves_soak_out(collector.config) and is_soak(getattr(obj, "pytestmark", []))
    return [] if left_out else None


@pytest.hookimpl(tryfirst=True)
def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Leave soak parameters out in the same way."""
    marks = metafunc.definition.own_markers
    for place, mark in enumerate(marks if leaves_soak_out(metafunc.config) else ()):
        if mark.name == "parametrize" and len(mark.args) == 2 and not isinstance(mark.kwargs.get("ids"), list):
            values = list(mark.args[1])
            kept = [value for value in values if not (isinstance(value, ParameterSet) and is_soak(value.marks))]
            if 0 < len(kept) < len(values):
                marks[place] = pytest.mark.parametrize(mark.args[0], kept, **mark.kwargs).mark


def pytest_collection(session: pytest.Session) -> None:
    """Collect no garbage among thousands of tests, which are none."""
    gc.disable()


def pytest_collection_finish(session: pytest.Session) -> None:
    """Leave what was collected out of every later search for garbage; fork what would import it again."""
    if warm.SHARED in os.environ:
        warm.fork_solvers_and_renderers()
    gc.collect()
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Move files of many quick tests to the end, so that no worker is left with a long one."""
    items.sort(key=lambda item: item.nodeid.startswith(QUICK))


@pytest.fixture(scope="session")
def free_endpoint() -> Callable[[], str]:
    """Return a function that returns unused zenoh endpoints on this machine."""
    return free_ports.free_endpoint


@pytest.fixture
def endpoint(free_endpoint: Callable[[], str]) -> str:
    """Return an unused zenoh endpoint on this machine."""
    return free_endpoint()


@pytest.fixture(scope="session")
def tables_folder(pytestconfig: pytest.Config) -> Path | None:
    """Return the folder that tables go to, if there is one."""
    return pytestconfig.getoption(OPTION)


@pytest.fixture(scope="session")
def hidden_folder() -> Iterator[Path]:
    """Yield a folder that services see only if their units say so."""
    with tempfile.TemporaryDirectory(prefix="bodyschema-", dir="/tmp") as folder:
        yield Path(folder)


@pytest.fixture
def patient_host(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait for servos and encoders as long as a full machine may hold up the emulator that answers for them."""
    monkeypatch.setattr("bodyschema.drivers.servos.bus.HOST_S", 1.0)
    monkeypatch.setattr("bodyschema.drivers.servos.scan.HOST_S", 1.0)
    monkeypatch.setattr("bodyschema.drivers.dynamixel.bus.HOST_S", 1.0)
    monkeypatch.setattr("bodyschema.drivers.servos.checks._Settings.identify_s", 30.0)
    monkeypatch.setattr("bodyschema.drivers.serial_lines.joints.LOST_AFTER_S", 10.0)
    monkeypatch.setattr("bodyschema.drivers.serial_lines.board.DOUBTS", 10_000)


@pytest.fixture
def mount_small_disk(tmp_path: Path) -> Iterator[Callable[[str], Path]]:
    """Yield a function that mounts an empty tmpfs with the options given; needs root."""
    if os.geteuid() != 0:
        pytest.skip("no small disk can be mounted; to run it: be root")
    folder = tmp_path / "disk"
    folder.mkdir()

    def mount(options: str) -> Path:
        command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            pytest.skip(f"no tmpfs ({done.stderr.strip()}); to run it: leave the container")
        return folder

    yield mount
    subprocess.run(["umount", folder], capture_output=True, check=False)
