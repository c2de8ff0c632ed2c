"""Lens models: directions to pixels and back."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from bodyschema.vision.rig.lens import Lens, Model

SIZE = (320, 240)
BARREL: dict[Model, tuple[float, ...]] = {
    "pinhole": (-0.3, 0.05, 1e-3, -1e-3, 0.0),
    "fisheye": (-0.02, 0.004, 0.0, 0.0),
    "rational": (0.4, 0.02, 1e-3, -1e-3, 0.0, 0.7, 0.1, 0.01),
}


def lens(model: Model, focal_px: float = 260.0, distortion: tuple[float, ...] | None = None) -> Lens:
    return Lens(model, (focal_px, 1.2 * focal_px), (161.0, 118.0), distortion or BARREL[model])


@pytest.mark.parametrize("model", BARREL)
def test_directions_of_projected_points_are_the_points(model) -> None:
    ahead = np.random.default_rng(1).uniform(-0.4, 0.4, (50, 2))
    px = lens(model).project(np.column_stack([ahead, np.ones(50)]))
    np.testing.assert_allclose(lens(model).directions(px), ahead, atol=1e-9)


def test_the_rational_model_is_opencvs() -> None:
    x = np.random.default_rng(2).uniform([-0.4, -0.4, 0.6], [0.4, 0.4, 1.4], (20, 3))
    rational = lens("rational")
    theirs = cv2.projectPoints(x, np.zeros(3), np.zeros(3), rational.matrix, np.array(rational.distortion))[0]
    np.testing.assert_allclose(rational.project(x), theirs[:, 0], atol=1e-9)


@pytest.mark.parametrize("model", BARREL)
def test_a_webcams_lens_is_one_to_one(model) -> None:
    assert lens(model).is_one_to_one(SIZE)


@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("pinhole", (-0.3, 0.0, 0.0, 0.0, 0.0)),  # turns back at 0.70 focal lengths; the corners are at 1
        ("fisheye", (-0.5, 0.0, 0.0, 0.0)),
        ("rational", (0.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.5, 0.0)),
    ],
)
def test_folding_lens_is_not_one_to_one(model, distortion) -> None:
    assert not lens(model, 200.0, distortion).is_one_to_one(SIZE)
    assert lens(model, 900.0, distortion).is_one_to_one(SIZE)
