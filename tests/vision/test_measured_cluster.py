"""Positions of tags on a cluster, measured from images that show several at once."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import msgspec
import numpy as np
import pytest
from ball_renderer import Look
from scipy.spatial.transform import Rotation
from tag_renderer import Sheet, photograph

from bodyschema.cli.main import app
from bodyschema.daemon.wiring.markers import ClusterFile, TagSelection, _require_tags, figures, said, sides_of
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.records import FloatArray
from bodyschema.vision.cluster.measure import ClusterView, MeasuredCluster, measure_cluster
from bodyschema.vision.cluster.tables import cluster_tables
from bodyschema.vision.rig.lens import Lens
from bodyschema.vision.rig.rig_file import write_rig
from bodyschema.vision.rig.stereo_rig import CalibrationError, CalibrationProvenance, StereoRig, parameter_names
from bodyschema.vision.tags.config import PlacedTag
from bodyschema.vision.tags.image import TagImage

EYES = StereoCalibration(600.0, (319.5, 239.5), 0.12, (640, 480), 0.0)
SIDE_M = 0.04
NOISE_PX = 0.03
SQUARE = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])

Places = dict[int, tuple[FloatArray, FloatArray]]


def built(rng: np.random.Generator) -> Places:
    """Return a cube of tags glued on by hand: each turned and shifted slightly, including the first."""
    faces = [np.eye(3), *(Rotation.from_euler("xyz", turn, degrees=True).as_matrix() for turn in TURNS)]
    turned = [face @ Rotation.from_rotvec(rng.normal(0.0, 0.03, 3)).as_matrix() for face in faces]
    places = [0.03 * face[:, 2] + rng.normal(0, 1e-3, 3) for face in faces]
    return dict(zip((3, 4, 7, 8, 9), zip(turned, places, strict=True), strict=True))


TURNS = ([0, 90, 0], [0, -90, 0], [90, 0, 0], [-90, 0, 0])


def poses(rng: np.random.Generator, count: int) -> list[tuple[FloatArray, FloatArray]]:
    """Return poses of the cluster turned by 35° to 65° to all sides in turn, about 0.5 m ahead."""
    ways = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False) + 0.4
    turns = [rng.uniform(0.6, 1.1) * np.array([np.cos(way), np.sin(way), 0.0]) for way in ways]
    facing = np.diag([1.0, -1.0, -1.0])
    low, high = [0.0, -0.05, 0.4], [0.1, 0.05, 0.55]
    return [(Rotation.from_rotvec(turn).as_matrix() @ facing, rng.uniform(low, high)) for turn in turns]


def looked(
    places: Places, rng: np.random.Generator, count: int = 20, sides_m: Mapping[int, float] | None = None
) -> list[ClusterView]:
    """Return noisy corners of the tags that face a camera by 70° or less; some may have sides of their own [m]."""
    views = []
    for k, (turn, x) in enumerate(poses(rng, count)):
        eyes = []
        for eye in (np.zeros(3), np.array([EYES.baseline_m, 0.0, 0.0])):
            tags = {}
            for id, (rotation, place) in places.items():
                side_m = (sides_m or {}).get(id, SIDE_M)
                corners = (side_m * SQUARE @ rotation.T + place) @ turn.T + x - eye
                sight = corners.mean(axis=0)
                if -(turn @ rotation[:, 2]) @ sight < 0.35 * np.linalg.norm(sight):
                    continue
                px = EYES.focal_px * corners[:, :2] / corners[:, 2:] + EYES.principal_point_px
                tags[id] = TagImage(id, px + rng.normal(0.0, NOISE_PX, px.shape), NOISE_PX**2 * np.eye(8))
            eyes.append(tags)
        views.append(ClusterView(f"{k:02d}", *eyes))
    return views


def errors(found: MeasuredCluster, places: Places) -> tuple[FloatArray, FloatArray]:
    """Return errors of position [m] and turn [rad] of all tags but the first, in the first one's frame, (n, 3) each."""
    first = min(places)
    R, x = places[first]
    off, turns = [], []
    for tag in found.tags[1:]:
        rotation, place = places[tag.placed.id]
        off.append(np.array(tag.placed.xyz) - R.T @ (place - x))
        measured = Rotation.from_euler("xyz", tag.placed.rpy)
        turns.append((measured * Rotation.from_matrix(R.T @ rotation).inv()).as_rotvec())
    return np.array(off), np.array(turns)


def test_glued_tag_poses_are_recovered_with_covering_intervals() -> None:
    off, claimed = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        places = built(rng)
        found = measure_cluster(looked(places, rng), EYES, SIDE_M)
        assert [tag.placed.id for tag in found.tags] == [3, 4, 7, 8, 9]
        off.append(np.hstack(errors(found, places)))
        claimed.append([[*tag.xyz_sigma_m, *tag.turn_sigma_rad] for tag in found.tags[1:]])
    ratio = np.abs(np.concatenate(off)) / np.concatenate(claimed)
    assert 0.58 < np.mean(ratio < 1.0) < 0.78
    assert np.mean(ratio < 2.0) > 0.90
    assert np.abs(np.concatenate(off)[:, :3]).max() < 3e-4


def test_tags_of_different_sides_are_recovered() -> None:
    rng = np.random.default_rng(2)
    places, sides_m = built(rng), {4: 0.025, 9: 0.03}
    found = measure_cluster(looked(places, rng, sides_m=sides_m), EYES, SIDE_M, sides_m)
    assert np.abs(errors(found, places)[0]).max() < 3e-4
    assert {tag.placed.id: tag.placed.side_m for tag in found.tags} == {3: None, 4: 0.025, 7: None, 8: None, 9: 0.03}


def test_tables_name_individual_tag_sides() -> None:
    tags = [PlacedTag(id=3), PlacedTag(id=4, side_m=0.025)]
    written = tomllib.loads(cluster_tables("apriltag_36h11", SIDE_M, tags))
    assert written["vision"]["tag"]["side_m"] == SIDE_M
    assert [tag.get("side_m") for tag in written["vision"]["cluster"]["tags"]] == [None, 0.025]


def test_single_tag_view_is_reported_as_unused() -> None:
    rng = np.random.default_rng(4)
    views = looked(built(rng), rng)
    alone = {min(views[5].left): views[5].left[min(views[5].left)]}
    views[5] = ClusterView(views[5].name, alone, {})
    found = measure_cluster(views, EYES, SIDE_M)
    assert found.unused == ("05",)
    assert said(found).endswith("Not used, as they do not show two tags to both eyes: 05.")
    assert figures(found).unused == ["05"]
    tag, pose = found.tags[1], figures(found).tags[1].pose
    assert pose.translation_m == pytest.approx(list(tag.placed.xyz))
    assert np.diag(np.reshape(pose.covariance, (6, 6)))[3:] == pytest.approx(np.square(tag.turn_sigma_rad))


@pytest.mark.parametrize("text", ["7", "7=", "=25", "seven=25", "7=-25", "7=nan", "7=25,"])
def test_a_text_that_tells_no_sides_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="is not as in 7=25,8=25"):
        sides_of(text)


def test_tag_moved_in_one_view_is_left_out() -> None:
    rng = np.random.default_rng(1)
    places = built(rng)
    views = looked(places, rng)
    k = next(k for k, view in enumerate(views) if len(view.left.keys() & view.right.keys()) > 2)
    id = max(views[k].left)
    wrong = replace(views[k].left[id], corners_px=views[k].left[id].corners_px + 3.0)
    views[k] = replace(views[k], left={**views[k].left, id: wrong})
    found = measure_cluster(views, EYES, SIDE_M)
    assert found.left_out == ((f"{k:02d}", id),)
    assert np.abs(errors(found, places)[0]).max() < 4e-4


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.soak
def test_duplicate_tag_on_opposite_faces_is_named(seed: int) -> None:
    """Check duplicate numbers on opposite faces, so that no image shows both."""
    rng = np.random.default_rng(seed)
    places = built(rng)
    views = [renumbered(view, {4: 7}) for view in looked({id: places[id] for id in (3, 4, 7, 8)}, rng)]
    with pytest.raises(CalibrationError, match=r"do not fit one rigid body, and without tag 7 .*there twice"):
        measure_cluster(views, EYES, SIDE_M)


def renumbered(view: ClusterView, numbers: Mapping[int, int]) -> ClusterView:
    """Return the cluster with other numbers of some tags; if both are seen, neither is."""

    def eye(tags: Mapping[int, TagImage]) -> dict[int, TagImage]:
        both = {new for old, new in numbers.items() if old in tags and new in tags}
        kept = {numbers.get(id, id): tag for id, tag in tags.items()}
        return {id: tag for id, tag in kept.items() if id not in both}

    return ClusterView(view.name, eye(view.left), eye(view.right))


def test_tags_of_wrongly_stated_size_are_noticed() -> None:
    rng = np.random.default_rng(2)
    found = measure_cluster(looked(built(rng), rng), EYES, 0.97 * SIDE_M)
    assert found.grown == pytest.approx(0.03, abs=max(4 * found.grown_sigma, 0.004))


def test_tags_that_are_never_seen_together_are_named() -> None:
    rng = np.random.default_rng(3)
    views = [only(view, [3, 4] if k % 2 else [7, 8]) for k, view in enumerate(looked(built(rng), rng, 60))]
    with pytest.raises(CalibrationError, match="no pair of images shows tags 7, 8 to both eyes together"):
        measure_cluster(views, EYES, SIDE_M)


def only(view: ClusterView, ids: Sequence[int]) -> ClusterView:
    left, right = ({id: tag for id, tag in eye.items() if id in ids} for eye in (view.left, view.right))
    return ClusterView(view.name, left, right)


def test_views_of_single_tags_are_too_few() -> None:
    rng = np.random.default_rng(4)
    with pytest.raises(CalibrationError, match="0 of 20 pairs of images show two tags or more"):
        measure_cluster([only(view, [3]) for view in looked(built(rng), rng)], EYES, SIDE_M)


def test_wanted_tag_in_no_image_is_named() -> None:
    views = looked(built(np.random.default_rng(0)), np.random.default_rng(0))
    with pytest.raises(CalibrationError, match=r"not tag 5, 6 of apriltag_36h11 .* there are 3, 4, 7, 8, 9"):
        _require_tags(views, {}, TagSelection("apriltag_36h11", SIDE_M, (3, 4, 5, 6)))


def test_images_without_tags_of_family_are_refused() -> None:
    with pytest.raises(CalibrationError, match=r"no tag of aruco_6x6_50 .* Are --family"):
        _require_tags([ClusterView("00", {}, {})], {}, TagSelection("aruco_6x6_50", SIDE_M))


def test_duplicate_tag_in_one_image_is_named() -> None:
    views = looked(built(np.random.default_rng(0)), np.random.default_rng(0))
    with pytest.raises(CalibrationError, match=r"tag 3 is there twice in one image \(04, 07\)"):
        _require_tags(views, {3: ["04", "07"]}, TagSelection("apriltag_36h11", SIDE_M))


@pytest.mark.soak
def test_rendered_images_of_a_cluster_become_its_tables(tmp_path, capsys) -> None:
    rng = np.random.default_rng(5)
    places = built(rng)
    lens = Lens("pinhole", (600.0, 600.0), (319.5, 239.5), (0.0,) * 5)
    made = CalibrationProvenance("2026-01-01T00:00:00Z", "none", 20, 0, 0.02, 0.02, 0.0)
    n = len(parameter_names("pinhole"))
    rig = StereoRig(lens, lens, np.zeros(3), np.array([-0.12, 0.0, 0.0]), (640, 480), ("", ""), 1e-10 * np.eye(n), made)
    write_rig(rig, tmp_path / "cameras.toml")
    for k, (turn, x) in enumerate(poses(rng, 5)):
        sheets = [Sheet(id, turn @ rotation, turn @ place + x, SIDE_M) for id, (rotation, place) in places.items()]
        frame = photograph(sheets, EYES, Look(wall=0.4, samples=2), rng)
        cv2.imwrite(str(tmp_path / f"left{k}.png"), frame.left)
        cv2.imwrite(str(tmp_path / f"right{k}.png"), frame.right)
    words = ["marker", "learn", str(tmp_path), "--side-mm", "40", "--calibration", str(tmp_path / "cameras.toml")]
    app([*words, "--json"], exit_on_error=False, result_action="return_value")
    found = msgspec.json.decode(capsys.readouterr().out, type=ClusterFile)
    R, x = places[3]
    for tag in found.tags:
        truth = 1e3 * R.T @ (places[tag.id][1] - x)
        assert np.abs(np.array(tag.xyz_mm) - truth).max() < 0.8
    app(words, exit_on_error=False, result_action="return_value")
    assert "id = 3  # the marker's frame" in capsys.readouterr().out
    with pytest.raises(CalibrationError, match=r"the black squares seem to be .* mm wide, not 38"):
        app([*words[:3], "--side-mm", "38", *words[5:]], exit_on_error=False, result_action="return_value")
