"""The board's printed page, and board detection in images."""

from __future__ import annotations

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from board_renderer import Photographer, Printed, Taken, webcams
from printed_page import PX_A_MM, from_pdf, from_svg, rasterised
from scipy.spatial.transform import Rotation
from shown_board import BOARD, photographed

from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.records import FloatArray, ImageArray
from bodyschema.vision.board import Board, BoardDetector, Corners, NotFound
from bodyschema.vision.board.page import page
from bodyschema.vision.printing import pdf, svg

BOARDS = [Board(), Board(7, 5, 0.025, dictionary="6X6_250"), Board(10, 7, 0.020, pattern="chessboard")]


# --- the page, read back from the files' own numbers


@pytest.mark.parametrize(
    ("board", "write", "read"),
    [
        *((board, pdf, from_pdf) for board in BOARDS),
        (BOARDS[0], svg, from_svg),
        *(pytest.param(board, svg, from_svg, marks=pytest.mark.soak) for board in BOARDS[1:]),
    ],
)
def test_printed_squares_have_the_requested_size(board, write, read) -> None:
    drawn = page(board)
    image = rasterised(*read(write(drawn)))
    found = BoardDetector(board).find(cv2.GaussianBlur(image, (0, 0), 1.0))
    assert isinstance(found, Corners), found
    mm = (found.px + 0.5) / PX_A_MM - np.array(drawn.drawing_mm)
    np.testing.assert_allclose(mm, 1e3 * board.corners_m[:, :2], atol=0.1)


@pytest.mark.parametrize(("write", "read"), [(pdf, from_pdf), (svg, from_svg)], ids=["pdf", "svg"])
def test_rulers_are_as_long_as_the_page_says(write, read) -> None:
    drawn = page(Board())
    _, black = read(write(drawn))
    words = write(drawn).decode("latin-1")
    across = black[np.isclose(black[:, 3], 0.2, atol=1e-3) & (black[:, 2] > 50)]
    upright = black[np.isclose(black[:, 2], 0.2, atol=1e-3) & (black[:, 3] > 50)]
    assert (across[:, 2], upright[:, 3]) == (pytest.approx([240.0], abs=1e-3), pytest.approx([180.0], abs=1e-3))
    assert "this line is 240 mm, the upright one 180 mm" in words


def test_page_content_stays_inside_printer_margins() -> None:
    for board in BOARDS:
        (width, height), black = from_pdf(pdf(page(board)))
        assert black[:, :2].min() >= 5.0
        assert ((black[:, :2] + black[:, 2:]) <= np.array([width, height]) - 5.0).all()


def test_the_board_is_opencvs_own() -> None:
    mine = rasterised(*from_pdf(pdf(page(BOARD))))
    x, y = (round(each * PX_A_MM) for each in page(BOARD).drawing_mm)
    wide, high = (round(1e3 * each * PX_A_MM) for each in BOARD.size_m)
    theirs = BOARD.opencv().generateImage((wide, high), marginSize=0)
    assert np.mean(mine[y : y + high, x : x + wide] != theirs) < 0.01


def test_the_file_is_a_whole_pdf() -> None:
    data = pdf(page(BOARD))
    table = int(re.search(rb"startxref\n(\d+)", data)[1])
    assert data[table : table + 4] == b"xref"
    for number, place in enumerate(re.findall(rb"^(\d{10}) 00000 n ", data, re.MULTILINE), 1):
        assert data[int(place) :].startswith(b"%d 0 obj" % number)
    length, stream = re.search(rb"/Length (\d+)>>stream\n(.*)\nendstream", data, re.DOTALL).groups()
    assert int(length) == len(stream)


def test_oversized_board_is_refused_with_fitting_square_size() -> None:
    with pytest.raises(ConfigError, match=r"do not fit on A4. There is room for squares of 3\d"):
        page(Board(8, 6, 0.040))


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"columns": 2}, "2x6 squares"),
        ({"square_m": 0.0}, "squares of 0 mm"),
        ({"marker_m": 0.029}, "corners need white around them"),
        ({"dictionary": "8X8_50"}, "there is no dictionary '8X8_50'"),
        ({"columns": 20, "rows": 20, "dictionary": "4X4_50"}, "200 markers are needed, 4X4_50 has 50"),
    ],
)
def test_a_board_that_there_is_not_is_refused(wrong, said) -> None:
    with pytest.raises(ConfigError, match=re.escape(said)):
        Board(**wrong)


# --- the corners


def shown(taken: Taken, printed: Printed | None = None, turned: float = 0.2) -> tuple[ImageArray, FloatArray]:
    """Return the left image of a board about half a metre away, and the positions of its corners."""
    rng = np.random.default_rng(3)
    rig = webcams(rng)
    photographer = Photographer(rig, printed or Printed(), taken, rng)
    R = Rotation.from_euler("xyz", [0.3, turned, 0.1]).as_matrix()
    pose = R, np.array([0.0, 0.0, 0.55]) - R @ np.array([0.12, 0.09, 0.0])
    return photographer.left(*pose), photographer.corners(*pose)[0]


def test_corners_are_found_to_hundredths_of_a_pixel() -> None:
    rig, pairs, shown_at = photographed(count=4)
    photographer = Photographer(rig, Printed(), Taken(), np.random.default_rng(0))
    errors = []
    for pair, pose in zip(pairs, shown_at, strict=True):
        for image, px in zip((pair.left, pair.right), photographer.corners(*pose), strict=True):
            found = BoardDetector(BOARD).find(image)
            assert isinstance(found, Corners)
            errors.append(found.px - px[found.numbers])
    errors = np.concatenate(errors)
    assert np.sqrt(np.mean(errors**2)) < 0.05
    assert np.abs(errors.mean(axis=0)).max() < 0.005


@pytest.mark.parametrize("turned", [2.9, *(pytest.param(turned, marks=pytest.mark.soak) for turned in (0.2, -1.5))])
def test_chessboard_corner_order_is_independent_of_rotation(turned) -> None:
    rng = np.random.default_rng(3)
    rig = webcams(rng)
    printed = Printed(8, 5, 0.025, dictionary=None)
    photographer = Photographer(rig, printed, Taken(), rng)
    R = Rotation.from_euler("zxy", [turned, 0.3, 0.1]).as_matrix()
    pose = R, np.array([0.0, 0.0, 0.55]) - R @ np.array([0.1, 0.0625, 0.0])
    found = BoardDetector(Board(8, 5, 0.025, pattern="chessboard")).find(photographer.left(*pose))
    assert isinstance(found, Corners)
    assert np.abs(found.px - photographer.corners(*pose)[0]).max() < 0.3


def fault(image: ImageArray, board: Board = BOARD) -> NotFound:
    found = BoardDetector(board).find(image)
    assert isinstance(found, NotFound)
    return found


def test_a_lens_cap_is_named() -> None:
    found = fault(shown(Taken(exposure=0.02))[0])
    assert (found.why, "lens cap" in found.text) == ("dark", True)


def test_over_exposure_is_named() -> None:
    found = fault(shown(Taken(exposure=40.0))[0])
    assert (found.why, "Shorten the exposure" in found.text) == ("over_exposed", True)


@pytest.mark.parametrize(
    "taken",
    [Taken(blur_px=4.0), Taken(motion_px=13.0), pytest.param(Taken(blur_px=9.0), marks=pytest.mark.soak)],
    ids=str,
)
def test_a_blurred_image_is_named(taken) -> None:
    assert fault(shown(taken)[0]).why == "blurred"


@pytest.mark.parametrize("sigma", [0.8, 1.8, pytest.param(1.2, marks=pytest.mark.soak)])
def test_blur_is_measured(sigma) -> None:
    found = BoardDetector(BOARD).find(shown(Taken(blur_px=sigma))[0])
    assert isinstance(found, Corners)
    assert found.blur_px == pytest.approx(np.hypot(sigma, 0.3), rel=0.25)


def test_another_dictionary_is_named() -> None:
    found = fault(shown(Taken(), Printed(dictionary="5X5_50", marker_share=7 / 9))[0])
    assert found.why == "other_dictionary"
    assert "the markers are 5X5_50, not 4X4_50. Give --dictionary 5X5_50" in found.text


def test_a_board_with_markers_is_no_plain_chessboard() -> None:
    half = cv2.resize(shown(Taken())[0], (320, 240), interpolation=cv2.INTER_AREA)  # quicker to search
    found = fault(np.asarray(half, dtype=np.uint8), replace(BOARD, pattern="chessboard"))
    assert found.why == "other_pattern"
    assert "has 4X4_50 markers in its squares. Leave out --pattern, and give --dictionary 4X4_50" in found.text


@pytest.mark.parametrize(
    ("columns", "rows"), [(10, 7), *(pytest.param(*size, marks=pytest.mark.soak) for size in ((6, 6), (9, 6)))]
)
def test_another_number_of_squares_is_named(columns, rows) -> None:
    found = fault(shown(Taken(), Printed(columns, rows, 0.024))[0])
    assert found.why == "other_squares"
    assert f"the board has {columns}x{rows} squares, not 8x6" in found.text


def small(printed: Printed) -> ImageArray:
    """Return an image of half the size, which is quicker to search."""
    return np.asarray(cv2.resize(shown(Taken(), printed)[0], (320, 240), interpolation=cv2.INTER_AREA), np.uint8)


def test_a_mirrored_board_is_named() -> None:
    found = fault(np.ascontiguousarray(small(Printed())[:, ::-1]))
    assert (found.why, "the board is mirrored" in found.text) == ("mirrored", True)


def test_a_mirrored_board_is_named_from_near() -> None:
    # Some of its mirrored markers look like others.
    found = [fault(np.ascontiguousarray(pair.left[:, ::-1])).why for pair in photographed()[1][:6]]
    assert set(found) == {"mirrored"}


@pytest.mark.parametrize(
    ("board", "said"),
    [
        (BOARD, "a plain chessboard of 8x5 squares. Give --pattern chessboard --squares 8x5"),
        (Board(7, 4, 0.025, pattern="chessboard"), "the board has 8x5 squares, not 7x4. Give --squares 8x5"),
        (Board(9, 6, 0.025, pattern="chessboard"), "8x5 squares of a chessboard, not 9x6. All of it has to be in view"),
    ],
    ids=["markers wanted", "a smaller one wanted", "a larger one wanted"],
)
def test_a_plain_chessboard_of_other_squares_is_named(board, said) -> None:
    assert said in fault(small(Printed(8, 5, 0.025, dictionary=None)), board).text


def test_image_without_board_reports_not_found() -> None:
    noise = np.random.default_rng(0).integers(60, 190, (240, 320, 3), dtype=np.uint8)
    assert fault(noise).why == "not_found"
