"""Replay of a recording: feed it, wait for the learner, query predictions, measure their errors."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bodyschema.calibration.evaluate import ErrorFigures, Split, aligned_chain, coverage
from bodyschema.cli.replay.processes import Process, free_endpoint, override, started
from bodyschema.cli.replay.report import AngleFigures, Figures, ReplayReport
from bodyschema.daemon.config import Config, DaemonConfig
from bodyschema.daemon.sampler.align import joint_difference
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import ZenohSession, client
from bodyschema.daemon.transport.status import LearnerStatus, SamplerStatus
from bodyschema.daemon.transport.wire import JointsRequest, PredictReply, decode, encode
from bodyschema.interfaces.errors import BusError, RecordingError
from bodyschema.interfaces.records import FloatArray
from bodyschema.recordings.recording import Recording, RecordingSettings
from bodyschema.robot.description import RobotDescription
from kbmaps import rotation_matrices, rotation_vectors


class _Settings:
    max_too_far: float = 0.5  # share of the steps: with more it is no path
    glance_s: float = 0.25  # interval of looking at the progress
    stall_limit_s: float = 120.0  # without progress
    # Live pairs come at most at the frame rate, and over some time: background learning is designed for that.
    shortest_s: float = 20.0


@dataclass(frozen=True, slots=True)
class Steps:
    """Steps between neighbouring rows, by the sampler's rule."""

    count: int  # their number
    too_far: int  # number of steps larger than `max_step_deg`
    median_deg: float
    max_step_deg: float  # the sampler's limit

    @classmethod
    def of(cls, recording: Recording, robot: RobotDescription, rules: DaemonConfig) -> Steps:
        """Return the steps of a recording of at least two rows."""
        prismatic = robot.chain.prismatic
        units = np.where(prismatic, 1 / rules.metres_per_degree, 180 / np.pi)
        steps_deg = np.linalg.norm(joint_difference(recording.q[1:], recording.q[:-1], prismatic) * units, axis=1)
        too_far = int(np.count_nonzero(steps_deg > rules.max_step_deg))
        return cls(len(steps_deg), too_far, float(np.median(steps_deg)), rules.max_step_deg)

    def __str__(self) -> str:
        return (
            f"{self.too_far} of {self.count} steps are larger than max_step_deg = {self.max_step_deg:g} "
            f"(median {self.median_deg:.1f}°)"
        )


def require_path(steps: Steps, recording: Recording) -> None:
    """Raise RecordingError if the rows are single poses far apart."""
    if steps.too_far > _Settings.max_too_far * steps.count:
        raise RecordingError(
            f"{steps}: these are single poses, not a guided path, and the sampler's step and speed rules do not "
            "apply to them",
            file=recording.file or "recording",
            remedy="Give --any-step to relax these rules and accept every row, each as a segment of its own",
        )


@dataclass(frozen=True, slots=True)
class Job:
    """Settings of a replay."""

    config: Config  # the robot's configuration
    recording: Recording
    split: Split  # its held-out rows
    # 1 as recorded, 0 as fast as the sampler takes it; None at the usual frame rate on average, but in `shortest_s` at
    # least
    speed: float | None
    sigma_m: float | None  # 1-sigma of the positions if the recording has none [m]; None as in robot.toml
    any_step: bool  # relax the sampler's step and speed rules
    folder: Path  # for store, checkpoint, logs and the learnt rows
    warnings: tuple[str, ...] = ()  # possible problems of the recording

    @property
    def drivers(self) -> dict[str, float]:
        """Keys of the table [drivers] for this job."""
        times = self.learnt_rows.play_times
        live = float(times[-1] - times[0]) / max(len(times) * RecordingSettings.row_interval_s, _Settings.shortest_s)
        keys = {"speed": live if self.speed is None else self.speed}
        return keys if self.sigma_m is None else keys | {"recording_sigma_m": self.sigma_m}

    @property
    def noise_m(self) -> FloatArray | float:
        """Noise of the held-out positions, 1-sigma [m], from the recording (n, 3) or the command; 0 if unknown."""
        cov = self.held_out_rows.cov
        if cov is not None:
            return np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
        stated = self.config.tables.drivers.recording_sigma_m if self.sigma_m is None else self.sigma_m
        return stated or 0.0

    @property
    def learnt_rows(self) -> Recording:
        """Rows to be fed."""
        return self.recording.rows(~self.split.held_out)

    @property
    def held_out_rows(self) -> Recording:
        return self.recording.rows(self.split.held_out)


Report = Callable[[SamplerStatus, LearnerStatus], None]


def replay(job: Job, report: Report) -> ReplayReport:
    """Replay a recording and measure the errors of the learnt model.

    Args:
        report: called with the status of both processes about four times a second.

    Raises:
        EvaluationError: the recording does not determine what robot.toml declares unknown.
        RecordingError: the sampler accepted nothing.
        BusError: a process ended, or made no progress.
        RequestError: the learner cannot answer yet.
    """
    held_out = job.held_out_rows
    before = aligned_chain(job.config.robot, job.learnt_rows).positions(held_out.q)
    with _running(job) as live:
        sampler, learner, learning_s = live.until_learnt(report)
        prediction = live.predictions(held_out.q)
    robot = job.config.robot
    x, sigma = np.array(prediction.x), np.array(prediction.sigma)
    claimed = learner.claimed_error_m
    expected = learner.expected_error_m(claimed)
    unknown = (("pose_known = false", robot.camera.pose_known), ("marker_known = false", robot.robot.marker_known))
    return ReplayReport(
        recording=str(job.recording.file),
        robot=robot.name,
        rows=len(job.recording),
        held_out=len(held_out),
        held_out_blocks=job.split.blocks,
        accepted=sampler.pairs,
        rejected=sampler.rejected,
        any_step=job.any_step,
        steps=str(Steps.of(job.recording, robot, job.config.tables.daemon)),
        fitted=[name for name, known in unknown if not known],
        before=Figures.of(ErrorFigures.of(before, held_out.x)),
        after=Figures.of(ErrorFigures.of(x, held_out.x)),
        answering=learner.answering,
        prequential_mm={name: 1e3 * error for name, error in learner.prequential_m.items()},
        claimed_mm=None if claimed is None else 1e3 * claimed,
        expected_mm=None if expected is None else 1e3 * expected,
        in_support_share=float(np.mean(prediction.in_support)),
        within_sigma_share=coverage(x, held_out.x, sigma, job.noise_m),
        doubted=learner.doubted,
        replayed=learner.replayed,
        outlook=learner.outlook,
        doubt=" ".join(job.warnings) or None,
        learning_s=learning_s,
        angle=_angles(held_out, prediction, learner),
    )


def _angles(held_out: Recording, prediction: PredictReply, learner: LearnerStatus) -> AngleFigures | None:
    if held_out.orientation is None or prediction.R is None:
        return None
    lengths = np.linalg.norm(held_out.orientation, axis=1, keepdims=True)
    measured = rotation_matrices("orientation", held_out.orientation / lengths)
    turns = rotation_vectors(rotation_matrices("R", prediction.R) @ measured.swapaxes(1, 2))
    claimed = None if learner.orientation is None else learner.orientation.claimed_rad
    return AngleFigures.of(np.linalg.norm(turns, axis=1), claimed)


class _Live:
    def __init__(self, job: Job, sampler: tuple[Process, ZenohSession], learner: tuple[Process, ZenohSession]) -> None:
        self._keys = Keys(job.config.robot.name)
        (self._sampler, self._sampler_bus), (self._learner, self._learner_bus) = sampler, learner
        self._recording = job.recording
        speed = job.drivers["speed"]
        pauses_s = np.diff(job.learnt_rows.play_times) / speed if speed else np.zeros(1)
        self._stall_limit_s = _Settings.stall_limit_s + float(pauses_s.max(initial=0.0))

    def until_learnt(self, report: Report) -> tuple[SamplerStatus, LearnerStatus, float]:
        """Wait until the recording has ended, every pair is learnt, and the learner is at rest.

        Returns:
            Both states then, and the time that learning took [s].
        """
        begin = changed = time.monotonic()
        last: tuple[object, ...] = ()
        while True:
            sampler, learner = self._status()
            report(sampler, learner)
            now = time.monotonic()
            state = sampler.frames, learner.pairs, learner.replayed, learner.model, learner.outlook
            if state != last:
                last, changed = state, now
            has_ended = sampler.state == "ended"
            if has_ended and not sampler.pairs:
                raise RecordingError(
                    f"the sampler accepted none of the rows: {_reasons_text(sampler.rejected)}",
                    file=self._recording.file or "recording",
                    remedy="--any-step relaxes its step and speed rules",
                )
            if has_ended and learner.pairs + learner.refused >= sampler.pairs and learner.at_rest:
                return sampler, learner, changed - begin
            if now - changed > self._stall_limit_s:
                raise BusError(f"no progress for {self._stall_limit_s:.0f} s; --keep DIR keeps the logs that say why")
            time.sleep(_Settings.glance_s)

    def predictions(self, q: FloatArray, batch: int = 2000) -> PredictReply:
        """Return the learner's predictions for q (n, d), queried in batches."""
        replies = [
            decode(
                self._learner_bus.ask_one(
                    self._keys.predict, encode(JointsRequest(q[begin : begin + batch].tolist())), timeout_s=30.0
                ),
                PredictReply,
            )
            for begin in range(0, len(q), batch)
        ]
        return PredictReply(
            x=[row for reply in replies for row in reply.x],
            sigma=[row for reply in replies for row in reply.sigma],
            in_support=[row for reply in replies for row in reply.in_support],
            model=replies[-1].model,
            pairs=replies[-1].pairs,
            age_s=replies[-1].age_s,
            R=None
            if any(reply.R is None for reply in replies)
            else [row for reply in replies for row in reply.R or []],
        )

    def _status(self) -> tuple[SamplerStatus, LearnerStatus]:
        self._sampler.check()
        self._learner.check()
        sampler = self._sampler_bus.ask_one(self._keys.status("sampler"), timeout_s=30.0)
        learner = self._learner_bus.ask_one(self._keys.status("learner"), timeout_s=30.0)
        return decode(sampler, SamplerStatus), decode(learner, LearnerStatus)


@contextmanager
def _running(job: Job) -> Iterator[_Live]:
    """Run both processes; the learner starts before the first pair, as in a live system."""
    fed = job.folder / "learnt_rows.csv"
    job.learnt_rows.write_csv(fed)
    sampler_endpoint, learner_endpoint, keys = free_endpoint(), free_endpoint(), Keys(job.config.robot.name)
    environment = {
        **override("zenoh", "sampler", sampler_endpoint),
        **override("zenoh", "learner", learner_endpoint),
        **override("zenoh", "router", ""),  # the live robot's router must not be used
        **override("drivers", "recording", str(fed.resolve())),
        **{name: text for key, value in job.drivers.items() for name, text in override("drivers", key, value).items()},
        **override("daemon", "any_step", job.any_step),
    }
    arguments = ["--robot", os.fspath(job.config.file), "--state-dir", os.fspath(job.folder)]
    with (
        started("learner", ["learner", *arguments], environment, job.folder / "learner.log") as learner,
        _connected(learner, learner_endpoint, keys.alive(learner.name)) as learner_bus,
        started("sampler", ["sampler", *arguments], environment, job.folder / "sampler.log") as sampler,
        _connected(sampler, sampler_endpoint, keys.alive(sampler.name)) as sampler_bus,
    ):
        yield _Live(job, (sampler, sampler_bus), (learner, learner_bus))


@contextmanager
def _connected(process: Process, endpoint: str, token: str) -> Iterator[ZenohSession]:
    process.wait_for(endpoint, token)
    with client(endpoint) as bus:
        yield bus


def _reasons_text(rejected: dict[str, int]) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in sorted(rejected.items())) or "there were none"
