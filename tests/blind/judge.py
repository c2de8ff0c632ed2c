"""Judge a diagnosis of a hidden case: its causes, their certainty, their numbers and their gain."""

from __future__ import annotations

import resource
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import msgspec
import numpy as np

from bodyschema.diagnosis.diagnosis import Diagnosis, diagnose
from bodyschema.diagnosis.report.conclusion import conclusion
from bodyschema.diagnosis.report.result import Cause, DiagnosisFile, Indistinguishable, Interval
from bodyschema.effects import Effect, Motion, Simulation
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription

from .arrays import FloatArray
from .cases import HiddenCase
from .hidden import Hidden
from .judgement import CauseJudged, Judgement, Key, Number, Outcome, TruthJudged, written
from .meaning import Meant, meant
from .oracle import Fitted, Scene, wide

TOLD = 25.0  # chi-square by which an oracle distinguishes two effects
SAME_SHARE = 1e-4  # share of a signal's chi-square left by an effect that is the same in every motion
SURE = 0.9
FEWEST_FALSE_FIXES = 3
SHOWS, HIDDEN_FROM = 0.25, 0.02  # share of the variance from which a joint has to be named, and below which it must not
FIRST_ORDER = ("joint_ripple",)  # poles of unequal strength, read by atan2
TELLS_LITTLE = 10.0  # usual sizes: with a wider interval the number is not identifiable from this motion


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth of a case in the terms of the effects table, and what an oracle knows of it.

    Attributes:
        scene: the measured motion.
        wide: a path through all postures, which stands for any motion.
        nuisances: parameters unknown in robot.toml, with their true numbers.
        hidden, meanings: the effects described by a row of the table, in the same order.
        strange: the effects outside the table.
    """

    case: HiddenCase
    robot: RobotDescription
    scene: Scene
    wide: Scene
    nuisances: tuple[Effect, ...]
    hidden: tuple[Hidden, ...]
    meanings: tuple[Meant, ...]
    strange: tuple[Hidden, ...]

    @classmethod
    def of(cls, case: HiddenCase, robot: RobotDescription, motion: Motion) -> Truth:
        """Build the ground truth from a case and the recorded motion."""
        scene = Scene.of(robot, motion, case.measured.covariance, case.scatter)
        usual_s = float(np.median(np.diff(motion.clock)[motion.segment[1:] == motion.segment[:-1]]))
        nuisances = tuple(m.effect for h in case.nuisances if (m := meant(h, robot, usual_s)) is not None)
        both = [(h, m) for h in case.truth if (m := meant(h, robot, usual_s)) is not None]
        strange = tuple(h for h in case.truth if h.outside)
        hidden, meanings = tuple(h for h, _ in both), tuple(m for _, m in both)
        return cls(case, robot, scene, wide(scene), nuisances, hidden, meanings, strange)

    @cached_property
    def fitted(self) -> Fitted:
        """The true effects with the numbers that come nearest to the measured positions free of noise."""
        effects = [*self.nuisances, *(m.effect for m in self.meanings)]
        return self.scene.fitted(self.case.measured.x_noise_free, effects)

    @cached_property
    def effects(self) -> tuple[Effect, ...]:
        """Effects of `fitted`, without the nuisances."""
        return self.fitted.effects[len(self.nuisances) :]

    @cached_property
    def target(self) -> FloatArray:
        """Positions (n, 3) [m] that an oracle compares rivals with: at the readings as they were rounded."""
        return self.case.measured.x_noise_free if self.strange else self.scene.positions(self.fitted.effects)

    def beside(self, index: int) -> tuple[Effect, ...]:
        """Return all true effects but one."""
        return (*self.nuisances, *(e for k, e in enumerate(self.effects) if k != index))

    def same_anywhere(self, index: int, other: Effect) -> bool:
        """Return True if no motion can distinguish a true effect from another one."""
        others = self.beside(index)
        target = self.wide.positions([*others, self.effects[index]])
        signal = self.wide.fitted(target, others).chi2
        return self.wide.replaced(target, others, self.effects[index], other).chi2 < SAME_SHARE * max(signal, 1e-9)

    def behind(self, index: int, other: Effect) -> float:
        """Return the rise of chi-square if another effect replaces a true one on the measured motion."""
        others = self.beside(index)
        return self.scene.replaced(self.target, others, self.effects[index], other).chi2

    def judged(self, index: int, found_as: Key | None, among_rivals: bool) -> TruthJudged:
        """Return what an oracle sees of one of the true effects, and how it was found."""
        return msgspec.structs.replace(self._seen_by_oracle[index], found_as=found_as, among_rivals=among_rivals)

    @cached_property
    def _seen_by_oracle(self) -> tuple[TruthJudged, ...]:
        return tuple(self._told_apart(index) for index in range(len(self.effects)))

    def _told_apart(self, index: int) -> TruthJudged:
        """Judge how well an oracle sees one of the true effects, and distinguishes it from its best alternative."""
        hidden, effect = self.hidden[index], self.effects[index]
        others = self.beside(index)
        rivals = self.scene.rivals(self.target, others, [effect])
        apart = next(
            (fit for fit in rivals if fit.chi2 >= TOLD or not self.same_anywhere(index, fit.effects[-1])), None
        )
        seen = self.scene.fitted(self.target, others).chi2
        return TruthJudged(
            *effect.key,
            size=hidden.size,
            outside=False,
            seen_chi2=seen,
            told_chi2=seen if apart is None else min(apart.chi2, seen),
            rival=None if apart is None else apart.effects[-1].key,
            found_as=None,
            among_rivals=False,
        )

    def strange_judged(self, hidden: Hidden) -> TruthJudged:
        """Judge how far the best single effect of the table falls short of one outside the table."""
        others = self.beside(-1)
        target = self.case.measured.x_noise_free
        floor = self.fitted_strange_floor
        seen = max(self.scene.fitted(target, others).chi2 - floor, 0.0)
        best = self.scene.rivals(target, others, [])[0]
        told = min(max(best.chi2 - floor, 0.0), seen)
        key = (hidden.effect, hidden.where, hidden.source)
        return TruthJudged(*key, hidden.size, True, seen, told, best.effects[-1].key, None, False)

    @cached_property
    def fitted_strange_floor(self) -> float:
        """Chi-square that rounded readings leave in positions free of noise."""
        rounding = self.scene.rounding
        return float(np.einsum("nij,njk,nik->", self.scene.whitening, rounding, self.scene.whitening))


@dataclass(frozen=True, eq=False)
class Named:
    """A named cause as an effect with numbers."""

    cause: Cause
    effect: Effect

    @classmethod
    def of(cls, cause: Cause, robot: RobotDescription) -> Named | None:
        """Return the named cause; None for outliers, which are not an effect of the simulation."""
        if cause.effect == "outliers":
            return None
        effect = Effect.at(robot, cause.effect, cause.where, cause.source)
        values = {p.name: cause.parameters[p.name].value for p in effect.parameters if p.name in cause.parameters}
        return cls(cause, Effect.at(robot, cause.effect, cause.where, cause.source, values))


def judge(case: HiddenCase, scenario: str = "", command: str = "") -> Judgement:
    """Diagnose measured.csv and compare with what was hidden."""
    robot = RobotDescription.load(case.robot_file)
    recording = Recording.read(case.folder / "measured.csv", robot.joints)
    begun, begun_cpu = time.perf_counter(), time.process_time()
    diagnosis = diagnose(recording, Simulation(robot))
    file = conclusion(diagnosis)
    seconds, cpu_seconds = time.perf_counter() - begun, time.process_time() - begun_cpu
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    truth = Truth.of(case, robot, Motion.of(recording))
    truths, causes, outcome = compared(truth, file)
    gain, of_truth = gains(truth, diagnosis, Recording.read(case.folder / "fresh.csv", robot.joints))
    shows = truth.strange[0].shows_on if truth.strange else {}
    return Judgement(
        scenario=scenario,
        seed=case.seed,
        arm=case.arm.name,
        hold=case.hold,
        style=case.style,
        pairs=len(recording),
        verdict=file.verdict,
        outcome=outcome,
        truth=truths,
        causes=causes,
        gain=gain,
        gain_of_truth=of_truth,
        stated_gain_percent=file.gain.held_out_percent,
        depends_on=file.unexplained.depends_on,
        shows_on=shows,
        joints_right=joints_right(truth.strange[0], file.unexplained.depends_on) if truth.strange else None,
        smooth_ratio=smooth_ratio(truth, diagnosis),
        seconds=seconds,
        cpu_seconds=cpu_seconds,
        memory_mb=memory,
        command=command,
        false_fixes=int(case.measured.outlier.sum()),
    )


def compared(truth: Truth, file: DiagnosisFile) -> tuple[tuple[TruthJudged, ...], tuple[CauseJudged, ...], Outcome]:
    """Return the judged hidden effects, the judged causes and the outcome."""
    named = [n for cause in file.causes if (n := Named.of(cause, truth.robot)) is not None]
    found = matched(truth, named)
    rivals = {(r.effect, r.where, r.source) for n in named for r in (*n.cause.rivals, *n.cause.indistinguishable_from)}
    hidden = [
        truth.judged(k, None if k not in found else found[k].effect.key, effect.key in rivals)
        for k, effect in enumerate(truth.effects)
    ]
    hidden += [truth.strange_judged(strange) for strange in truth.strange]
    index_of = {id(n): k for k, n in found.items()}
    whole = len(found) == len(truth.effects) == len(named) and not truth.strange
    causes = [cause_judged(truth, n, index_of.get(id(n)), whole) for n in named]
    false_fixes = judged_false_fixes(truth.case, file)
    causes += [cause for cause in (false_fixes,) if cause is not None]
    expected = truth.case.measured.outlier.sum() >= FEWEST_FALSE_FIXES
    missed_fixes = bool(expected) and false_fixes is None
    return tuple(hidden), tuple(causes), outcome(file, hidden, causes, missed_fixes)


def matched(truth: Truth, named: Sequence[Named]) -> dict[int, Named]:
    """Match causes to true effects: by the same name, or by one that is as simple and the same in any motion."""
    found: dict[int, Named] = {}
    for k, effect in enumerate(truth.effects):
        same = [n for n in named if n.effect.key == effect.key]
        if same and not (effect.name == "link_geometry" and _is_camera_pose(truth, k)):
            found[k] = same[0]
    for k, effect in enumerate(truth.effects):
        free = [n for n in named if n not in found.values() and _rank(n.effect) <= _rank(effect)]
        if k not in found:
            same = [n for n in free if n.effect.key != effect.key and truth.same_anywhere(k, n.effect)]
            found |= {k: same[0]} if same else {}
    return found


def _rank(effect: Effect) -> tuple[int, bool]:
    """Return a sort key that puts the simpler effect first: fewer numbers, then no joint."""
    return len(effect.parameters), effect.where is not None


def _is_camera_pose(truth: Truth, index: int) -> bool:
    """Return True if a link's geometry is equivalent to the camera's pose, which is its simpler name."""
    return truth.robot.camera.pose_known and truth.same_anywhere(index, Effect.at(truth.robot, "camera_pose"))


def cause_judged(truth: Truth, named: Named, index: int | None, whole: bool) -> CauseJudged:
    """Return the judgement of one cause; `index` is that of the true effect that it names."""
    cause = named.cause
    true_keys = {effect.key for effect in truth.effects}
    rivals = {(r.effect, r.where, r.source) for r in (*cause.rivals, *cause.indistinguishable_from)}
    needless: list[str] = []
    wrong_reach: list[str] = []
    if index is not None:
        # An oracle has no effect to put in place of one outside the table.
        for member in (member for member in cause.indistinguishable_from if not member.what):
            needless += _needless(truth, index, member)
            wrong_reach += _wrong_reach(truth, index, member)
    numbers, left_out = judged_numbers(truth, named, index) if index is not None and whole else ((), {})
    return CauseJudged(
        *named.effect.key,
        probability=cause.probability,
        is_right=index is not None,
        open=(bool(rivals & true_keys) or _may_be_strange(truth, cause)) and cause.probability < SURE,
        listed=len(cause.indistinguishable_from),
        needless=tuple(needless),
        wrong_reach=tuple(wrong_reach),
        numbers=numbers,
        left_out=left_out,
    )


def _may_be_strange(truth: Truth, cause: Cause) -> bool:
    """Return True if something is hidden outside the table and the cause allows for an unnamed alternative."""
    return bool(truth.strange) and any(rival.what for rival in cause.rivals)


def _member(truth: Truth, member: Indistinguishable) -> Effect:
    return Effect.at(truth.robot, member.effect, member.where, member.source)


def _needless(truth: Truth, index: int, member: Indistinguishable) -> list[str]:
    effect = _member(truth, member)
    if effect.key in {e.key for e in truth.effects}:
        return []
    behind = truth.behind(index, effect)
    return [f"{written(effect.key)} (Δχ² {behind:.0f})"] if behind >= TOLD else []


def _wrong_reach(truth: Truth, index: int, member: Indistinguishable) -> list[str]:
    effect = _member(truth, member)
    if effect.key in {e.key for e in truth.effects}:
        return []
    same = truth.same_anywhere(index, effect)
    return [f"{written(effect.key)} by {member.by}"] if same != (member.by == "any_motion") else []


def judged_numbers(truth: Truth, named: Named, index: int) -> tuple[tuple[Number, ...], dict[str, str]]:
    """Return the numbers of a cause with the true ones, and reasons for those left out."""
    meaning = truth.meanings[index]
    # Of these the mechanism has the numbers to first order only: where they come nearest to it is the truth.
    near = truth.effects[index] if meaning.effect.name in FIRST_ORDER else meaning.effect
    if named.effect.key != meaning.key:
        return (), {"all": "named otherwise"}
    numbers, left_out = [], {}
    for parameter, value in zip(meaning.effect.parameters, near.values, strict=True):
        given = named.cause.parameters.get(parameter.name)
        if given is None or parameter.name not in meaning.told:
            left_out[parameter.name] = "the mechanism has no such number" if given else "not stated"
        elif parameter.is_amount and np.ptp(given.ci95) > TELLS_LITTLE * parameter.usual:
            left_out[parameter.name] = "not determined by this motion"
        else:
            low, high = _between_rows(truth.scene.motion, given) if parameter.name == "t0" else given.ci95
            numbers.append(Number(parameter.name, float(value), given.value, (low, high)))
    return tuple(numbers), left_out


def _between_rows(motion: Motion, moment: Interval) -> tuple[float, float]:
    """Return the interval of a moment widened to whole rows: moments between two rows cannot be distinguished."""
    low, high = moment.ci95
    before, after = motion.clock[motion.clock <= low], motion.clock[motion.clock >= high]
    return float(before.max(initial=-np.inf)), float(after.min(initial=np.inf))


def judged_false_fixes(case: HiddenCase, file: DiagnosisFile) -> CauseJudged | None:
    """Judge the cause that reports outliers; return None if it is not named."""
    for cause in file.causes:
        if cause.effect == "outliers":
            count = int(case.measured.outlier.sum())
            given = next(iter(cause.parameters.values()))
            share = count / len(case.measured.outlier)
            numbers = (Number("share", share, given.value, given.ci95),) if count else ()
            return CauseJudged("outliers", None, None, cause.probability, count > 0, False, 0, (), (), numbers, {})
    return None


def outcome(
    file: DiagnosisFile, hidden: Sequence[TruthJudged], causes: Sequence[CauseJudged], missed_fixes: bool
) -> Outcome:
    """Return the outcome of the diagnosis as a whole."""
    false = [cause for cause in causes if not cause.is_right]
    if any(truth.outside for truth in hidden):
        if file.verdict == "unexplained":
            return "wrong" if any(cause.probability >= SURE for cause in false) else "right"
        unseen = all(truth.seen_chi2 < TOLD for truth in hidden)
        left_open = all(truth.told_chi2 < TOLD for truth in hidden) and all(cause.open for cause in false)
        return "honest" if (left_open if false else unseen) else "wrong" if false else "missed"
    if any(not cause.open for cause in false) or file.verdict == "unexplained":
        return "wrong"
    lost = [t for t in hidden if t.found_as is None and not t.among_rivals]
    if missed_fixes or any(truth.seen_chi2 >= TOLD for truth in lost):
        return "missed"
    return "honest" if false or any(truth.found_as is None for truth in hidden) else "right"


def gains(truth: Truth, diagnosis: Diagnosis, fresh: Recording) -> tuple[float | None, float | None]:
    """Return the shares of the error on a fresh recording that the found and the true causes remove."""
    if not truth.effects and not truth.strange:
        return None, None
    motion, there = Motion.of(fresh), truth.case.fresh.x_noise_free

    def rms(simulation: Simulation) -> float:
        return float(np.sqrt(np.mean(np.sum((simulation.positions(motion) - there) ** 2, axis=1))))

    before = rms(diagnosis.aligned.simulation)
    after = rms(diagnosis.extended.simulation)
    best = None if truth.strange else rms(Simulation(truth.robot, truth.fitted.effects))
    return 1.0 - after / before, None if best is None else 1.0 - best / before


def joints_right(hidden: Hidden, depends_on: Sequence[str]) -> bool:
    """Return True if the named joints are the erring one and those on which it clearly depends, without an idle one.

    An error that changes with time alone has to be named by time.
    """
    named = set(depends_on)
    if not hidden.drivers and hidden.effect in ("wandering_zero", "growing_link"):
        return "time" in named
    pair = {str(hidden.where), hidden.source} if hidden.source is not None else set()
    needed = pair | {joint for joint in hidden.drivers if hidden.shows_on[joint] >= SHOWS}
    idle = {joint for joint, share in hidden.shows_on.items() if share < HIDDEN_FROM} - {hidden.where, hidden.source}
    return needed <= named and not idle & named


def smooth_ratio(truth: Truth, diagnosis: Diagnosis) -> float | None:
    """Return the held-out error after the smooth model of the unexplained part, over the noise; None without a model.

    Positions free of noise need no held-out data: a fit to the noise counts as an error.
    """
    if not truth.strange or diagnosis.left.model is None:
        return None
    modelled = diagnosis.extended.run.measured + diagnosis.left.model.unstored
    off = np.square(modelled - truth.case.measured.x_noise_free).sum(axis=1).mean()
    return float(np.sqrt(1.0 + off / truth.case.sigma_m**2))
