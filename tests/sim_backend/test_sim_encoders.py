from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from bodyschema.sim_backend import EncoderConfig
from bodyschema.sim_backend.sources import Encoders

TICK = 2 * np.pi / 4096
ANGLES = st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3).map(np.array)


def encoders(noise_ticks=0.0, offsets=(0.0, 0.0, 0.0), prismatic=(False, False, False), seed=0):
    config = EncoderConfig(noise_ticks=noise_ticks)
    return Encoders(config, np.array(offsets), np.array(prismatic), np.random.default_rng(seed))


@given(ANGLES)
def test_a_reading_is_the_nearest_whole_tick(true):
    reading = encoders().read(true)
    assert np.abs(reading - true).max() <= TICK / 2 + 1e-12
    np.testing.assert_allclose(reading / TICK, np.round(reading / TICK), atol=1e-9)


@given(ANGLES)
def test_an_offset_is_added_to_the_true_angle(true):
    reading = encoders(offsets=(0.1, -0.2, 0.3)).read(true)
    assert np.abs(reading - true - [0.1, -0.2, 0.3]).max() <= TICK / 2 + 1e-12


def test_prismatic_joint_is_read_in_own_ticks():
    reading = encoders(prismatic=(True, False, False)).read(np.array([0.100026, 0.0, 0.0]))
    assert reading[0] == np.round(0.100026 * 20_000) / 20_000


def test_the_noise_has_the_stated_size():
    source = encoders(noise_ticks=5.0)
    errors = np.array([source.read(np.zeros(3)) for _ in range(2000)]) / TICK
    assert abs(errors.std() - 5.0) < 0.25  # 6000 values: 0.05 standard error, and 1/12 of a tick² from rounding
