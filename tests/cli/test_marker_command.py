"""`bodyschema marker` with the robot's own cameras, and the pages of tags that it writes."""

from __future__ import annotations

import tomllib

import cv2
import msgspec
import numpy as np
import pytest
from small_arm import write_small_arm

from bodyschema.cli.main import app
from bodyschema.interfaces.errors import BodyschemaError, ConfigError
from bodyschema.vision.config import VisionConfig
from bodyschema.vision.tags.body import TagBody


def called(*arguments: object) -> None:
    app([*map(str, arguments)], exit_on_error=False, result_action="return_value")


def printed(capsys: pytest.CaptureFixture[str]) -> VisionConfig:
    return msgspec.convert(tomllib.loads(capsys.readouterr().out)["vision"], VisionConfig)


def test_colour_of_moving_ball_is_learnt_automatically(tmp_path, capsys) -> None:
    for k in range(8):
        image = np.full((120, 160, 3), 120, np.uint8)
        cv2.circle(image, (20 + 15 * k, 60), 12, (30, 200, 30), -1, cv2.LINE_AA)
        for eye in ("left", "right"):
            cv2.imwrite(str(tmp_path / f"{eye}{k}.png"), image)
    cameras = '[vision.cameras.images]\nleft = "left*.png"\nright = "right*.png"\nfps = 4.0\nspeed = 0.0\n'
    called("marker", "learn", "--auto", "--robot", write_small_arm(tmp_path, cameras))
    said = capsys.readouterr()
    assert "move the ball across the view for 5 s" in said.err
    assert abs(tomllib.loads(said.out)["vision"]["colour"]["hue_deg"] - 120.0) < 5.0


def test_a_click_needs_an_image(tmp_path) -> None:
    with pytest.raises(BodyschemaError, match="the robot's own cameras need --auto"):
        called("marker", "learn", "--at", 3, 4)


def test_printed_cube_tables_use_its_size_on_paper(tmp_path, capsys) -> None:
    called(
        "marker", "print", "--shape", "cube", "--ids", "3-8", "--out", tmp_path / "cube.pdf", "--ruler-mm", 0.98 * 210
    )
    config = printed(capsys)
    assert config.tag.side_m == pytest.approx(0.98 * 0.04)
    assert sorted(TagBody.cluster(config.cluster, config.tag).corners) == [3, 4, 5, 6, 7, 8]
    assert (tmp_path / "cube.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize(
    ("ids", "said"),
    [("5", "both rulers: each is 50 mm."), ("0-5", "both rulers: 160 mm below the picture, 110 mm beside it.")],
)
def test_lengths_to_measure_on_the_print_are_named(ids, said, tmp_path, capsys) -> None:
    called("marker", "print", "--ids", ids, "--out", tmp_path / "tags.svg")
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("shape", ["tags", "plate", "cube", "board", "chessboard"])
def test_each_shape_is_printed_without_further_options(shape, tmp_path) -> None:
    called("marker", "print", "--shape", shape, "--out", tmp_path / "page.svg")
    assert (tmp_path / "page.svg").stat().st_size > 0


def test_single_tags_have_the_table_of_the_first(tmp_path, capsys) -> None:
    called("marker", "print", "--ids", "5,9", "--family", "aruco_6x6_50", "--out", tmp_path / "tags.svg")
    config = printed(capsys)
    assert (config.marker, config.tag.id, config.tag.dictionary) == ("tag", 5, "aruco_6x6_50")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--ids", "a-b"), "--ids a-b is not as in 0-5,9"),
        (("--ids", "3,1-4"), "has a tag twice"),
        (("--ids", "0-500"), "more than 100"),
        (("--ids", "5-3"), "has a tag twice, or none"),
        (("--ruler-mm", 3), "the ruler across of this page is"),
        (("--out", "tags.png"), r"neither \.pdf nor \.svg"),
    ],
)
def test_options_that_fit_nothing_are_refused(options, said, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=said):
        called("marker", "print", *options)
