"""Many robots at one endpoint: discovery, and finding the unit whose model is off."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_arm import write_small_arm
from told_statuses import LEARNER, SAMPLER

from bodyschema.cli.main import app
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import Request, ZenohSession
from bodyschema.daemon.transport.status import JointRange, LearnerStatus, SamplerStatus
from bodyschema.daemon.transport.wire import JointsRequest, PredictReply, decode, encode
from bodyschema.fleet.comparison import Model, common_poses, compare_models, sentences
from bodyschema.fleet.roster import Fleet, places
from bodyschema.interfaces.errors import BusError, RequestError
from bodyschema.interfaces.records import FloatArray
from bodyschema.learning.status import ChainCalibration, JointZero, LearntFigure

JOINTS = ("waist", "shoulder")


def sampler_of(robot: str) -> SamplerStatus:
    coverage = {joint: JointRange(-1.0, 1.0, -3.0, 3.0) for joint in JOINTS}
    return msgspec.structs.replace(SAMPLER, robot=robot, store=f"store of {robot}", state="running", coverage=coverage)


def calibration(waist: float = 0.0) -> ChainCalibration:
    figure = LearntFigure(0.0, 0.0, 0.001)
    return ChainCalibration(
        pairs=600,
        camera_link="base",
        camera_xyz=[figure] * 3,
        camera_rpy=[figure] * 3,
        marker_link="hand",
        marker_xyz=[figure] * 3,
        zeros={"waist": JointZero(waist, 0.002), "shoulder": None},
        axes_rad=None,
        points_m=None,
        noise_m=0.001,
        outliers=0,
    )


def learner_of(robot: str, waist: float = 0.0) -> LearnerStatus:
    told = {"pairs_since_change": 612, "changes": 0, "last_change": None, "outlook": None}
    return msgspec.structs.replace(
        LEARNER, robot=robot, store=f"store of {robot}", calibration=calibration(waist), **told
    )


def positions(q: FloatArray, waist: float) -> FloatArray:
    """Return the positions of an arm of two links with this waist offset [rad]; q (n, 2)."""
    waists, shoulders = q[:, 0] + waist, q[:, 1]
    reach = 0.3 + 0.4 * np.cos(shoulders)
    # A hand off the plane of the links: else a turned waist is a turned camera.
    side = 0.1 * np.sin(2.0 * waists)
    return np.column_stack([reach * np.cos(waists), reach * np.sin(waists) + side, -0.4 * np.sin(shoulders)])


@contextmanager
def robots(endpoint: str, waists: dict[str, float], *, learners: bool = True) -> Iterator[None]:
    """Serve robots at one endpoint, each with its own waist offset."""
    with ZenohSession(listen=endpoint) as bus:

        def stand(name: str, waist: float) -> None:
            def predict(request: Request) -> bytes:
                q = np.array(decode(request.payload, JointsRequest, request.encoding).q, dtype=float)
                x = positions(q, waist)
                return encode(PredictReply(x.tolist(), np.full(x.shape, 1e-3).tolist(), [True] * len(q), "m", 612, 0.1))

            keys = Keys(name)
            bus.token(keys.alive("sampler"))
            bus.answer(keys.status("sampler"), lambda _: encode(sampler_of(name)))
            if learners:
                bus.token(keys.alive("learner"))
                bus.answer(keys.status("learner"), lambda _: encode(learner_of(name, waist)))
                bus.answer(keys.predict, predict)

        for name, waist in waists.items():
            stand(name, waist)
        yield


def fleet(*words: str) -> None:
    app(["fleet", *words], exit_on_error=False, result_action="return_value")


def test_robots_are_found_with_both_states(endpoint: str) -> None:
    with robots(endpoint, {"left": 0.0, "right": 0.0, "spare": 0.0}), Fleet(places([endpoint], [])) as found:
        members = found.poll()
    assert [member.name for member in members] == ["left", "right", "spare"]
    assert all(member.sampler is not None and member.learner is not None for member in members)
    assert members[0].error_m == 0.002


def test_the_list_is_json_when_asked(endpoint: str, capsys: pytest.CaptureFixture[str]) -> None:
    with robots(endpoint, {"left": 0.0, "right": 0.0}):
        fleet("--connect", endpoint, "--json")
    listed = json.loads(capsys.readouterr().out)
    assert [(each["robot"], each["alive"]) for each in listed] == [
        ("left", ["learner", "sampler"]),
        ("right", ["learner", "sampler"]),
    ]


def test_list_has_row_per_robot_and_faults(endpoint: str, capsys: pytest.CaptureFixture[str]) -> None:
    with robots(endpoint, {"left": 0.0}, learners=False):
        fleet("--connect", endpoint)
    shown = " ".join(capsys.readouterr().out.split())
    assert "left sampler only 612 12.3" in shown
    assert "! left: its learner is not alive" in shown


def test_absent_described_robot_is_listed(tmp_path: Path, free_endpoint: Callable[[], str]) -> None:
    here, elsewhere = free_endpoint(), free_endpoint()
    file = write_small_arm(tmp_path, f'[zenoh]\nsampler = "{elsewhere}"\nlearner = "{here}"\n')
    with robots(here, {"left": 0.0}), Fleet(places([], [file])) as found:
        members = {member.name: member for member in found.poll()}
        assert f"nothing listens on {elsewhere}" in found.unreachable[0]
    assert members["arm"].health == ["neither its sampler nor its learner is alive"]
    assert members["left"].alive == {"sampler", "learner"}


def test_silent_endpoint_error_names_address(endpoint: str) -> None:
    with pytest.raises(BusError, match=f"nothing listens on {endpoint}"):
        fleet("--connect", endpoint)


def test_a_place_without_robots_is_an_error(endpoint: str) -> None:
    with ZenohSession(listen=endpoint), pytest.raises(BusError, match=f"no robot is alive on {endpoint}"):
        fleet("--connect", endpoint)


@pytest.mark.parametrize(
    ("endpoint", "said"), [("127.0.0.1:7447", "this is no endpoint"), ("tls/robots:7447", "takes certificates")]
)
def test_an_endpoint_that_cannot_be_meant_is_refused(endpoint: str, said: str) -> None:
    with pytest.raises(RequestError, match=said):
        places([endpoint], [])


def test_unit_with_waist_offset_is_named(endpoint: str, capsys: pytest.CaptureFixture[str]) -> None:
    with robots(endpoint, {"left": 0.0, "right": 0.0, "spare": 0.05}):
        fleet("--compare", "--connect", endpoint)
    shown = " ".join(capsys.readouterr().out.split())
    assert "spare is off by" in shown
    assert f"zero of waist +{math.degrees(0.05):.2f} ± " in shown


def test_robots_without_learners_are_skipped_with_reason(endpoint: str) -> None:
    with robots(endpoint, {"left": 0.0}, learners=False), pytest.raises(RequestError, match="no learner of it answers"):
        fleet("--compare", "--connect", endpoint)


# --- the comparison itself


def model(name: str, q: FloatArray, waist: float, turned: Rotation | None = None) -> Model:
    x = positions(q, waist) + np.random.default_rng(len(name)).normal(0.0, 1e-4, (len(q), 3))
    seen = x if turned is None else turned.apply(x) + np.array([0.3, -2.0, 1.0])
    return Model(name, seen, 3e-4, 1.0, calibration(waist))


@pytest.fixture
def q() -> FloatArray:
    return common_poses([sampler_of("arm").coverage], JOINTS)


def test_where_the_camera_stands_makes_no_robot_odd(q: FloatArray) -> None:
    turns = Rotation.random(5, random_state=1)
    found = compare_models(JOINTS, q, [model("m" * k, q, 0.0, turn) for k, turn in enumerate(turns, 1)])
    assert [unit.is_off for unit in found.units] == [False] * 5
    assert max(unit.apart.rms_mm for unit in found.units) < 0.3


@pytest.mark.parametrize("robots", [3, 4, 10])
def test_one_odd_robot_does_not_shift_the_median(q: FloatArray, robots: int) -> None:
    models = [model("m" * k, q, 0.05 if k == 2 else 0.0) for k in range(1, robots + 1)]
    found = compare_models(JOINTS, q, models)
    assert [unit.robot for unit in found.units if unit.is_off] == ["mm"]


def test_two_robots_have_no_odd_one(q: FloatArray) -> None:
    found = compare_models(JOINTS, q, [model("m", q, 0.0), model("mm", q, 0.05)])
    assert [unit.is_off for unit in found.units] == [None, None]
    assert "not possible to say which" in sentences(found)[-1]


def test_only_the_figure_that_differs_stands_out(q: FloatArray) -> None:
    found = compare_models(JOINTS, q, [model("m" * k, q, 0.05 if k == 1 else 0.0) for k in range(1, 6)])
    assert [[odd.figure for odd in unit.odd] for unit in found.units] == [["zero of waist"], [], [], [], []]


def test_common_joint_offset_does_not_stand_out(q: FloatArray) -> None:
    waists = [-0.05, -0.02, 0.0, 0.03, 0.06]
    found = compare_models(JOINTS, q, [model("m" * k, q, waist) for k, waist in enumerate(waists, 1)])
    assert [unit.odd for unit in found.units] == [()] * 5


def test_barely_moved_robot_does_not_narrow_poses() -> None:
    wide = {joint: JointRange(-1.0, 1.0, -3.0, 3.0) for joint in JOINTS}
    still = {joint: JointRange(0.0, 0.01, -3.0, 3.0) for joint in JOINTS}
    assert np.ptp(common_poses([wide, wide, still], JOINTS), axis=0).min() > 1.9
