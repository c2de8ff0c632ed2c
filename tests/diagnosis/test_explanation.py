"""Causes kept beside an unnamed alternative, and the criterion for predicting held-out rows."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from planted_cases import ELBOW, SHOULDER, SIGMA_M, desk_arm, measured, motion_of, start_of, surveyed_arm, walk

from bodyschema.diagnosis.assess import explanation
from bodyschema.diagnosis.assess.explanation import Explanation, explain, useful
from bodyschema.diagnosis.fit.alignment import aligned
from bodyschema.diagnosis.fit.fit import Fit
from bodyschema.diagnosis.fit.net_evidence import WorthSettings
from bodyschema.diagnosis.fit.observations import Observations
from bodyschema.diagnosis.search.held_out import Blocks
from bodyschema.diagnosis.search.search import Search
from bodyschema.diagnosis.unnamed.families import families
from bodyschema.diagnosis.unnamed.family_fits import PreparedFamily, UnnamedFamilies
from bodyschema.effects import Effect, Simulation


class Believing:
    """Stub: the unnamed alternative predicts everything, and the search costs nothing."""

    def predicts(self, *_: object) -> bool:
        return True

    def multiplicity_penalty_of(self, _: Effect) -> float:
        return 0.0


def explained_beside(fits: list[Fit], net_evidences: list[float], monkeypatch: pytest.MonkeyPatch) -> Explanation:
    """Return the explanation chosen from fits of these worths: the last has no direction, the others share one."""
    prepared = SimpleNamespace(family=SimpleNamespace(what="something", is_specific=False))
    discrepancy_fit = cast(Any, SimpleNamespace(chosen=(prepared,), fit=fits[0]))
    known = {
        fit: Explanation(
            fit, None if fit is fits[-1] else discrepancy_fit, net_evidence, size=1e6, best_unnamed_gain=1e6
        )
        for fit, net_evidence in zip(fits, net_evidences, strict=True)
    }
    shorter = {len(fit.causes): one for fit, one in known.items()}
    monkeypatch.setattr(explanation, "_with_unnamed", lambda fit, *_: known.get(fit) or shorter[len(fit.causes)])
    monkeypatch.setattr(explanation, "_rescaled", lambda best, *_: best)
    believing = cast(Any, Believing())
    return explain(fits[-1], fits, believing, believing, lambda _: None)


def fits_on_the_way() -> list[Fit]:
    robot = desk_arm()
    truth = tuple(Effect.at(robot, "joint_offset", joint, values=[0.02]) for joint in (SHOULDER, ELBOW))
    start = start_of(robot, walk(robot, 1), truth, 1)
    return [start.with_causes(truth[:count]) for count in range(3)]


def test_marginally_better_extra_cause_is_not_added(monkeypatch) -> None:
    fits = fits_on_the_way()
    assert explained_beside(fits, [100.0, 101.0 + WorthSettings.named_nats, 0.0], monkeypatch).fit is fits[0]


def test_clearly_better_extra_cause_is_added(monkeypatch) -> None:
    fits = fits_on_the_way()
    assert explained_beside(fits, [100.0, 120.0, 0.0], monkeypatch).fit is fits[1]


def test_unnamed_family_shown_by_few_rows_is_kept() -> None:
    # A shoulder that errs by the elbow's square, where the elbow was far out in a few rows alone.
    robot = desk_arm()
    shoulder, elbow = (robot.joints.index(joint) for joint in (SHOULDER, ELBOW))
    q = walk(robot, 1, rows=200).q.copy()
    q[:, elbow] = np.median(q[:, elbow]) + 0.25 * (q[:, elbow] - np.median(q[:, elbow]))
    q[100:105, elbow] = q[:, elbow].max() + np.linspace(0.5, 1.0, 5)
    errs = q.copy()
    errs[:, shoulder] += 0.005 * np.square(q[:, elbow])
    simulation = Simulation(robot)
    noise = SIGMA_M * np.random.default_rng([1, 1]).normal(size=(len(q), 3))
    recording = measured(robot, motion_of(q), simulation.positions(motion_of(errs)) + noise)
    start = aligned(Observations.of(recording, simulation), simulation)
    unnamed = UnnamedFamilies(start)
    (family,) = (one for one in families(start.run) if (one.joint, one.drivers) == (shoulder, (shoulder, elbow)))
    assert unnamed.predicts(unnamed.discrepancy_fit(start, (PreparedFamily.of(family, start),)), start)


def test_autocorrelated_noise_replaces_no_cause_by_unnamed_error() -> None:
    robot = desk_arm()
    simulation, motion = Simulation(robot), walk(robot, 1, rows=600)
    cause = Effect.at(robot, "joint_eccentricity", ELBOW, values=[0.02, 0.01])
    noise = SIGMA_M * np.random.default_rng([1, 1]).normal(size=(600, 3))
    for row in range(1, 600):
        noise[row] = 0.7 * noise[row - 1] + np.sqrt(1.0 - 0.7**2) * noise[row]
    recording = measured(robot, motion, Simulation(robot, (cause,)).positions(motion) + noise)
    start = aligned(Observations.of(recording, simulation), simulation)
    found = start.with_causes([cause])
    chosen = explain(found, [start, found], UnnamedFamilies(start), Search([cause], lambda _: None), lambda _: None)
    assert chosen.fit.causes
    assert not chosen.unnamed_causes


@pytest.mark.parametrize("seed", range(4))
def test_cause_shown_only_by_precise_rows_is_kept(seed) -> None:
    robot, rng = surveyed_arm(), np.random.default_rng([seed, 7])
    motion = walk(robot, seed, 400)
    cause = Effect.at(robot, "joint_eccentricity", ELBOW, values=[1e-3, 1e-3])
    sizes = np.where(rng.random(400) < 0.2, 0.05, SIGMA_M)
    x = Simulation(robot, (cause,)).positions(motion) + sizes[:, None] * rng.normal(size=(400, 3))
    recording = replace(measured(robot, motion, x), cov=np.square(sizes)[:, None, None] * np.eye(3))
    fit = aligned(Observations.of(recording, Simulation(robot)), Simulation(robot)).with_causes([cause])
    found = Explanation(fit, None, 0.0)
    assert useful(found, Search([cause], lambda _: None), Blocks.cut(400), lambda _: None).fit.causes
