from __future__ import annotations

import cv2
import numpy as np
import pytest
from guided_run import shipped
from scipy.spatial.transform import Rotation

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.sim_backend import CameraConfig
from bodyschema.sim_backend.bullet import load_pybullet
from bodyschema.sim_backend.config import SimTag
from bodyschema.sim_backend.rendering.raster import Grid, Raster
from bodyschema.sim_backend.rendering.stereo_renderer import TO_LIGHT, StereoRenderer, cluttered_room

PLAIN = CameraConfig(noise=0, clutter=0)
UNTURNED = np.eye(3)
CALIBRATION = StereoCalibration(600.0, (319.5, 239.5), 0.09, (640, 480))
RADIUS = CameraConfig().marker_radius_m


@pytest.fixture
def bullet():
    """Yield an empty pybullet world and its module."""
    module = load_pybullet()
    client = module.connect(module.DIRECT)
    yield module, client
    module.disconnect(physicsClientId=client)


def painted(bullet, x, config=PLAIN, seed=0, T_world_camera=None, turn=UNTURNED):
    """Return left and right image of a marker at `x` in the left optical frame."""
    T = np.eye(4) if T_world_camera is None else T_world_camera
    images = tuple(np.zeros((480, 640, 3), dtype=np.uint8) for _ in range(2))
    eyes = StereoRenderer(Raster(*bullet, CALIBRATION, TO_LIGHT), CALIBRATION, config, seed)
    eyes.paint(0, T, np.stack([x, x - [CALIBRATION.baseline_m, 0, 0]]), turn, images)
    return images


def ellipse_centre(x):
    """Return the outline's centre (u, v) of a ball at `x`: the projected centre, shifted outward by z²/(z²-r²)."""
    stretch = x[2] ** 2 / (x[2] ** 2 - RADIUS**2)
    return np.array([319.5, 239.5]) + CALIBRATION.focal_px * stretch * x[:2] / x[2]


def weighted_centre(weight):
    rows, columns = np.indices(weight.shape)
    return np.array([(columns * weight).sum(), (rows * weight).sum()]) / weight.sum()


def ball_centre(image):
    """Return the ball's centroid in an image with a plain light wall: clipped green contrast, free of shading."""
    contrast = 1.0 - image[..., 1] / 120.0
    return weighted_centre(np.clip(contrast, 0.0, 0.5))


def random_places(count, seed):
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.35, 0.9, count)
    return np.column_stack([rng.uniform(-0.3, 0.3, (count, 2)) * depth[:, None], depth])


def test_rendered_ball_centre_matches_the_calibration(bullet):
    misses = []
    for x in random_places(12, 0):
        for image, shift in zip(painted(bullet, x), (0.0, CALIBRATION.baseline_m), strict=True):
            misses.append(ball_centre(image) - ellipse_centre(x - [shift, 0.0, 0.0]))
    assert np.abs(np.mean(misses, axis=0)).max() < 0.03
    assert np.std(misses, axis=0).max() < 0.06


@pytest.mark.parametrize("per_pixel", [0.5, 1, 3])
def test_tiny_renderer_matches_calibrated_pixel_positions(bullet, per_pixel):
    module, client = bullet
    shape = module.createVisualShape(module.GEOM_SPHERE, radius=RADIUS, physicsClientId=client)
    body = module.createMultiBody(0, -1, shape, physicsClientId=client)
    raster = Raster(module, client, CALIBRATION, TO_LIGHT)
    grid = Grid(0, 0, int(640 * per_pixel), int(480 * per_pixel), per_pixel)
    misses = []
    for x in random_places(12 if per_pixel < 3 else 5, 1):
        module.resetBasePositionAndOrientation(body, x.tolist(), [0, 0, 0, 1], physicsClientId=client)
        _, depth = raster.render(np.eye(4), grid)
        sample = weighted_centre(np.isfinite(depth).astype(float))
        misses.append((sample + 0.5) / per_pixel - 0.5 - ellipse_centre(x))
    assert np.abs(np.mean(misses, axis=0)).max() < 0.1


def test_robot_depths_are_metres_along_optical_axis(bullet):
    module, client = bullet
    shape = module.createVisualShape(module.GEOM_BOX, halfExtents=[1, 1, 0.1], physicsClientId=client)
    module.createMultiBody(0, -1, shape, [0, 0, 0.9], physicsClientId=client)
    _, depth = Raster(module, client, CALIBRATION, TO_LIGHT).render(np.eye(4), Grid(0, 0, 640, 480, 1))
    np.testing.assert_allclose(depth, 0.8, atol=1e-4)


def red_pixels(image):
    blue, green, red = np.moveaxis(image.astype(int), -1, 0)
    return int(((red > 90) & (red > 2 * green) & (red > 2 * blue)).sum())


@pytest.mark.parametrize(("z", "hidden"), [(0.4, True), (0.8, False)])
def test_only_objects_in_front_hide_the_ball(bullet, z, hidden):
    module, client = bullet
    shape = module.createVisualShape(
        module.GEOM_BOX, halfExtents=[0.2, 0.2, 0.02], rgbaColor=[0.5, 0.5, 0.5, 1], physicsClientId=client
    )
    module.createMultiBody(0, -1, shape, [0, 0, z], physicsClientId=client)
    left, right = painted(bullet, np.array([0.03, 0.0, 0.6]))
    seen = [red_pixels(image) > 500 for image in (left, right)]
    assert seen == [not hidden, not hidden]


def test_edge_half_across_the_ball_hides_half(bullet):
    module, client = bullet
    shape = module.createVisualShape(
        module.GEOM_BOX, halfExtents=[0.1, 0.2, 0.001], rgbaColor=[0.5, 0.5, 0.5, 1], physicsClientId=client
    )
    module.createMultiBody(0, -1, shape, [0.1, 0, 0.5], physicsClientId=client)  # its edge is the left camera's axis
    x = np.array([0.0, 0.0, 0.6])
    whole_area = np.pi * (CALIBRATION.focal_px * RADIUS) ** 2 / (0.6**2 - RADIUS**2)
    assert red_pixels(painted(bullet, x)[0]) == pytest.approx(whole_area / 2, rel=0.1)


def test_image_noise_has_stated_size_independently_per_eye(bullet):
    behind = np.array([0.0, 0.0, -1.0])
    clean = painted(bullet, behind)
    noisy = painted(bullet, behind, CameraConfig(noise=3.0, clutter=0))
    left, right = (image.astype(float) - base for image, base in zip(noisy, clean, strict=True))
    assert left.std() == pytest.approx(3.0, rel=0.05)
    assert abs(np.corrcoef(left.ravel(), right.ravel())[0, 1]) < 0.02


def test_the_background_moves_against_the_heads_turn(bullet):
    config, away = CameraConfig(noise=0, clutter=1000), np.array([0.0, 0.0, -1.0])
    forward = Rotation.from_euler("xyz", [-np.pi / 2, 0, -np.pi / 2]).as_matrix()
    yaw, pictures = 0.1, []
    for angle in (0.0, yaw):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("z", angle).as_matrix() @ forward
        pictures.append(painted(bullet, away, config, T_world_camera=T)[0].astype(float))
    # The head turns left, the room moves right; about the middle of the image by f·tan(yaw).
    shift = round(CALIBRATION.focal_px * np.tan(yaw))
    here, there = pictures[0][200:280, 250:350], pictures[1][200:280, 250 + shift : 350 + shift]
    unmoved = pictures[1][200:280, 250:350]
    assert np.abs(here - there).mean() < 0.5 * np.abs(here - unmoved).mean()


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(1, 5))])
def test_background_is_never_as_red_as_the_ball(seed):
    assert red_pixels(cluttered_room(200, np.random.default_rng(seed))) == 0


@pytest.mark.parametrize("hue_deg", [0.0, 120.0, 350.0])
@pytest.mark.parametrize("gap_deg", [36.0, 96.0])
def test_the_background_avoids_the_balls_hue(hue_deg, gap_deg):
    room = cluttered_room(200, np.random.default_rng(0), ball_hue_deg=hue_deg, gap_deg=gap_deg)
    hue, saturation, _ = np.moveaxis(cv2.cvtColor(room, cv2.COLOR_BGR2HSV).astype(float), -1, 0)
    apart_deg = np.abs((2.0 * hue - hue_deg + 180.0) % 360.0 - 180.0)[saturation > 100]
    assert len(apart_deg) > 1000
    assert (apart_deg < gap_deg - 8.0).mean() < 0.01  # a blurred edge mixes two things


def test_a_lamp_is_brighter_than_all_else(bullet):
    lamp = CameraConfig(noise=0, light=0.3, ball_rgb=(0.9, 0.9, 0.9))
    left, _ = painted(bullet, np.array([0.03, 0.0, 0.6]), lamp)
    grey = left.mean(axis=2)
    assert grey.max() == pytest.approx(0.9 * 255, abs=1)
    assert np.percentile(grey, 90) < 0.3 * 255


def test_shipped_calibration_has_a_centred_principal_point():
    calibration = shipped().calibration
    assert calibration is not None
    assert calibration.principal_point_px == (319.5, 239.5)


TAGS = CameraConfig(noise=0, clutter=0, tags=(SimTag(id=3, xyz=(0.01, 0.0, 0.0), rpy=(0.0, 0.0, 0.0), side_m=0.06),))
FACING = np.diag([1.0, -1.0, -1.0])


def test_a_tag_is_where_its_pose_says(bullet) -> None:
    """The black square of an upright tag that faces the eye, by where its outline crosses the middle grey."""
    x = np.array([0.02, -0.03, 0.6])
    image = painted(bullet, x, TAGS, turn=FACING)[0].mean(axis=2)
    u, v = np.array([319.5, 239.5]) + 600.0 * np.array([x[0] + 0.01, x[1]]) / 0.6
    black = image < 60.0
    rows, columns = np.flatnonzero(black[:, round(u - 27)]), np.flatnonzero(black[round(v - 27)])
    assert (rows.min() + rows.max()) / 2 == pytest.approx(v, abs=0.5)
    assert (columns.min() + columns.max()) / 2 == pytest.approx(u, abs=0.5)
    assert len(rows) == len(columns) == pytest.approx(60, abs=1)


def test_a_tag_is_not_seen_from_behind(bullet) -> None:
    x = np.array([0.0, 0.0, 0.6])
    from_behind = painted(bullet, x, TAGS, turn=UNTURNED)[0]
    assert from_behind.min() > 60


def test_object_before_a_tag_hides_it(bullet) -> None:
    module, client = bullet
    shape = module.createVisualShape(
        module.GEOM_BOX, halfExtents=[0.1] * 3, rgbaColor=[0, 1, 0, 1], physicsClientId=client
    )
    module.createMultiBody(0, -1, shape, basePosition=[0, 0, 0.4], physicsClientId=client)
    image = painted(bullet, np.array([0.0, 0.0, 0.6]), TAGS, turn=FACING)[0]
    assert (image[200:280, 290:350, 1] > image[200:280, 290:350, 2]).all()
