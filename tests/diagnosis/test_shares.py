"""Each cause has a share of what is explained, even where tolerances could take its place."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace
from planted_cases import ELBOW, SHOULDER, scattered, start_of, surveyed_arm

from bodyschema.diagnosis.assess.shares import Shares, shares
from bodyschema.diagnosis.fit.background import Scales
from bodyschema.diagnosis.report.result import Cause, Indistinguishable
from bodyschema.diagnosis.report.text import in_order
from bodyschema.effects import Effect


@pytest.fixture(scope="module")
def divided() -> Shares:
    robot = surveyed_arm()
    zero = Effect.at(robot, "joint_offset", SHOULDER, values=[0.03])
    scale = Effect.at(robot, "joint_scale", ELBOW, values=[0.005])
    start = start_of(robot, scattered(robot, 5, 120), (zero, scale), 5)
    fit = start.with_causes([zero, scale]).with_tolerances(Scales()).with_tolerances_applied()
    return shares(start, fit, np.ones(120, dtype=np.bool_), None)


def test_shares_add_up_to_the_whole(divided: Shares) -> None:
    assert sum(divided.causes) + divided.links + divided.drives == pytest.approx(1.0)


def test_joint_offset_keeps_its_share_against_link_tolerances(divided: Shares) -> None:
    zero, scale = divided.causes
    assert zero > 0.8
    assert scale > 0.005
    assert divided.links + divided.drives < 0.05


def _cause(joint: str, probability: float, share: float, gain: float) -> Cause:
    rivals = (Indistinguishable("settling", joint, None, "this_motion", 1.0 - probability),)
    return Cause("backlash", joint, None, {}, probability, share, gain, (), rivals, "")


def test_unsure_minor_cause_leaves_the_verdict_decided() -> None:
    assert not _cause("a", 0.6, share=0.5, gain=1.2).leaves_open


def test_a_cause_that_nothing_replaces_leaves_it_open() -> None:
    assert _cause("a", 0.6, share=0.5, gain=18.0).leaves_open


def test_heaviest_cause_comes_first() -> None:
    causes = [_cause("small", 1.0, 1.0, 2.0), _cause("link", 1.0, 80.0, 0.0), _cause("play", 1.0, 4.0, 18.0)]
    assert [cause.where for cause in in_order(causes)] == ["link", "play", "small"]


def test_outliers_are_listed_before_minor_causes() -> None:
    outliers = replace(_cause("outliers", 1.0, 0.0, 0.0), effect="outliers")
    assert [cause.where for cause in in_order([_cause("small", 1.0, 1.0, 2.0), outliers])] == ["outliers", "small"]
