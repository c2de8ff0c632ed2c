from __future__ import annotations

import colorsys
from dataclasses import replace

import pytest
from ball_renderer import SMALL
from scenes import Ball, reason, sigmas_off, stage

from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.records import Reason
from bodyschema.robot.toml_file import convert, read_toml
from bodyschema.vision.ball.tracker import StereoTracker
from bodyschema.vision.config import NAMED_COLOURS, HueBand, VisionConfig

FAR_SIGMAS = 5.0


def ball_of_hue(hue_deg: float) -> Ball:
    return Ball((0.02, 0.01, 0.8), rgb=colorsys.hsv_to_rgb(hue_deg / 360, 0.9, 0.85))


@pytest.mark.parametrize("colour", NAMED_COLOURS)
def test_ball_of_each_named_colour_is_located(colour):
    ball = ball_of_hue(NAMED_COLOURS[colour].hue_deg)
    assert sigmas_off(StereoTracker(SMALL, VisionConfig(colour=colour)).track(stage(ball)), ball) < FAR_SIGMAS


@pytest.mark.parametrize("colour", NAMED_COLOURS)
def test_only_the_ball_of_the_colour_named_counts(colour):
    others = [
        Ball((0.06 * n - 0.03, y, 0.8), rgb=ball_of_hue(band.hue_deg).rgb)
        for n, y in ((0, -0.08), (1, -0.08), (2, -0.08))
        for other, band in NAMED_COLOURS.items()
        if other == ("red", "green", "blue")[n] and other != colour
    ]
    ball = ball_of_hue(NAMED_COLOURS[colour].hue_deg)
    found = StereoTracker(SMALL, VisionConfig(colour=colour)).track(stage(ball, *others))
    assert sigmas_off(found, ball) < FAR_SIGMAS


def test_bands_of_the_named_colours_do_not_overlap():
    bands = sorted(NAMED_COLOURS.values(), key=lambda band: band.hue_deg)
    for band, following in zip(bands, [*bands[1:], bands[0]], strict=True):
        apart = (following.hue_deg - band.hue_deg) % 360
        assert apart >= band.half_width_deg + following.half_width_deg, (band, following)


@pytest.mark.parametrize("hue_deg", [350.0, 5.0, 75.0, 200.0, 275.0])
def test_ball_of_hue_in_degrees_is_located(hue_deg):
    ball = ball_of_hue(hue_deg)
    tracker = StereoTracker(SMALL, VisionConfig(colour=HueBand(hue_deg)))
    assert sigmas_off(tracker.track(stage(ball)), ball) < FAR_SIGMAS


def test_a_pale_ball_needs_a_lower_saturation():
    pale = Ball((0.02, 0.01, 0.8), rgb=colorsys.hsv_to_rgb(0.0, 0.45, 0.85))
    assert reason(StereoTracker(SMALL).track(stage(pale))) is Reason.NO_MARKER
    tracker = StereoTracker(SMALL, VisionConfig(colour=HueBand(0.0, min_saturation=0.3)))
    assert sigmas_off(tracker.track(stage(pale)), pale) < FAR_SIGMAS


def read(tmp_path, table: str) -> VisionConfig:
    file = tmp_path / "robot.toml"
    file.write_text(f"[vision]\n{table}\n")
    tables, text = read_toml(file)
    return convert(tables["vision"], VisionConfig, file=file, text=text, prefix=("vision",))


def test_hue_band_is_read_from_its_table(tmp_path):
    config = read(tmp_path, "[vision.colour]\nhue_deg = 95\nhalf_width_deg = 10")
    assert config.band == HueBand(95.0, half_width_deg=10.0)


@pytest.mark.parametrize(
    ("table", "line", "said"),
    [
        ('colour = "read"', 2, "vision.colour: 'read' is unknown, known are: red, orange"),
        ("radius_m = 0", 2, "vision.radius_m: expected `float` > 0"),
        ("radius_m = -0.02", 2, "vision.radius_m"),
        ('radius_m = "20 mm"', 2, "vision.radius_m: expected `float`, got `str`"),
        ("radius_mm = 20", 2, "unknown key 'radius_mm' in [vision]. Did you mean 'radius_m'?"),
        ("[vision.colour]\nhue_deg = 400", 3, "vision.colour.hue_deg"),
        ("[vision.colour]\nhue_deg = 10\nhalf_width_deg = 120", 4, "vision.colour.half_width_deg"),
        ("[vision.colour]\nhue_deg = 10\nmin_value = 15", 4, "vision.colour.min_value"),
        ("[vision.colour]\nhue_deg = 10\nhue = 15", 4, "unknown key 'hue' in [vision.colour]"),
    ],
)
def test_a_wrong_setting_is_refused_with_its_line(tmp_path, table, line, said):
    with pytest.raises(ConfigError) as refused:
        read(tmp_path, table)
    assert refused.value.line == line
    assert said in str(refused.value)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("focal_px", 0.0),
        ("focal_px", float("nan")),
        ("baseline_m", -0.06),
        ("baseline_m", float("inf")),
        ("pixel_sigma", -0.1),
        ("principal_point_px", (float("nan"), 120.0)),
        ("image_size_px", (320, 8)),
    ],
)
def test_invalid_stereo_calibration_is_refused_with_its_key(field, value):
    with pytest.raises(ConfigError, match=field):
        StereoTracker(replace(SMALL, **{field: value}))
