"""Names, paths and sizes with a special meaning to the next program that reads them."""

from __future__ import annotations

from pathlib import Path

import pytest
from small_arm import URDF, write_small_arm

from bodyschema.cli.install.router import RouterConfig
from bodyschema.cli.install.service_files import ServiceFiles
from bodyschema.cli.install.units import Installed, of_host, of_robot
from bodyschema.daemon.config import Config
from bodyschema.interfaces.errors import ConfigError
from bodyschema.robot.urdf import UrdfTree

HERE = Installed(("/opt/a b/python", "-P", "-m", "bodyschema"), (Path("/usr"),), 252)
STEREO = "focal_px = 600.0\nprincipal_point_px = [319.5, 239.5]\nbaseline_m = 0.2\nimage_size_px = [640, 480]\n"


def refused(tmp_path: Path, old: str, new: str, said: str) -> None:
    """Check that robot.toml is refused, with this message, after `old` in it has become `new`."""
    file = write_small_arm(tmp_path, STEREO)
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(ConfigError, match=said):
        Config.load(file, {})


@pytest.mark.parametrize(
    "name", ["arm\\n", "arm\\n[Service]", "a/b", "..", "a b", "*", "@a", "", "a\\u0000", "ä", "-a"]
)
def test_a_robots_name_is_one_word(tmp_path: Path, name: str) -> None:
    refused(tmp_path, 'name = "arm"', f'name = "{name}"', "is no name for zenoh keys")


def test_a_routers_robot_is_one_word(tmp_path: Path) -> None:
    text = 'listen = "tls/127.0.0.1:7450"\n[tls]\nca = "a"\ncertificate = "b"\n[access."arm\\n"]\nviewer = ["anna"]\n'
    (tmp_path / "router.toml").write_text(text)
    with pytest.raises(ConfigError, match=r"'arm\\n' is no robot's name"):
        RouterConfig.load(tmp_path / "router.toml")


@pytest.mark.parametrize(("old", "key"), [("arm.urdf", "robot.urdf"), ("waist", "robot.joints"), ("base", "camera")])
def test_no_name_or_path_has_a_nul(tmp_path: Path, old: str, key: str) -> None:
    refused(tmp_path, f'"{old}"', f'"{old}\\u0000"', rf"{key}.*has the character U\+0000")


@pytest.mark.parametrize(
    ("value", "said"),
    [("[1000000000, 1000000000]", "16384"), ("[640, 100000]", "16384"), ("[0, 480]", ">= 1"), ("[-640, 480]", ">= 1")],
)
def test_impossible_image_size_is_refused(tmp_path: Path, value: str, said: str) -> None:
    refused(tmp_path, "[640, 480]", value, rf"line \d+: camera.image_size_px: expected `int` .*{said}")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('<axis xyz="0 1 0"/>', '<axis xyz="0 1e200 0"/>', "line 4: the axis of joint 'shoulder' has the length"),
        (
            '<axis xyz="0 1 0"/>',
            '<axis xyz="0 1e-200 0"/>',
            "line 4: the axis of joint 'shoulder' has the length 1e-200",
        ),
        ('<axis xyz="0 1 0"/>', '<axis xyz="0 1e-12 0"/>', "line 4: the axis of joint 'shoulder' has the length"),
        (
            'type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>\n<limit lower="-3"',
            'type="prismatic"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>\n<limit lower="-1e308"',
            "line 3: <limit> of joint 'waist' lets it slide 1e.308 m away. Give metres",
        ),
        ('"0.3 0 0"', '"1e300 0 0"', "line 4: the <origin> of joint 'shoulder' is 1e.300 m away. Give metres"),
    ],
)
def test_no_number_of_a_urdf_overflows(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in URDF
    (tmp_path / "arm.urdf").write_text(URDF.replace(old, new))
    with pytest.raises(ConfigError, match=said):
        UrdfTree.load(tmp_path / "arm.urdf")


# --- units of systemd


def in_folder(folder: Path) -> Config:
    folder.mkdir()
    return Config.load(write_small_arm(folder), {})


@pytest.mark.parametrize("name", ["a\nExecStartPre=true", "a\rb", "a\tb", "a\x1bb", "a\u2028b", "a\udc80b"])
def test_control_character_in_unit_folder_is_refused(tmp_path: Path, name: str) -> None:
    config = in_folder(tmp_path / name)
    for make in (lambda: of_robot("sampler", config, "pi", HERE), lambda: of_host([config], "pi", HERE)):
        with pytest.raises(ConfigError, match="cannot stand in a unit of systemd"):
            make()


def test_signs_of_systemd_in_a_path_stay_signs(hidden_folder: Path) -> None:
    config = in_folder(hidden_folder / 'a:b $HOME ${x} %h "c"')
    text = of_host([config], "pi", HERE)
    assert rf'"{hidden_folder}/a:b $$HOME $${{x}} %%h \"c\"/robot.toml"' in text
    assert rf'BindReadOnlyPaths="-{hidden_folder}/a:b $HOME ${{x}} %%h \"c\""' in text


@pytest.mark.parametrize("name", ["../../x", "a/b", "a\nb", "a\n", "", "a b", "%i"])
def test_a_services_name_is_one_word(name: str) -> None:
    with pytest.raises(ConfigError, match="is no name for a service"):
        ServiceFiles(name)


def test_a_users_own_drop_in_outlives_the_service(tmp_path: Path) -> None:
    config = in_folder(tmp_path / "robot")
    files = ServiceFiles("arm", ("learner",), tmp_path / "root")
    files.install(files.texts(config, "pi", HERE))
    own = next(file for file in files.installed() if file.name == "robot.conf").with_name("override.conf")
    own.write_text("[Service]\nMemoryMax=4G\n")
    files.uninstall()
    assert own.read_text() == "[Service]\nMemoryMax=4G\n"
