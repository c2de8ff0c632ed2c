"""Mechanisms between an encoder's reading and a joint's true position."""

from __future__ import annotations

import math

import numpy as np
import pytest

from .joints import biased_poles, lag_that_leaves, lagging, left_of_move, off_centre_ring, play


def test_an_off_centre_ring_errs_once_per_turn() -> None:
    angle = np.linspace(-3.0, 3.0, 200)
    error = off_centre_ring(angle, 0.05, 0.0) - angle
    np.testing.assert_allclose(off_centre_ring(angle + 2.0 * np.pi, 0.05, 0.0) - angle - 2.0 * np.pi, error, atol=1e-12)
    assert np.abs(error).max() == pytest.approx(math.asin(0.05), rel=1e-3)  # the line of sight touches the circle


def test_biased_poles_err_once_per_pole() -> None:
    angle = np.linspace(-1.0, 1.0, 200)
    error = biased_poles(angle, 12.0, 0.1, -0.05) - angle
    np.testing.assert_allclose(
        biased_poles(angle + np.pi / 6.0, 12.0, 0.1, -0.05) - angle - np.pi / 6.0, error, atol=1e-12
    )
    assert np.abs(error).max() == pytest.approx(math.asin(math.hypot(0.1, 0.05)) / 12.0, rel=1e-2)


def test_play_is_the_width_between_both_directions() -> None:
    up = np.linspace(-1.0, 1.0, 201)
    output = play(np.concatenate([up, up[::-1], up]), 0.2)
    back, again = output[201:402][::-1], output[402:]
    np.testing.assert_allclose((back - again)[25:-25], 0.2)


def test_backlash_holds_output_while_direction_reverses() -> None:
    turning = np.concatenate([np.linspace(0.0, 1.0, 50), np.linspace(1.0, 0.85, 20)])
    assert (play(turning, 0.2)[50:] == play(turning, 0.2)[49]).all()


def test_a_lag_follows_a_step_exponentially() -> None:
    t = np.array([0.0, 1e-9, 0.1, 0.2, 0.4])
    output = lagging(t, np.array([0.0, 1.0, 1.0, 1.0, 1.0]), 0.1)
    np.testing.assert_allclose(1.0 - output[2:], np.exp(-t[2:] / 0.1), rtol=1e-6)


def test_lag_computed_for_residual_share_leaves_that_share() -> None:
    assert left_of_move(lag_that_leaves(0.2, 1.0, 0.5), 1.0, 0.5) == pytest.approx(0.2, rel=1e-6)
