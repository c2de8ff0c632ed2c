"""The robot as it looks: what the page's server reads of the files that a URDF names."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from small_arm import ROBOT, URDF

from bodyschema.dashboard import shapes
from bodyschema.dashboard.shapes import Body, _Settings, mesh_buffer, read_shapes
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.meshes import stl_bytes

# Corner k of a unit cube lies at the bits of k; its faces, two triangles each, wound to the outside.
FACES = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])
CORNERS = np.array([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)], dtype=float)
CUBE = CORNERS[FACES[:, [0, 1, 2, 0, 2, 3]]].reshape(-1, 3, 3)
CAMERA = """focal_px = 100.0
principal_point_px = [49.5, 39.5]
baseline_m = 0.1
image_size_px = [100, 80]
pixel_sigma = 0.2
"""
NO_MESHES = ["../secret.txt", "/etc/passwd", "file:///etc/passwd", "package://etc/passwd", "link.stl", "."]


def shape(geometry: str, more: str = "") -> str:
    return f'<visual><origin xyz="0.1 0 0" rpy="0 0 1.5707963267948966"/><geometry>{geometry}</geometry>{more}</visual>'


def robot(folder: Path, *visuals: str) -> RobotDescription:
    """Return the small arm with these shapes on its upper arm."""
    folder.mkdir(exist_ok=True)
    (folder / "arm.urdf").write_text(
        URDF.replace('<link name="upper"/>', f'<link name="upper">{"".join(visuals)}</link>')
    )
    (folder / "robot.toml").write_text(ROBOT + CAMERA)
    return RobotDescription.load(folder / "robot.toml")


def mesh(name: str, scale: str = "1 1 1") -> str:
    return shape(f'<mesh filename="{name}" scale="{scale}"/>')


def parts(buffer: bytes):
    vertices, indices = np.frombuffer(buffer, "<u4", 2)
    positions = np.frombuffer(buffer, "<f4", 3 * vertices, 8).reshape(-1, 3)
    normals = np.frombuffer(buffer, np.int8, 4 * vertices, 8 + 12 * vertices).reshape(-1, 4)[:, :3] / 127.0
    places = np.frombuffer(buffer, "<u4", indices, 8 + 16 * vertices)
    assert len(buffer) == 8 + 16 * vertices + 4 * indices
    return positions, normals, places


def ball(count: int) -> np.ndarray:
    """Return a unit sphere of 2 count² triangles."""
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, count + 1), np.linspace(0, np.pi, count + 1))
    points = np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)], axis=-1)
    a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
    return np.concatenate([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)]).reshape(-1, 3, 3)


def test_sharp_edges_stay_sharp() -> None:
    positions, normals, places = parts(mesh_buffer(CUBE))
    assert len(positions) == 24  # each corner belongs to three faces
    np.testing.assert_allclose(np.abs(normals).max(axis=1), 1.0)
    assert np.einsum("ij,ij->i", normals, positions - 0.5).min() == 0.5  # they face outwards
    np.testing.assert_allclose(positions[places].reshape(-1, 3, 3), CUBE)


def test_smooth_surfaces_share_their_vertices() -> None:
    positions, normals, places = parts(mesh_buffer(ball(24)))
    assert len(positions) < len(places) / 4
    length = np.linalg.norm(normals, axis=1)
    assert np.einsum("ij,ij->i", np.abs(normals), np.abs(positions))[length > 0.5].min() > 0.97


def test_shapes_have_place_size_and_colour(tmp_path) -> None:
    (tmp_path / "a.stl").write_bytes(stl_bytes(1000.0 * CUBE))
    red = '<material name=""><color rgba="1 0 0 0.5"/></material>'
    body = Body(robot(tmp_path, shape('<box size="1 2 3"/>', red), mesh("a.stl", "0.001 0.001 0.001")))
    document = body.document()
    box, cube = document.shapes[document.links.index("upper")]
    assert (box.kind, box.sizes, box.rgba, box.mesh) == ("box", [1, 2, 3], [1, 0, 0, 0.5], None)
    np.testing.assert_allclose(cube.pose, [0.1, 0, 0, 0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-12)
    assert (cube.kind, cube.mesh, document.said) == ("mesh", 0, [])
    found = body.mesh(0)
    assert found is not None
    np.testing.assert_allclose(np.ptp(parts(found)[0], axis=0), 1.0, rtol=1e-6)


def test_links_without_shapes_are_rods(tmp_path) -> None:
    document = Body(robot(tmp_path, shape('<sphere radius="0.1"/>'))).document()
    number = document.links.index
    assert document.rods == [(number("base"), number("upper"))]
    assert document.moving == [number("upper"), number("hand")]


def test_the_cameras_view_is_known(tmp_path) -> None:
    camera = Body(robot(tmp_path)).document().camera
    assert camera is not None
    assert camera.eyes == [[0, 0, 0], [0.1, 0, 0]]
    np.testing.assert_allclose(camera.edges, [-0.5, 0.5, -0.4, 0.4])


def test_missing_meshes_are_named(tmp_path) -> None:
    body = Body(robot(tmp_path, mesh("package://arm/gone.stl")))
    document = body.document()
    assert "Missing meshes: package://arm/gone.stl." in document.said[0]
    assert (len(document.rods), body.mesh(0)) == (2, None)


@pytest.mark.parametrize("error", [PermissionError(13, "Permission denied"), OSError(36, "File name too long")])
def test_names_that_the_system_refuses_are_missing_meshes(tmp_path, monkeypatch, error: OSError) -> None:
    robot(tmp_path, mesh("package://locked/a.stl"), mesh("b.stl"))
    (tmp_path / "b.stl").write_bytes(stl_bytes(CUBE))
    look = os.stat

    def refuse(path, *more, **options):
        if "locked" in str(path):
            raise error
        return look(path, *more, **options)

    monkeypatch.setattr(os, "stat", refuse)
    found = read_shapes(tmp_path / "arm.urdf")
    assert ([each.mesh for each in found.shapes["upper"]], len(found.said)) == ([0], 1)
    assert "Missing meshes: package://locked/a.stl." in found.said[0]


def test_overlong_mesh_name_counts_as_missing(tmp_path) -> None:
    robot(tmp_path, mesh(f"{'a' * 5000}.stl"))
    assert "Missing meshes: aaa" in read_shapes(tmp_path / "arm.urdf").said[0]


HOSTILE = {
    "words": (b"solid\nvertex 1 2 x\n", "cannot be used"),
    "short": (bytes(80) + b"\xff\xff\xff\xff", "cannot be used"),
    "nothing": (b"", "cannot be used"),
    "far": (stl_bytes(1e30 * CUBE), "lies too far"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_malformed_meshes_become_rods(tmp_path, name: str) -> None:
    data, why = HOSTILE[name]
    robot(tmp_path, mesh("a.stl"), mesh("b.stl"))
    (tmp_path / "a.stl").write_bytes(data)
    (tmp_path / "b.stl").write_bytes(stl_bytes(CUBE))
    found = read_shapes(tmp_path / "arm.urdf")
    assert [each.mesh for each in found.shapes["upper"]] == [0]
    assert why in found.said[0]


@pytest.mark.parametrize(
    "name", ["../secret.txt", "/etc/passwd", "file:///etc/passwd", "package://etc/passwd", "link.stl", "."]
)
def test_files_that_are_no_meshes_are_not_read(tmp_path, name: str, monkeypatch) -> None:
    robot(tmp_path / "arm", mesh(name))
    (tmp_path / "secret.txt").write_bytes(stl_bytes(CUBE))
    os.symlink(tmp_path / "secret.txt", tmp_path / "arm" / "link.stl")
    monkeypatch.setattr("bodyschema.robot.meshes.read_mesh", lambda file: pytest.fail(f"read {file}"))
    found = read_shapes(tmp_path / "arm" / "arm.urdf")
    assert (found.meshes, found.shapes["upper"], len(found.said)) == ([], [], 1)


def test_heavy_meshes_become_light(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(shapes._Settings, "max_triangles", 500)
    robot(tmp_path, mesh("a.stl"), mesh("a.stl", "1 1 -1"))
    (tmp_path / "a.stl").write_bytes(stl_bytes(ball(20)))
    found = read_shapes(tmp_path / "arm.urdf")
    assert 500 < sum(len(parts(buffer)[2]) for buffer in found.meshes) <= 1500
    assert "The meshes have 1,600 triangles" in found.said[0]


def test_even_triangles_that_share_nothing_stay_light() -> None:
    loose = np.random.default_rng(0).uniform(size=(100, 3, 3))
    assert len(mesh_buffer(loose)) / 100 * _Settings.max_triangles < 2_000_000


def test_a_reader_that_dies_leaves_the_other_shapes(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(shapes, "MODULE", "bodyschema.no_such_module")
    document = Body(robot(tmp_path, shape('<sphere radius="0.1"/>'), mesh("a.stl"))).document()
    assert [each.kind for each in document.shapes[document.links.index("upper")]] == ["sphere"]
    assert "could not be read" in document.said[0]


def test_a_reader_that_takes_too_long_is_ended(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(shapes._Settings, "read_limit_s", 0.0)
    document = Body(robot(tmp_path, mesh("a.stl"))).document()
    assert "could not be read" in document.said[0]


def test_a_urdf_that_is_gone_leaves_rods(tmp_path) -> None:
    body = Body(robot(tmp_path))
    (tmp_path / "arm.urdf").unlink()
    document = body.document()
    assert len(document.rods) == 2
    assert "arm.urdf" in document.said[0]
