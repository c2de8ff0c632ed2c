"""One robot's learner on a fake bus: its status and its backlog."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from guided_arm import make_pair
from small_arm import write_small_arm

from bodyschema.daemon.config import Config
from bodyschema.daemon.learner.learner import Learner
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import Request, ZenohSession
from bodyschema.daemon.transport.status import LearnerStatus
from bodyschema.daemon.transport.wire import (
    JSON,
    CommandReply,
    CommandRequest,
    PairsReply,
    PredictReply,
    decode,
    encode,
    pair_to_wire,
)
from bodyschema.interfaces.errors import BusError
from bodyschema.interfaces.records import Pair
from bodyschema.learning.solvers.solver import DirectSolver
from bodyschema.vision.rig.lens import Lens
from bodyschema.vision.rig.rig_file import write_rig
from bodyschema.vision.rig.stereo_rig import CalibrationProvenance, OneEyeRig

KEYS = Keys("arm")


class Still:
    """A clock that stands still."""

    def now(self) -> float:
        return 50.0

    def utc(self) -> str:
        return "2026-11-21T12:00:00.000+00:00"


class Wire:
    """Fake session: keeps the handlers, and serves the sampler's history until that is gone."""

    def __init__(self, stored: list[Pair]) -> None:
        self.handlers: dict[str, Callable[..., Any]] = {}
        self._stored = stored

    def answer(self, key: str, handler: Callable[..., Any], **_: object) -> None:
        self.handlers[key] = handler

    def subscribe(self, key: str, handler: Callable[..., Any], **_: object) -> None:
        self.handlers[key] = handler

    def watch(self, key: str, changed: Callable[[bool], None]) -> None:
        self.handlers[key] = changed

    def token(self, key: str) -> None:
        """Do nothing: no client watches the token."""

    def ask_one(self, key: str, **_: object) -> bytes:
        begin = int(key.partition("from=")[2])
        page = [pair_to_wire(pair) for pair in self._stored if pair.seq >= begin]
        if not page:
            raise BusError("nobody answers")
        return encode(PairsReply("one", self._stored[-1].seq, page))

    def ask(self, key: str, request: object = None) -> bytes:
        return self.handlers[key](Request({}, b"" if request is None else encode(request), JSON))

    def status(self) -> LearnerStatus:
        return decode(self.ask(KEYS.status("learner")), LearnerStatus)


def pair(seq: int) -> Pair:
    return make_pair(seq, np.array([0.01 * seq, 0.1]), np.array([0.3, 0.001 * seq, 0.2]))


@pytest.fixture
def learner(tmp_path: Path) -> tuple[Learner, Wire]:
    config = Config.load(write_small_arm(tmp_path, '[daemon]\nstate_dir = "state"\n'), {})
    wire = Wire([pair(seq) for seq in range(1, 6)])
    learner = Learner(config, DirectSolver(), cast(ZenohSession, wire), Still())
    learner._declare()
    learner._feed.step(0.0)
    wire.handlers[KEYS.alive("sampler")](True)
    return learner, wire


def test_a_learner_with_all_pairs_is_well(learner: tuple[Learner, Wire]) -> None:
    status = learner[1].status()
    assert (status.pairs, status.behind, status.age_s, status.health) == (5, 0, 0.0, [])


def test_learner_far_behind_reports_its_backlog(learner: tuple[Learner, Wire]) -> None:
    wire = learner[1]
    late = pair(4000)
    wire.handlers[KEYS.pair](encode(pair_to_wire(late)).replace(b"12:00:00.000", b"12:05:00.000"))
    status = wire.status()
    assert (status.behind, status.age_s) == (3995, 300.0)
    assert "3995 stored samples are not learnt yet, and the newest that was learnt is 300 s old" in status.health[0]
    assert decode(wire.ask(KEYS.predict, {"q": [0.1, 0.2]}), PredictReply).age_s == 300.0


def test_tool_changed_command_reports_how_to_undo_it(learner: tuple[Learner, Wire]) -> None:
    wire = learner[1]
    reply = decode(wire.ask(KEYS.command("learner"), CommandRequest("tool_changed")), CommandReply)
    assert "`bodyschema command rollback` takes it back" in reply.message
    change = wire.status().last_change
    assert change is not None
    assert (change.kind, change.found, change.can_roll_back) == ("tool", False, True)


def test_status_counts_pairs_behind_prequential_error(learner: tuple[Learner, Wire]) -> None:
    status = learner[1].status()
    assert status.prequential_pairs == 5
    assert set(status.prequential_m) == {"prior", "nlms"}


TAG_CAMERA = """eyes = 1
[daemon]
state_dir = "state"
[vision]
marker = "tag"
[vision.tag]
side_m = 0.05
side_sigma_m = 0.0005
[vision.cameras]
calibration = "cameras.toml"
[vision.cameras.one]
device = "/dev/v4l/by-id/usb-A-video-index0"
image_size_px = [640, 480]
"""


def calibrated(tmp_path: Path, *, k1: float = 0.0) -> None:
    """Write the camera's calibration."""
    made = CalibrationProvenance("", "", 20, 0, 0.0, 0.0, 0.0)
    lens = Lens("pinhole", (600.0, 600.0), (319.5, 239.5), (k1, 0.0, 0.0, 0.0, 0.0))
    write_rig(OneEyeRig(lens, (640, 480), ("",), 1e-12 * np.eye(9), made), tmp_path / "cameras.toml")


def answers_of(tmp_path: Path, text: str) -> tuple[LearnerStatus, PredictReply]:
    """Return the state and a prediction of a learner of five pairs."""
    config = Config.load(write_small_arm(tmp_path, text), {})
    wire = Wire([pair(seq) for seq in range(1, 6)])
    learner = Learner(config, DirectSolver(), cast(ZenohSession, wire), Still())
    learner._declare()
    learner._feed.step(0.0)
    return wire.status(), decode(wire.ask(KEYS.predict, {"q": [0.1, 0.2]}), PredictReply)


def test_predictions_include_calibration_and_tag_size_uncertainty(tmp_path: Path) -> None:
    calibrated(tmp_path)
    (status, reply), (_, sure) = (
        answers_of(tmp_path, text) for text in (TAG_CAMERA, TAG_CAMERA.replace("0.0005", "0.0"))
    )
    x = np.array(reply.x)
    # A size that is 1 % off is 1 % of all distances, within the view.
    assert np.hypot(sure.sigma[0][2], 0.01 * x[0, 2]) == pytest.approx(reply.sigma[0][2], rel=1e-3)
    assert status.common_error_m is not None
    assert 0.5 < status.common_error_m / (0.01 * float(np.linalg.norm(x))) < 1.2


@pytest.mark.parametrize(
    ("damaged", "said"),
    [
        (lambda _: None, "cameras.toml: there is no such file"),
        (lambda folder: (folder / "cameras.toml").write_text("format = 1"), "cameras.toml, line 1: of another format"),
        (lambda folder: calibrated(folder, k1=-50.0), "folds over within the image"),
    ],
    ids=["missing", "damaged", "folded"],
)
def test_a_learner_goes_on_without_the_cameras_calibration(tmp_path: Path, damaged, said) -> None:
    damaged(tmp_path)
    status, reply = answers_of(tmp_path, TAG_CAMERA)
    assert (status.pairs, status.common_error_m, reply.pairs) == (5, None, 5)
    assert any("leaves out how well the cameras are calibrated" in each and said in each for each in status.health)


MOCAP = """[[marker_source]]
kind = "udp"
port = 5005
"""


def test_mocap_positions_have_no_common_camera_error(tmp_path: Path) -> None:
    calibrated(tmp_path)
    status, _ = answers_of(tmp_path, TAG_CAMERA + MOCAP)
    assert status.common_error_m is None
    assert not any("calibrated" in each for each in status.health)
