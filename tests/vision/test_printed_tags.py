"""Tags as printed, cut out and folded agree with those that the tracker looks for."""

from __future__ import annotations

import re
import tomllib

import cv2
import msgspec
import numpy as np
import pytest
from printed_page import PX_A_MM, from_pdf, from_svg, rasterised
from scipy.spatial.transform import Rotation

from bodyschema.cli.cameras.tag_pages import Tags, face_mm, sheet, tables
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.records import FloatArray, ImageArray, MarkerFix, StereoFrame
from bodyschema.vision.cluster.page import FACE_SIDES, shape_page, tags_page
from bodyschema.vision.cluster.shapes import Shape, cube, plate
from bodyschema.vision.cluster.tables import cluster_tables, tag_tables
from bodyschema.vision.config import VisionConfig
from bodyschema.vision.printing import Page, pdf, svg
from bodyschema.vision.tags.config import Dictionary
from bodyschema.vision.trackers import tracker_of

EYES = StereoCalibration(900.0, (639.5, 479.5), 0.10, (1280, 960), 0.1)
# Modules of 4 mm: whole pixels of the page as it is painted.
SIDE_MM = 32.0
WIDTH_M = 1e-3 * FACE_SIDES * SIDE_MM
APRILTAG: Dictionary = "apriltag_36h11"
FOUR_TIMES = 4


def ids_of(shape: Shape, first: int = 0) -> list[int]:
    return list(range(first, first + len(shape.faces)))


def tracked(text: str, frame: StereoFrame) -> MarkerFix:
    """Return the fix of the tracker that these tables of robot.toml describe."""
    config = msgspec.convert(tomllib.loads(text)["vision"], VisionConfig)
    found = tracker_of(EYES, config).track(frame)
    assert isinstance(found, MarkerFix), found
    return found


def photographed(
    page: Page, shape: Shape, rotation: FloatArray, x: FloatArray, width_m: float = WIDTH_M
) -> StereoFrame:
    """Render the printed sheet, folded and held at a pose in the left optical frame: each face is cut from the page."""
    printed = np.asarray(cv2.GaussianBlur(rasterised(*from_pdf(pdf(page))), (0, 0), 1.0), np.uint8)
    left, right = (seen(printed, page, shape, rotation, x - [at, 0, 0], width_m) for at in (0.0, EYES.baseline_m))
    return StereoFrame(0.0, left, right)


def seen(
    printed: ImageArray, page: Page, shape: Shape, rotation: FloatArray, x: FloatArray, width_m: float
) -> ImageArray:
    width, height = (FOUR_TIMES * side for side in EYES.image_size_px)
    image = np.full((height, width), 110, np.uint8)
    for face in shape.faces:
        normal = rotation @ face.rotation[:, 2]
        centre = rotation @ face.centre * width_m + x
        if normal @ centre >= 0:
            continue
        square = np.array([[-0.5, 0.5, 0], [0.5, 0.5, 0], [0.5, -0.5, 0], [-0.5, -0.5, 0]])
        corners = width_m * (square @ face.rotation.T + face.centre) @ rotation.T + x
        px = EYES.focal_px * corners[:, :2] / corners[:, 2:] + EYES.principal_point_px
        cell = np.array([face.cell, np.add(face.cell, (1, 0)), np.add(face.cell, (1, 1)), np.add(face.cell, (0, 1))])
        mm = cell * 1e3 * width_m + page.drawing_mm
        # Both pictures count pixels from the middle of the first one.
        H = cv2.getPerspectiveTransform(
            (mm * PX_A_MM - 0.5).astype(np.float32), (FOUR_TIMES * (px + 0.5) - 0.5).astype(np.float32)
        )
        piece = cv2.warpPerspective(printed, H, (width, height), flags=cv2.INTER_LINEAR)
        inside = cv2.fillConvexPoly(np.zeros_like(image), np.rint(FOUR_TIMES * (px + 0.5)).astype(np.int32), 1)
        image = np.where(inside > 0, piece, image)
    grey = cv2.resize(image, EYES.image_size_px, interpolation=cv2.INTER_AREA)
    noisy = grey + np.random.default_rng(0).normal(0.0, 1.0, grey.shape)
    return cv2.cvtColor(np.clip(noisy, 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR)


def facing(*rotvec_deg: float) -> FloatArray:
    """Return the orientation of a body whose z axis points back at the cameras, then turned."""
    return Rotation.from_rotvec(rotvec_deg, degrees=True).as_matrix() @ np.diag([1.0, -1.0, -1.0])


POSES = [facing(0, 0, 0), facing(35, 0, 0), facing(0, 40, 20), facing(0, 150, 0), facing(100, 30, 0)]


@pytest.mark.parametrize(
    "rotation",
    [POSES[0], *(pytest.param(pose, marks=pytest.mark.soak) for pose in POSES[1:-2]), *POSES[-2:]],
    ids=["front", "below", "left", "behind", "top"],
)
def test_printed_folded_cube_matches_its_tables(rotation) -> None:
    shape, x = cube(), np.array([0.03, -0.02, 0.45])
    page = shape_page(shape, ids_of(shape, 7), APRILTAG, SIDE_MM, "A4")
    text = cluster_tables(APRILTAG, 1e-3 * SIDE_MM, shape.placed(ids_of(shape, 7), WIDTH_M))
    fix = tracked(text, photographed(page, shape, rotation, x))
    assert np.abs(fix.x - x).max() < 3e-4
    assert Rotation.from_matrix(rotation.T @ Rotation.from_quat(fix.R).as_matrix()).magnitude() < np.radians(0.4)


@pytest.mark.parametrize(
    ("columns", "rows", "fold_deg"),
    [
        (1, 1, 0.0),
        pytest.param(3, 2, 0.0, marks=pytest.mark.soak),
        (3, 1, 40.0),
        pytest.param(4, 1, 90.0, marks=pytest.mark.soak),
    ],
)
def test_printed_plate_matches_its_tables(columns, rows, fold_deg) -> None:
    shape, x, rotation = plate(columns, rows, fold_deg), np.array([-0.05, -0.02, 0.40]), facing(0, 12, 0)
    page = shape_page(shape, ids_of(shape), APRILTAG, SIDE_MM, "A4")
    text = cluster_tables(APRILTAG, 1e-3 * SIDE_MM, shape.placed(ids_of(shape), WIDTH_M))
    fix = tracked(text, photographed(page, shape, rotation, x))
    assert np.abs(fix.x - x).max() < 3e-4


@pytest.mark.parametrize("dictionary", ["aruco_6x6_50", "apriltag_36h11"])
def test_printed_charuco_board_matches_its_tables(dictionary) -> None:
    # A side of 24 mm has squares of 32 mm: whole pixels, again.
    board = Tags("board", None, dictionary, 24.0, columns=4, rows=3)
    square_m, x, rotation = 1e-3 * face_mm(board), np.array([-0.02, -0.02, 0.40]), facing(0, 12, 0)
    # The upper left square is black, and the first tag is beside it.
    frame = photographed(sheet(board, "A4"), plate(4, 3, 0.0), rotation, x - square_m * rotation[:, 0], square_m)
    fix = tracked(tables(board), frame)
    assert np.abs(fix.x - x).max() < 3e-4
    assert Rotation.from_matrix(rotation.T @ Rotation.from_quat(fix.R).as_matrix()).magnitude() < np.radians(0.2)


def test_printed_chessboard_is_found_as_its_tables_say() -> None:
    board = Tags("chessboard", side_mm=32.0, columns=5, rows=4)
    square_m, x, rotation = 1e-3 * face_mm(board), np.array([-0.02, -0.02, 0.40]), facing(0, 12, 10)
    # Its frame is in its middle, the shape's in that of the upper left square.
    corner = x - square_m * rotation @ [2.0, -1.5, 0.0]
    fix = tracked(tables(board), photographed(sheet(board, "A4"), plate(5, 4, 0.0), rotation, corner, square_m))
    assert np.abs(fix.x - x).max() < 3e-4
    assert Rotation.from_matrix(rotation.T @ Rotation.from_quat(fix.R).as_matrix()).magnitude() < np.radians(0.2)


@pytest.mark.parametrize(("columns", "rows"), [(8, 6), (2, 1)])
def test_chessboard_that_is_no_marker_is_not_printed(columns, rows) -> None:
    with pytest.raises(ConfigError, match=r"looks the same turned by half a turn|is too small"):
        sheet(Tags("chessboard", columns=columns, rows=rows), "A4")


@pytest.mark.parametrize("dictionary", ["aruco_6x6_250", "aruco_mip_36h12"])
def test_a_single_tag_of_another_family_is_found(dictionary) -> None:
    shape, x = plate(1, 1, 0.0), np.array([0.0, 0.0, 0.4])
    page = shape_page(shape, [17], dictionary, SIDE_MM, "A4")
    fix = tracked(tag_tables(dictionary, 1e-3 * SIDE_MM, 17), photographed(page, shape, facing(0, 20, 0), x))
    assert np.abs(fix.x - x).max() < 3e-4


@pytest.mark.parametrize(("write", "read"), [(pdf, from_pdf), (svg, from_svg)], ids=["pdf", "svg"])
def test_printed_single_tags_have_requested_size_and_numbers(write, read) -> None:
    page = tags_page([3, 11, 40, 41, 42], APRILTAG, SIDE_MM, "A4")
    data = write(page)
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11))
    corners, ids, _ = detector.detectMarkers(cv2.GaussianBlur(rasterised(*read(data)), (0, 0), 1.0))
    assert sorted(np.ravel(ids)) == [3, 11, 40, 41, 42]
    sides = [np.linalg.norm(np.diff(quad[0], axis=0), axis=1) / PX_A_MM for quad in corners]
    assert np.abs(np.concatenate(sides) - SIDE_MM).max() < 0.4
    assert re.findall(r"apriltag_36h11 (\d+), 32 mm", data.decode("latin-1")) == ["3", "11", "40", "41", "42"]


def edge(shape: Shape, cell: tuple[int, int], other: tuple[int, int]) -> FloatArray:
    """Return both ends of the edge between two neighbouring cells on the folded body, in the frame of `cell`'s face."""
    face = next(face for face in shape.faces if face.cell == cell)
    step = np.array([other[0] - cell[0], cell[1] - other[1]]) * 0.5
    across = np.abs(step[::-1])
    return np.array([[*(step + sign * across), 0.0] for sign in (-1, 1)]) @ face.rotation.T + face.centre


@pytest.mark.parametrize("shape", [cube(), plate(4, 1, 90.0), plate(5, 3, -30.0)], ids=lambda shape: shape.name)
def test_faces_meet_where_the_sheet_is_folded(shape) -> None:
    assert shape.folds
    for cell, other in shape.folds:
        np.testing.assert_allclose(edge(shape, cell, other), edge(shape, other, cell), atol=1e-12)


def test_cube_faces_look_outwards_in_six_directions() -> None:
    normals = np.array([face.rotation[:, 2] for face in cube().faces])
    np.testing.assert_allclose([face.centre for face in cube().faces], 0.5 * normals, atol=1e-12)
    assert len({tuple(np.rint(normal).astype(int)) for normal in normals}) == 6


def test_flat_plate_has_no_folds_only_cuts() -> None:
    shape = plate(3, 2, 0.0)
    assert (shape.folds, len(shape.cuts)) == ([], 10)


def test_nothing_leaves_the_sheet() -> None:
    for page in (shape_page(cube(), range(6), APRILTAG, 40.0, "A4"), tags_page([0], APRILTAG, 60.0, "A4")):
        (width, height), black = from_pdf(pdf(page))
        assert black[:, :2].min() >= 5.0
        assert ((black[:, :2] + black[:, 2:]) <= np.array([width, height]) - 5.0).all()
        assert all(text.x_mm + 0.5 * text.size_mm * len(text.text) < width for text in page.texts if not text.turned)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: shape_page(cube(), range(6), APRILTAG, 80.0, "A4"), "There is room for tags of 46 mm"),
        (lambda: tags_page([0], APRILTAG, 200.0, "A4"), "There is room for tags of 1"),
        (lambda: tags_page(range(30), APRILTAG, 60.0, "A4"), "30 tags of 60 mm do not fit on A4"),
        (
            lambda: tags_page([600], APRILTAG, 40.0, "A4"),
            "there is no tag 600 in apriltag_36h11. Its numbers go from 0",
        ),
        (lambda: shape_page(cube(), range(5), APRILTAG, 40.0, "A4"), "a cube has 6 tags, not 5"),
        (lambda: plate(6, 1, 90.0), "6 columns folded by 90° each run into each other"),
        (lambda: plate(0, 1, 0.0), "a plate of 0x1 tags"),
        (lambda: tags_page([0], APRILTAG, 40.0, "A9"), "there is no paper 'A9'"),
    ],
)
def test_unprintable_request_is_refused_with_its_reason(make, said) -> None:
    with pytest.raises(ConfigError, match=re.escape(said)):
        make()
