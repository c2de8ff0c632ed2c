"""`bodyschema calibrate cameras`, with --print-board and --check, from image files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import redirect_stdout
from functools import cache
from io import StringIO
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from board_renderer import Photographer, Printed, Taken
from shown_board import photographed, true_vector

from bodyschema.cli.cameras.calibration import NORMAL_95, CamerasFile, CheckFile
from bodyschema.cli.main import app
from bodyschema.interfaces.errors import ConfigError
from bodyschema.vision.board import Board, BoardDetector, Corners, NotFound
from bodyschema.vision.calibration.image_pairs import Images
from bodyschema.vision.calibration.report.page import to_its_interval
from bodyschema.vision.rig.rig_file import read_rig
from bodyschema.vision.rig.stereo_rig import CalibrationError

COUNT = 8  # pairs of images: the fewest that a calibration needs


@cache
def found_once(board: Board, shape: tuple[int, ...], image: bytes) -> Corners | NotFound:
    return _find(BoardDetector(board), np.frombuffer(image, np.uint8).reshape(shape))


_find = BoardDetector.find


@pytest.fixture(scope="module", autouse=True)
def corners_found_once() -> Iterator[None]:
    """Look for the board in each image once: several tests give the same images to a command."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(BoardDetector, "find", lambda self, image: found_once(self.board, image.shape, image.tobytes()))
        yield


def called(*arguments: object) -> None:
    app([*map(str, arguments)], exit_on_error=False, result_action="return_value")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Return a folder of image pairs with cameras.toml, and the output on a terminal of 80 columns."""
    folder = tmp_path_factory.mktemp("images")
    for pair in photographed(count=COUNT)[1]:
        cv2.imwrite(str(folder / f"left{pair.name}.png"), pair.left)
        cv2.imwrite(str(folder / f"right{pair.name}.png"), pair.right)
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(StringIO()) as said:
        patch.setenv("COLUMNS", "80")
        called("calibrate", "cameras", folder, "--out", folder / "cameras.toml", "--left-serial", "A1")
    (folder / "said.txt").write_text(said.getvalue(), encoding="utf-8")
    return folder


def test_a_folder_of_images_becomes_a_calibration(folder) -> None:
    rig = read_rig(folder / "cameras.toml")
    truth = photographed(count=COUNT)[0]
    assert abs(rig.baseline_m - truth.baseline_m) < 2.5 * rig.baseline_sigma_m
    assert np.abs((rig.vector - true_vector(truth)) / rig.sigma).max() < 5.0
    assert (rig.model, rig.serials) == ("pinhole", ("A1", ""))


def test_report_is_self_contained_with_every_image(folder) -> None:
    text = (folder / "cameras_report.html").read_text(encoding="utf-8")
    pairs = photographed(count=COUNT)[1]
    assert text.count("<img ") == 2 * len(pairs)
    assert "http" not in text
    for name in read_rig(folder / "cameras.toml").names:
        assert f"<td>{name}<" in text


def test_figures_fit_a_terminal_of_80_columns(folder) -> None:
    lines = (folder / "said.txt").read_text(encoding="utf-8").splitlines()
    assert max(len(line.rstrip()) for line in lines if "written" not in line) <= 80
    assert any(line.startswith("fx [px]") for line in lines)


def test_check_of_bumped_camera_exits_with_code_1(folder, tmp_path, capsys) -> None:
    truth, _, poses = photographed(count=COUNT)
    tilt = cv2.Rodrigues(np.radians([0.3, 0.0, 0.0]))[0]
    bumped = type(truth)(truth.left, truth.right, tilt @ truth.R, tilt @ truth.t_m)
    frame = Photographer(bumped, Printed(), Taken(), np.random.default_rng(1)).pair(*poses[4])
    cv2.imwrite(str(tmp_path / "left1.png"), frame.left)
    cv2.imwrite(str(tmp_path / "right1.png"), frame.right)
    with pytest.raises(SystemExit, match="1"):
        called("calibrate", "cameras", "--check", tmp_path, "--calibration", folder / "cameras.toml")
    said = " ".join(capsys.readouterr().out.split())
    assert "The calibration does not hold" in said
    assert "turned up or down by 0.3" in said


@pytest.mark.parametrize(
    ("left", "right", "said"),
    [
        (lambda pair: pair.right, lambda pair: pair.left, "left and right are exchanged"),
        pytest.param(
            lambda pair: pair.left,
            lambda pair: pair.right[::-1, ::-1],
            "the right image is upside down",
            marks=pytest.mark.soak,
        ),
        pytest.param(
            lambda pair: pair.left[::-1, ::-1],
            lambda pair: pair.right,
            "the left image is upside down",
            marks=pytest.mark.soak,
        ),
        pytest.param(
            lambda pair: pair.left[::-1, ::-1],
            lambda pair: pair.right[::-1, ::-1],
            "both images are upside down",
            marks=pytest.mark.soak,
        ),
    ],
)
def test_check_names_exchanged_or_upside_down_images(folder, tmp_path, capsys, left, right, said) -> None:
    pair = photographed(count=COUNT)[1][4]
    cv2.imwrite(str(tmp_path / "left1.png"), left(pair))
    cv2.imwrite(str(tmp_path / "right1.png"), right(pair))
    with pytest.raises(SystemExit, match="1"):
        called("calibrate", "cameras", "--check", tmp_path, "--calibration", folder / "cameras.toml", "--json")
    wrong = msgspec.json.decode(capsys.readouterr().out, type=CheckFile).wrong
    assert len(wrong) == 1
    assert said in wrong[0]


def test_check_picks_newest_view_by_numeric_order(folder, tmp_path, capsys) -> None:
    pair = photographed(count=COUNT)[1][4]
    for number in (2, 9, 10):
        cv2.imwrite(str(tmp_path / f"left{number}.png"), pair.left)
        cv2.imwrite(str(tmp_path / f"right{number}.png"), pair.right)
    called("calibrate", "cameras", "--check", tmp_path, "--calibration", folder / "cameras.toml")
    said = capsys.readouterr().out
    assert said.startswith("view 10: ")
    assert "The calibration holds" in said


def test_unmeasured_ruler_is_reported(folder) -> None:
    said = " ".join((folder / "said.txt").read_text(encoding="utf-8").split())
    assert "No image shows whether the board has its stated size" in said


def test_images_side_by_side_are_split(tmp_path, folder, capsys) -> None:
    pair = photographed(count=COUNT)[1][4]
    cv2.imwrite(str(tmp_path / "both.png"), np.hstack([pair.left, pair.right]))
    called(
        "calibrate",
        "cameras",
        "--check",
        tmp_path,
        "--side-by-side",
        "--calibration",
        folder / "cameras.toml",
        "--json",
    )
    assert msgspec.json.decode(capsys.readouterr().out, type=CheckFile).holds


@pytest.mark.parametrize(
    ("left", "right", "patterns"),
    [
        ("left/a.png", "right/a.png", (None, None)),
        ("a_l.png", "a_r.png", (None, None)),
        ("cam0_007.jpg", "cam1_007.jpg", ("cam0_*", "cam1_*")),
    ],
)
def test_pairs_are_found_by_their_names(tmp_path, left, right, patterns) -> None:
    for name in (left, right):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    [pair] = Images(tmp_path, *patterns).files()
    assert (pair.left, pair.right) == (tmp_path / left, tmp_path / right)


def test_folder_without_pairs_error_names_expected_filenames(tmp_path) -> None:
    with pytest.raises(CalibrationError, match=r"no pairs of images. Name them left01.png and right01.png"):
        called("calibrate", "cameras", tmp_path)


def test_a_file_that_is_no_image_is_named(tmp_path) -> None:
    (tmp_path / "left1.png").write_bytes(b"not an image")
    (tmp_path / "right1.png").write_bytes(b"")
    with pytest.raises(CalibrationError, match=r"left1.png: no image that can be read"):
        called("calibrate", "cameras", tmp_path)


def test_wrong_number_of_squares_is_reported(folder, tmp_path) -> None:
    with pytest.raises(CalibrationError, match=r"the board has 8x6 squares, not 7x5. Give --squares 8x6"):
        called("calibrate", "cameras", folder, "--squares", "7x5", "--out", tmp_path / "c.toml")


def test_a_refused_calibration_writes_nothing(folder, tmp_path) -> None:
    with pytest.raises(CalibrationError, match="which would make the squares"):
        called("calibrate", "cameras", folder, "--baseline-mm", 200, "--out", tmp_path / "c.toml", "--lens", "pinhole")
    assert not (tmp_path / "c.toml").exists()


@pytest.mark.soak
def test_the_ruler_on_the_print_scales_the_baseline(folder, tmp_path, capsys) -> None:
    out = tmp_path / "c.toml"
    called("calibrate", "cameras", folder, "--ruler-mm", 0.97 * 240, "--out", out, "--lens", "pinhole", "--json")
    found = msgspec.json.decode(capsys.readouterr().out, type=CamerasFile)
    assert found.baseline_mm == pytest.approx(970 * photographed(count=COUNT)[0].baseline_m, rel=0.01)
    assert (len(found.parameters), len(found.held_out_by_model_px)) == (24, 1)
    assert found.right_camera is not None
    place, covariance = np.array(found.right_camera.translation_m), np.array(found.right_camera.covariance)
    assert 1e3 * np.linalg.norm(place) == pytest.approx(found.baseline_mm)
    along = place / np.linalg.norm(place)
    sigma_m = np.sqrt(along @ covariance.reshape(6, 6)[:3, :3] @ along)
    assert 1e3 * NORMAL_95 * sigma_m == pytest.approx(found.baseline_half_width_mm, rel=1e-3)


@pytest.mark.parametrize(
    ("value", "half_width", "shown"),
    [
        (592.4, 0.15, ("592.40", "± 0.15")),
        (-0.00035163, 5.5e-5, ("-0.000352", "± 0.000055")),
        (0.013662, 0.018, ("0.014", "± 0.018")),
        (1234.5, 120.0, ("1234", "± 120")),
        (3.0, 0.0, ("3", "± 0")),
    ],
)
def test_value_is_rounded_to_its_interval(value, half_width, shown) -> None:
    assert to_its_interval(value, half_width) == shown


@pytest.mark.parametrize("ending", ["pdf", "svg"])
def test_the_board_is_written(tmp_path, ending, capsys) -> None:
    called("calibrate", "cameras", "--print-board", "--out", tmp_path / f"board.{ending}")
    assert (tmp_path / f"board.{ending}").stat().st_size > 4000
    assert "measure both rulers: 240 mm below, 180 mm beside the board" in capsys.readouterr().out


def test_a_board_of_another_ending_is_refused(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"neither \.pdf nor \.svg"):
        called("calibrate", "cameras", "--print-board", "--out", tmp_path / "board.png")
