"""Check that machine and arm are ready for use; each failed check names the command that fixes it."""

from __future__ import annotations

import ctypes
import os
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import msgspec
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bodyschema.cli.install.units import FOLDER
from bodyschema.daemon.config import Config
from bodyschema.daemon.service.remedies import as_typed
from bodyschema.daemon.transport.identity import Route
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import ZenohSession, accepts, is_alive
from bodyschema.daemon.transport.status import SamplerStatus
from bodyschema.daemon.transport.wire import decode
from bodyschema.daemon.transport.zenoh_config import PROCESSES
from bodyschema.daemon.wiring.servos import (
    Check,
    configured_ports,
    encoder_checks,
    joint_state_checks,
    other_holders,
    port_checks,
    servo_checks,
    servos_of,
)
from bodyschema.interfaces.errors import BodyschemaError, BusError
from bodyschema.interfaces.extras import require_extra
from bodyschema.recordings.store.file import LOW_DISK_BYTES
from bodyschema.recordings.store.store import PairReader

TIME_ERROR = 5  # adjtimex(2): the clock is not synchronised


class _Settings:
    connect_s: float = 0.3  # how long a connection is waited for
    open_s: float = 0.7  # how long a session is waited for


# One that began before an update is called by the old name.
SAMPLER = re.compile(r"(bodyschema|-m daemon) (run )?sampler\b")
OLD_UNIT = re.compile(r"^ExecStart=.* -m daemon\b", re.MULTILINE)

Step = tuple[str, Callable[[], Iterator[Check]]]


def steps(config: Config) -> Iterator[Step]:
    """Yield the name of each step with the function that runs its checks."""
    yield "robot.toml", lambda: _description(config)
    if configured_ports(config):
        yield "ports", lambda: port_checks(config, _samplers(config))
    if servos_of(config) is not None:
        yield "servos", lambda: _on_the_ports(config, servo_checks)
    elif configured_ports(config):
        yield "encoders", lambda: _on_the_ports(config, encoder_checks)
    if config.tables.vision.cameras is not None:
        yield "cameras", lambda: _cameras(config)
    if config.tables.marker_source:
        yield "marker source", lambda: _marker_sources(config)
    if config.tables.drivers.ros2 is not None:
        yield "router", lambda: joint_state_checks(config)
    yield "disk", lambda: disk_checks(config.state_dir)
    if os.path.exists(config.store_file):  # a folder of another user has none
        yield "store", lambda: store_checks(config.store_file)
    yield "clock", clock_checks
    yield "service", unit_checks
    yield "zenoh", lambda: _zenoh(config)


def as_json(checks: list[Check]) -> str:
    """Return the checks as JSON; `well` is true if none failed."""
    contents = {"schema": 1, "well": all(check.state != "wrong" for check in checks), "checks": checks}
    return msgspec.json.format(msgspec.json.encode(contents)).decode()


def _description(config: Config) -> Iterator[Check]:
    yield Check(
        "robot.toml", "ok", f"{config.file} is in order: {config.robot.name}, {len(config.robot.joints)} joints"
    )
    if config.tables.drivers.hardware is None:
        message = "no servos are configured, so none were looked at"
        yield Check("robot.toml", "warning", message, "bodyschema init --urdf YOUR.urdf --from scan")
    cameras = config.tables.vision.cameras
    if cameras is not None and cameras.calibration is not None:
        return
    if cameras is None and config.tables.marker_source:
        return
    if config.robot.calibration is None:
        message = "[camera] does not describe how the cameras see: images cannot be used, recordings can"
        keys = "focal_px, principal_point_px, image_size_px, and baseline_m or eyes = 1"
        yield Check("camera", "warning", message, f"add {keys} to [camera]")
    else:
        what = "a stereo pair" if config.robot.calibration.is_stereo else "one camera"
        yield Check("camera", "ok", f"[camera] describes {what}")


def _sampler_status(config: Config) -> SamplerStatus | None:
    """Return the status of a running sampler, which holds ports and cameras; None if none answers."""
    route, keys = config.route("sampler"), Keys(config.robot.name)
    if not is_alive(route, keys.alive("sampler"), open_timeout_s=_Settings.open_s):
        return None
    with ZenohSession(connect=route, client=True) as bus:
        return decode(bus.ask_one(keys.status("sampler")), SamplerStatus)


def _cameras(config: Config) -> Iterator[Check]:
    if (status := _sampler_status(config)) is not None:
        yield Check("cameras", "ok", f"the running sampler takes {status.frames_per_s:.1f} stereo frames/s")
        return
    require_extra("cameras", "looking at the cameras")
    from bodyschema.daemon.wiring.cameras import camera_checks

    yield from camera_checks(config)


def _marker_sources(config: Config) -> Iterator[Check]:
    if (status := _sampler_status(config)) is None:
        from bodyschema.daemon.wiring.wiring import marker_source_checks

        yield from marker_source_checks(config)
        return
    yield Check("marker source", "ok", f"the running sampler takes {status.frames_per_s:.1f} positions/s")
    names = [table.label for table in config.tables.marker_source]
    for complaint in status.health:
        name, _, rest = complaint.partition(": ")
        if name in names:
            what, _, remedy = rest.partition(": ")
            yield Check(f"marker source {name}", "warning", what, remedy)


def _on_the_ports(config: Config, look: Callable[[Config], Iterator[Check]]) -> Iterator[Check]:
    """Yield the checks of `look`; if a running sampler holds the ports, those of its status instead."""
    if not all(os.path.exists(port) for port in configured_ports(config).values()):
        return
    if other_holders(config):
        yield from _of_the_sampler(config)
    else:
        yield from look(config)


def _samplers(config: Config) -> list[int]:
    """Return the PIDs of sampler processes that have a port open, if the sampler answers."""
    pids = [holder.pid for holder in other_holders(config) if SAMPLER.search(holder.command)]
    route, token = config.route("sampler"), Keys(config.robot.name).alive("sampler")
    return pids if pids and is_alive(route, token, open_timeout_s=_Settings.open_s) else []


def _of_the_sampler(config: Config) -> Iterator[Check]:
    if (status := _sampler_status(config)) is None:
        yield Check("servos", "warning", "not looked at: another program has the port")
        return
    yield Check("rate", "ok", f"the running sampler takes {status.readings_per_s:.0f} readings/s")
    for complaint in status.health:
        yield Check("servos", "warning", complaint)


def disk_checks(folder: Path) -> Iterator[Check]:
    """Yield checks of free space and write permission for the pairs in `folder`."""
    try:
        existing = next(path for path in (folder, *folder.parents) if path.exists())
    except PermissionError as error:
        remedy = "bodyschema run --state-dir FOLDER    # one that you can write"
        yield Check("disk", "wrong", f"{folder}, where samples are to be kept, is not yours: {error.strerror}", remedy)
        return
    if not os.access(existing, os.W_OK):
        message = f"{existing} cannot be written, and samples are to be kept in {folder}"
        yield Check("disk", "wrong", message, f"sudo chown $USER {existing}")
        return
    free = shutil.disk_usage(existing).free
    message = f"{free / 2**30:.1f} GiB are free for {folder}"
    if free < 5 * LOW_DISK_BYTES:
        state = "wrong" if free < LOW_DISK_BYTES else "warning"
        yield Check("disk", state, message, f"du -xh {existing} | sort -h | tail    # what could go")
    else:
        yield Check("disk", "ok", message)


def store_checks(file: Path) -> Iterator[Check]:
    """Yield checks that the disk returns every pair as it was written."""
    with PairReader(file) as pairs:
        trouble, audit = pairs.trouble(), pairs.audit()
    if trouble is not None:
        message = f"{file} is damaged ({trouble}). The sampler puts what can be read into a new file when it starts"
        yield Check("store", "wrong", message, "bodyschema backup before.zip")
    elif audit.damage.count:
        yield Check(
            "store", "warning", audit.damage.sentence(file), f"sudo smartctl -a $(df --output=source {file} | tail -1)"
        )
    elif audit.lost_rows:
        message = f"{audit.lost_rows} notes on runs or servos in {file} cannot be read: the disk changed them"
        yield Check("store", "warning", message, "bodyschema backup before.zip")
    else:
        yield Check("store", "ok", f"all {audit.pairs} samples in {file} are as they were written")


def clock_checks(is_synchronised: Callable[[], bool | None] | None = None) -> Iterator[Check]:
    """Check that the wall clock, which dates the pairs, is synchronised. (Timestamps use the monotonic clock.)"""
    known = (_is_synchronised if is_synchronised is None else is_synchronised)()
    if known is None:
        yield Check("clock", "ok", "the system does not report whether the clock is synchronised")
    elif known:
        yield Check("clock", "ok", "kept right by the network")
    else:
        message = "the wall clock is not kept right by the network"
        yield Check("clock", "warning", message, "sudo timedatectl set-ntp true")


def unit_checks(root: Path = Path("/")) -> Iterator[Check]:
    """Yield a check for each unit of an older bodyschema: these start `python -m daemon`, which no longer exists."""
    files = [*(root / FOLDER).glob("bodyschema-*.service"), *(root / FOLDER).glob("bodyschema-*.service.d/*.conf")]
    for file in sorted(files):
        if OLD_UNIT.search(file.read_text(encoding="utf-8", errors="replace")):
            fix = "install router" if "router" in file.name else "install service"
            message = f"{file} starts `python -m daemon`, which this bodyschema does not have"
            yield Check("service", "wrong", message, f'sudo "$(command -v bodyschema)" {fix}')


def _is_synchronised() -> bool | None:
    try:
        state = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(512))  # more than struct timex has
    except (OSError, AttributeError):
        return None
    return None if state < 0 else state != TIME_ERROR


def _zenoh(config: Config) -> Iterator[Check]:
    keys, zenoh = Keys(config.robot.name), config.tables.zenoh
    identity = zenoh.identity(config.file.parent)
    for process in PROCESSES:
        yield zenoh_check(process, Route((zenoh.endpoint(process),), identity), keys.alive(process))
    if zenoh.router:
        yield router_check(Route((zenoh.router,), identity))


def router_check(route: Route) -> Check:
    """Check that the router accepts our connection."""
    try:
        with ZenohSession(connect=route, client=True, open_timeout_s=_Settings.open_s):
            return Check("zenoh", "ok", f"the router {route} takes our connection")
    except BusError as error:
        first, _, rest = str(error).partition(". ")
        return Check("zenoh", "wrong", f"{first}: other machines do not see this robot", rest or "see the router's log")


def zenoh_check(process: str, route: Route, token: str) -> Check:
    """Check that the process answers or, if it does not run, that its endpoint is free."""
    endpoint = str(route)
    if endpoint.startswith(("tcp/", "tls/")) and not accepts(endpoint, _Settings.connect_s):
        return Check("zenoh", "ok", f"the {process} does not run; {endpoint} is free for it")
    if is_alive(route, token, open_timeout_s=_Settings.open_s):
        return Check("zenoh", "ok", f"the {process} answers on {endpoint}")
    port = endpoint.rpartition(":")[2]
    message = f"another program listens on {endpoint}, where the {process} should"
    return Check("zenoh", "wrong", message, f"ss -ltnp 'sport = :{port}'    # who it is; or another port in [zenoh]")


def run(config: Config, tell: Callable[[str], None]) -> list[Check]:
    """Run all checks; an error on the way counts as a failed check."""
    checks: list[Check] = []
    for name, look in steps(config):
        tell(name)
        try:
            checks += [replace(check, fix=check.fix.replace("robot.toml", str(config.file))) for check in look()]
        except BodyschemaError as error:
            checks.append(Check(name, "wrong", str(error)))
    return checks


MARKS = {"ok": Text("✓", "green"), "warning": Text("!", "yellow"), "wrong": Text("✗", "red")}
INDENT = "    "


def show(console: Console, checks: Sequence[Check]) -> None:
    """Print a line for each check, the command that fixes it below, and the summary."""
    for check in checks:
        line = Table.grid(padding=(0, 1))
        line.add_column(no_wrap=True)
        line.add_column(no_wrap=True, min_width=13)
        line.add_column(overflow="fold")
        line.add_row(MARKS[check.state], Text(check.subject), Text(as_typed(check.said)))
        console.print(line)
        if check.fix:  # not wrapped here, so that it can be copied
            console.print(Text(f"{INDENT}{as_typed(check.fix)}", "bold"), soft_wrap=True)
    console.print(_sum(checks))


def _sum(checks: Sequence[Check]) -> str:
    wrong = sum(check.state == "wrong" for check in checks)
    warnings = sum(check.state == "warning" for check in checks)
    if not wrong and not warnings:
        return "All is well."
    parts = [f"{wrong} wrong"] * bool(wrong) + [f"{warnings} that could be better"] * bool(warnings)
    return f"{', '.join(parts)}: the line below each says what to do."
