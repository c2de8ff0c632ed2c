"""Poses to measure next, chosen to reduce the uncertainty of a calibration."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.errors import RecordingError
from bodyschema.interfaces.records import FloatArray
from bodyschema.interfaces.whole_files import raising_write_errors, require_target, write_atomically
from bodyschema.robot.description import link_poses
from kbmaps import ChainPosterior, ExperimentDesign, next_poses

from .rigid_chain import Calibration

JSON, CSV = ".json", ".csv"


class _Settings:
    # Shares of a joint's range at each end, and of the image at each edge, that poses keep away from.
    joint_margin, image_margin = 0.03, 0.05
    # More candidates gain less than 2 %.
    candidates, region = 600, 200
    batch, batches = 2000, 50


@dataclass(frozen=True, eq=False)
class NextPoses:
    """Poses to measure next, the most informative first."""

    robot: str
    joints: tuple[str, ...]  # names in the order of q
    prismatic: NDArray[np.bool_]  # True for each prismatic joint (d,)
    q: FloatArray  # joint readings (n, d) [rad or m]
    expected_m: float  # mean error of the present calibration over all allowed poses [m]
    expected_after_m: float  # the same after measuring these poses

    @classmethod
    def of(cls, calibration: Calibration, count: int, seed: int = 0) -> NextPoses:
        """Choose `count` poses.

        They are within the joint limits, the marker is in the image (if [camera] describes one), and no link is lower
        than in the recording, so that an arm on a table stays above it.

        Raises:
            RecordingError: hardly any pose is allowed.
        """
        rng = np.random.default_rng(seed)
        allowed = np.empty((0, len(calibration.robot.joints)))
        for _ in range(_Settings.batches):
            allowed = np.concatenate([allowed, allowed_poses(calibration, rng)])
            if len(allowed) >= _Settings.candidates + _Settings.region:
                break
        if len(allowed) < 2 * count:
            raise RecordingError(
                f"only {len(allowed)} poses are within the limits, in view of the camera, and no lower than the "
                "recording",
                file=calibration.recording.file,
                remedy="Record poses that are farther apart, or ask for fewer",
            )
        half = min(_Settings.region, len(allowed) // 2)
        region, candidates = np.split(allowed[: _Settings.candidates + _Settings.region], [half])
        posterior = ChainPosterior.of(calibration.learner)
        design = ExperimentDesign(posterior, region)
        chosen = next_poses(posterior, region, candidates, count)
        return cls(
            robot=calibration.robot.name,
            joints=calibration.robot.joints,
            prismatic=calibration.robot.chain.prismatic,
            q=chosen,
            expected_m=design.error,
            expected_after_m=design.error_after(posterior.roots(chosen)),
        )

    def write(self, file: Path, *, replace: bool) -> None:
        """Write the poses as JSON or CSV, by the ending of `file`.

        Raises:
            RecordingError: the file exists already, or cannot be written.
        """
        check_target(file, replace=replace)
        with raising_write_errors(file, RecordingError):
            write_atomically({file: self._json() if file.suffix.lower() == JSON else self._csv()})

    def _json(self) -> bytes:
        value = {
            "schema": 1,
            "robot": self.robot,
            "joints": self.joints,
            "units": ["m" if slides else "rad" for slides in self.prismatic],
            "poses": self.q.tolist(),
            "expected_m": self.expected_m,
            "expected_after_m": self.expected_after_m,
        }
        return msgspec.json.format(msgspec.json.encode(value), indent=2) + b"\n"

    def _csv(self) -> bytes:
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([self.joints, *self.q.tolist()])
        return text.getvalue().encode()


def check_target(file: Path, *, replace: bool) -> None:
    """Raise RecordingError unless poses can be written to `file`: known ending, no file in the way."""
    require_target(file, (JSON, CSV), "files of poses", force=replace, error=RecordingError)


def allowed_poses(calibration: Calibration, rng: np.random.Generator) -> FloatArray:
    """Sample joint readings (n, d), and return those allowed for a next pose."""
    robot, recording = calibration.robot, calibration.recording
    margin = _Settings.joint_margin * (robot.upper - robot.lower)
    q = rng.uniform(robot.lower + margin, robot.upper - margin, (_Settings.batch, len(robot.joints)))
    kept = _lowest(calibration, q) >= _lowest(calibration, recording.q).min()
    if robot.calibration is not None:
        size = np.array(robot.calibration.image_size_px * (2 if robot.calibration.is_stereo else 1))
        x = calibration.learner.predict(q)
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = robot.calibration.project(x)[:, : len(size)]
        inside = (pixels > _Settings.image_margin * size) & (pixels < (1.0 - _Settings.image_margin) * size)
        kept &= (x[:, 2] > 0.0) & inside.all(axis=1)
    return q[kept]


def _lowest(calibration: Calibration, q: FloatArray) -> FloatArray:
    """Return the height [m] of the lowest link's origin at each of q (n, d), along z of the root link."""
    return np.min([poses[:, 2, 3] for poses in link_poses(calibration.robot, q).values()], axis=0)
