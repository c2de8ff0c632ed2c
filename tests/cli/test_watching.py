"""`bodyschema watch cameras`, and the other commands' messages about cameras."""

from __future__ import annotations

import http.client
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from board_renderer import webcams
from shown_board import known_rig
from small_arm import write_small_arm

from bodyschema.cli.cameras.watching import MjpegServer, _Settings
from bodyschema.cli.hardware.robot_template import EXAMPLE, CameraFindings, robot_toml
from bodyschema.cli.main import app
from bodyschema.daemon.config import Config
from bodyschema.daemon.wiring.cameras import camera_checks
from bodyschema.daemon.wiring.wiring import check_sources
from bodyschema.interfaces.errors import ConfigError
from bodyschema.vision.rig.rig_file import write_rig

STEREO = """
focal_px = 300.0
principal_point_px = [159.5, 119.5]
baseline_m = 0.1
image_size_px = [320, 240]
"""
SERVOS = """
[drivers.serial_lines]
port = "/dev/serial/by-id/none"
[[drivers.serial_lines.encoders]]
joint = "waist"
[[drivers.serial_lines.encoders]]
joint = "shoulder"
"""
IMAGES = '\n[vision.cameras.images]\nleft = "l_*.png"\nright = "r_*.png"\nfps = 10.0\nspeed = {speed}\n'


def write_robot(folder: Path, tables: str, stereo: str = STEREO) -> Path:
    file = write_small_arm(folder, tables)
    text = file.read_text()
    file.write_text(text.replace("[camera]\n", f"[camera]{stereo}\n"))
    return file


def write_images(folder: Path, count: int = 4) -> None:
    """Write images of a red ball at 0.5 m before a grey wall; in the last pair the right image is 4 rows lower."""
    for number in range(count):
        for eye, u in (("l", 160), ("r", 100)):
            image = np.full((240, 320, 3), 128, np.uint8)
            v = 120 + 4 * (number == count - 1 and eye == "r")
            cv2.circle(image, (16 * u, 16 * v), 16 * 12, (30, 30, 220), -1, cv2.LINE_AA, 4)
            cv2.imwrite(str(folder / f"{eye}_{number}.png"), cv2.GaussianBlur(image, (5, 5), 0.7))


def run(*words: str) -> None:
    app(list(words), result_action="return_value")


def test_saved_pictures_show_the_other_camera_s_ray(tmp_path, capsys) -> None:
    write_images(tmp_path)
    file = write_robot(tmp_path, IMAGES.format(speed=0.0))
    run("watch", "cameras", "--robot", str(file), "--out", str(tmp_path / "seen"), "--every", "0")
    assert "4 frames, the marker in 3; rows differ: 1" in capsys.readouterr().out
    pictures = sorted((tmp_path / "seen").iterdir())
    assert [picture.name for picture in pictures] == [f"{number:06}.jpg" for number in (1, 2, 3, 4)]
    picture = cv2.imread(str(pictures[0]))
    assert picture is not None
    row = picture[120, :60].astype(int)  # the other camera's ray, through the ball: yellow on grey
    assert (row[:, 2] - row[:, 0]).min() > 60


def test_uncalibrated_cameras_are_shown_unrectified(tmp_path, capsys) -> None:
    write_images(tmp_path)
    file = write_robot(tmp_path, IMAGES.format(speed=0.0), "")
    run("watch", "cameras", "--robot", str(file), "--out", str(tmp_path / "seen"), "--every", "0")
    said = capsys.readouterr().out
    assert "nothing says how the cameras see" in said
    assert "4 frames\n" in said


def test_a_browser_gets_the_newest_picture() -> None:
    with MjpegServer(0) as server:
        server.show(b"old")
        server.show(b"newest")
        connection = http.client.HTTPConnection(server.address.split("/")[2])
        connection.request("GET", "/stream")
        answer = connection.getresponse()
        assert answer.headers["Content-Type"].startswith("multipart/x-mixed-replace")
        lines = [answer.readline() for _ in range(4)]
        assert b"Content-Length: 6\r\n" in lines
        assert answer.read(6) == b"newest"
        connection.close()


@pytest.mark.parametrize("path", ["/", "/stream", "/else"])
@pytest.mark.parametrize("hosts", [["evil.example:8080"], [""], [], ["127.0.0.1", "evil.example"], ["127.0.0.1.evil"]])
def test_pictures_are_refused_under_another_host(path: str, hosts: list[str]) -> None:
    """Check the case of DNS rebinding, when another site's name resolves to this server."""
    with MjpegServer(0) as server:
        server.show(b"secret")
        answer = asked(server, path, hosts)
    assert answer.status == 403
    assert b"use 127.0.0.1 or localhost" in answer.read()


@pytest.mark.parametrize("host", ["127.0.0.1:8080", "localhost", "LOCALHOST:9000", "[::1]:8080"])
def test_pictures_are_served_to_this_machine(host: str) -> None:
    with MjpegServer(0) as server:
        answer = asked(server, "/", [host])
    assert answer.status == 200
    assert answer.headers["Cross-Origin-Resource-Policy"] == "same-origin"


def test_too_many_viewers_of_pictures_are_refused() -> None:
    with MjpegServer(0) as server:
        server.show(b"picture")
        streams = [asked(server, "/stream", ["localhost"]) for _ in range(_Settings.max_viewers)]
        assert {answer.status for answer in streams} == {200}
        assert asked(server, "/stream", ["localhost"]).status == 503
        assert asked(server, "/", ["localhost"]).status == 200
        for answer in streams:
            answer.close()


def asked(server: MjpegServer, path: str, hosts: list[str]) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection(server.address.split("/")[2], timeout=300)
    connection.putrequest("GET", path, skip_host=True)
    for host in hosts:
        connection.putheader("Host", host)
    connection.endheaders()
    return connection.getresponse()


def test_a_port_that_is_taken_is_named() -> None:
    with MjpegServer(0) as server:
        port = int(server.address.split(":")[2].strip("/"))
        with pytest.raises(ConfigError, match=f"port {port} cannot be used"), MjpegServer(port):
            raise AssertionError


def test_joints_without_cameras_error_names_missing_table(tmp_path) -> None:
    config = Config.load(write_robot(tmp_path, SERVOS), {})
    with pytest.raises(ConfigError, match=r"no cameras are configured. Add the table \[vision.cameras\]"):
        check_sources(config, sim=False)


def test_uncalibrated_cameras_error_names_both_remedies(tmp_path) -> None:
    config = Config.load(write_robot(tmp_path, SERVOS + IMAGES.format(speed=1.0), ""), {})
    with pytest.raises(ConfigError, match=r"nothing says how the cameras see.*calibrate cameras.*\[camera\]"):
        check_sources(config, sim=False)


def test_images_off_the_encoder_clock_are_refused(tmp_path) -> None:
    config = Config.load(write_robot(tmp_path, SERVOS + IMAGES.format(speed=0.0)), {})
    with pytest.raises(ConfigError, match="speed 0 are not on the encoders' clock"):
        check_sources(config, sim=False)


def test_a_misspelt_key_is_named_with_its_line(tmp_path) -> None:
    file = write_robot(tmp_path, IMAGES.format(speed=1.0).replace("fps", "fsp"))
    with pytest.raises(ConfigError, match=r"robot.toml, line \d+: unknown key 'fsp'.*Did you mean 'fps'"):
        Config.load(file, {})


def test_config_check_says_where_images_come_from(tmp_path, capsys) -> None:
    run("config", "--robot", str(write_robot(tmp_path, IMAGES.format(speed=1.0))))
    assert "images l_*.png and r_*.png, at 1 times their speed" in capsys.readouterr().out


def test_config_check_names_a_damaged_calibration(tmp_path, capsys) -> None:
    calibrated = IMAGES.format(speed=1.0).replace("[vision", '[vision.cameras]\ncalibration = "c.toml"\n[vision', 1)
    file = write_robot(tmp_path, calibrated)
    run("config", "--robot", str(file))
    assert "calibrated by c.toml, which is not there yet" in capsys.readouterr().out
    (tmp_path / "c.toml").write_text('format = "bodyschema stereo rig 1"\n[left', encoding="utf-8")
    with pytest.raises(ConfigError, match=r"c.toml: not TOML: .* calibrate again"):
        app(["config", "--robot", str(file)], exit_on_error=False, result_action="return_value")
    assert "is in order" not in capsys.readouterr().out


def test_calibrated_image_files_need_no_matching_serials(tmp_path, capsys) -> None:
    write_images(tmp_path)
    rig = known_rig(webcams(np.random.default_rng(1), size_px=(320, 240)), serials=("A1", "B2"))
    write_rig(rig, tmp_path / "c.toml")
    calibrated = IMAGES.format(speed=0.0).replace("[vision", '[vision.cameras]\ncalibration = "c.toml"\n[vision', 1)
    run("watch", "cameras", "--robot", str(write_robot(tmp_path, calibrated)), "--out", str(tmp_path / "seen"))
    assert "4 frames, the marker in " in capsys.readouterr().out


def test_doctor_names_a_camera_that_is_not_there(tmp_path) -> None:
    cameras = '[vision.cameras.side_by_side]\ndevice = "/dev/v4l/by-id/none"\nimage_size_px = [320, 240]\n'
    checks = list(camera_checks(Config.load(write_robot(tmp_path, cameras), {})))
    assert [(check.state, "is not there" in check.said) for check in checks] == [("wrong", True)]


def test_doctor_opens_the_configured_images(tmp_path) -> None:
    write_images(tmp_path)
    checks = list(camera_checks(Config.load(write_robot(tmp_path, IMAGES.format(speed=1.0)), {})))
    assert [check.state for check in checks] == ["ok"]
    assert "320x240 pixels" in checks[0].said


def test_two_plugged_in_cameras_become_robot_eyes() -> None:
    text = robot_toml(EXAMPLE, CameraFindings(["/dev/v4l/by-id/a", "/dev/v4l/by-id/b"]))
    assert 'left = "/dev/v4l/by-id/a"\nright = "/dev/v4l/by-id/b"\n' in text


def test_camera_tables_without_cameras_are_commented_out() -> None:
    lines = robot_toml(EXAMPLE).split("docs/cameras.md has the rest.\n")[1].splitlines()
    assert all(line.startswith("#") for line in lines)
    assert json.dumps("/dev/v4l/by-id/usb-LEFT-video-index0") in "\n".join(lines)


def swapped(folder: Path) -> None:
    write_images(folder)
    for left in sorted(folder.glob("l_*.png")):
        right = left.with_name(left.name.replace("l_", "r_"))
        images = cv2.imread(str(left)), cv2.rotate(cv2.imread(str(right)), cv2.ROTATE_180)
        cv2.imwrite(str(left), np.roll(images[0], 30, axis=0))
        cv2.imwrite(str(right), images[1])


def test_commonest_frame_fault_is_explained_with_its_remedy(tmp_path, capsys) -> None:
    swapped(tmp_path)
    robot = write_robot(tmp_path, IMAGES.format(speed=0.0))
    run("watch", "cameras", "--robot", str(robot), "--out", str(tmp_path / "out"), "--every", "0")
    said = " ".join(capsys.readouterr().out.split())
    assert "the marker in 0; rows differ: 4. Are the cameras exchanged, one upside down, or moved?" in said


def test_black_image_files_suggest_a_lens_cap(tmp_path, capsys) -> None:
    write_images(tmp_path)
    for right in tmp_path.glob("r_*.png"):
        cv2.imwrite(str(right), np.full((240, 320, 3), 5, np.uint8))
    robot = write_robot(tmp_path, IMAGES.format(speed=0.0))
    run("watch", "cameras", "--robot", str(robot), "--out", str(tmp_path / "out"), "--every", "0")
    assert "the right eye's image is black: is the lens cap on?" in " ".join(capsys.readouterr().out.split())
