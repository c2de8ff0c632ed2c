"""Several sources of one marker: the mean by covariance, and disagreement named with what would end it."""

from __future__ import annotations

import sys
from collections import deque
from types import TracebackType
from typing import Self

import numpy as np
import pytest
from virtual_port import VirtualClock

from bodyschema.drivers.markers.fusing import FusedMarkers, Member
from bodyschema.interfaces.records import MarkerFix, MarkerMiss, Reason, frozen_array
from bodyschema.robot.rpy import pose_of, rotation_of

STEREO = np.diag([1e-6, 1e-6, 25e-6])  # depth is five times less certain
MOCAP = np.diag([1e-6, 25e-6, 1e-6])
PERIOD_S = 0.02


class Script:
    """A `MarkerSource` that gives what was put into it."""

    def __init__(self, clock: VirtualClock) -> None:
        self.clock, self.seen = clock, deque[MarkerFix | MarkerMiss]()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def read(self, timeout_s: float) -> MarkerFix | MarkerMiss | None:
        if self.seen:
            return self.seen.popleft()
        self.clock.wait_until(self.clock.now() + timeout_s)
        return None


class Scene:
    """A marker moved by hand, and sources that see it with noise, each at its own times."""

    def __init__(self, *covariances: np.ndarray, bias=None, pose=None, wander_m: float = 0.0) -> None:
        self.clock, self.rng = VirtualClock(), np.random.default_rng(1)
        self.covs = covariances
        self.bias = np.zeros(3) if bias is None else np.array(bias)
        self.wander_m = wander_m  # of the second source, beside its noise
        self.pose = np.eye(4) if pose is None else pose
        self.scripts = [Script(self.clock) for _ in covariances]
        names = ("cameras", "mocap", "laser")
        poses = [np.eye(4), self.pose, np.eye(4)]
        self.members = [Member(*row) for row in zip(names, self.scripts, poses[: len(covariances)], strict=False)]
        self.fused = FusedMarkers(self.members, self.clock)

    @staticmethod
    def truth(t: float) -> np.ndarray:
        return np.array([0.2 * np.sin(0.9 * t), 0.15 * np.cos(1.1 * t), 0.6 + 0.1 * np.sin(0.5 * t)])

    def run(self, steps: int, silent=()) -> list[MarkerFix | MarkerMiss]:
        """Let the sources see the marker so many times; return what the fusion makes of it."""
        inverse, found = np.linalg.inv(self.pose), []
        with self.fused:
            for _ in range(steps):
                self.clock.wait_until(self.clock.now() + PERIOD_S)
                for number, (script, cov) in enumerate(zip(self.scripts, self.covs, strict=True)):
                    t = self.clock.now() - 0.004 * number
                    x = self.truth(t) + self.rng.multivariate_normal(np.zeros(3), cov)
                    R = np.eye(3)
                    if number == 1:
                        x = x + self.bias + self.rng.normal(0.0, 1.0, 3) * self.wander_m
                        x, R = inverse[:3, :3] @ x + inverse[:3, 3], inverse[:3, :3]
                    if number in silent:
                        continue
                    script.seen.append(MarkerFix(t, frozen_array(x), frozen_array(R @ cov @ R.T), t_sigma=1e-3))
                while (seen := self.fused.read(0.0)) is not None:
                    found.append(seen)
        return found


def squared(scene: Scene, fixes: list) -> np.ndarray:
    """Return the squared errors in units of the claimed covariance; 3 in the mean if it is right."""
    off = [fix.x - scene.truth(fix.t) for fix in fixes]
    return np.array([e @ np.linalg.solve(fix.cov, e) for e, fix in zip(off, fixes, strict=True)])


def test_each_source_covers_the_other_s_weak_axis() -> None:
    scene = Scene(STEREO, MOCAP)
    fixes = scene.run(600)
    assert len(fixes) > 550
    off = np.array([fix.x - scene.truth(fix.t) for fix in fixes if isinstance(fix, MarkerFix)])
    assert (off.std(axis=0) < 1.3e-3).all()
    assert 2.0 < squared(scene, fixes).mean() < 4.0
    assert scene.fused.health == ()


def test_sources_in_their_own_frames_are_brought_together() -> None:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_of(np.array([0.3, -0.2, 1.0])), [1.0, -2.0, 0.5]
    scene = Scene(STEREO, MOCAP, pose=pose)
    assert squared(scene, scene.run(200)).mean() < 4.0


def test_orientations_turn_with_the_frame_without_an_import(monkeypatch) -> None:
    member = Member("mocap", Script(VirtualClock()), pose_of(np.zeros(3), np.array([0.0, 0.0, np.pi / 2])))
    monkeypatch.setitem(sys.modules, "scipy.spatial.transform", None)  # it takes half a second
    member.take(MarkerFix(0.0, np.zeros(3), MOCAP, R=np.array([0.0, 0.0, 0.0, 1.0])), 0.0)
    turn = member.fixes[0].R
    assert turn is not None
    np.testing.assert_allclose(np.abs(turn), [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-12)


def test_contradicting_sources_give_no_position() -> None:
    seen = Scene(STEREO, MOCAP, bias=[0.03, 0, 0]).run(100)
    assert {one.reason for one in seen if isinstance(one, MarkerMiss)} == {Reason.DISAGREEING}
    assert sum(isinstance(one, MarkerFix) for one in seen) < 5


def test_two_of_three_overrule_the_third() -> None:
    scene = Scene(STEREO, MOCAP, MOCAP, bias=[0.03, 0, 0])
    fixes = [one for one in scene.run(150) if isinstance(one, MarkerFix)]
    assert len(fixes) > 130
    assert np.abs(np.mean([fix.x - scene.truth(fix.t) for fix in fixes], axis=0)).max() < 1e-3


def test_disagreement_names_the_frame_that_would_end_it() -> None:
    wrong = np.eye(4)
    wrong[:3, :3], wrong[:3, 3] = rotation_of(np.array([0.0, 0.0, 0.1])), [0.02, 0.0, 0.0]
    scene = Scene(STEREO, MOCAP, pose=wrong)
    scene.members[1].pose = np.eye(4)  # robot.toml says nothing of the pose
    scene.run(300)
    [said] = scene.fused.health
    assert said.startswith("cameras and mocap disagree in ")
    numbers = said.partition("xyz = [")[2].partition("]")[0].split(", ")
    assert [float(value) for value in numbers] == pytest.approx([0.02, 0.0, 0.0], abs=6e-3)


def test_another_marker_is_told_from_another_frame() -> None:
    scene = Scene(STEREO, MOCAP, wander_m=0.05)
    scene.run(300)
    assert "follows another marker, or its latency_s or sigma_m is wrong" in scene.fused.health[0]


def test_remaining_source_goes_on_alone() -> None:
    scene = Scene(STEREO, MOCAP)
    assert len(scene.run(100, silent=(0,))) > 80
    assert len(scene.run(100, silent=(1,))) > 80
