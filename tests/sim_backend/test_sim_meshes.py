from __future__ import annotations

import struct

import numpy as np
import pytest
from guided_run import described

from bodyschema.interfaces.errors import RobotError
from bodyschema.robot import meshes
from bodyschema.robot.meshes import MeshError, read_mesh, stl_bytes
from bodyschema.sim_backend import SimConfig
from bodyschema.sim_backend.bullet import Body
from bodyschema.sim_backend.physics_urdf import Meshes, UrdfSettings, physics_urdf
from bodyschema.sim_backend.truth import TrueRobot

WEDGE = np.array([[[0, 0, 0], [0, 2, 0], [3, 0, 0]], [[0, 0, 0], [3, 0, 0], [0, 0, 5]]], dtype=float)


def stl(triangles, announced=None):
    data = bytearray(stl_bytes(np.array(triangles, dtype=float)))
    data[80:84] = struct.pack("<I", len(triangles) if announced is None else announced)
    return bytes(data)


def ascii_stl(triangles):
    corners = "".join(f"vertex {x} {y} {z}\n" for x, y, z in np.reshape(triangles, (-1, 3)))
    return f"solid wedge\n{corners}endsolid\n".encode()


def obj(triangles):
    corners = np.reshape(triangles, (-1, 3))
    lines = [f"v {x} {y} {z}" for x, y, z in corners]
    lines += [f"f {k + 1}/1 {k + 2}//7 {k - len(corners) + 2}" for k in range(0, len(corners), 3)]
    return "\n".join(["mtllib /etc/passwd", "# a wedge", *lines, ""]).encode()


def collada(triangles=WEDGE, *, unit="0.1", faces=None, count=None, scene='<instance_geometry url="#g"/>', more=""):
    """Return COLLADA text: the triangles ten times as large, in a unit of 0.1 m, shifted to and fro by two nodes."""
    corners = 10.0 * np.reshape(triangles, (-1, 3)) - [0, 0, 4]
    faces = " ".join(map(str, range(len(corners)))) if faces is None else faces
    values = " ".join(map(str, corners.ravel()))
    return f"""<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema"><asset><unit meter="{unit}"/></asset>
    <library_geometries><geometry id="g"><mesh>
    <source id="s"><float_array id="a" count="{corners.size if count is None else count}">{values}</float_array>
    <technique_common><accessor source="#a" count="{len(corners)}" stride="3"/></technique_common></source>
    <vertices id="v"><input semantic="POSITION" source="#s"/></vertices>
    <triangles count="2"><input semantic="VERTEX" offset="0" source="#v"/><p>{faces}</p></triangles>
    </mesh></geometry></library_geometries>{more}
    <library_visual_scenes><visual_scene id="scene"><node id="n"><translate>0 0 3</translate>
    <node><matrix>1 0 0 0 0 1 0 0 0 0 1 1 0 0 0 1</matrix>{scene}</node></node></visual_scene></library_visual_scenes>
    <scene><instance_visual_scene url="#scene"/></scene></COLLADA>""".encode()


@pytest.mark.parametrize(
    ("name", "data"), [("a.stl", stl(WEDGE)), ("a.STL", ascii_stl(WEDGE)), ("a.obj", obj(WEDGE)), ("a.dae", collada())]
)
def test_every_format_gives_the_same_triangles(tmp_path, name, data) -> None:
    (tmp_path / name).write_bytes(data)
    np.testing.assert_allclose(read_mesh(tmp_path / name), WEDGE, atol=1e-6)


def test_polygons_become_fans(tmp_path) -> None:
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
    polylist = collada().replace(b"triangles", b"polylist").replace(b"<p>0 1 2 3 4 5", b"<vcount>4</vcount><p>0 1 2 4")
    (tmp_path / "a.dae").write_bytes(polylist)
    assert read_mesh(tmp_path / "a.obj").tolist() == [
        [[0, 0, 0], [1, 0, 0], [1, 1, 0]],
        [[0, 0, 0], [1, 1, 0], [0, 1, 0]],
    ]
    np.testing.assert_allclose(read_mesh(tmp_path / "a.dae")[1], WEDGE[[0, 0, 1], [0, 2, 1]], atol=1e-9)


RING = collada(scene='<instance_node url="#n"/>')
MALFORMED = {
    "empty.stl": (b"", "0 triangles are announced, 0 are there"),
    "short.stl": (bytes(40), "0 triangles are announced"),
    "truncated.stl": (stl(WEDGE, 1000), "1000 triangles are announced, 2 are there"),
    "endless.stl": (stl(WEDGE, 2**32 - 1), "4294967295 triangles are announced"),
    "none.stl": (stl(np.zeros((0, 3, 3))), "no triangles"),
    "nan.stl": (stl(WEDGE * np.nan), "not finite"),
    "text.stl": (b"not a mesh " * 20, "are announced"),
    "half.stl": (ascii_stl(WEDGE[0, :2]), "ends within a triangle"),
    "words.stl": (ascii_stl(WEDGE).replace(b"3.0", b"three"), "could not convert"),
    "empty.obj": (b"", "no triangles"),
    "beyond.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99999999\n", "a vertex that is not there"),
    "before.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -4\n", "a vertex that is not there"),
    "huge.obj": (b"v 0 0 0\nf 1 1 99999999999999999999999\n", "a vertex that is not there"),
    "faces.obj": (b"f 1 2 3\n", "a vertex that is not there"),
    "zero.obj": (b"v 0 0 0\nf 0 0 0\n", "the vertex 0"),
    "flat.obj": (b"v 0 0\nf 1 1 1\n", "not enough values"),
    "inf.obj": (b"v 0 0 1e999\nf 1 1 1\n", "not finite"),
    "line.obj": (b"v " + b"9" * 100_000 + b"\n", "too long"),
    "bytes.obj": (bytes(range(256)) * 20, "no triangles"),
    "empty.dae": (b"", "not XML"),
    "open.dae": (b"<COLLADA><library_geometries>", "not XML"),
    "hollow.dae": (b"<COLLADA/>", "no triangles"),
    "beyond.dae": (collada(faces="0 1 99999999"), "a vertex that is not there"),
    "negative.dae": (collada(faces="0 1 -7"), "a vertex that is not there"),
    "nan.dae": (collada(unit="nan"), "not finite"),
    "words.dae": (collada(faces="one two three"), "invalid literal"),
    "nowhere.dae": (collada(scene='<instance_geometry url="#h"/>'), "'#h', which is not there"),
    "ring.dae": (RING, "more than 10000 nodes"),
    "entities.dae": (b'<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]><a>&b;</a>', "no triangles"),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_files_are_told_apart(tmp_path, name) -> None:
    data, why = MALFORMED[name]
    (tmp_path / name).write_bytes(data)
    with pytest.raises(MeshError, match=why):
        read_mesh(tmp_path / name)


def test_files_beyond_the_limit_are_not_read(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(meshes.MeshLimits, "mesh_bytes", 1 << 20)
    (tmp_path / "endless.stl").symlink_to("/dev/zero")
    (tmp_path / "large.stl").write_bytes(bytes(2 << 20))
    for name, why in (("endless.stl", "a device"), ("large.stl", "larger than 1 MiB")):
        with pytest.raises(MeshError, match=why):
            read_mesh(tmp_path / name)


def test_too_many_triangles_are_refused(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(meshes.MeshLimits, "triangles", 1)
    for name, data in (("a.stl", stl(WEDGE)), ("a.obj", obj(np.tile(WEDGE, (3, 1, 1)))), ("a.dae", collada())):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(MeshError, match=r"more than 1 triangles|too long"):
            read_mesh(tmp_path / name)


def test_meshes_are_limited_together(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(meshes.MeshLimits, "all_bytes", 200)
    for name in ("a.stl", "b.stl"):
        (tmp_path / name).write_bytes(stl(WEDGE))
    known = Meshes(tmp_path / "robot.urdf")
    assert known.add("a.stl", (1.0, 1.0, 1.0), drawn=True) is not None
    assert known.add("b.stl", (1.0, 1.0, 1.0), drawn=True) is None
    assert "MiB together" in known.unusable["b.stl"]


def ball(count):
    """Return a unit sphere of 2 count² triangles."""
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, count + 1), np.linspace(0, np.pi, count + 1))
    points = np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)], axis=-1)
    a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
    return np.concatenate([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)]).reshape(-1, 3, 3)


def triangles_of(data):
    return np.frombuffer(data, dtype=meshes.STL_TRIANGLE, offset=84)["corners"]


def test_heavy_meshes_keep_their_shape(tmp_path) -> None:
    (tmp_path / "ball.stl").write_bytes(stl(0.1 * ball(120)))
    known = Meshes(tmp_path / "robot.urdf")
    names = [known.add("ball.stl", (1.0, 1.0, scale), drawn=True) for scale in (1.0, 1.0, -2.0)]
    files, said = known.files()
    shapes = [triangles_of(files[name]) for name in names]
    assert UrdfSettings.max_triangles / 4 < sum(map(len, shapes)) <= UrdfSettings.max_triangles
    assert said.startswith("the meshes have 86,400 triangles")
    radii = np.linalg.norm(shapes[0], axis=2)
    assert np.abs(radii - 0.1).max() < 0.004
    stretched = np.ptp(shapes[2], axis=(0, 1))
    np.testing.assert_allclose(stretched, [0.2, 0.2, 0.4], atol=0.01)


def test_the_triangles_of_mirrored_meshes_face_outwards(tmp_path) -> None:
    (tmp_path / "ball.stl").write_bytes(stl(ball(6)))
    known = Meshes(tmp_path / "robot.urdf")
    name = known.add("ball.stl", (1.0, 1.0, -1.0), drawn=True)
    mirrored, plain = triangles_of(known.files()[0][name]), ball(6)

    def outwards(triangles):
        return np.einsum("ij,ij->i", np.cross(*np.diff(triangles, axis=1).swapaxes(0, 1)), triangles.mean(axis=1)).sum()

    assert outwards(mirrored) == pytest.approx(outwards(plain), rel=1e-5)


def test_hulls_enclose_meshes_and_flat_ones_become_boxes(tmp_path) -> None:
    (tmp_path / "ball.stl").write_bytes(stl(ball(40)))
    (tmp_path / "flat.stl").write_bytes(stl([[[0, 0, 0], [1, 0, 0], [0, 2, 0]]]))
    known = Meshes(tmp_path / "robot.urdf")
    names = [known.add(name, (1.0, 1.0, 1.0), drawn=False) for name in ("ball.stl", "flat.stl")]
    files, _ = known.files()
    hull, box = (triangles_of(files[name]) for name in names)
    assert 100 < len(hull) < 250
    np.testing.assert_allclose(np.ptp(hull, axis=(0, 1)), 2.0, atol=0.01)
    assert np.linalg.norm(hull.mean(axis=1), axis=1).min() > 0.9  # of its faces' middles
    np.testing.assert_allclose(np.ptp(box, axis=(0, 1)), [1, 2, 0.001], atol=1e-6)


# --- robots

TOML = """
[robot]
name = "r"
urdf = "robot.urdf"
joints = ["turn"]
marker_link = "tip"
[camera]
parent_link = "base"
focal_px = 600.0
principal_point_px = [319.5, 239.5]
baseline_m = 0.1
image_size_px = [640, 480]
"""


def robot_of(tmp_path, base="", more="", offset="0.3 0 0.1"):
    """Return a robot of two links, with elements in the first of them."""
    urdf = f"""<robot name="r"><material name="sky"><color rgba="0.1 0.2 0.9 1"/></material>
    <link name="base">{base}</link><link name="tip"/>
    <joint name="turn" type="continuous"><parent link="base"/><child link="tip"/>
    <origin xyz="{offset}"/><axis xyz="0 0 1"/></joint>{more}</robot>"""
    return described(tmp_path, urdf, TOML)


def mesh(name, kinds=("visual", "collision"), scale="1 1 1"):
    shape = f'<geometry><mesh filename="{name}" scale="{scale}"/></geometry>'
    return "".join(
        f'<{kind}>{shape}<material name="sky"><texture filename="/etc/passwd"/></material></{kind}>' for kind in kinds
    )


def written(robot):
    return physics_urdf(TrueRobot.draw(robot, SimConfig()))


def shapes_of(robot):
    """Return pybullet's shapes of the robot after a collision check: kind and colour by link, and the output."""
    urdf = written(robot)
    with Body(urdf, robot.joints) as body:
        body.bullet.performCollisionDetection(physicsClientId=body.client)
        body.bullet.rayTest([0, 0, 5], [0, 0, -5], physicsClientId=body.client)
        rows = body.bullet.getVisualShapeData(body.id, physicsClientId=body.client)
        return [(row[2], row[3], row[7]) for row in rows], " | ".join(urdf.said), body.bullet


def test_meshes_are_drawn_in_their_colour(tmp_path) -> None:
    (tmp_path / "wedge.stl").write_bytes(stl(0.1 * WEDGE))
    shapes, said, bullet = shapes_of(robot_of(tmp_path, mesh("wedge.stl")))
    assert [(kind, colour) for kind, _, colour in shapes] == [(bullet.GEOM_MESH, pytest.approx((0.1, 0.2, 0.9, 1.0)))]
    assert said == ""


@pytest.mark.parametrize("name", ["truncated.stl", "nan.stl", "faces.obj", "beyond.obj", "hollow.dae", "beyond.dae"])
def test_a_malformed_mesh_becomes_a_rod(tmp_path, name) -> None:
    data, why = MALFORMED[name]
    (tmp_path / name).write_bytes(data)
    shapes, said, bullet = shapes_of(robot_of(tmp_path, mesh(name)))
    assert [kind for kind, _, _ in shapes] == [bullet.GEOM_CYLINDER]
    assert shapes[0][1][0] == pytest.approx(np.hypot(0.3, 0.1), abs=0.03)
    assert f"meshes that cannot be used: {name}" in said
    assert why in said
    assert said.endswith("draws rods for base")


@pytest.mark.parametrize("name", ["package://robot/base.stl", "meshes/base.dae", ""])
def test_missing_meshes_become_rods_and_are_named(tmp_path, name) -> None:
    shapes, said, bullet = shapes_of(robot_of(tmp_path, mesh(name)))
    assert [kind for kind, _, _ in shapes] == [bullet.GEOM_CYLINDER]
    assert said.startswith(f"missing meshes: {name or 'one without a file name'}. The simulation continues without")


def test_no_rod_leads_to_a_tool(tmp_path) -> None:
    tool = frame("tool").replace("</joint>", '<origin xyz="0.2 0.2 0"/></joint>')
    shapes, _, _ = shapes_of(robot_of(tmp_path, mesh("base.stl"), tool))
    assert [shape[1][0] for shape in shapes] == [pytest.approx(np.hypot(0.3, 0.1), abs=0.03)]


def test_many_missing_meshes_make_one_sentence(tmp_path) -> None:
    said = written(robot_of(tmp_path, "".join(mesh(f"part_{k}.stl") for k in range(9)))).said
    assert [sentence.split(". ")[0] for sentence in said] == [
        "missing meshes: part_0.stl, part_1.stl, part_2.stl and 6 more"
    ]


@pytest.mark.parametrize(
    "name", ["/etc/passwd", "../../../../../../../../etc/passwd", "package://a/../../etc/passwd", "linked.stl"]
)
def test_non_mesh_file_is_not_read(tmp_path, name, monkeypatch) -> None:
    monkeypatch.setattr(meshes, "read_mesh", lambda file: pytest.fail(f"{file} was read"))
    (tmp_path / "linked.stl").symlink_to("/etc/passwd")
    urdf = written(robot_of(tmp_path, mesh(name)))
    assert "missing" in urdf.said[0] or "meshes end in .stl, .obj, .dae" in urdf.said[0]


def test_pybullet_hears_of_no_file_but_ours(tmp_path) -> None:
    (tmp_path / "wedge.obj").write_bytes(obj(0.1 * WEDGE))
    urdf = written(robot_of(tmp_path, mesh("wedge.obj")))
    assert set(urdf.meshes) == {"drawn_0.stl", "hull_0.stl"}
    assert "passwd" not in urdf.text
    assert "wedge" not in urdf.text


@pytest.mark.parametrize("scale", ["1000 1000 1000", "1e300 1 1", "1e-320 1e-320 1e-320"])
def test_absurd_sizes_are_reported(tmp_path, scale) -> None:
    (tmp_path / "wedge.stl").write_bytes(stl(WEDGE))
    assert "A mesh in millimetres needs" in written(robot_of(tmp_path, mesh("wedge.stl", scale=scale))).said[0]


def shape(geometry, origin="", kind="collision"):
    return f"<{kind}>{origin}<geometry>{geometry}</geometry></{kind}>"


@pytest.mark.parametrize(
    "base",
    [
        shape('<box size="nan 1 1"/>'),
        shape('<box size="1e300 1 1"/>', kind="visual"),
        shape('<box size="-1 1 1"/>'),
        shape('<box size="1 1"/>'),
        shape("<box/>"),
        shape('<sphere radius="inf"/>'),
        shape('<cylinder radius="0" length="1"/>'),
        shape('<plane normal="0 0 1"/>'),
        shape(""),
        shape('<box size="1 1 1"/>', '<origin xyz="1e30 0 0"/>'),
        shape('<box size="1 1 1"/>', '<origin rpy="nan 0 0"/>'),
        shape('<mesh filename="wedge.stl" scale="0 1 1"/>'),
        shape('<mesh filename="wedge.stl" scale="nan"/>'),
        '<inertial><mass value="1"/><inertia ixx="-1" iyy="1" izz="1"/></inertial>',
        '<inertial><mass value="1"/><inertia ixx="1e300" iyy="1" izz="1"/></inertial>',
        '<inertial><mass value="1e300"/><inertia ixx="1" iyy="1" izz="1"/></inertial>',
    ],
)
def test_numbers_that_no_body_has_are_left_out(tmp_path, base) -> None:
    (tmp_path / "wedge.stl").write_bytes(stl(0.1 * WEDGE))
    _, said, _ = shapes_of(robot_of(tmp_path, base))
    assert said.startswith("the simulation leaves out what it cannot take of")
    assert "the link 'base'" in said


def test_links_without_mass_have_a_small_one(tmp_path) -> None:
    urdf = written(robot_of(tmp_path, '<inertial><mass value="0"/><inertia ixx="0" iyy="0" izz="0"/></inertial>'))
    assert urdf.said == ()
    assert urdf.text.count('<mass value="0.1" />') == 2


def frame(name):
    """Return an empty link, fixed to the base."""
    joint = f'<joint name="to_{name}" type="fixed"><parent link="base"/><child link="{name}"/></joint>'
    return f'<link name="{name}"/>{joint}'


@pytest.mark.parametrize(
    ("more", "offset", "message"),
    [
        ("", "300 0 0", "joint 'turn' is 300 m from the joint before it. Give metres"),
        (frame("x" * 1001), "0.3 0 0", "longer than 1000 bytes"),
        (
            "".join(frame(f"l{k}") for k in range(UrdfSettings.max_links)),
            "0.3 0 0",
            f"up to {UrdfSettings.max_links} links, this one has",
        ),
    ],
)
def test_robots_that_pybullet_cannot_take_are_refused(tmp_path, more, offset, message) -> None:
    with pytest.raises(RobotError, match=message):
        written(robot_of(tmp_path, more=more, offset=offset))
