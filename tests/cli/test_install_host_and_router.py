"""`bodyschema install service` of several robots and `install router`: the units, held to systemd's own tools."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from security_recipe import ROOT, SEVERAL, carried_out
from small_arm import write_small_arm

from bodyschema.cli.install.router import RouterConfig
from bodyschema.cli.install.units import FOLDER, Installed, of_router
from bodyschema.cli.main import command_line
from bodyschema.daemon.transport.identity import Identity
from bodyschema.interfaces.errors import ConfigError

EXPOSURE = 2.0
analyze = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="no systemd-analyze; to run it: apt-get install systemd"
)


def install(*arguments: object) -> None:
    command_line("install")(["install", *map(str, arguments)], exit_on_error=False, result_action="return_value")


def write_robot(folder: Path, name: str, tables: str = "") -> Path:
    folder.mkdir(parents=True)
    file = write_small_arm(folder, tables)
    file.write_text(file.read_text().replace('name = "arm"', f'name = "{name}"'))
    return file


@pytest.fixture
def robots(tmp_path: Path) -> Path:
    """Return the folder of two robots' descriptions."""
    write_robot(tmp_path / "robots" / "left", "left", '[zenoh]\nlearner = "tcp/127.0.0.1:7458"\n')
    write_robot(tmp_path / "robots" / "right", "right")
    return tmp_path / "robots"


@pytest.fixture(scope="module")
def router_file(hidden_folder) -> Path:
    (hidden_folder / "pki").mkdir()
    folder = carried_out(hidden_folder / "pki")
    shutil.copy(SEVERAL / "router.toml", folder)
    return folder / "router.toml"


def drop_in(root: Path, name: str) -> str:
    return (root / FOLDER / f"bodyschema-learner@{name}.service.d" / "robot.conf").read_text("utf-8")


def values(text: str, key: str) -> list[str]:
    return re.findall(rf"^{key}=(.*)$", text, re.MULTILINE)


def systemd_analyze(root: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    paths = os.environ | {"SYSTEMD_UNIT_PATH": f"{root / FOLDER}:/lib/systemd/system"}
    command = ["systemd-analyze", *arguments]
    return subprocess.run(command, env=paths, capture_output=True, text=True, check=False)


def assert_in_order(root: Path, unit: str) -> None:
    verified = systemd_analyze(root, "verify", "--man=no", unit)
    assert (verified.returncode, verified.stderr) == (0, "")
    rated = systemd_analyze(root, "security", "--offline=true", "--no-pager", unit)
    assert float(re.search(r"exposure level for \S+: ([0-9.]+)", rated.stdout)[1]) <= EXPOSURE


# --- one learner for several robots


def test_one_learner_serves_all_robots_of_a_folder(tmp_path, robots, capsys) -> None:
    install("service", "--robot", robots, "--name", "lab", "--user", "daemon", "--yes", "--root", tmp_path)
    start = values(drop_in(tmp_path, "lab"), "ExecStart")
    assert start[0] == ""  # the template's is for one robot
    assert re.findall(r"--robot (\S+)", start[1]) == [str(robots / name / "robot.toml") for name in ("left", "right")]
    assert values(drop_in(tmp_path, "lab"), "StateDirectory") == ["", "bodyschema/left bodyschema/right"]
    assert "sudo systemctl enable --now bodyschema-learner@lab.service" in capsys.readouterr().out


@analyze
def test_systemd_finds_the_learner_of_several_in_order(tmp_path, robots) -> None:
    install("service", "--robot", robots, "--name", "lab", "--user", "daemon", "--yes", "--root", tmp_path)
    assert_in_order(tmp_path, "bodyschema-learner@lab.service")


def test_shared_learner_installs_no_sampler(tmp_path, robots) -> None:
    install("service", "--robot", robots, "--user", "daemon", "--yes", "--root", tmp_path)
    assert not list((tmp_path / FOLDER).glob("bodyschema-sampler*"))
    with pytest.raises(ConfigError, match="each robot has a sampler of its own"):
        install("service", "--robot", robots, "--only", "sampler", "--dry-run", "--root", tmp_path)


def test_a_robot_is_not_given_a_second_learner(tmp_path, robots) -> None:
    left = robots / "left" / "robot.toml"
    alone = ("service", "--robot", left, "--only", "learner", "--user", "daemon", "--yes", "--root", tmp_path)
    together = ("service", "--robot", robots, "--user", "daemon", "--yes", "--root", tmp_path)
    install(*alone)
    with pytest.raises(ConfigError, match="left has a learner on this machine already, bodyschema-learner@left"):
        install(*together)
    install("service", "--robot", left, "--only", "learner", "--uninstall", "--yes", "--root", tmp_path)
    install(*together)
    with pytest.raises(ConfigError, match="left has a learner on this machine already, bodyschema-learner@fleet"):
        install(*alone)


def test_shared_learner_rejects_the_name_of_a_robot(tmp_path, robots) -> None:
    with pytest.raises(ConfigError, match="left is one of the robots"):
        install("service", "--robot", robots, "--name", "left", "--user", "daemon", "--yes", "--root", tmp_path)


def test_uninstall_removes_the_learner_of_several(tmp_path, robots) -> None:
    install("service", "--robot", robots, "--user", "daemon", "--yes", "--root", tmp_path)
    install("service", "--robot", robots, "--uninstall", "--yes", "--root", tmp_path)
    assert list((tmp_path / FOLDER).iterdir()) == []


# --- the router


def test_router_unit_mounts_its_file_and_certificates(tmp_path, router_file, hidden_folder) -> None:
    file = hidden_folder / "elsewhere" / "router.toml"
    file.parent.mkdir()
    text, certificates = re.subn(r'"(\S+\.(?:pem|key))"', rf'"{router_file.parent}/\1"', router_file.read_text("utf-8"))
    file.write_text(text, encoding="utf-8")
    install("router", file, "--user", "daemon", "--yes", "--root", tmp_path)
    unit = (tmp_path / FOLDER / "bodyschema-router.service").read_text("utf-8")
    assert values(unit, "ExecStart")[0].endswith(f"router {file}")
    assert values(unit, "User") == ["daemon"]
    seen = [Path(value.removeprefix("-")) for value in values(unit, "BindReadOnlyPaths")]
    assert certificates == 3
    assert {file.parent, router_file.parent} <= set(seen)


@analyze
def test_systemd_finds_the_router_in_order(tmp_path, router_file) -> None:
    install("router", router_file, "--user", "daemon", "--yes", "--root", tmp_path)
    assert_in_order(tmp_path, "bodyschema-router.service")


def test_a_wrong_router_file_installs_nothing(tmp_path, router_file) -> None:
    wrong = router_file.with_name("wrong.toml")
    wrong.write_text(router_file.read_text().replace("tls/", "tcp/"))
    with pytest.raises(ConfigError, match="is no endpoint with TLS"):
        install("router", wrong, "--user", "daemon", "--yes", "--root", tmp_path)
    assert not (tmp_path / "etc").exists()


def test_uninstall_removes_the_router_and_needs_no_file(tmp_path, router_file, capsys) -> None:
    install("router", router_file, "--user", "daemon", "--yes", "--root", tmp_path)
    install("router", "gone.toml", "--uninstall", "--yes", "--root", tmp_path)
    assert list((tmp_path / FOLDER).iterdir()) == []
    install("router", "gone.toml", "--uninstall", "--yes", "--root", tmp_path)
    assert "has installed nothing here" in capsys.readouterr().out


def test_shipped_router_unit_matches_the_generated_unit(router_file) -> None:
    etc = Path("/etc/bodyschema")
    config = RouterConfig(etc / "router.toml", RouterConfig.load(router_file).tables, Identity(etc / "ca.pem"))
    shown = (ROOT / "deploy" / "systemd" / "bodyschema-router.service").read_text(encoding="utf-8")
    assert shown == of_router(config, "bodyschema", Installed(("/opt/bodyschema/bin/bodyschema",), (), 252))
