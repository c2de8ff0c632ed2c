from __future__ import annotations

import colorsys

import cv2
import msgspec
import numpy as np
import pytest
from ball_renderer import SMALL, Look
from scenes import Ball, Slab, sigmas_off, stage

from bodyschema.daemon.wiring.markers import learnt_colour_table
from bodyschema.interfaces.records import MarkerFix
from bodyschema.vision.ball.colour import ColourGate
from bodyschema.vision.ball.colour_model import ColourUnlearnt, colour_at, colour_of_the_moving, colour_table
from bodyschema.vision.ball.tracker import StereoTracker
from bodyschema.vision.config import HueBand, VisionConfig

SKIN = (0.78, 0.55, 0.43)
FAR_SIGMAS = 5.0


def ball(hue_deg: float, x: float = 0.02) -> Ball:
    return Ball((x, 0.01, 0.8), rgb=colorsys.hsv_to_rgb(hue_deg / 360, 0.85, 0.85))


def pixel(thing: Ball) -> tuple[float, float]:
    u, v = SMALL.project(np.array(thing.x))[:2]
    return float(u), float(v)


@pytest.mark.parametrize("hue_deg", [5.0, 60.0, 150.0, 240.0, 330.0])
def test_one_click_suffices_to_track_a_ball(hue_deg):
    shown = ball(hue_deg)
    band = colour_at(stage(shown).left, *pixel(shown))
    elsewhere = ball(hue_deg, x=0.05)
    assert sigmas_off(StereoTracker(SMALL, VisionConfig(colour=band)).track(stage(elsewhere)), elsewhere) < FAR_SIGMAS


def test_learnt_colour_holds_in_other_light():
    shown = ball(200.0)
    band = colour_at(stage(shown, look=Look(ambient=0.5, diffuse=0.6)).left, *pixel(shown))
    dim = stage(shown, look=Look(ambient=0.3, diffuse=0.4, exposure=0.5))
    assert sigmas_off(StereoTracker(SMALL, VisionConfig(colour=band)).track(dim), shown) < FAR_SIGMAS


def test_a_click_on_the_grey_wall_is_refused():
    with pytest.raises(ColourUnlearnt, match="no colour"):
        colour_at(stage(ball(120.0)).left, 20.0, 20.0)


def test_a_click_outside_the_image_is_refused():
    with pytest.raises(ColourUnlearnt, match="outside the image of 320x240"):
        colour_at(stage(ball(120.0)).left, 400.0, 20.0)


@pytest.mark.parametrize("hue_deg", [120.0, 240.0, 330.0])
def test_moving_ball_colour_is_learnt_despite_moving_hand(hue_deg):
    frames = []
    for number in range(8):
        moved = ball(hue_deg, x=-0.04 + 0.02 * number)
        x, y, z = moved.x
        hand = Slab((x - 0.03, y + 0.015), (x + 0.03, y + 0.08), z, rgb=SKIN)
        frames.append(stage(hand, moved, seed=number).left)
    band = colour_of_the_moving(frames)
    assert abs((band.hue_deg - hue_deg + 180) % 360 - 180) < 5.0


def test_where_nothing_moves_nothing_is_learnt():
    with pytest.raises(ColourUnlearnt, match="nothing colourful moves"):
        colour_of_the_moving([stage(ball(120.0), seed=number).left for number in range(5)])


def test_printed_table_matches_learnt_band(tmp_path):
    shown = ball(100.0)
    file = tmp_path / "left.png"
    cv2.imwrite(str(file), stage(shown).left)
    table = msgspec.toml.decode(learnt_colour_table([file], pixel(shown)))
    assert msgspec.convert(table["vision"]["colour"], HueBand).hue_deg == pytest.approx(100.0, abs=4.0)


def test_a_file_that_is_no_image_is_named(tmp_path):
    file = tmp_path / "notes.txt"
    file.write_text("no image")
    with pytest.raises(ColourUnlearnt, match=r"notes\.txt is no image"):
        learnt_colour_table([file], None)


def test_the_band_follows_light_that_grows_warm():
    # At the end the ball's hue is 24° from the band's initial centre, whose half-width is 20°.
    tracker = StereoTracker(SMALL, VisionConfig(colour=HueBand(120.0, half_width_deg=30.0)))
    hues = np.linspace(120.0, 82.0, 50)
    fixes = [tracker.track(stage(ball(float(hue)), t=n / 30, seed=n)) for n, hue in enumerate(hues)]
    assert all(isinstance(fix, MarkerFix) for fix in fixes)


def test_band_drift_is_limited_to_half_its_width():
    gate = ColourGate(HueBand(120.0, half_width_deg=20.0))
    for hue in np.linspace(120.0, 200.0, 400):
        rgb = np.array(colorsys.hsv_to_rgb(float(hue) / 360, 0.9, 0.8))
        gate.adapt(np.full((4, 4, 3), np.rint(255 * rgb[::-1]), np.uint8))
    blue_green = np.full((2, 2, 3), np.rint(255 * np.array(colorsys.hsv_to_rgb(155 / 360, 0.9, 0.8))[::-1]), np.uint8)
    assert not gate.mask(blue_green).any()


def test_the_table_has_every_setting_of_a_band():
    band = HueBand(200.0, 12.0, 0.3, 0.2)
    assert msgspec.toml.decode(colour_table(band))["vision"]["colour"] == msgspec.to_builtins(band)


@pytest.mark.parametrize("exposure", [1.0, 1.6])
def test_bright_ball_is_found_even_when_over_exposed(exposure):
    white = Ball((0.02, 0.01, 0.8), rgb=(0.95, 0.95, 0.95))
    look = Look(exposure=exposure, ambient=0.7, diffuse=0.3, specular=0.0, noise_sd=2.0)
    frame = stage(white, Slab((-1, -1), (1, 1), 0.8, rgb=(0.2, 0.2, 0.2)), white, look=look)
    fix = StereoTracker(SMALL, VisionConfig(marker="bright_ball")).track(frame)
    assert isinstance(fix, MarkerFix)
    # In over-exposed pixels the stated uncertainty does not cover the clipping: a sixth of a pixel here.
    assert np.abs(fix.x - np.array(white.x))[:2].max() < 4e-4
