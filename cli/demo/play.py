"""Script of the demo: guide the arm, change its tool half-way, continue, and report the result."""

from __future__ import annotations

import csv
import json
import math
import queue
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Literal

import numpy as np

from bodyschema.cli.demo.scene import Scene
from bodyschema.cli.replay.processes import Process, ProcessSettings, started
from bodyschema.cli.terminal.screen import rejected
from bodyschema.daemon.config import Config
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import ZenohSession
from bodyschema.daemon.transport.status import LearnerStatus, SamplerStatus
from bodyschema.daemon.transport.wire import CommandRequest, JointsRequest, PairsReply, PredictReply, decode, encode
from bodyschema.diagnosis.report.svg_plot import Layout, Plot
from bodyschema.interfaces.errors import BusError
from bodyschema.interfaces.interpreter import end, module_command
from bodyschema.interfaces.records import FloatArray
from bodyschema.learning.online_learner import OnlineSettings
from bodyschema.learning.status import DataOutlook
from bodyschema.robot.description import RobotDescription
from kbmaps import RigidChain, nearest_rotation, rotation_matrices, rotation_vectors

_HEADING = "Forward kinematics learnt while the arm is guided (simulation)"
_TITLE, _LEGEND_LINE = 22, 14  # heights in the units of the plot, whose text is 10 to 11 high
_STYLE = (
    ".page{fill:#fff}text{font:10.5px system-ui,'DejaVu Sans',sans-serif;fill:#4d5662}"
    ".title{font-size:11px;fill:#1d2127}text.label{fill:#1d2127}text.named{fill:#b3261e}.grid{stroke:#e5e3de}.line{fill:none;stroke-width:1.6}"
    ".moment{stroke:#b3261e;stroke-dasharray:4 3}.nominal{stroke:#98a2af}.next{stroke:#e39a55;stroke-width:1}"
    ".expected{stroke:#14804a;stroke-dasharray:5 3}.truth{stroke:#1f78c8;stroke-width:2.2}"
)


@dataclass(frozen=True, slots=True)
class CurveRow:
    """One moment of the demo: mean errors against the simulator's ground truth [m].

    `angle_rad` is the mean angle to the true orientation on held-out poses [rad]; None if no orientation is learnt.
    """

    pairs: int
    truth_m: float
    predicted_m: float | None
    prequential_m: float | None
    nominal_m: float
    angle_rad: float | None = None


def write_curve(rows: Sequence[CurveRow], file: Path) -> None:
    """Write the curve as CSV, in mm and degrees; angles only where orientations are learnt."""
    turned = any(row.angle_rad is not None for row in rows)
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        heading = ["pairs", "held_out_error_mm", "claimed_error_mm", "prequential_error_mm", "nominal_error_mm"]
        writer.writerow([*heading, "held_out_angle_deg"] if turned else heading)
        for row in rows:
            errors = (row.truth_m, row.predicted_m, row.prequential_m, row.nominal_m)
            angle = "" if row.angle_rad is None else f"{math.degrees(row.angle_rad):.4f}"
            cells = ["" if e is None else f"{1e3 * e:.3f}" for e in errors]
            writer.writerow([row.pairs, *cells, angle] if turned else [row.pairs, *cells])


def plot_curve(rows: Sequence[CurveRow], change_at: int | None, file: Path) -> None:
    """Write the curve as an SVG file, with the moment of the tool change."""
    curves = {
        "nominal model": ("nominal", [row.nominal_m for row in rows]),
        "error on each new sample before it is learnt": ("next", [row.prequential_m for row in rows]),
        "error that the learner expects": ("expected", [row.predicted_m for row in rows]),
        "ground truth: error on held-out poses": ("truth", [row.truth_m for row in rows]),
    }
    known = [1e3 * error for _, errors in curves.values() for error in errors if error]
    pairs = np.array([row.pairs for row in rows], dtype=np.float64)
    plot = Plot(
        "accepted samples",
        "mean error [mm]",
        (float(pairs.min()), float(pairs.max()) + 1.0),
        (0.8 * min(known), 1.25 * max(known)),
        log_y=True,
    )
    marks = []
    for look, errors in curves.values():
        there = np.array([bool(error) for error in errors])
        marks.append(plot.line(pairs[there], 1e3 * np.array([error for error in errors if error]), look))
    if change_at is not None:
        marks.append(plot.moment(float(change_at), "tool change"))
    file.write_text(_page(plot.svg(*marks), {text: look for text, (look, _) in curves.items()}), encoding="utf-8")


def _page(plot: str, legend: dict[str, str]) -> str:
    """Return a standalone SVG: a title, the plot, and a legend below it."""
    width, height = Layout.width, Layout.height + _TITLE + _LEGEND_LINE * (len(legend) + 1)
    title = f'<text class="title" x="{width / 2}" y="16" text-anchor="middle">{_HEADING}</text>'
    entries = []
    for number, (text, look) in enumerate(legend.items(), 1):
        y = Layout.height + _TITLE + _LEGEND_LINE * number
        entries.append(f'<path class="line {look}" d="M60 {y - 4}h24"/><text x="92" y="{y}">{text}</text>')
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{2 * width}" '
        f'height="{2 * height}"><style>{_STYLE}</style><rect class="page" width="{width}" height="{height}"/>{title}'
        f'<svg y="{_TITLE}" width="{Layout.width}" height="{Layout.height}">{plot}</svg>{"".join(entries)}</svg>\n'
    )


class _Settings:
    poses: int = 300  # at which the models are judged
    stall_limit_s: float = 60.0  # without a new pair
    glance_s: float = 0.5  # interval of looking at the learner
    tool_length_m: float = 0.25  # by which the tool changes
    pairs_between_verdicts: int = 15  # for the plot of the errors


@dataclass(frozen=True, slots=True)
class Verdict:
    """Result of the evaluation."""

    pairs: int  # number of pairs that the answering model had learnt
    error_m: float  # mean distance between prediction and ground truth on held-out poses [m]
    nominal_m: float  # the same for the nominal model [m]
    within_sigma: float  # share of coordinates within the predicted 1-sigma
    # mean angle between predicted and true orientation there [rad]; None if none is learnt
    angle_rad: float | None = None
    angles_within_sigma: float | None = None  # share of the angles' components within the predicted 1-sigma


class Evaluation:
    """Evaluation of the learner's answers against the simulated ground truth."""

    def __init__(self, robot: RobotDescription, sampler: ZenohSession, learner: ZenohSession, seed: int) -> None:
        self._robot, self._sampler, self._learner = robot, sampler, learner
        self._keys = Keys(robot.name)
        self._rng = np.random.default_rng(seed)
        self._seen = np.empty((0, len(robot.joints)))
        self._region_start = 0

    @property
    def seen(self) -> int:
        """Number of accepted pairs fetched so far."""
        return len(self._seen)

    def fetch_pairs(self) -> None:
        """Fetch the joint angles of the pairs accepted since the last call."""
        while True:
            request = f"{self._keys.pairs}?from={len(self._seen) + 1}"
            reply = decode(self._sampler.ask_one(request), PairsReply)
            if reply.pairs:
                self._seen = np.vstack([self._seen, [pair.q for pair in reply.pairs]])
            if len(self._seen) >= reply.last_seq or not reply.pairs:
                return

    def new_region(self) -> None:
        """Restart the region of the data: from now on only new pairs define it."""
        self._region_start = len(self._seen)

    def change_tool(self, marker_xyz: FloatArray) -> None:
        """Change the tool in the robot's hand."""
        self._sampler.ask_one(self._keys.simulation, json.dumps({"tool": marker_xyz.tolist()}).encode())

    def truth(self) -> RigidChain:
        """Return the true kinematics of the simulated robot, with the marker's rotation in its last frame."""
        raw = json.loads(self._sampler.ask_one(self._keys.simulation))
        fixed = np.array(raw["fixed"])
        fixed[-1, :3, :3] = nearest_rotation(fixed[-1, :3, :3] @ np.array(raw["turn"]))
        return RigidChain(fixed, axes=np.array(raw["axes"]), prismatic=np.array(raw["prismatic"], dtype=bool))

    def verdict(self) -> Verdict | None:
        """Evaluate the learner's current answers; return None before any pair."""
        self.fetch_pairs()
        region = self._seen[self._region_start :]
        if not len(region):
            return None
        poses = region[self._rng.integers(len(region), size=_Settings.poses)]
        poses = poses + self._rng.normal(0.0, OnlineSettings.region_rad, poses.shape)
        poses = np.clip(poses, self._robot.lower, self._robot.upper)
        truth = self.truth()
        x_true = truth.positions(poses)
        request = encode(JointsRequest(poses.tolist()))
        answer = decode(self._learner.ask_one(self._keys.predict, request), PredictReply)
        miss = np.array(answer.x) - x_true
        return Verdict(
            pairs=answer.pairs,
            error_m=float(np.linalg.norm(miss, axis=1).mean()),
            nominal_m=float(np.linalg.norm(self._robot.chain.positions(poses) - x_true, axis=1).mean()),
            within_sigma=float((np.abs(miss) <= np.array(answer.sigma)).mean()),
            **_turned(answer, truth.orientation(poses)),
        )


def _turned(answer: PredictReply, truth: FloatArray) -> dict[str, float]:
    """Return the errors of predicted orientations against the true ones (n, 3, 3); empty if none are learnt."""
    if answer.R is None or answer.sigma_R is None:
        return {}
    turns = rotation_vectors(rotation_matrices("R", answer.R) @ truth.swapaxes(1, 2))
    return {
        "angle_rad": float(np.linalg.norm(turns, axis=1).mean()),
        "angles_within_sigma": float((np.abs(turns) <= np.array(answer.sigma_R)).mean()),
    }


class PredictionLines:
    """Output of the asking process."""

    def __init__(self, lines: queue.SimpleQueue[bytes]) -> None:
        self._lines = lines
        self.answers = 0
        self.unanswered = 0
        self.p50_ms = 0.0
        self.worst_ms = 0.0

    def update(self) -> None:
        """Read its output since the last call."""
        while not self._lines.empty():
            report = json.loads(self._lines.get())
            self.answers += report["answers"]
            self.unanswered += report["unanswered"] + report["refused"]
            self.p50_ms, self.worst_ms = report["p50_ms"], report["worst_ms"]


@contextmanager
def started_query_load(scene: Scene, seed: int) -> Iterator[PredictionLines]:
    """Run a process that asks for predictions until the end of the with statement."""
    command = module_command("bodyschema.cli.demo.query_load", str(scene.robot_file), str(seed))
    lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert process.stdout is not None
    reader = threading.Thread(target=_collect, args=(process.stdout, lines), name="asker's lines")
    reader.start()
    try:
        yield PredictionLines(lines)
    finally:
        end(process, ProcessSettings.end_limit_s)
        reader.join()
        process.stdout.close()


def _collect(stream: IO[bytes], lines: queue.SimpleQueue[bytes]) -> None:
    for line in stream:
        lines.put(line)


@dataclass
class Snapshot:
    """The data that the view shows."""

    target: int
    asker: PredictionLines
    phase: str
    sampler: SamplerStatus
    learner: LearnerStatus
    verdict: Verdict | None = None


@dataclass(frozen=True, slots=True)
class Chapter:
    """State at the end of one part of the demo."""

    pairs: int  # number of pairs learnt with this part's tool
    verdict: Verdict  # errors against the ground truth
    predicted_m: float | None  # predicted error [m], or None
    claimed_rad: float | None  # predicted error of the marker's orientation [rad], or None
    outlook: DataOutlook | None  # expected gain of further pairs, or None


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of the demo: the learning curve, and the state before and after the tool change.

    `changed_at` is the number of pairs before the change.
    """

    rows: list[CurveRow]
    first_tool: Chapter
    second_tool: Chapter
    changed_at: int
    answers: int
    unanswered: int


def play(scene: Scene, *, first: int, second: int, seed: int, show: Callable[[Snapshot], None]) -> Outcome:
    """Run the demo to its end.

    Args:
        first, second: pairs to learn before and after the tool change.
        show: called with the current state about twice a second.

    Raises:
        BusError: a process did not start, died, or stopped making progress; its log has the reason.
    """
    config = Config.load(scene.robot_file)
    endpoints, keys = config.tables.zenoh, Keys(config.robot.name)
    with ExitStack() as stack:
        daemon = stack.enter_context(started("daemon", ["--sim", "--robot", str(scene.robot_file)], {}, scene.log_file))
        daemon.wait_for(endpoints.sampler, keys.alive("sampler"))
        daemon.wait_for(endpoints.learner, keys.alive("learner"))
        sampler = stack.enter_context(ZenohSession(connect=endpoints.sampler, client=True))
        learner = stack.enter_context(ZenohSession(connect=endpoints.learner, client=True))
        asker = stack.enter_context(started_query_load(scene, seed))
        stage = _Stage(config, daemon, sampler, learner, asker, show, seed)
        before = stage.learn(first, f"guided by hand, {first} samples with the first tool", first + second)
        changed_at = stage.change_tool()
        after = stage.learn(second, "guided by hand, the tool is 250 mm longer now", first + second)
        return Outcome(stage.rows, before, after, changed_at, asker.answers, asker.unanswered)


def stalled(sampler: SamplerStatus) -> str:
    """Return the message for a sampler that has made no pair for too long."""
    why = ", ".join(f"{count} rejected: {reason}" for reason, count in rejected(sampler))
    seen = f"the sampler has seen {sampler.frames} frames" + (f", {why}" if why else "")
    more = "More may be in daemon.log. Try another --seed or marker"
    return f"no new sample for {_Settings.stall_limit_s:.0f} s; {seen}. {more}"


@dataclass
class _Stage:
    config: Config
    daemon: Process
    sampler: ZenohSession
    learner: ZenohSession
    asker: PredictionLines
    show: Callable[[Snapshot], None]
    seed: int
    rows: list[CurveRow] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._keys = Keys(self.config.robot.name)
        self._evaluation = Evaluation(self.config.robot, self.sampler, self.learner, self.seed)

    def learn(self, pairs: int, phase: str, target: int) -> Chapter:
        """Wait until the learner has learnt `pairs` pairs with the present tool."""
        snapshot = Snapshot(target, self.asker, phase, self._sampler_status(), self._learner_status())
        begin = snapshot.learner.pairs
        next_verdict, progress_at = begin + 1, time.monotonic()
        while True:
            self.daemon.check()
            learnt = snapshot.learner.pairs
            snapshot.sampler, snapshot.learner = self._sampler_status(), self._learner_status()
            if snapshot.learner.pairs != learnt:
                progress_at = time.monotonic()
            done = snapshot.learner.pairs >= begin + pairs
            if done or snapshot.learner.pairs >= next_verdict:
                snapshot.verdict = self._verdict(snapshot.learner)
                next_verdict = snapshot.learner.pairs + _Settings.pairs_between_verdicts
            self.asker.update()
            self.show(snapshot)
            if done and snapshot.verdict is not None:
                status = snapshot.learner
                claimed_rad = None if status.orientation is None else status.orientation.claimed_rad
                return Chapter(
                    status.pairs - begin, snapshot.verdict, status.claimed_error_m, claimed_rad, status.outlook
                )
            if time.monotonic() - progress_at > _Settings.stall_limit_s:
                raise BusError(stalled(snapshot.sampler))
            time.sleep(_Settings.glance_s)

    def change_tool(self) -> int:
        """Act as a user would: pause, change the tool, report it to the learner, resume.

        Return the earlier pairs' number.
        """
        self._command("sampler", "pause")
        self._evaluation.fetch_pairs()
        while self._learner_status().last_seq < self._evaluation.seen:
            self.daemon.check()
            time.sleep(0.05)
        changed_at = self._evaluation.seen
        marker = np.array(self.config.robot.robot.marker_xyz)
        self._evaluation.change_tool(marker * (1.0 + _Settings.tool_length_m / float(np.linalg.norm(marker))))
        self._evaluation.new_region()
        self._command("learner", "tool_changed")
        self._command("sampler", "resume")
        return changed_at

    def _verdict(self, learner: LearnerStatus) -> Verdict | None:
        verdict = self._evaluation.verdict()
        if verdict is not None:
            self.rows.append(
                CurveRow(
                    pairs=verdict.pairs,
                    truth_m=verdict.error_m,
                    predicted_m=learner.claimed_error_m,
                    prequential_m=learner.prequential_m.get(learner.answering),
                    nominal_m=verdict.nominal_m,
                    angle_rad=verdict.angle_rad,
                )
            )
        return verdict

    def _sampler_status(self) -> SamplerStatus:
        return decode(self.sampler.ask_one(self._keys.status("sampler")), SamplerStatus)

    def _learner_status(self) -> LearnerStatus:
        return decode(self.learner.ask_one(self._keys.status("learner")), LearnerStatus)

    def _command(self, process: str, command: Literal["pause", "resume", "tool_changed"]) -> None:
        bus = self.sampler if process == "sampler" else self.learner
        bus.ask_one(self._keys.command(process), encode(CommandRequest(command)))
