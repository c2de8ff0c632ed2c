from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from ball_renderer import SMALL, VGA, Look, clutter, render_pair
from chance import successes
from scenes import RADIUS_M, Errors, compare, measure_errors, place

from benchmarks.tables import Column, Table
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray, MarkerFix, MarkerMiss
from bodyschema.vision.ball.contour import BallContour
from bodyschema.vision.ball.tracker import StereoTracker

LOOKS = {
    "clean": Look(noise_sd=1.0),
    "usual": Look(),
    "noisy": Look(noise_sd=8.0),
    "defocused": Look(blur_px=1.0, noise_sd=4.0),
    "hard edges": Look(samples=1, blur_px=0.0, noise_sd=2.0),
    "half hard edges": Look(samples=2, blur_px=0.0, noise_sd=2.5),
}

# A colour mosaic, noise filter, tone curve, halos and JPEG.
PHONE = Look(sharpen=1.0, bayer=True, denoise=4.0, jpeg=75, tone=1 / 2.2)


def pooled(frames: int, seed: int) -> Errors:
    return joined(measure_errors(SMALL, look, frames, seed + number) for number, look in enumerate(LOOKS.values()))


def joined(kinds: Iterable[Errors]) -> Errors:
    parts = list(kinds)
    return Errors(
        np.concatenate([part.x for part in parts]),
        np.concatenate([part.sigma for part in parts]),
        np.concatenate([part.centres_px for part in parts]),
        tuple(reason for part in parts for reason in part.misses),
    )


@pytest.fixture(scope="module")
def report(tables_folder: Path | None) -> Iterator[Callable[[str, Errors], None]]:
    """Yield what adds a row to the table in docs/results/vision.md; shown by `pytest -s`."""
    axes = "{:.0f} {:.0f} {:.0f}"
    table = Table(
        "ball_accuracy",
        [
            Column("look"),
            Column("median centre error", "px", "{:.3f}"),
            Column("errors within 1 sigma, x y z", "%", axes),
            Column("within 2 sigma", "%", axes),
            Column("no fix", "%", "{:.1f}"),
        ],
    )

    def add(name: str, found: Errors) -> None:
        missed = 100 * len(found.misses) / (len(found.x) + len(found.misses))
        covered = (100 * found.covered(sigmas) for sigmas in (1.0, 2.0))
        table.add(name, np.median(np.abs(found.centres_px)), *covered, missed)

    yield add
    if table.rows:
        table.save(tables_folder)


@pytest.fixture(scope="module")
def errors() -> Errors:
    return pooled(frames=12, seed=1)


def test_sigma_covers_60_to_75_percent_per_axis(errors):
    covered = errors.covered()
    # 72 frames: a standard error is 0.06.
    assert (covered >= 0.60 - 0.06).all(), covered
    assert (covered <= 0.75 + 0.06).all(), covered


def test_two_claimed_sigmas_cover_nine_errors_in_ten(errors):
    assert (errors.covered(2.0) >= 0.88).all(), errors.covered(2.0)


def test_median_centre_error_is_below_a_thirtieth_pixel(errors):
    assert np.median(np.abs(errors.centres_px)) < 1 / 30


def test_the_centres_have_no_bias(errors):
    medians = np.median(errors.centres_px, axis=0)
    assert np.abs(medians).max() < 0.01, medians


def test_ball_in_full_view_is_nearly_always_found(errors):
    # 45 of 1200 others are missed; at a rate of 4 % there are more than this once in a thousand times.
    most = successes(1.0 - 1e-3, len(errors.x) + len(errors.misses), 0.04)
    assert len(errors.misses) <= most, errors.misses


def test_phone_image_errors_stay_within_claimed_sigma():
    found = measure_errors(SMALL, PHONE, 5, seed=3)
    assert len(found.misses) <= 2, found.misses
    assert (np.abs(found.x) < 4.0 * found.sigma).all()


def test_a_ball_on_carpet_in_jpeg_is_found():
    # Chroma at half resolution makes the edge 2 px wide and the carpet keeps its noise: each ray is unsure.
    look = Look(noise_sd=2.0, jpeg=90)
    found: list[tuple[FloatArray, MarkerFix | MarkerMiss]] = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        pictures = carpet(rng), carpet(rng)
        x = place(SMALL, float(rng.uniform(12.0, 36.0)), rng)
        found.append((x, StereoTracker(SMALL).track(render_pair(x, RADIUS_M, look, pictures, rng, SMALL))))
    errors = compare(found, SMALL)
    assert len(errors.misses) <= 2, errors.misses
    assert (np.abs(errors.x) < 5.0 * errors.sigma).all()


def carpet(rng: np.random.Generator) -> FloatArray:
    """Return a picture (240, 320, 3) RGB of 0..1 of green threads."""
    grain = cv2.GaussianBlur(rng.standard_normal((240, 320)), (0, 0), 1.0)
    return np.clip((1.0 + 0.6 * grain / grain.std())[..., None] * np.array([0.1, 0.32, 0.25]), 0.0, 1.0)


def test_bar_along_limb_hardly_pulls_the_centre():
    x = np.array([0.01, 0.0, SMALL.focal_px * RADIUS_M / 12.0])
    u = SMALL.project(x)[0]
    pictures = np.full((2, *SMALL.image_size_px[::-1], 3), 0.6)
    pictures[0, :, round(u - 12.0) : round(u - 6.0)] = (0.1, 0.1, 0.12)
    off_px = []
    for seed in range(12):
        frame = render_pair(
            x, RADIUS_M, Look(noise_sd=2.0), (pictures[0], pictures[1]), np.random.default_rng(seed), SMALL
        )
        fix = StereoTracker(SMALL).track(frame)
        assert isinstance(fix, MarkerFix)
        off_px.append(fix.centres_px[0] - u)
    # 0.07 px if all rays that show an edge have the same weight.
    assert abs(np.mean(off_px)) < 0.05, off_px


def test_limb_evenness_is_share_of_carrying_rays():
    rays = np.zeros((8, 3))
    for carrying in (2, 4, 8):
        weight = np.where(np.arange(8) < carrying, 50.0, 0.0)
        assert BallContour(rays, np.zeros(8), weight, 0.8, 1.0).evenness == pytest.approx(carrying / 8)


def test_more_image_noise_makes_the_claimed_sigma_larger():
    quiet, loud = (measure_errors(SMALL, Look(noise_sd=sd), 4, 7).sigma for sd in (1.0, 12.0))
    assert np.median(loud) > 1.5 * np.median(quiet)


def test_calibration_pixel_sigma_adds_to_covariance():
    rng = np.random.default_rng(3)
    pictures = clutter(rng, SMALL.image_size_px), clutter(rng, SMALL.image_size_px)
    frame = render_pair(np.array([0.02, 0.0, 0.8]), RADIUS_M, Look(), pictures, rng, SMALL)
    exact, rough = (StereoTracker(replace(SMALL, pixel_sigma=sigma)).track(frame) for sigma in (1e-6, 0.3))
    assert isinstance(exact, MarkerFix)
    assert isinstance(rough, MarkerFix)
    added = rough.cov[1, 1] - exact.cov[1, 1]
    # Two rows, each with 0.3 px, at 0.8 m.
    assert added == pytest.approx((0.3 / np.sqrt(2) * 0.8 / SMALL.focal_px) ** 2, rel=0.02)


def test_off_axis_centre_is_sphere_s_not_ellipse_s():
    rng = np.random.default_rng(5)
    wall = np.full((480, 640, 3), 0.5)
    x = np.array([0.12, 0.085, 0.28])
    frame = render_pair(x, RADIUS_M, Look(noise_sd=1.0), (wall, wall), rng, VGA)
    fix = StereoTracker(VGA).track(frame)
    assert isinstance(fix, MarkerFix)
    # The ellipse's centres are 1.1 px and more away from these.
    assert np.abs(np.array(fix.centres_px) - VGA.project(x)).max() < 0.06


@pytest.fixture(scope="module")
def many_errors(report) -> dict[str, Errors]:
    found: dict[str, Errors] = {}
    for name, look in LOOKS.items():
        found[name] = measure_errors(VGA, look, 1000, 100, radii_px=(5.0, 40.0))
        report(name, found[name])
    return found


@pytest.mark.soak
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", LOOKS)
def test_sigma_covers_60_to_75_percent_per_look(many_errors, name):
    covered = many_errors[name].covered()
    # Of 1000 fixes a standard error is 0.014.
    assert ((covered >= 0.60 - 0.014) & (covered <= 0.75 + 0.014)).all(), covered


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_sigma_covers_65_to_71_percent_overall(many_errors, report):
    together = joined(many_errors.values())
    report("all six together", together)
    # Of 5900 fixes a standard error is 0.006.
    assert ((together.covered() >= 0.65 - 0.006) & (together.covered() <= 0.71 + 0.006)).all(), together.covered()


@pytest.mark.soak
def test_claimed_sigma_is_large_enough_before_even_wall(report):
    found = measure_errors(VGA, Look(noise_sd=1.0, wall=0.5), 300, 300)
    report("even wall", found)
    assert (found.covered() >= 0.60).all(), found.covered()


@pytest.mark.soak
def test_median_centre_before_black_stays_within_tenth_pixel(report):
    found = measure_errors(VGA, Look(wall=0.02), 300, 400)
    report("black wall", found)
    assert np.median(np.abs(found.centres_px)) < 0.1


def errors_on_bullet_images(calibration: StereoCalibration, frames: int, seed: int) -> Errors:
    pytest.importorskip("pybullet")
    from bullet_renderer import BulletScene

    rng = np.random.default_rng(seed)
    tracker = StereoTracker(calibration)
    answers = []
    with BulletScene(calibration, RADIUS_M, supersampling=1) as scene:
        for number in range(frames):
            x = place(calibration, float(rng.uniform(10.0, 30.0)), rng)
            light = np.array([rng.uniform(-1, 1), rng.uniform(-1, 0), -1.0])
            frame = scene.render(x, light, float(rng.uniform(1.0, 3.0)), rng, t=float(number))
            answers.append((x, tracker.track(frame)))
    return compare(answers, calibration)


@pytest.mark.soak
def test_simulator_pixel_convention_matches_the_tracker():
    bullet_errors = errors_on_bullet_images(SMALL, frames=20, seed=2)
    # Half a pixel would be the renderer's own convention.
    assert np.abs(np.median(bullet_errors.centres_px, axis=0)).max() < 0.05


def test_ball_is_found_in_nearly_all_simulator_images():
    found = errors_on_bullet_images(SMALL, frames=8, seed=2)
    assert len(found.misses) <= 1, found.misses


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_claimed_sigma_holds_over_many_simulator_images(report):
    found = errors_on_bullet_images(VGA, frames=1000, seed=200)
    report("bullet", found)
    covered = found.covered()
    assert ((covered >= 0.60) & (covered <= 0.75)).all(), covered
    # At a rate of 0.5 % there are more than this once in a thousand times.
    assert len(found.misses) <= successes(1.0 - 1e-3, 1000, 0.005), found.misses
