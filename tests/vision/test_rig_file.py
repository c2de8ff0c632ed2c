"""cameras.toml: complete when written, strict when read."""

from __future__ import annotations

import os
import re

import numpy as np
import pytest
from board_renderer import webcams
from shown_board import known_rig

from bodyschema.interfaces.errors import ConfigError
from bodyschema.vision.rig.rig_file import read_rig, write_rig
from bodyschema.vision.rig.stereo_rig import CalibrationError, StereoRig


@pytest.fixture(params=[False, True], ids=["pinhole", "fisheye"])
def rig(request) -> StereoRig:
    """Return a rig with a covariance that is not diagonal."""
    rng = np.random.default_rng(2)
    known = known_rig(webcams(rng, fisheye=request.param))
    half = rng.normal(size=(len(known.vector), 60)) * 10.0 ** rng.uniform(-6, 0, len(known.vector))[:, None]
    return StereoRig(
        known.left, known.right, known.rotation_rad, known.translation_m, known.image_size_px, known.serials,
        half @ half.T, known.provenance,
    )  # fmt: skip


def test_rig_file_round_trip_restores_all_values(rig, tmp_path) -> None:
    write_rig(rig, tmp_path / "cameras.toml")
    read = read_rig(tmp_path / "cameras.toml")
    np.testing.assert_array_equal(read.vector, rig.vector)
    assert np.abs((read.covariance - rig.covariance) / np.outer(rig.sigma, rig.sigma)).max() < 1e-5
    assert (read.model, read.serials, read.image_size_px, read.provenance) == (
        rig.model, rig.serials, rig.image_size_px, rig.provenance,
    )  # fmt: skip


def test_failed_write_keeps_existing_file(rig, tmp_path, monkeypatch) -> None:
    file = tmp_path / "cameras.toml"
    write_rig(rig, file)
    before = file.read_bytes()

    def full(*_) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ConfigError, match=r"cannot be written: No space left on device"):
        write_rig(rig, file)
    assert (file.read_bytes(), list(tmp_path.iterdir())) == (before, [file])


DAMAGE = [
    (r"focal_px = \[[^,]*,", "focal_px = [nan,", r"left.focal_px: not a finite number"),
    (r"focal_px = \[[^,]*,", "focal_px = [-600.0,", r"left.focal_px.*> 0|expected `float` > 0"),
    (r"focal_px = \[[^,]*, ", "focal_px = [", r"left.focal_px"),
    (r"image_size_px = .*", 'image_size_px = "VGA"', r"image_size_px"),
    (r"principal_point_px = \[[^,]*,", "principal_point_px = [9000.0,", r"left.principal_point_px: 9000 is outside"),
    (r"distortion = \[[^,]*, ", "distortion = [", r"left.distortion: \d coefficients, (pinhole has 5|fisheye has 4)"),
    (
        r"translation_m = .*",
        "translation_m = [0.0, 0.0, 0.0]",
        r"right_from_left.translation_m: the eyes are in one place",
    ),
    (r"sigma = \[[^,]*, ", "sigma = [", r"uncertainty.sigma: \d\d numbers, not \d\d"),
    (r"sigma = \[[^,]*,", "sigma = [-1.0,", r"uncertainty.sigma"),
    (
        r"correlation = \[\[1.0,",
        "correlation = [[0.5,",
        r"uncertainty.correlation: not symmetric with 1 on its diagonal",
    ),
    (r"correlation = \[\[[^\]]*\],", "correlation = [", r"uncertainty.correlation: not \d\d rows of \d\d numbers"),
    (r'names = \["left.fx_px"', 'names = ["left.gx_px"', r"uncertainty.names: not the parameters of"),
    (r'format = ".*"', 'format = "bodyschema stereo rig 9"', r"of another format: 'bodyschema stereo rig 9'"),
    (r'format = ".*"\n', "", r"no camera calibration, not 'bodyschema stereo rig 1'"),
    (r"\[made\]", "[maid]", r"unknown key 'maid'"),
    (r"held_out_px = .*", "held_out_px = 0.0.1", r"not TOML"),
]


@pytest.mark.parametrize(("what", "by", "said"), DAMAGE, ids=[said[:30] for _, _, said in DAMAGE])
def test_damage_is_named_with_its_line(rig, tmp_path, what, by, said) -> None:
    file = tmp_path / "cameras.toml"
    write_rig(rig, file)
    damaged, count = re.subn(what, by, file.read_text(), count=1)
    assert count == 1
    file.write_text(damaged)
    with pytest.raises(ConfigError, match=said) as raised:
        read_rig(file)
    assert raised.value.remedy
    if what != 'format = ".*"\\n':
        assert raised.value.line is not None


def test_file_truncated_anywhere_is_refused(rig, tmp_path) -> None:
    file = tmp_path / "cameras.toml"
    write_rig(rig, file)
    data = file.read_bytes()
    for end in range(0, len(data) - 2, 211):
        file.write_bytes(data[:end])
        with pytest.raises(ConfigError, match="Take the file from a copy, or calibrate again"):
            read_rig(file)


def test_non_utf8_file_error_advises_recalibration(tmp_path) -> None:
    file = tmp_path / "cameras.toml"
    file.write_bytes(b"\x8d\xff\x00")
    with pytest.raises(ConfigError, match=r"not UTF-8 text. Take the file from a copy, or calibrate again"):
        read_rig(file)


def test_missing_file_error_names_calibrate_command(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"no such file. `bodyschema calibrate cameras` writes one"):
        read_rig(tmp_path / "cameras.toml")


def test_other_cameras_are_refused(rig) -> None:
    size = rig.image_size_px
    rig.require(size, ("A1", "B2"))
    rig.require(size, ("", ""))
    with pytest.raises(CalibrationError, match=r"left and right are exchanged: B2 is the right camera"):
        rig.require(size, ("B2", "A1"))
    with pytest.raises(CalibrationError, match=r"the right camera is C3, calibrated was B2: .* another pair"):
        rig.require(size, ("A1", "C3"))
    with pytest.raises(CalibrationError, match=r"give images of 1280x720, they were calibrated with 640x480"):
        rig.require((1280, 720), ("A1", "B2"))
