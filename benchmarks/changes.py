"""Changes while running: `python -m benchmarks.changes [--quiet] [--seeds N] [--joints 6 7] [--sigmas 1 5 20]`.

The learner's change monitor runs over guided walks in steps of 1 to 3 degrees, as the sampler takes them. It compares
the pairs with a chain learnt from 1,000 pairs (--known); the arm changes 520 to 580 pairs later. Each case lists the
pairs until the change is detected (mean, 95th percentile, share within 30), beside three reference detectors whose
theoretical rate is one false alarm in 50,000 pairs (Siegmund 1985; Pollak 1987):

- a CUSUM that knows the exact arm, and the change with its size and direction;
- a CUSUM that knows the change, but has the monitor's own model of the arm and, like it, counts no pair beyond four
  sigmas (so it is of no use for large changes);
- with that model, the sum over onsets for a change of known kind and size, but unknown direction.

Each reference has its mean, its own share within 30, and the ratio of the monitor's mean to its mean. Then follow the
shares that are identified correctly, left undecided and identified wrongly 30, 100 and 300 pairs after the change; the
remainder was not detected by then.

With --quiet: false alarms on walks without a change. The arms are rigid, rigid with 1 % gross outliers, not rigid (with
only a chain to follow them), and rigid with the noise of a real arm: encoders of 4,096 ticks a turn, and a stereo
camera that is less accurate along its view.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass

import msgspec
import numpy as np

from benchmarks.first_pairs import REACH
from benchmarks.rough_arm import RoughArm, rough_arm
from benchmarks.tables import Column, Table, tables_option
from bodyschema.interfaces.records import FloatArray, Pair, frozen_array
from bodyschema.learning.changes.known_arm import ArmBeforeChange, KnownArm
from bodyschema.learning.changes.monitor import ChangeMonitor, MonitorSettings, Reference
from bodyschema.learning.solvers.solver import fitted_belief
from bodyschema.learning.status import ChangeRecord, KindOfChange
from bodyschema.learning.uncertainty import PredictiveUncertainty
from kbmaps import ChainBelief, ChainParameters, ChainTolerances, Explanation, learning_bases
from kbmaps.changes.kinds import log_ratios
from kbmaps.robust import RobustSettings

# Pairs that the chain knows (half as many more validate it), range of pairs until the change, and pairs to notice it.
KNOWN, CHANGED_WITHIN, LONGEST = 1000, (20, 80), 600
STEPS_DEG = (1.0, 3.0)
TOLERANCES = ChainTolerances(
    axes=math.radians(3.0),
    points=0.015,
    zeros=math.radians(3.0),
    tool=0.03,
    base_rotation=math.radians(3.0),
    base_translation=0.03,
)
VERDICTS = RIGHT, UNDECIDED, WRONG = "right", "undecided", "wrong"
IN_TIME, NAMED_AFTER = 30, (30, 100, 300)
PAIRS_BETWEEN_FALSE_ALARMS = 50_000
# On a walk without a change: pairs between two fits of the chain, and the number of latest pairs it is fitted to.
REFIT, FITTED = 500, 2000
OUTLIERS, OUTLIER_M = 0.01, 0.3
# An arm that is no chain: by how much, at most, in how many waves over a turn.
BENT_M, WAVES = 0.004, 2.0
RIGID, BENT, TICKS = "rigid", "not rigid", "ticks"
# Encoder resolution [rad], and the factor by which a stereo camera is less precise along its view.
TICK_RAD, DEPTH = 2.0 * math.pi / 4096, 8.0


@dataclass(frozen=True)
class Case:
    """A change of the arm.

    Attributes:
        kind: "tool", "camera" or "joint".
        size: tool: shift [m]; joint: offset [rad]; camera: multiple of about 1 degree and 10 mm.
        mean_way: True if the size is the marker's mean displacement over the pairs after the change [m].
    """

    name: str
    kind: str
    size: float
    mean_way: bool = False


CASES = (
    Case("tool 5 mm", "tool", 0.005),
    Case("tool 10 mm", "tool", 0.010),
    Case("tool 30 mm", "tool", 0.030),
    Case("tool 200 mm", "tool", 0.200),
    Case("camera 1 deg, 10 mm", "camera", 1.0),
    Case("joint 0.5 deg", "joint", math.radians(0.5)),
    Case("joint 1 deg", "joint", math.radians(1.0)),
    Case("joint 2 deg", "joint", math.radians(2.0)),
    Case("camera's way 10 mm", "camera", 0.010, mean_way=True),
    Case("joint's way 10 mm", "joint", 0.010, mean_way=True),
)


@dataclass(frozen=True)
class Outcome:
    """Result of one seed: delays [pairs], infinite where undetected, and the verdicts after each number of pairs."""

    delay: float
    optimal: float
    optimal_with_model: float
    undirected: float
    early: bool
    named: tuple[str, ...]


def walk(joints: int, count: int, rng: np.random.Generator) -> FloatArray:
    """Return straight segments between random waypoints in steps of 1 to 3 degrees, shape (count, joints)."""
    q, goal = [np.zeros(joints)], rng.uniform(-REACH, REACH, joints)
    while len(q) < count:
        step = math.radians(rng.uniform(*STEPS_DEG))
        while np.linalg.norm(goal - q[-1]) < step:
            goal = rng.uniform(-REACH, REACH, joints)
        way = goal - q[-1]
        q.append(q[-1] + step * way / np.linalg.norm(way))
    return np.array(q)


def changed(
    arm: RoughArm, case: Case, q: FloatArray, rng: np.random.Generator
) -> tuple[RoughArm, FloatArray, int | None]:
    """Return the changed arm, the change of its parameters, and the joint whose offset changed (None for other kinds).

    q (n, d) [rad] are the poses after the change.
    """
    parameters, joint = arm.parameters, None
    theta = np.zeros(parameters.size)
    if case.kind == "tool":
        theta[parameters.tool] = case.size * direction(rng)
    elif case.kind == "camera":
        theta[parameters.base_turn] = math.radians(1.0) * direction(rng)
        theta[parameters.base_shift] = 0.01 * direction(rng)
    else:
        # Offsets of the first and the last joint look like a change of the camera and of the tool.
        joint = int(rng.integers(1, arm.drawing.joints - 1))
        theta[np.arange(parameters.size)[parameters.zeros][joint]] = math.radians(1.0) if case.mean_way else case.size
    if case.mean_way:
        moved = parameters.positions(arm.change + theta, q) - arm.positions(q)
        theta *= case.size / float(np.linalg.norm(moved, axis=1).mean())
    return RoughArm(parameters, arm.change + theta), theta, joint


def direction(rng: np.random.Generator) -> FloatArray:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def reference(arm: RoughArm, q: FloatArray, x: FloatArray, covs: FloatArray) -> Reference:
    """Fit the reference chain to pairs q (n, d) [rad], x (n, 3) [m] with covariances (n, 3, 3) [m²]."""
    belief = fitted_belief(ChainBelief.from_tolerances(ChainParameters(arm.drawing), TOLERANCES), q, x)
    bases = learning_bases(np.full(q.shape[1], -np.pi), np.full(q.shape[1], np.pi), [False] * q.shape[1])
    kbmap = belief.chain.to_kbmap(bases)
    known, good = len(q), np.linalg.norm(x - belief.predict(q), axis=1) < RobustSettings.outlier_sigmas * belief.noise
    q, x, covs = (each[good][-MonitorSettings.looked_back :] for each in (q, x, covs))
    variance = covs.diagonal(axis1=1, axis2=2).mean(axis=0)
    return Reference(kbmap, kbmap, belief, belief, None, PredictiveUncertainty(np.zeros(3)), known, q, x, variance)


def cusum_threshold(information: float) -> float:
    """Return the alarm threshold of a CUSUM of Gaussian log likelihood ratios (Siegmund 1985, section 2.6).

    Args:
        information: mean log likelihood ratio of a pair after the change.
    """
    beyond = 1.166 * math.sqrt(2.0 * information)

    threshold = 1.0
    for _ in range(100):  # a contraction: its slope is below 1 if false alarms are rare
        threshold = math.log(PAIRS_BETWEEN_FALSE_ALARMS * information + 1.0 + threshold + beyond) - beyond
    return max(threshold, 0.0)


def sum_threshold(information: float) -> float:
    """Return the threshold of the log of summed likelihood ratios over onsets (Pollak 1987), at the same alarm rate."""
    return math.log(PAIRS_BETWEEN_FALSE_ALARMS) - 0.583 * math.sqrt(2.0 * information)


def outcome(case: Case, joints: int, sigma: float, seed: int, known_pairs: int) -> Outcome:
    rng = np.random.default_rng([seed, joints, round(1e4 * sigma), CASES.index(case)])
    arm = rough_arm(joints, rng, TOLERANCES)
    at = known_pairs // 2 + int(rng.integers(*CHANGED_WITHIN))
    q = walk(joints, known_pairs + at + LONGEST, rng)
    x = arm.measured(q, sigma, rng)
    after, theta, joint = changed(arm, case, q[known_pairs + at :], rng)
    moved = after.positions(q[known_pairs + at :]) - arm.positions(q[known_pairs + at :])
    x[known_pairs + at :] += moved
    cov = sigma**2 * np.eye(3)
    known = reference(arm, q[:known_pairs], x[:known_pairs], np.broadcast_to(cov, (known_pairs, 3, 3)))
    watch = ChangeMonitor()
    watch.solution_requested()
    watch.offer(known)
    ratios = ((x - arm.positions(q))[known_pairs + at :] * moved).sum(axis=1) - 0.5 * np.square(moved).sum(axis=1)
    information = 0.5 * float(np.square(moved).sum(axis=1).mean()) / sigma**2
    threshold, threshold_of_sum = cusum_threshold(information), sum_threshold(information)
    optimal = delay_of(cusum(ratios / sigma**2), threshold)
    with_model, undirected, delay, early, origin = math.inf, math.inf, math.inf, False, None
    named = dict.fromkeys(NAMED_AFTER, "not noticed")
    for k in range(at + LONGEST):
        watch.add(pair_of(k, q[known_pairs + k], x[known_pairs + k], cov), kept=True)
        since = k - at + 1
        if since > 0 and math.isinf(with_model + undirected):
            told, of_all = statistics_if_told(watch, theta, case, joint)
            with_model = min(with_model, since if told > threshold else math.inf)
            undirected = min(undirected, since if of_all > threshold_of_sum else math.inf)
        if origin is None and watch.alarmed:
            delay, early = since, since <= 0
            detected = watch.detected()
            if early or detected is None:
                break
            origin = ArmBeforeChange(detected, KnownArm(known.belief, TOLERANCES)), known_pairs + detected.first
        if origin is not None and since in NAMED_AFTER:
            found = origin[0].explain(q[origin[1] : known_pairs + k + 1], x[origin[1] : known_pairs + k + 1])
            named[since] = verdict(found, case, joint)
        if origin is not None and since >= NAMED_AFTER[-1] and not math.isinf(with_model + undirected):
            break
    return Outcome(delay, optimal, with_model, undirected, early, tuple(named.values()))


def verdict(found: list[Explanation], case: Case, joint: int | None) -> str:
    """Classify the learner's verdict on the change as right, wrong or undecided.

    A joint offset that cannot be distinguished from a change of the tool or the camera counts as right for these.
    """
    kinds = [KindOfChange(each.kind.name, each.kind.joint, each.probability) for each in found]
    record = msgspec.structs.replace(ChangeRecord.reported(0), kinds=kinds)
    if record.named is None:
        return UNDECIDED
    right = (record.named.name, record.named.joint) == (case.kind, joint) or record.alike(record.named) == case.kind
    return RIGHT if right else WRONG


def statistics_if_told(watch: ChangeMonitor, theta: FloatArray, case: Case, joint: int | None) -> tuple[float, float]:
    """Return log statistics of detectors that know the change beforehand, computed with the monitor's own model.

    The first is the greatest likelihood ratio over the onsets, given the change. The second is the sum of these ratios
    over the onsets, given its kind and size but not its direction.
    """
    detector, place = watch.detector, 0
    if detector is None:
        return -math.inf, -math.inf
    for kind in detector.kinds:
        at = slice(place, place := place + len(kind.columns))
        if (kind.name, kind.joint) == (case.kind, joint):
            onsets, information, score = detector.sums()
            information, score, change = information[:, at, at], score[:, at], theta[kind.columns] / kind.units
            told = float((score @ change - 0.5 * (information @ change) @ change).max())
            stands_for = np.diff(np.append(onsets, detector.pairs))
            ratios = log_ratios(information, score, np.array([float(np.sqrt(np.square(change).mean()))]))
            return told, float(np.logaddexp.reduce(ratios + np.log(stands_for)))
    return -math.inf, -math.inf


def cusum(ratios: FloatArray) -> FloatArray:
    total = np.concatenate([[0.0], np.cumsum(ratios)])
    return (total - np.minimum.accumulate(total))[1:]


def delay_of(statistic: FloatArray, threshold: float) -> float:
    reached = np.flatnonzero(statistic > threshold)
    return float(reached[0] + 1) if len(reached) else math.inf


def pair_of(number: int, q: FloatArray, x: FloatArray, cov: FloatArray) -> Pair:
    where, seen, covariance = map(frozen_array, (q, x, cov))
    return Pair("simulated", number + 1, 1, number / 30.0, "", where, seen, covariance)


def quiet(kind: str, joints: int, sigma: float, seed: int, pairs: int) -> int:
    """Count false alarms along a walk without a change; the monitor restarts after each."""
    rng = np.random.default_rng([seed, joints, round(1e4 * sigma), (RIGID, BENT, TICKS).index(kind), 99])
    arm = rough_arm(joints, rng, TOLERANCES)
    q = walk(joints, KNOWN + pairs, rng)
    x, covs = arm.measured(q, sigma, rng), np.broadcast_to(sigma**2 * np.eye(3), (len(q), 3, 3))
    if kind == BENT:
        waves = rng.normal(size=(joints, 3)) * WAVES / math.sqrt(joints)
        x += BENT_M * np.sin(q @ waves + rng.uniform(0.0, 2.0 * np.pi, 3))
    elif kind == TICKS:
        x, covs = seen_in_stereo(arm.positions(q), sigma, rng)
        q = TICK_RAD * np.round(q / TICK_RAD)
    wild = rng.random(len(q)) < OUTLIERS
    x[wild] += OUTLIER_M * rng.normal(size=(int(wild.sum()), 3))
    alarms, watch = 0, ChangeMonitor()
    for k in range(KNOWN, len(q)):
        if (k - KNOWN) % REFIT == 0:
            watch.solution_requested()
            if watch.needs_reference:
                first = max(0, k - FITTED)
                watch.offer(reference(arm, q[first:k], x[first:k], covs[first:k]))
        watch.add(pair_of(k, q[k], x[k], covs[k]), kept=not wild[k])
        if watch.alarmed:
            first, alarms, watch = max(0, k - FITTED), alarms + 1, ChangeMonitor()
            watch.solution_requested()
            watch.offer(reference(arm, q[first:k], x[first:k], covs[first:k]))
    return alarms


def seen_in_stereo(x: FloatArray, sigma: float, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return noisy positions (n, 3) [m] and covariances (n, 3, 3) [m²]: sigma across the view, more along it."""
    view = x / np.linalg.norm(x, axis=1)[:, None]
    noise = sigma * (rng.normal(size=x.shape) + DEPTH * rng.normal(size=(len(x), 1)) * view)
    return x + noise, sigma**2 * (np.eye(3) + DEPTH**2 * view[:, :, None] * view[:, None, :])


def delays_table() -> Table:
    """Return the empty table of delays."""
    references = ("change and arm known", "change and model known", "kind and size known")
    columns = [
        Column("change"),
        Column("delay, mean (95 %)", "", "{:.3g} ({:.0f})"),
        Column(f"not within {LONGEST}", "", "{} of {}"),
        Column(f"within {IN_TIME}", "%", "{:.0f} ({:.0f})"),
        *(Column(name, "", "{:.2g}") for name in references),
    ]
    return Table("change_detection", columns)


def names_table() -> Table:
    """Return the empty table of shares that are named rightly, undecided, and named wrongly."""
    columns = [Column(f"after {count}", "%", "{:.0f} / {:.0f} / {:.0f}") for count in NAMED_AFTER]
    return Table("change_identification", [Column("change"), *columns])


def delay_cells(found: list[Outcome]) -> list[object]:
    """Return the cells of a row of delays; detections before the change do not count."""
    delays, *references = (
        np.array([getattr(each, name) for each in found])
        for name in ("delay", "optimal", "optimal_with_model", "undirected")
    )
    seen = np.minimum(delays, LONGEST)
    within = [100.0 * np.mean(each <= IN_TIME) for each in (delays, references[0])]
    # A reference that counts no pair beyond four sigmas never sees what is far beyond that.
    means = [np.minimum(each, LONGEST).mean() if np.isfinite(each).any() else None for each in references]
    return [[seen.mean(), np.percentile(seen, 95)], [int(np.isinf(delays).sum()), len(found)], within, *means]


def name_cells(found: list[Outcome]) -> list[object]:
    """Return the shares of each verdict after each number of pairs."""
    return [
        [100.0 * np.mean([each.named[k] == said for each in found]) for said in VERDICTS]
        for k in range(len(NAMED_AFTER))
    ]


def print_quiet(arguments: argparse.Namespace) -> None:
    for kind in (RIGID, BENT, TICKS):
        for joints in arguments.joints:
            for sigma in arguments.sigmas:
                began = time.process_time()
                alarms = [quiet(kind, joints, 1e-3 * sigma, seed, arguments.pairs) for seed in seeds_of(arguments)]
                pairs, cpu = arguments.pairs * len(alarms), time.process_time() - began
                print(
                    f"{kind:9s} d = {joints}, sigma {sigma:g} mm: {sum(alarms)} false "
                    f"alarms in {pairs} pairs; {1e3 * cpu / pairs:.2f} ms a pair",
                    flush=True,
                )


def seeds_of(arguments: argparse.Namespace) -> Iterator[int]:
    yield from range(arguments.first, arguments.first + arguments.seeds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quiet", action="store_true", help="false alarms")
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--pairs", type=int, default=5000, help="of a quiet walk")
    parser.add_argument("--joints", type=int, nargs="+", default=[6, 7])
    parser.add_argument("--sigmas", type=float, nargs="+", default=[1.0, 5.0, 20.0], help="[mm]")
    parser.add_argument("--known", type=int, default=KNOWN, help="pairs that the chain knows")
    parser.add_argument("--only", nargs="+", choices=[case.name for case in CASES], default=[], metavar="CASE")
    tables_option(parser)
    arguments = parser.parse_args()
    if arguments.quiet:
        print_quiet(arguments)
        return
    delays, names, named = delays_table(), names_table(), list[list[object]]()
    for joints in arguments.joints:
        for sigma in arguments.sigmas:
            for case in CASES:
                if not arguments.only or case.name in arguments.only:
                    found = [outcome(case, joints, 1e-3 * sigma, seed, arguments.known) for seed in seeds_of(arguments)]
                    kept = [each for each in found if not each.early]
                    change = f"{case.name}, {joints} joints, σ = {sigma:g} mm"
                    if len(kept) < len(found):
                        print(f"{change}: {len(found) - len(kept)} false alarms before the change")
                    delays.add(change, *delay_cells(kept))
                    named.append([change, *name_cells(kept)])
    print()
    for cells in named:
        names.add(*cells)
    for table in (delays, names):
        table.save(arguments.tables)


if __name__ == "__main__":
    main()
