"""Status messages of the two processes, under `status/sampler` and `status/learner`."""

from __future__ import annotations

import math

import msgspec

from bodyschema.interfaces.servos import BusStatus, ServoStatus
from bodyschema.learning.status import ChainCalibration, CurvePoint, DataOutlook, OrientationStatus

from .wire import SCHEMA


class JointRange(msgspec.Struct, frozen=True):
    """The part of one joint's range that accepted samples have covered [rad; m for a prismatic joint]."""

    low: float  # smallest angle of all accepted samples
    high: float  # largest
    # lower_limit, upper_limit: from the URDF
    lower_limit: float
    upper_limit: float


class SamplerStatus(msgspec.Struct, frozen=True, kw_only=True):
    """State of the sampler."""

    robot: str  # its name
    store: str  # UUID of the store
    state: str  # `running`, `paused`, `ended` (end of a recording) or `failed`
    pairs: int  # number of the newest stored sample, which is the number of accepted samples
    segment: int  # present segment
    uptime_s: float  # since the start [s]
    frames: int  # stereo frames since the start
    frames_per_s: float  # over the last second
    readings_per_s: float  # encoder readings over the last second
    pairs_per_s: float  # over the last second
    rejected: dict[str, int]  # frames that did not become samples, by reason
    coverage: dict[str, JointRange]  # by joint; empty before the first sample
    disk_free_bytes: int  # on the store's disk
    health: list[str]  # problems; empty if none
    version: str  # of bodyschema
    servos: dict[str, ServoStatus] = {}  # by joint; empty without servos
    buses: dict[str, BusStatus] = {}  # by name; empty without servos
    unreadable: int = 0  # corrupted samples in the store, left out
    schema: int = SCHEMA


UNDECIDED = "undecided"  # a change whose cause is not known yet


class Change(msgspec.Struct, frozen=True, kw_only=True):
    """The last change of the tool, of the camera or of a joint's offset."""

    first_seq: int  # most probable first sample after it
    # earliest_seq, latest_seq: 95 % interval of that sample
    earliest_seq: int
    latest_seq: int
    noticed_seq: int  # sample at which it was detected, or the last one before it was reported
    found: bool  # detected (true) or reported by a command (false)
    kind: str  # `tool`, `camera`, `joint NAME` (its offset), `other` or `undecided`
    probabilities: dict[str, float]  # by kind, those above 1 %
    # kind that is equivalent to it: the last joint's offset to a tool, the first one's to a camera; null if none
    alike: str | None
    moved_m: float | None  # RMS displacement of the marker at the samples since [m]; null if unknown
    can_roll_back: bool  # the model before it is kept


# Mean length of a normal vector in three dimensions, in units of its 1-sigma a coordinate.
_MEAN_LENGTH = math.sqrt(8.0 / math.pi)


class LearnerStatus(msgspec.Struct, frozen=True, kw_only=True):
    """State of the learner."""

    robot: str  # its name
    store: str | None  # UUID of the samples' store; null before any
    state: str  # `waiting` (no sample yet), `aligning` (frame still unknown), `learning` or `paused`
    pairs: int  # samples learnt online, each once
    last_seq: int  # number of the newest of them
    pairs_since_change: int  # since the last change, or the start
    sampler_alive: bool  # a sampler is visible
    replayed: int  # replay steps since the start
    answering: str  # answering model: `prior`, `nlms`, `rigid`, `residual` or `exact`
    # error on new samples, by model: mean distance between the measurement, its noise included, and the prediction made
    # before the sample was learnt, over the last `prequential_pairs`, the same for all models [m]
    prequential_m: dict[str, float]
    # predicted mean distance to the truth as the cameras see it, without measurement noise, where data is [m]; null
    # until a few samples have been predicted
    claimed_error_m: float | None
    curve: list[CurvePoint]  # error on new samples of the answering model
    model: str  # its hash; empty before the first
    # camera, tool and joint offsets; null before the first solution with the present tool
    calibration: ChainCalibration | None
    outlook: DataOutlook | None  # expected gain of more data; null before such a solution
    gaps_recovered: int  # samples fetched from the sampler's history
    refused: int  # unusable samples
    doubted: int  # suspected outliers
    changes: int  # changes reported or detected
    last_change: Change | None  # the last one not rolled back; null if none
    at_rest: bool  # all samples are fitted, solved and replayed
    checkpoint_age_s: float | None  # [s]; null before the first, or after a failed one
    uptime_s: float  # since the start [s]
    health: list[str]  # problems; empty if none
    version: str  # of bodyschema
    orientation: OrientationStatus | None = None  # null without orientations with the present tool
    prequential_pairs: int = 0  # at most 50; fewer after a change or with a new model
    missed: int = 0  # samples no longer available from the sampler
    behind: int = 0  # samples stored but not yet learnt; a `health` problem from 100 on
    age_s: float | None = None  # as in PredictReply
    # predicted mean error there that all samples share, so that no sample shows it: of the cameras' calibration and
    # of a tag's size [m]; in the sigma of predictions; null where cameras.toml does not tell
    common_error_m: float | None = None
    schema: int = SCHEMA

    def expected_error_m(self, claimed_m: float | None) -> float | None:
        """Return the expected mean distance [m] between predictions and new measurements, noise included.

        This is the figure shown to users, who can compare it with `prequential_m`.

        Args:
            claimed_m: mean distance of predictions to the ground truth [m].

        Returns:
            None if the noise of the measurements is unknown.
        """
        noise_m = self.noise_m()
        return None if claimed_m is None or noise_m is None else math.hypot(claimed_m, _MEAN_LENGTH * noise_m)

    def noise_m(self) -> float | None:
        """Return the noise of the measurements, 1-sigma per coordinate [m]; None if unknown.

        The calibration's noise contains the errors that its chain cannot explain. Errors on new pairs contain the
        noise, so it is at most the error of the best model.
        """
        if self.calibration is None:
            return None
        return min([self.calibration.noise_m, *(error_m / _MEAN_LENGTH for error_m in self.prequential_m.values())])
