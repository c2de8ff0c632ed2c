"""Configuration of cameras, time stamps and pairing of their images, and files used as cameras."""

from __future__ import annotations

import tomllib
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bodyschema.interfaces.errors import ConfigError, SourceEnded, SourceError
from bodyschema.vision.cameras.config import CamerasConfig, ImagesConfig, TwoConfig, VideosConfig
from bodyschema.vision.cameras.image_monitor import exposure_fault
from bodyschema.vision.cameras.image_reader import ImageReader
from bodyschema.vision.cameras.opened import eyes_of
from bodyschema.vision.cameras.pairing import Pairing, Shot
from bodyschema.vision.cameras.stamps import Stamps, _Settings
from bodyschema.vision.cameras.v4l2.serials import connected, serial_of

FILE = Path("robot.toml")
BY_ID = "/dev/v4l/by-id/usb-A-video-index0"
PIXEL = np.zeros((1, 1, 3), np.uint8)


class HandClock:
    """A clock that a test sets; sleeping moves it."""

    def __init__(self) -> None:
        self.t = 100.0

    def now(self) -> float:
        return self.t

    def utc(self) -> str:
        return "2026-01-01T00:00:00Z"

    def sleep(self, seconds: float) -> None:
        self.t += seconds


# --- robot.toml


def two(left: str = BY_ID, right: str = "/dev/v4l/by-path/b") -> dict[str, object]:
    return {"two": {"left": left, "right": right, "image_size_px": [640, 480]}}


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({}, "no cameras are named"),
        ({**two(), "images": {"left": "a", "right": "b", "fps": 1.0}}, "from both two and images"),
        (two(left="0"), "'0' may be another camera after the next plugging in.*ls /dev/v4l/by-id"),
        (two(right="/dev/video2"), "'/dev/video2' may be another camera"),
        (two(right=BY_ID), "both eyes are the same device"),
        ({"side_by_side": {"device": "1", "image_size_px": [640, 480]}}, "side_by_side.device: '1' may be another"),
        ({"images": {"left": "a", "right": "b"}}, "times have to come from one thing"),
        ({"images": {"left": "a", "right": "b", "fps": 1.0, "times": "t"}}, "times have to come from one thing"),
        ({"videos": {"right": "a"}}, "which films"),
        ({"videos": {"left": "a", "right": "b", "side_by_side": "c"}}, "which films"),
        ({"videos": {"side_by_side": "c", "fps": 1.0, "times": "t"}}, "times have to come from one thing"),
    ],
)
def test_contradictory_cameras_table_is_refused_with_remedy(table, message) -> None:
    with pytest.raises(ConfigError, match=message):
        msgspec.convert(table, CamerasConfig).check(FILE, "")


def test_default_latency_uncertainty_applies_to_devices_only() -> None:
    images = {"images": {"left": "a", "right": "b", "fps": 1.0}}
    assert msgspec.convert(two(), CamerasConfig).sigma_s > 0.01
    assert msgspec.convert({**two(), "latency_sigma_s": 0.001}, CamerasConfig).sigma_s == 0.001
    assert msgspec.convert(images, CamerasConfig).sigma_s == 0.0


# --- time


def stamped(pairs: list[tuple[float, float]]) -> tuple[Stamps, list[float | None]]:
    stamps = Stamps()
    return stamps, [stamps.stamp(kernel, arrival) for kernel, arrival in pairs]


def test_believable_stamps_are_taken_once_some_were_seen() -> None:
    stamps, times = stamped([(1.0 + k, 1.03 + k) for k in range(5)])
    assert stamps.source == "kernel"
    assert times == [None] * (_Settings.trial_frames - 1) + [1.0 + k for k in range(_Settings.trial_frames - 1, 5)]


@pytest.mark.parametrize("kernel", [lambda k: 0.0, lambda k: 1.7e9 + k, lambda k: 5.0, lambda k: 1.2 + k])
def test_implausible_kernel_timestamps_are_replaced_by_arrival_time(kernel) -> None:
    stamps, times = stamped([(kernel(k), 1.03 + k) for k in range(5)])
    assert stamps.source == "arrival"
    assert times[-1] == 5.03
    assert stamps.sigma_s >= 0.02


def test_a_stamp_that_goes_back_costs_one_frame() -> None:
    stamps, times = stamped([(1.0, 1.1), (2.0, 2.1), (3.0, 3.1), (2.5, 3.5), (4.0, 4.1)])
    assert times[-3:] == [3.0, None, 4.0]
    assert stamps.rejected == 1


def shots(pairing: Pairing, stream: list[tuple[float, int]]) -> list[tuple[float, float]]:
    given = []
    for t, eye in sorted(stream):
        pairing.put(eye, Shot(t, 0.0, PIXEL))
        pair = pairing.take()
        if pair is not None:
            given.append((pair[0].t, pair[1].t))
    return given


@given(phase=st.floats(0, 1), jitter=st.lists(st.floats(-0.04, 0.04), min_size=80, max_size=80), late=st.floats(0, 0.3))
def test_free_running_images_are_paired_once_within_limit(phase, jitter, late) -> None:
    stream = [(k + jitter[k], 0) for k in range(40)] + [(k + phase + jitter[40 + k], 1) for k in range(40)]
    pairs = shots(Pairing(0.6), stream)
    assert len(pairs) >= 37
    assert all(abs(left - right) <= 0.6 for left, right in pairs)
    assert all(len({pair[eye] for pair in pairs}) == len(pairs) for eye in (0, 1))


def test_images_too_far_apart_are_counted_not_paired() -> None:
    pairing = Pairing(0.1)
    assert shots(pairing, [(k, 0) for k in range(10)] + [(k + 0.4, 1) for k in range(10)]) == []
    assert pairing.too_far > 5


# --- light


@pytest.mark.parametrize(("level", "words"), [(0, "lens cap"), (255, "over-exposed"), (128, None)])
def test_an_image_is_black_white_or_fine(level, words) -> None:
    image = np.full((120, 160, 3), level, np.uint8)
    said = exposure_fault(image, "left camera")
    assert said is None if words is None else words in str(said)


def test_white_wall_in_corner_is_not_over_exposure() -> None:
    image = np.full((120, 160, 3), 128, np.uint8)
    image[:50, :60] = 255
    assert exposure_fault(image, "left camera") is None


# --- which camera


def test_serial_number_comes_from_usb_device(tmp_path) -> None:
    device = tmp_path / "sys/devices/usb1/1-2/1-2:1.0"
    device.mkdir(parents=True)
    (device.parent / "serial").write_text("46D3A1\n")
    node = tmp_path / "sys/class/video4linux/video0"
    node.mkdir(parents=True)
    (node / "device").symlink_to(device)
    (tmp_path / "video0").touch()
    assert serial_of(str(tmp_path / "video0"), tmp_path) == "46D3A1"


def test_missing_serial_number_falls_back_to_device_name() -> None:
    assert serial_of("/dev/v4l/by-id/usb-Cam_A-video-index0") == "usb-Cam_A"


def test_camera_is_listed_once_by_better_name(tmp_path) -> None:
    for folder in ("by-id", "by-path"):
        (tmp_path / "dev/v4l" / folder).mkdir(parents=True)
    for number, names in enumerate([("by-id/usb-A", "by-path/pci-1"), ("by-path/pci-2",)]):
        node = tmp_path / f"dev/video{2 * number}"
        node.touch()
        for name in names:
            (tmp_path / f"dev/v4l/{name}-video-index0").symlink_to(node)
    assert [Path(name).name for name in connected(tmp_path)] == ["usb-A-video-index0", "pci-2-video-index0"]


# --- files


def write_images(folder: Path, names: list[str], size_px: tuple[int, int] = (32, 24)) -> None:
    for level, name in enumerate(names):
        cv2.imwrite(str(folder / name), np.full((size_px[1], size_px[0], 3), 10 * level, np.uint8))


def test_numbers_in_names_count_as_numbers(tmp_path) -> None:
    write_images(tmp_path, ["l_9.png", "l_10.png", "r_9.png", "r_10.png"])
    roll = ImageReader(ImagesConfig(left="l_*.png", right="r_*.png", fps=2.0), tmp_path)
    roll.open(0)
    assert [int(roll.next()[0].mean()) for _ in range(2)] == [0, 10]


def test_nanosecond_names_give_exact_times_and_eye_offset(tmp_path) -> None:
    write_images(tmp_path, [f"{eye}_{n}.png" for n in (1403636579763555584, 1403636579813555456) for eye in "l"])
    write_images(tmp_path, [f"{eye}_{n}.png" for n in (1403636579764555584, 1403636579814555456) for eye in "r"])
    roll = ImageReader(ImagesConfig(left="l_*.png", right="r_*.png", name_ticks_per_s=1e9), tmp_path)
    assert np.diff(roll.t) == pytest.approx([0.049999872], abs=1e-9)
    assert roll.t_sigma == pytest.approx([1e-3, 1e-3], abs=1e-9)


def test_unequal_image_counts_are_refused(tmp_path) -> None:
    write_images(tmp_path, ["l_1.png", "l_2.png", "r_1.png"])
    with pytest.raises(ConfigError, match=r"l_\*.png are 2 images, r_\*.png are 1"):
        ImageReader(ImagesConfig(left="l_*.png", right="r_*.png", fps=2.0), tmp_path)


def test_eyes_of_different_sizes_are_refused(tmp_path) -> None:
    write_images(tmp_path, ["l_1.png"])
    write_images(tmp_path, ["r_1.png"], (64, 24))
    with pytest.raises(SourceError, match=r"32x24 pixels in .*l_1.png, 64x24 pixels"):
        ImageReader(ImagesConfig(left="l_*.png", right="r_*.png", fps=2.0), tmp_path)


@pytest.mark.parametrize(
    ("text", "message"), [("0.1\n", "has 1 times for 2"), ("0.2\n0.1\n", "time 2 is not later"), ("a\nb\n", "cannot")]
)
def test_times_not_fitting_the_images_are_refused(tmp_path, text, message) -> None:
    write_images(tmp_path, ["l_1.png", "l_2.png", "r_1.png", "r_2.png"])
    (tmp_path / "times.txt").write_text(text)
    with pytest.raises(ConfigError, match=message):
        ImageReader(ImagesConfig(left="l_*.png", right="r_*.png", times="times.txt"), tmp_path)


def test_real_time_film_skips_unread_frames(tmp_path) -> None:
    write_images(tmp_path, [f"{eye}_{k}.png" for eye in "lr" for k in range(10)])
    clock = HandClock()
    table = {"images": {"left": "l_*.png", "right": "r_*.png", "fps": 10.0}, "latency_s": 0.02}
    film = eyes_of(msgspec.convert(table, CamerasConfig), tmp_path, clock)
    with film:
        first = film.read(1.0)
        clock.sleep(0.45)
        later = film.read(1.0)
    assert first is not None
    assert later is not None
    assert (first.t, later.t) == pytest.approx((99.98, 100.38))
    assert film.dropped == 3


def test_unreadable_film_is_refused_on_opening(tmp_path) -> None:
    (tmp_path / "l.avi").write_bytes(b"RIFF")
    config = CamerasConfig(videos=VideosConfig(left="l.avi", right="l.avi"))
    with pytest.raises(ConfigError, match="is not a readable video"), eyes_of(config, tmp_path, HandClock()):
        raise AssertionError


def test_film_pair_ends_with_the_shorter_film(tmp_path) -> None:
    for name, count in (("l.avi", 7), ("r.avi", 5)):
        film = cv2.VideoWriter(str(tmp_path / name), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (32, 24))
        for _ in range(count):
            film.write(np.zeros((24, 32, 3), np.uint8))
        film.release()
    config = CamerasConfig(videos=VideosConfig(left="l.avi", right="r.avi", speed=0.0))
    with eyes_of(config, tmp_path, HandClock()) as eyes:
        frames = [eyes.read(1.0) for _ in range(5)]
        with pytest.raises(SourceEnded):
            eyes.read(1.0)
    assert [frame.t for frame in frames if frame] == pytest.approx([0.0, 0.05, 0.1, 0.15, 0.2])


# --- the page


def test_the_page_shows_tables_that_are_taken() -> None:
    page = (Path(__file__).parents[2] / "docs" / "cameras.md").read_text(encoding="utf-8")
    text = page.split("```toml\n")[1].split("```")[0]
    shown = msgspec.convert(tomllib.loads(text)["vision"]["cameras"], CamerasConfig)
    shown.check(FILE, text)
    assert shown.two is not None


def test_the_page_names_every_setting_of_a_camera() -> None:
    page = (Path(__file__).parents[2] / "docs" / "cameras.md").read_text(encoding="utf-8")
    fields = [field.name for kind in (TwoConfig, ImagesConfig, VideosConfig) for field in msgspec.structs.fields(kind)]
    assert [name for name in fields if f"`{name}`" not in page and f"`{name} = " not in page] == []
