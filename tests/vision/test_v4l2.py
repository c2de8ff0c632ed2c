"""Cameras under OpenCV's V4L2 backend, emulated below it, with the usual faults of webcams."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from v4l2_cameras import WALL_CLOCK, ZERO, ShimCamera, compiled, preloaded

PROBE = Path(__file__).parent / "v4l2_shim" / "probe.py"
ROOT = Path(__file__).parents[2]
SIZE_PX = (160, 120)
FPS = 60.0
LIMIT_S = 300.0
GREY = [np.full((SIZE_PX[1], SIZE_PX[0], 3), 60 + 2 * k, np.uint8) for k in range(60)]
WIDE = [np.hstack([image, image + 40]) for image in GREY]

Cameras = dict[str, ShimCamera]
Make = Callable[..., ShimCamera]


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = compiled(tmp_path_factory.mktemp("shim"))
    if found is None:
        pytest.skip("cameras are emulated in C; to run it: apt-get install gcc linux-libc-dev")
    return found


@pytest.fixture
def camera(tmp_path):
    """Yield a function that plugs a camera in."""
    with ExitStack() as stack:

        def plug(name: str, images=GREY, **settings: Any) -> ShimCamera:
            made = ShimCamera(tmp_path / f"usb-{name}-video-index0", images, **{"fps": FPS, **settings})
            return stack.enter_context(made)

        yield plug


def settings_of(given: dict[str, Any]) -> dict[str, Any]:
    return {"image_size_px": SIZE_PX, "fps": FPS, **given}


def two(left: ShimCamera, right: ShimCamera, **given: Any) -> dict[str, Any]:
    return {"two": {"left": str(left.file), "right": str(right.file), **settings_of(given)}, "latency_sigma_s": 0.0}


def one(device: ShimCamera, **given: Any) -> dict[str, Any]:
    return {"side_by_side": {"device": str(device.file), **settings_of(given)}, "latency_sigma_s": 0.0}


def start(library: Path, table: dict[str, Any], frames: int) -> subprocess.Popen[bytes]:
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    process = subprocess.Popen(
        [sys.executable, str(PROBE), str(frames)], env={**preloaded(library), "PYTHONPATH": path}, **pipes
    )
    assert process.stdin is not None
    process.stdin.write(json.dumps(table).encode())
    process.stdin.close()
    process.stdin = None
    return process


def probe(library: Path, table: dict[str, Any], frames: int = 40) -> dict[str, Any]:
    out, errors = start(library, table, frames).communicate(timeout=LIMIT_S)
    assert out, errors.decode()
    return json.loads(out)


def complaint(told: dict[str, Any], words: str) -> str:
    return next((text for text in told["health"] if words in text), f"nobody complains: {told}")


def test_kernel_timestamps_are_used_and_eyes_share_image(library, camera) -> None:
    told = probe(library, one(camera("one", WIDE)))
    assert told["stamps"] == ["kernel"]
    assert 0 < np.median(told["behind"]) < 0.1
    assert (np.diff(told["t"]) > 0).all()
    assert {right - left for left, right in told["levels"]} <= {39, 40, 41}


def test_time_offset_between_cameras_enters_time_sigma(library, camera) -> None:
    told = probe(library, two(camera("left"), camera("right", phase=0.3)))
    assert np.median(told["sigma"]) == pytest.approx(np.hypot(0.3 / FPS, 1e-3), rel=0.02)


def test_uncompressed_images_are_read_too(library, camera) -> None:
    told = probe(library, one(camera("one", WIDE, fourcc="YUYV"), fourcc="YUYV"))
    assert len(told["t"]) > 10
    assert complaint(told, "sends YUYV").startswith("nobody complains")


@pytest.mark.parametrize("stamps", [ZERO, WALL_CLOCK])
def test_non_monotonic_timestamps_are_replaced_by_arrival_time(library, camera, stamps) -> None:
    device = camera("one", WIDE)
    device.set(stamps=stamps)
    told = probe(library, one(device))
    assert told["stamps"] == ["arrival"]
    assert min(told["sigma"]) >= 0.02
    assert "no monotonic time stamps" in complaint(told, "time stamps")


def test_settings_arrive_at_the_camera(library, camera) -> None:
    device = camera("one", WIDE)
    wanted = {"exposure_s": 0.008, "gain": 100, "white_balance_k": 5000, "focus": 30}
    told = probe(library, one(device, **wanted))
    names = ("exposure", "gain", "wb_temperature", "focus", "auto_exposure", "auto_wb", "autofocus")
    assert [device.control(name) for name in names] == [80, 100, 5000, 30, 1, 0, 0]
    assert not any("does not" in text or "focus" in text for text in told["health"])


def test_ignored_setting_and_persistent_automatic_are_named(library, camera) -> None:
    device = camera("one", WIDE)
    device.make_deaf("gain")
    device.make_deaf("autofocus")
    told = probe(library, one(device, gain=100, focus=30))
    assert "does not take gain = 100: it has 64" in complaint(told, "gain")
    assert "does not switch its automatic for focus off" in complaint(told, "focus")
    assert "calibration no longer holds" in complaint(told, "autofocus is on")


def test_wrong_image_size_is_refused_with_actual_size(library, camera) -> None:
    told = probe(library, one(camera("one", GREY)))
    assert told["error"].startswith("SourceError: the stereo camera sends 160x120 pixels, not 320x120")


def test_reduced_frame_rate_is_reported_despite_camera_promise(library, camera) -> None:
    told = probe(library, one(camera("one", WIDE, fps=10.0, told_fps=30.0), fps=30.0), 20)
    assert "sends 10.0 frames/s instead of 30" in complaint(told, "frames/s")


def test_frame_rate_not_offered_is_reported(library, camera) -> None:
    told = probe(library, one(camera("one", WIDE, fps=10.0), fps=30.0), 10)
    assert "offers 10 frames/s, not 30" in complaint(told, "offers")


def test_lens_cap_and_over_exposure_name_their_camera(library, camera) -> None:
    black, white = [image // 30 for image in GREY], [np.full_like(image, 255) for image in GREY]
    told = probe(library, two(camera("left", black), camera("right", white)))
    assert "the left camera's image is black: is the lens cap on?" in complaint(told, "black")
    assert "the right camera is over-exposed: 100 %" in complaint(told, "over-exposed")


def test_half_images_are_dropped_and_counted(library, camera) -> None:
    device = camera("one", WIDE)
    device.set(torn_every=2)
    told = probe(library, one(device))
    assert told["damaged"][0] > 5
    assert {right - left for left, right in told["levels"]} <= {39, 40, 41}


def test_camera_sending_only_half_images_is_refused(library, camera) -> None:
    device = camera("one", WIDE)
    device.set(torn_every=1)
    assert "sent no whole image" in probe(library, one(device))["error"]


def test_a_camera_that_is_not_there_is_named(library, camera) -> None:
    device = camera("one", WIDE)
    device.file.unlink()
    assert "is not there. Plug it in" in probe(library, one(device))["error"]


def test_silent_second_camera_error_names_shared_hub(library, camera) -> None:
    left, right = camera("left"), camera("right")
    right.set(silent=1)
    told = probe(library, two(left, right))
    assert told["error"].startswith("SourceLost: the right camera sends no images")
    assert "Two cameras on one hub" in told["error"]


def test_unplugging_one_of_two_cameras_is_a_loss(library, camera) -> None:
    left, right = camera("left"), camera("right", phase=0.4)
    process = start(library, two(left, right), 10_000)
    assert process.stderr is not None
    process.stderr.readline()
    right.set(unplugged=1)
    told = json.loads(process.communicate(timeout=LIMIT_S)[0])
    assert told["error"].startswith("SourceLost: the right camera sends no images")
