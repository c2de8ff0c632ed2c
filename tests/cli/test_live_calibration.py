"""Calibrating and checking the robot's own cameras while a person moves the board."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from io import StringIO
from pathlib import Path
from unittest.mock import Mock

import cv2
import msgspec
import numpy as np
import pytest
from board_renderer import webcams
from rich.console import Console
from shown_board import BOARD, SIZE, KnownCorners, corner_views, known_rig, photographed, shot
from small_arm import write_small_arm

from bodyschema.cli.cameras.calibration import CheckFile, calibrated, kept_in
from bodyschema.cli.cameras.live_calibration import Lines, LiveCalibration, Shown, checked_live, guidance_on, screen
from bodyschema.cli.commands.calibrate.calibrate_cameras import KnownCameras
from bodyschema.cli.main import app
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import ConfigError, SourceEnded, SourceLost
from bodyschema.interfaces.records import StereoFrame
from bodyschema.vision.calibration.calibrate import Calibrated
from bodyschema.vision.calibration.gather import Gathered
from bodyschema.vision.calibration.image_pairs import pair_files
from bodyschema.vision.calibration.live import LiveViews
from bodyschema.vision.calibration.view import View
from bodyschema.vision.rig.rig_file import read_rig, write_rig
from bodyschema.vision.rig.stereo_rig import CalibrationError, StereoRig

RIGHT = ("A1", "B2")


class PluggedEyes:
    """Cameras that follow a script of frames and losses; `serials` are those of each opening, the last one stays."""

    def __init__(self, script: Iterable[StereoFrame | SourceLost], serials: Iterable[tuple[str, str]] = (RIGHT,)):
        self._script, self._plugged = list(script), list(serials)
        self.serials, self.image_size_px = self._plugged[0], SIZE
        self.health: tuple[str, ...] = ()
        self.opened, self.is_open = 0, False

    def __enter__(self):
        self.serials = self._plugged[min(self.opened, len(self._plugged) - 1)]
        self.opened, self.is_open = self.opened + 1, True
        return self

    def __exit__(self, *_) -> None:
        self.is_open = False

    def read(self, timeout_s: float) -> StereoFrame:
        if not self._script:
            raise SourceEnded("through")
        step = self._script.pop(0)
        if isinstance(step, SourceLost):
            raise step
        return step


@pytest.fixture(scope="module")
def views() -> list[View]:
    """Return views of all kinds, from a user who followed the instructions."""
    rng = np.random.default_rng(21)
    return corner_views(webcams(rng), rng, 30)


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bodyschema.interfaces.waits.Waits.first_s", 0.0)


def held(views: list[View], places: Iterable[int] | None = None) -> tuple[LiveViews, list[StereoFrame]]:
    """Return each view held for two frames."""
    shown = [k for k in (range(len(views)) if places is None else places) for _ in range(2)]
    return LiveViews(BOARD, KnownCorners(views)), [shot(k, 0.1 * n) for n, k in enumerate(shown)]


def fitted(found: Gathered, serials: tuple[str, str], tell: Callable[[str], None]) -> Calibrated:
    return calibrated(found, KnownCameras(lens="pinhole"), tell, serials)


def unfitted(found: Gathered, serials: tuple[str, str], tell: Callable[[str], None]) -> Calibrated:
    """Fit nothing, for tests of the views alone."""
    return Mock(spec=Calibrated)


def live(eyes: PluggedEyes, views: LiveViews, provenance=fitted, show=lambda _: None, **given) -> LiveCalibration:
    return LiveCalibration(eyes, views, provenance, show, SystemClock(), **given)


def test_it_ends_by_itself_when_nothing_is_missing(views) -> None:
    seen, frames = held(views)
    eyes = PluggedEyes(frames)
    found, result = live(eyes, seen).run()
    assert found.coverage().missing() == []
    assert len(found.views) < len(views)
    assert (result.rig.serials, eyes.is_open) == (RIGHT, False)


@pytest.mark.soak
def test_given_serials_override_those_of_the_cameras(views) -> None:
    seen, frames = held(views)
    found, _ = live(PluggedEyes(frames), seen).run()
    assert calibrated(found, KnownCameras(left_serial="L", lens="pinhole"), lambda _: None, RIGHT).rig.serials == (
        "L",
        "B2",
    )


def test_refused_calibration_is_shown_and_capture_continues(views) -> None:
    shown: list[Shown] = []
    tries: list[int] = []

    def strict(found: Gathered, serials, tell) -> Calibrated:
        tries.append(len(found.views))
        if len(tries) == 1:
            raise CalibrationError("the left focal length is known to 2 % only")
        return unfitted(found, serials, tell)

    seen, frames = held(views)
    live(PluggedEyes(frames), seen, strict, shown.append).run()
    assert tries[1] == tries[0] + 4
    assert any(each.refusal == "the left focal length is known to 2 % only" for each in shown)


def test_stopping_calibrates_from_the_views_so_far(views) -> None:
    seen, frames = held(views)
    eyes = PluggedEyes(frames)

    def show(shown: Shown) -> None:
        if shown.views == 10:
            calibration.stop()

    calibration = live(eyes, seen, show=show)
    found, result = calibration.run()
    assert (len(found.views), result.rig.provenance.views) == (10, 10)


def test_stopping_too_early_names_missing_views(views) -> None:
    seen, frames = held(views, range(3))
    with pytest.raises(CalibrationError, match="too few views: both eyes saw the board in 3, at least 8"):
        live(PluggedEyes(frames), seen).run()


def test_cameras_that_saw_no_board_say_so() -> None:
    seen, frames = held([View("nothing", None, None)])
    with pytest.raises(CalibrationError, match="there are no images"):
        live(PluggedEyes(frames), seen).run()


def test_views_survive_unplugged_cameras(views, impatient) -> None:
    shown: list[Shown] = []
    seen, frames = held(views, range(10))
    eyes = PluggedEyes([*frames[:9], SourceLost("the left camera is gone"), *frames[9:]])
    found, _ = live(eyes, seen, unfitted, shown.append).run()
    # The board was seen once before the loss and once after it: these two are not held against each other.
    assert (len(found.views), eyes.opened) == (9, 2)
    assert any("the cameras are lost (the left camera is gone)" in text for each in shown for text in each.trouble)


def test_different_cameras_plugged_in_midway_are_refused(views, impatient) -> None:
    shown: list[Shown] = []
    seen, frames = held(views, range(10))
    eyes = PluggedEyes([*frames[:8], SourceLost("unplugged"), *frames[8:]], [RIGHT, ("A1", "C3"), RIGHT])
    told: list[tuple[str, str]] = []

    def provenance(found: Gathered, serials: tuple[str, str], tell: Callable[[str], None]) -> Calibrated:
        told.append(serials)
        return unfitted(found, serials, tell)

    found, _ = live(eyes, seen, provenance, shown.append).run()
    assert (len(found.views), eyes.opened, told) == (10, 3, [RIGHT])
    assert any("A1 and C3 with 640x480 pixels, the views are of A1 and B2" in "".join(each.trouble) for each in shown)


def test_the_images_of_every_view_are_kept(views, tmp_path) -> None:
    seen, frames = held(views, range(9))
    live(PluggedEyes(frames), seen, unfitted, keep=kept_in(tmp_path / "kept")).run()
    assert len(pair_files(tmp_path / "kept", None, None, side_by_side=False)) == 9


# --- pictures


def shown_of(views: list[View], frames: int) -> Shown:
    seen, shots = held(views)
    look = [seen.look(shot) for shot in shots[:frames]][-1]
    return Shown(seen.coverage, len(seen.found.views), look)


def text_of(shown: Shown, width: int = 80) -> str:
    console = Console(width=width, record=True, file=StringIO())
    console.print(screen(shown, BOARD.name))
    return console.export_text()


def test_screen_shows_the_next_and_the_taken_view(views) -> None:
    text = text_of(shown_of(views, 2))
    assert "Next: tilt the board's" in text
    assert "Now:  taken: view 1" in text
    assert text.count("○") > 2


def test_the_screen_fits_a_terminal_of_80_columns(views) -> None:
    shown = shown_of(views, 11)
    assert max(map(len, text_of(shown).splitlines())) <= 80
    assert len(text_of(shown).splitlines()) < 24


def test_lines_report_each_view_without_repetition(views) -> None:
    said: list[str] = []
    lines = Lines(said.append, SystemClock())
    shown = shown_of(views, 2)
    moving = shown_of(views, 3)
    for each in (shown, moving, moving, moving):
        lines(each)
    assert said[0].startswith("taken: view 1. 1 views, ")
    assert said[1:] == ["hold it still"]


def test_lines_report_a_complaint_only_once(views) -> None:
    said: list[str] = []
    lines = Lines(said.append, SystemClock())
    for k in (2, 4):
        lines(replace(shown_of(views, k), trouble=("its autofocus is on",)))
    assert [text[:8] for text in said].count("its auto") == 1


def test_where_there_is_no_terminal_lines_are_printed(views, capsys) -> None:
    with guidance_on(Console(stderr=True), BOARD.name, SystemClock()) as show:
        show(shown_of(views, 2))
    assert capsys.readouterr().err.startswith("taken: view 1. 1 views")


# --- the check


def test_check_waits_until_the_board_is_still(views, tmp_path) -> None:
    rig = known_rig(webcams(np.random.default_rng(21)))
    write_rig(rig, tmp_path / "cameras.toml")
    nothing = View("nothing", None, None)
    seen = LiveViews(BOARD, KnownCorners([nothing, views[0], views[1]]))
    eyes = PluggedEyes([shot(k, 0.1 * n) for n, k in enumerate((0, 1, 2, 2))])
    found = checked_live(eyes, tmp_path / "cameras.toml", seen, lambda _: None, SystemClock(), 60.0)
    assert (found.holds, eyes.is_open) == (True, False)


def test_the_check_of_other_cameras_is_refused(views, tmp_path) -> None:
    write_rig(known_rig(webcams(np.random.default_rng(21))), tmp_path / "cameras.toml")
    seen, frames = held(views)
    with pytest.raises(CalibrationError, match="this is the calibration of another pair"):
        checked_live(
            PluggedEyes(frames, [("A1", "C3")]), tmp_path / "cameras.toml", seen, lambda _: None, SystemClock(), 60.0
        )


def test_the_check_says_why_no_look_came(views, tmp_path) -> None:
    write_rig(known_rig(webcams(np.random.default_rng(21))), tmp_path / "cameras.toml")
    seen, frames = held([View("nothing", None, None)])
    with pytest.raises(CalibrationError, match=r"held still \(left: no board; right: no board\)"):
        checked_live(PluggedEyes(frames), tmp_path / "cameras.toml", seen, lambda _: None, SystemClock(), 60.0)


# --- from the command line, the cameras being images in a folder


@pytest.fixture(scope="module")
def robot(tmp_path_factory) -> Path:
    """Return a robot whose cameras show the board, each view for two frames."""
    folder = tmp_path_factory.mktemp("robot")
    for k, pair in enumerate(photographed()[1][:9]):
        for eye, image in zip(("left", "right"), pair.images, strict=True):
            cv2.imwrite(str(folder / f"{eye}{2 * k:02d}.png"), image)
            (folder / f"{eye}{2 * k + 1:02d}.png").symlink_to(folder / f"{eye}{2 * k:02d}.png")
    cameras = '[vision.cameras.images]\nleft = "left*.png"\nright = "right*.png"\nfps = 10.0\nspeed = 0.0\n'
    return write_small_arm(folder, cameras)


def called(*arguments: object) -> None:
    app([*map(str, arguments)], exit_on_error=False, result_action="return_value")


@pytest.mark.soak  # of images in files: test_cameras_command; of views: the tests above
def test_the_robots_own_cameras_are_calibrated_and_checked(robot, capsys) -> None:
    called("calibrate", "cameras", "--robot", robot, "--lens", "pinhole", "--save", robot.parent / "views")
    said = capsys.readouterr()
    rig, truth = read_rig(robot.parent / "cameras.toml"), photographed()[0]
    assert isinstance(rig, StereoRig)
    assert abs(rig.baseline_m - truth.baseline_m) < 2.5 * rig.baseline_sigma_m
    assert 'In [vision.cameras] write\ncalibration = "cameras.toml"' in said.out
    assert "Next: tilt the board's" in said.err
    assert len(list((robot.parent / "views").glob("left*.png"))) == rig.provenance.views + rig.provenance.left_out
    called("calibrate", "cameras", "--check", "--robot", robot, "--json")
    assert msgspec.json.decode(capsys.readouterr().out, type=CheckFile).holds


def test_a_robot_without_cameras_is_refused(tmp_path) -> None:
    with pytest.raises(ConfigError, match="no cameras are configured"):
        called("calibrate", "cameras", "--robot", write_small_arm(tmp_path))
