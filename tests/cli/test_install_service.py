"""`bodyschema install service`: the units, held to systemd's own tools where they are."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
from small_arm import write_small_arm

from bodyschema.cli.install import machine_files
from bodyschema.cli.install.service_files import ServiceFiles, user_for
from bodyschema.cli.install.units import FOLDER, PROCESSES, Installed, devices_of, hidden, of_robot, template
from bodyschema.cli.main import command_line
from bodyschema.daemon.config import Config
from bodyschema.daemon.transport.identity import TlsConfig
from bodyschema.daemon.transport.zenoh_config import ZenohConfig
from bodyschema.interfaces.errors import ConfigError
from bodyschema.robot.plugins import PluginConfig

ROOT = Path(__file__).parents[2]
EXPOSURE = 2.0
PORT = "/dev/serial/by-id/usb-FTDI_USB__-__Serial_Converter_FT4THV5P-if00-port0"
EYES = ("/dev/v4l/by-id/usb-left-video-index0", "/dev/v4l/by-id/usb-right-video-index0")
HARDWARE = f"""
[vision.cameras.two]
left = "{EYES[0]}"
right = "{EYES[1]}"
image_size_px = [640, 480]
[drivers.dynamixel.buses.arm]
port = "{PORT}"
[[drivers.dynamixel.servos]]
joint = "waist"
id = 1
model = "XM430-W350"
[[drivers.dynamixel.servos]]
joint = "shoulder"
id = 2
model = "XM430-W350"
"""
STEREO = "focal_px = 600.0\nprincipal_point_px = [319.5, 239.5]\nbaseline_m = 0.2\nimage_size_px = [640, 480]\n"
HERE = Installed(("/bin/true",), (Path("/home/pi/arm/.venv"), Path("/usr")), 252)
analyze = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="no systemd-analyze; to run it: apt-get install systemd"
)


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    folder = tmp_path / "robot"
    folder.mkdir()
    return write_small_arm(folder, STEREO + HARDWARE)


@pytest.fixture
def config(robot: Path) -> Config:
    return Config.load(robot, {})


def install(*arguments: object) -> None:
    command_line("install")(
        ["install", "service", *map(str, arguments)], exit_on_error=False, result_action="return_value"
    )


def written(folder: Path, config: Config) -> dict[Path, str]:
    """Install the units of `config` in `folder`, as on a machine."""
    files = ServiceFiles(config.robot.name, root=folder)
    texts = files.texts(config, "daemon", HERE)
    files.install(texts)
    return texts


def unit_path(folder: Path) -> dict[str, str]:
    return os.environ | {"SYSTEMD_UNIT_PATH": f"{folder / FOLDER}:/lib/systemd/system"}


@analyze
@pytest.mark.parametrize("process", PROCESSES)
def test_systemd_finds_nothing_to_complain_of(tmp_path, config, process) -> None:
    written(tmp_path, config)
    command = ["systemd-analyze", "verify", "--man=no", f"bodyschema-{process}@arm.service"]
    done = subprocess.run(command, env=unit_path(tmp_path), capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def exposure(folder: Path, process: str) -> float:
    command = ["systemd-analyze", "security", "--offline=true", "--no-pager", f"bodyschema-{process}@arm.service"]
    done = subprocess.run(command, env=unit_path(folder), capture_output=True, text=True, check=False)
    return float(re.search(r"exposure level for \S+: ([0-9.]+)", done.stdout)[1])


@analyze
@pytest.mark.parametrize("process", PROCESSES)
def test_the_sandbox_leaves_little_exposed(tmp_path, config, process) -> None:
    written(tmp_path, config)
    assert exposure(tmp_path, process) <= EXPOSURE


@analyze
@pytest.mark.parametrize("process", PROCESSES)
def test_sandbox_exposure_stays_low_with_remote_peer(tmp_path, config, process) -> None:
    zenoh = config.tables.zenoh.__class__(sampler="tcp/192.0.2.1:7447")
    tables = config.tables.__class__(**{**_fields(config.tables), "zenoh": zenoh})
    written(tmp_path, config.with_tables(tables))
    assert "IPAddressAllow=any" in of_robot(process, config.with_tables(tables), "daemon", HERE)
    assert exposure(tmp_path, process) <= EXPOSURE


def _fields(struct: object) -> dict[str, object]:
    return {name: getattr(struct, name) for name in struct.__struct_fields__}


def values(text: str, key: str) -> list[str]:
    return re.findall(rf"^{key}=(.*)$", text, re.MULTILINE)


def test_sampler_opens_only_configured_ports_and_cameras(config) -> None:
    own = of_robot("sampler", config, "daemon", HERE)
    assert values(own, "DeviceAllow") == [f"{PORT} rw", f"{EYES[0]} rw", f"{EYES[1]} rw"]
    assert values(template("sampler", HERE), "DevicePolicy") == ["closed"]
    assert values(template("sampler", HERE), "DeviceAllow") == []


def test_only_sampler_may_use_plugin_devices_and_network(config) -> None:
    plugin = PluginConfig("field_bus", devices=("/dev/field_bus0",), network=True)
    drivers = config.tables.drivers.__class__(plugin=plugin)
    config = config.with_tables(config.tables.__class__(**{**_fields(config.tables), "drivers": drivers}))
    own = of_robot("sampler", config, "daemon", HERE)
    assert "/dev/field_bus0 rw" in values(own, "DeviceAllow")
    assert values(own, "IPAddressAllow") == ["any"]
    learner = of_robot("learner", config, "daemon", HERE)
    assert values(learner, "DeviceAllow") == values(learner, "IPAddressAllow") == []


def test_the_learner_may_open_no_device(config) -> None:
    assert values(of_robot("learner", config, "daemon", HERE), "DeviceAllow") == []
    assert values(template("learner", HERE), "PrivateDevices") == ["yes"]


def test_port_without_device_node_needs_no_rule(tmp_path) -> None:
    robot = write_small_arm(tmp_path, STEREO + HARDWARE.replace(PORT, "./bus"))
    assert devices_of(Config.load(robot, {})) == list(EYES)


def test_local_endpoints_allow_no_remote_address(config) -> None:
    assert values(template("sampler", HERE), "IPAddressDeny") == ["any"]
    assert values(of_robot("sampler", config, "daemon", HERE), "IPAddressAllow") == []


def test_remote_router_is_allowed_and_certificates_mounted(config) -> None:
    zenoh = ZenohConfig(router="tls/192.0.2.1:7447", tls=TlsConfig(ca="/home/pi/keys/ca.pem"))
    tables = config.tables.__class__(**{**_fields(config.tables), "zenoh": zenoh})
    own = of_robot("learner", config.with_tables(tables), "daemon", HERE)
    assert "-/home/pi/keys" in values(own, "BindReadOnlyPaths")
    assert values(own, "IPAddressAllow") == ["any"]


def test_only_needed_home_folders_are_visible() -> None:
    folders = ["/home/pi/arm/.venv", "/home/pi/arm", "/usr/lib", "/opt/arm", "/root/.pyenv/versions/3.11"]
    assert hidden(map(Path, folders)) == [Path("/home/pi/arm"), Path("/root/.pyenv/versions/3.11")]


def test_custom_state_dir_is_writable(tmp_path) -> None:
    robot = write_small_arm(tmp_path, '[daemon]\nstate_dir = "/srv/pairs of 100 %"\n')
    own = of_robot("sampler", Config.load(robot, {}), "daemon", HERE)
    assert values(own, "ReadWritePaths") == ['"-/srv/pairs of 100 %%"']


def test_new_systemd_gets_growing_restart_delays() -> None:
    new = replace(HERE, systemd=254)
    assert values(template("sampler", new), "RestartSteps") == ["6"]
    assert values(template("sampler", HERE), "RestartSteps") == []  # 252 would complain of it


@pytest.mark.parametrize("process", PROCESSES)
def test_shipped_units_match_the_generated_units(process) -> None:
    shown = (ROOT / "deploy" / "systemd" / f"bodyschema-{process}@.service").read_text(encoding="utf-8")
    assert shown == template(process, Installed(("/opt/bodyschema/bin/bodyschema",), (), 252))


def test_documented_patterns_of_units_end_in_service() -> None:
    shown = (ROOT / "docs" / "operation.md").read_text(encoding="utf-8")
    patterns = re.findall(r"(?:systemctl|journalctl) .*'(bodyschema-\*[^']*)'", shown)
    assert len(patterns) >= 4
    assert [pattern for pattern in patterns if not pattern.endswith(".service")] == []


# --- the command


def test_yes_writes_units_and_prints_start_command(tmp_path, robot, capsys) -> None:
    install("--robot", robot, "--user", "daemon", "--yes", "--root", tmp_path)
    assert len(ServiceFiles("arm", root=tmp_path).installed()) == 4
    enable = "sudo systemctl enable --now bodyschema-sampler@arm.service bodyschema-learner@arm.service"
    assert enable in capsys.readouterr().out


def test_a_dry_run_shows_them_and_writes_nothing(tmp_path, robot, capsys) -> None:
    install("--robot", robot, "--user", "daemon", "--dry-run", "--root", tmp_path)
    assert not (tmp_path / "etc").exists()
    assert f"DeviceAllow={PORT} rw" in capsys.readouterr().out


def test_installing_makes_the_state_dir(tmp_path, robot) -> None:
    with robot.open("a", encoding="utf-8") as toml:
        toml.write('[daemon]\nstate_dir = "/srv/arms/pairs"\n')
    words = ("--robot", robot, "--user", "daemon", "--root", tmp_path)
    install(*words, "--dry-run")
    assert not (tmp_path / "srv").exists()
    install(*words, "--yes")
    folder = tmp_path / "srv" / "arms" / "pairs"
    assert folder.stat().st_mode & 0o777 == 0o750
    if os.geteuid() == 0:
        assert folder.owner() == folder.parent.owner() == "daemon"


def test_existing_units_are_left_unchanged(tmp_path, robot, capsys) -> None:
    install("--robot", robot, "--user", "daemon", "--yes", "--root", tmp_path)
    units = [file for file in (tmp_path / FOLDER).rglob("*") if file.is_file()]
    assert len(units) >= len(PROCESSES)
    for file in units:
        os.utime(file, (0, 0))
    install("--robot", robot, "--user", "daemon", "--yes", "--root", tmp_path)
    assert "All of it is there already" in capsys.readouterr().out
    assert {file.stat().st_mtime for file in units} == {0}


def test_uninstall_leaves_what_other_robots_need(tmp_path, robot, config) -> None:
    install("--robot", robot, "--user", "daemon", "--yes", "--root", tmp_path)
    other = robot.with_name("other.toml")
    other.write_text(robot.read_text().replace('name = "arm"', 'name = "leg"'))
    install("--robot", other, "--user", "daemon", "--yes", "--root", tmp_path)
    install("--robot", robot, "--uninstall", "--yes", "--root", tmp_path)
    left = sorted(path.name for path in (tmp_path / FOLDER).iterdir())
    assert left == [
        "bodyschema-learner@.service",
        "bodyschema-learner@leg.service.d",
        "bodyschema-sampler@.service",
        "bodyschema-sampler@leg.service.d",
    ]
    install("--robot", other, "--uninstall", "--yes", "--root", tmp_path)
    assert list((tmp_path / FOLDER).iterdir()) == []


def test_a_dry_run_of_uninstall_removes_nothing(tmp_path, robot) -> None:
    install("--robot", robot, "--user", "daemon", "--yes", "--root", tmp_path)
    install("--robot", robot, "--uninstall", "--dry-run", "--root", tmp_path)
    assert len(ServiceFiles("arm", root=tmp_path).installed()) == 4


def test_a_learner_alone_needs_no_hardware(tmp_path) -> None:
    robot = write_small_arm(tmp_path)
    install("--robot", robot, "--only", "learner", "--user", "daemon", "--yes", "--root", tmp_path)
    assert [path.parent.name for path in ServiceFiles("arm", root=tmp_path).installed()] == [
        "bodyschema-learner@arm.service.d",
        "system",
    ]


def test_a_robot_without_hardware_is_refused(tmp_path) -> None:
    robot = write_small_arm(tmp_path)
    with pytest.raises(ConfigError, match="no driver is configured"):
        install("--robot", robot, "--user", "daemon", "--yes", "--root", tmp_path)


@pytest.mark.parametrize(
    ("user", "said"),
    [("root", "is not to run as root"), ("nobody", "is not to run as nobody"), ("gnome", "no user 'gnome'")],
)
def test_service_user_must_exist_and_not_be_root(user, said) -> None:
    with pytest.raises(ConfigError, match=said):
        user_for(user)


def test_service_runs_as_the_sudo_user(monkeypatch) -> None:
    monkeypatch.setenv("SUDO_USER", "daemon")
    assert user_for(None) == "daemon"


def test_systemd_is_reloaded_on_this_machine_alone(tmp_path, config) -> None:
    ran: list[object] = []
    ServiceFiles("arm", root=tmp_path, run=ran.append).install({})
    ServiceFiles("arm", run=ran.append).install({})
    assert ran == [("systemctl", "daemon-reload")]


def test_unwritable_unit_folder_error_names_sudo_command(tmp_path, config, monkeypatch) -> None:
    (tmp_path / "etc").write_text("no folder")
    monkeypatch.setattr(machine_files.os, "geteuid", lambda: 1000)
    with pytest.raises(ConfigError, match=r"sudo .* install service --yes$"):
        written(tmp_path, config)
