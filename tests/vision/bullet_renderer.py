"""A ball before an arm-like heap of capsules and boxes, rendered by pybullet's TinyRenderer."""

from __future__ import annotations

from types import TracebackType
from typing import Any, Self

import numpy as np
from ball_renderer import pixel_means

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray, ImageArray, StereoFrame

NEAR_M, FAR_M = 0.05, 5.0
BROWN, BRICK = (0.45, 0.28, 0.18, 1.0), (0.55, 0.22, 0.16, 1.0)
GREY, BLUE, DARK = (0.75, 0.75, 0.78, 1.0), (0.2, 0.3, 0.6, 1.0), (0.12, 0.12, 0.13, 1.0)
# Optical frame (x right, y down, z forward) to the renderer's frame (x right, y up, z backward), column-major.
VIEW = (1, 0, 0, 0, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1)


class BulletScene:
    """Objects of one pybullet client in the left optical frame."""

    def __init__(self, calibration: StereoCalibration, radius_m: float, supersampling: int) -> None:
        self.calibration, self.radius_m, self.supersampling = calibration, radius_m, supersampling

    def __enter__(self) -> Self:
        import pybullet

        self._bullet: Any = pybullet
        self._client = pybullet.connect(pybullet.DIRECT)
        self._ball = self._body(pybullet.GEOM_MESH, (0.9, 0.05, 0.05, 1.0), **_sphere(self.radius_m))
        for number, colour in enumerate((GREY, BLUE, BROWN, DARK, GREY)):
            at = (-0.5 + 0.25 * number, 0.15 * (-1) ** number, 1.7)
            self._place(
                self._body(pybullet.GEOM_CAPSULE, colour, radius=0.06, length=0.5), at, (0.4 * number, 0.9, 0.2)
            )
        for number, colour in enumerate((BRICK, GREY, BROWN)):
            self._place(
                self._body(pybullet.GEOM_BOX, colour, halfExtents=(0.25, 0.2, 0.05)), (-0.7 + 0.7 * number, -0.3, 2.1)
            )
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bullet.disconnect(self._client)

    def render(
        self, x: FloatArray, light: FloatArray, noise_sd: float, rng: np.random.Generator, t: float = 0.0
    ) -> StereoFrame:
        """Render both images with the ball at `x` (3,) [m], lit from the direction `light` (3,)."""
        self._place(self._ball, x)
        left, right = (self._eye(shift, light) for shift in (0.0, self.calibration.baseline_m))
        return StereoFrame(t, *(_noisy(image, noise_sd, rng) for image in (left, right)))

    def _body(self, kind: int, colour: tuple[float, ...], **shape: object) -> int:
        visual = self._bullet.createVisualShape(
            kind, rgbaColor=colour, specularColor=(0.3, 0.3, 0.3), physicsClientId=self._client, **shape
        )
        return int(self._bullet.createMultiBody(0, -1, visual, physicsClientId=self._client))

    def _place(self, body: int, xyz: Any, rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        turned = self._bullet.getQuaternionFromEuler(rpy)
        self._bullet.resetBasePositionAndOrientation(body, list(xyz), turned, physicsClientId=self._client)

    def _eye(self, shift_m: float, light: FloatArray) -> ImageArray:
        width, height = self.calibration.image_size_px
        n = self.supersampling
        view: list[float] = list(VIEW)
        view[12] = -shift_m
        _, _, rgba, _, _ = self._bullet.getCameraImage(
            width * n,
            height * n,
            view,
            self._projection(),
            lightDirection=light.tolist(),
            lightColor=(1, 1, 1),
            lightDistance=3.0,
            shadow=0,
            lightAmbientCoeff=0.5,
            lightDiffuseCoeff=0.5,
            lightSpecularCoeff=0.2,
            renderer=self._bullet.ER_TINY_RENDERER,
            physicsClientId=self._client,
        )
        samples = np.reshape(np.asarray(rgba, dtype=np.float32), (height * n, width * n, 4))
        return pixel_means(samples, n)[..., 2::-1].astype(np.uint8)

    def _projection(self) -> list[float]:
        """Return a frustum in which pixel centres have integer image coordinates.

        TinyRenderer samples column i at its left edge and row j at its lower edge, so the frustum is shifted by half
        a (sub)pixel to either side.
        """
        width, height = self.calibration.image_size_px
        (cx, cy), n = self.calibration.principal_point_px, self.supersampling
        per_px = NEAR_M / self.calibration.focal_px
        half_sub = 0.5 / n
        left, right = (-0.5 + half_sub - cx) * per_px, (width - 0.5 + half_sub - cx) * per_px
        top, bottom = (cy + 0.5 + half_sub) * per_px, (cy + 0.5 + half_sub - height) * per_px
        return list(self._bullet.computeProjectionMatrix(left, right, bottom, top, NEAR_M, FAR_M))


def _sphere(radius_m: float) -> dict[str, Any]:
    """Return the mesh of a sphere whose limb is round to 0.03 % of its radius.

    pybullet's own sphere is a polyhedron: its limb is a polygon of some twelve corners, up to 5 % of the radius inside
    the sphere's, with 6 % less area.
    """
    rings, sectors = 48, 96
    polar, azimuth = np.pi * np.arange(rings + 1) / rings, 2.0 * np.pi * np.arange(sectors) / sectors
    x, y = (np.outer(np.sin(polar), part) for part in (np.cos(azimuth), np.sin(azimuth)))
    normals = np.stack([x, y, np.repeat(np.cos(polar)[:, None], sectors, axis=1)], axis=2).reshape(-1, 3)
    above = np.arange(rings * sectors).reshape(rings, sectors)
    beside = np.roll(above, -1, axis=1)
    corners = [above, above + sectors, beside + sectors, above, beside + sectors, beside]
    return {
        "vertices": (radius_m * normals).tolist(),
        "indices": np.stack(corners, axis=2).ravel().tolist(),
        "normals": normals.tolist(),
    }


def _noisy(image: ImageArray, noise_sd: float, rng: np.random.Generator) -> ImageArray:
    noise = rng.normal(0.0, noise_sd, image.shape)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)
