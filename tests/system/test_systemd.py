"""The units under a real systemd, as a user installs them."""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
from collections.abc import Iterator
from functools import partial
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from own_systemd import Machine, missing_here
from sampled import drawn, on_emulator
from security_recipe import SEVERAL, carried_out
from small_arm import write_small_arm
from test_cameras_in_the_sampler import CAMERA, MIDDLE, write_arm
from test_install_service import HARDWARE, PORT, STEREO
from two_processes import write_robot
from v4l2_cameras import ShimCamera

from bodyschema.daemon.wiring.servos import configured_ports

pytestmark = pytest.mark.soak
BODYSCHEMA = (sys.executable, "-P", "-m", "bodyschema")
USER = "daemon"  # one that every Linux has
SAMPLER, LEARNER = "bodyschema-sampler@arm.service", "bodyschema-learner@arm.service"
ROUTER = "bodyschema-router.service"
CAMERA_FILE = "/dev/v4l/by-id/usb-Stereo_1234-video-index0"
PROBE = """
import json, mmap, os, socket, sys
def done(what):
    try: what()
    except OSError as error: return error.strerror or str(error)
    return "done"
print("PROBE", json.dumps({
    "named": os.access(sys.argv[1], os.R_OK | os.W_OK),
    "other": os.access("/dev/other", os.R_OK | os.W_OK),
    "etc": done(lambda: open("/etc/probe", "w")),
    "home": os.listdir("/home"),
    "tmp": os.path.exists(sys.argv[2]),
    "state": done(lambda: open(os.environ["STATE_DIRECTORY"] + "/probe", "w")),
    "here": done(lambda: socket.create_connection(("127.0.0.1", 1), 1)),
    "there": done(lambda: socket.create_connection(("192.0.2.10", 1), 1)),
    "written_and_run": done(lambda: mmap.mmap(-1, 4096, prot=mmap.PROT_WRITE | mmap.PROT_EXEC)),
    "capabilities": [line.split()[1] for line in open("/proc/self/status") if line.startswith("CapEff")],
    "processes": len([name for name in os.listdir("/proc") if name.isdigit()]),
}))
"""


@pytest.fixture(scope="module")
def booted(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    if (reason := missing_here()) is not None:
        pytest.skip(reason)
    with Machine(tmp_path_factory.mktemp("machine")) as machine:
        yield machine


@pytest.fixture
def machine(booted: Machine) -> Iterator[Machine]:
    """Yield the machine, with nothing of the project installed."""
    yield booted
    booted.run("systemctl", "stop", "bodyschema-*.service", check=False)
    booted.run("sh", "-c", "rm -rf /etc/systemd/system/* /var/lib/bodyschema")
    booted.systemctl("daemon-reload")
    booted.systemctl("reset-failed")


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    return walking(tmp_path)


def walking(folder: Path, name: str = "arm", first_port: int = 7447) -> Path:
    """Write a robot.toml that plays a recording and keeps its state where services do."""
    folder.chmod(0o755)  # the service is another user's
    ports = count(first_port)
    file = write_robot(folder, lambda: f"tcp/127.0.0.1:{next(ports)}").file
    text = re.sub(r"^state_dir = .*\n", "", file.read_text(), flags=re.MULTILINE)
    file.write_text(text.replace('name = "arm"', f'name = "{name}"', 1))
    return file


def install(machine: Machine, *words: object) -> str:
    return machine.run(*BODYSCHEMA, "install", *words, "--user", USER, "--yes").stdout


def started(machine: Machine, robot: Path) -> None:
    """Install sampler and learner, and type what the command prints."""
    (enable,) = re.findall(r"sudo (systemctl enable .*)", install(machine, "service", "--robot", robot))
    machine.run(*enable.split())


def pairs(machine: Machine, unit: str) -> int:
    """Return the number of pairs that a unit reports."""
    found = re.search(r"(\d+) samples", machine.show(unit, "StatusText"))
    return 0 if found is None else int(found[1])


def await_pairs(machine: Machine, *units: str) -> None:
    """Wait until each unit reports more pairs than now."""
    before = {unit: pairs(machine, unit) for unit in units}
    machine.until(lambda: all(pairs(machine, unit) > before[unit] for unit in units))


def restarts(machine: Machine, unit: str) -> int:
    return int(machine.show(unit, "NRestarts"))


def test_installed_services_start_and_learn(machine, robot) -> None:
    started(machine, robot)
    assert machine.is_active(SAMPLER)
    assert machine.is_active(LEARNER)
    await_pairs(machine, SAMPLER, LEARNER)
    assert restarts(machine, SAMPLER) == restarts(machine, LEARNER) == 0
    listed = machine.run("stat", "-c", "%U %a %n", "/var/lib/bodyschema/arm").stdout
    assert listed == f"{USER} 750 /var/lib/bodyschema/arm\n"


def test_a_boot_starts_what_is_enabled(machine, robot) -> None:
    started(machine, robot)
    machine.systemctl("isolate", "quiet.target")
    assert not machine.is_active(SAMPLER)
    machine.systemctl("isolate", "machine.target")
    assert machine.is_active(LEARNER)
    await_pairs(machine, SAMPLER, LEARNER)


def test_reload_follows_robot_toml(machine, robot) -> None:
    started(machine, robot)
    before = machine.show(SAMPLER, "MainPID")
    robot.write_text(robot.read_text().replace("any_step = true", "any_step = true\nmax_reading_gap_s = 7.0"))
    machine.systemctl("reload", SAMPLER)
    machine.until(lambda: "in force now: daemon.max_reading_gap_s = 7.0" in machine.journal(SAMPLER))
    machine.until(lambda: machine.is_active(SAMPLER))
    assert machine.show(SAMPLER, "MainPID") == before
    await_pairs(machine, SAMPLER, LEARNER)


@pytest.mark.parametrize("unit", [SAMPLER, LEARNER])
def test_a_hung_service_is_aborted_and_restarted(machine, robot, unit) -> None:
    started(machine, robot)
    machine.drop_in(unit, "[Service]\nWatchdogSec=10\n")
    machine.systemctl("restart", unit)
    await_pairs(machine, unit)
    machine.run("kill", "-STOP", machine.show(unit, "MainPID"))
    machine.until(lambda: restarts(machine, unit) >= 1)
    machine.until(lambda: machine.is_active(unit))
    assert "Fatal Python error: Aborted" in machine.journal(unit)
    await_pairs(machine, SAMPLER, LEARNER)


@pytest.mark.parametrize("unit", [SAMPLER, LEARNER])
def test_a_killed_service_is_restarted_alone(machine, robot, unit) -> None:
    started(machine, robot)
    await_pairs(machine, SAMPLER, LEARNER)
    other = LEARNER if unit == SAMPLER else SAMPLER
    running, killed = machine.show(other, "MainPID"), machine.show(unit, "MainPID")
    machine.run("kill", "-KILL", killed)
    machine.until(lambda: restarts(machine, unit) >= 1 and machine.is_active(unit))
    assert machine.show(other, "MainPID") == running
    await_pairs(machine, SAMPLER, LEARNER)


def test_a_service_over_its_memory_is_restarted(machine, robot) -> None:
    if "memory" not in machine.run("cat", "/sys/fs/cgroup/cgroup.controllers").stdout.split():
        pytest.skip("cgroup2 has no memory controller here; to run it: boot with cgroup_no_v1=all")
    started(machine, robot)
    machine.drop_in(LEARNER, "[Service]\nMemoryMax=60M\n")
    machine.systemctl("restart", "--no-block", LEARNER)
    machine.until(lambda: restarts(machine, LEARNER) >= 1)
    await_pairs(machine, SAMPLER)
    assert restarts(machine, SAMPLER) == 0


def test_a_robot_out_of_reach_is_awaited(machine, robot) -> None:
    started(machine, robot)
    away = robot.parent.rename(robot.parent.with_name("away"))
    for unit in (SAMPLER, LEARNER):
        machine.run("systemctl", "restart", unit, check=False)
        assert f"{robot}: " in machine.journal(unit)
    away.rename(robot.parent)
    machine.until(lambda: machine.is_active(SAMPLER) and machine.is_active(LEARNER))
    await_pairs(machine, SAMPLER, LEARNER)


def test_stop_ends_services_in_order(machine, robot) -> None:
    started(machine, robot)
    await_pairs(machine, SAMPLER, LEARNER)
    machine.systemctl("stop", SAMPLER, LEARNER)
    for unit in (SAMPLER, LEARNER):
        assert machine.show(unit, "ActiveState") == "inactive"
        assert (machine.show(unit, "Result"), machine.show(unit, "ExecMainStatus")) == ("success", "0")
        assert "Traceback" not in machine.journal(unit)


def test_documented_commands_reach_the_units(machine, robot) -> None:
    started(machine, robot)
    shown = (Path(__file__).parents[2] / "docs" / "operation.md").read_text(encoding="utf-8")
    lines = {line.removeprefix("sudo ") for line in re.findall(r"^.*'bodyschema-\*@left_arm.*$", shown, re.MULTILINE)}
    done = {
        words[1]: machine.run(*words).stdout
        for line in sorted(lines)
        if (words := line.replace("left_arm", "arm").replace("'", "").split())[-1] != "-f"
    }
    assert {SAMPLER, LEARNER} <= set(re.findall(r"bodyschema-\w+@arm\.service", done["status"]))
    assert not machine.is_active(SAMPLER)  # stop is the last in the alphabet
    assert not machine.is_active(LEARNER)


@pytest.mark.parametrize("process", ["sampler", "learner"])
def test_the_sandbox_hides_and_forbids(machine, tmp_path, process) -> None:
    unit = f"bodyschema-{process}@arm.service"
    tmp_path.chmod(0o755)
    robot, probe = write_small_arm(tmp_path, STEREO + HARDWARE), tmp_path / "probe.py"
    probe.write_text(PROBE)
    for file, minor in ((PORT, 62), ("/dev/other", 61)):  # terminals that nothing uses
        machine.run("sh", "-c", f"mkdir -p $(dirname {file}) && test -e {file} || mknod -m 666 {file} c 4 {minor}")
    machine.systemctl("start", "slow-network.service")
    install(machine, "service", "--robot", robot)
    command = f"ExecStart=\nExecStart={sys.executable} {probe} {PORT} {machine.folder}"
    machine.drop_in(unit, f"[Service]\nType=oneshot\nRestart=no\n{command}\n")
    machine.systemctl("start", unit)
    (line,) = re.findall(r"PROBE (.*)", machine.journal(unit))
    found = json.loads(line)
    assert found == {
        "named": process == "sampler",
        "other": False,
        "etc": "Read-only file system",
        "home": [],
        "tmp": False,
        "state": "done",
        "here": "Connection refused",  # reached, and nothing listens
        "there": "timed out",
        "written_and_run": "Operation not permitted",
        "capabilities": ["0000000000000000"],
        "processes": 1,
    }


def test_servos_and_a_camera_give_pairs(machine, tmp_path, library) -> None:
    tmp_path.chmod(0o755)
    library.parent.chmod(0o755)
    ports = count(7447)
    tables = CAMERA.format(device=CAMERA_FILE, latency=0.0)
    config = write_arm(tmp_path, lambda: f"tcp/127.0.0.1:{next(ports)}", tables, "[daemon]\nany_step = true\n")
    camera = ShimCamera(tmp_path / "camera", [np.hstack(drawn(config, MIDDLE))])
    with camera, on_emulator(config, tmp_path, lambda t: MIDDLE) as (emulated, _):
        for device, group in ((configured_ports(emulated)["arm"], "dialout"), (camera.file, "video")):
            shutil.chown(os.path.realpath(device), group=group)
            os.chmod(os.path.realpath(device), 0o660)
        place = f"mkdir -p {Path(CAMERA_FILE).parent} && touch {CAMERA_FILE}"
        machine.run("sh", "-c", f"{place} && mount --bind {camera.file} {CAMERA_FILE}")
        install(machine, "service", "--robot", emulated.file, "--only", "sampler")
        unit = f"bodyschema-sampler@{emulated.robot.name}.service"
        # The camera is a library below OpenCV: it takes the place of V4L2.
        machine.drop_in(unit, f"[Service]\nEnvironment=LD_PRELOAD={library}\nBindReadOnlyPaths={library.parent}\n")
        machine.systemctl("start", unit)
        await_pairs(machine, unit)
        machine.systemctl("stop", unit)
        assert machine.show(unit, "Result") == "success"


def test_one_learner_serves_several_robots(machine, tmp_path) -> None:
    robots = []
    for name, port in (("left", 7447), ("right", 7457)):
        (tmp_path / name).mkdir()
        robots.append(walking(tmp_path / name, name, port))
        install(machine, "service", "--robot", robots[-1], "--only", "sampler")
    tmp_path.chmod(0o755)
    install(machine, "service", *(word for robot in robots for word in ("--robot", robot)), "--name", "lab")
    units = ["bodyschema-learner@lab.service", *(f"bodyschema-sampler@{name}.service" for name in ("left", "right"))]
    machine.systemctl("start", *units)
    await_pairs(machine, *units)
    for name in ("left", "right"):
        machine.until(partial(machine.has, f"/var/lib/bodyschema/{name}/learner.ckpt"))
    assert [restarts(machine, unit) for unit in units] == [0, 0, 0]


def without_network(machine: Machine) -> None:
    machine.run("sh", "-c", "ip address del 192.0.2.10/24 dev lo 2>&- || true")
    machine.systemctl("stop", "slow-network.service", "network-online.target")


def test_a_boot_with_slow_network_lets_all_meet(machine, robot) -> None:
    folder = carried_out(robot.parent)
    shutil.copy(SEVERAL / "router.toml", folder)
    arm = re.sub(r"\[zenoh\]\n.*\n.*\n", "", robot.read_text())
    install(machine, "router", folder / "router.toml")
    for process in ("sampler", "learner"):
        file, table = folder / f"{process}.toml", "robot.toml" if process == "sampler" else "learner.toml"
        file.write_text(arm + (SEVERAL / table).read_text())
        install(machine, "service", "--robot", file, "--only", process)
    machine.run("chown", "-R", USER, folder)
    machine.systemctl("enable", ROUTER, SAMPLER, LEARNER)
    without_network(machine)
    machine.systemctl("isolate", "quiet.target")
    machine.systemctl("isolate", "--no-block", "machine.target")
    machine.until(lambda: all(map(machine.is_active, (ROUTER, SAMPLER, LEARNER))))
    await_pairs(machine, SAMPLER, LEARNER)


def test_the_router_waits_for_a_slow_network(machine, tmp_path) -> None:
    without_network(machine)
    pki = carried_out(tmp_path)
    shutil.copy(SEVERAL / "router.toml", pki)
    tmp_path.chmod(0o755)
    machine.run("chown", "-R", USER, pki)
    (enable,) = re.findall(r"sudo (systemctl enable .*)", install(machine, "router", pki / "router.toml"))
    machine.run(*enable.split())
    assert machine.is_active(ROUTER)
    assert restarts(machine, ROUTER) == 0
    machine.run("kill", "-STOP", machine.show(ROUTER, "MainPID"))
    machine.until(lambda: restarts(machine, ROUTER) >= 1 and machine.is_active(ROUTER))  # after its 30 s
    machine.systemctl("stop", ROUTER)
    assert machine.show(ROUTER, "Result") == "success"


def test_uninstall_stops_and_removes(machine, robot) -> None:
    started(machine, robot)
    machine.run(*BODYSCHEMA, "install", "service", "--robot", robot, "--uninstall", "--yes")
    assert not machine.is_active(SAMPLER)
    assert not machine.is_active(LEARNER)
    assert machine.run("find", "/etc/systemd/system", "-name", "bodyschema-*").stdout == ""
    assert machine.has("/var/lib/bodyschema/arm/pairs.sqlite")
