"""Status messages of the two processes, under `status/sampler` and `status/learner`."""

from __future__ import annotations

import math

import msgspec

from bodyschema.interfaces.servos import BusStatus, ServoStatus
from bodyschema.learning.status import ChainCalibration, CurvePoint, OrientationStatus, Outlook

from .wire import SCHEMA


class JointRange(msgspec.Struct, frozen=True):
    """The part of one joint's range that accepted pairs have covered [rad, of a prismatic joint m].

    Attributes:
        low: smallest angle of all accepted pairs.
        high: largest.
        lower_limit, upper_limit: from the URDF.
    """

    low: float
    high: float
    lower_limit: float
    upper_limit: float


class SamplerStatus(msgspec.Struct, frozen=True, kw_only=True):
    """State of the sampler.

    Attributes:
        robot: its name.
        store: UUID of the store.
        state: `running`, `paused`, `ended` (end of a recording) or `failed`.
        pairs: number of the newest stored pair, which is the number of accepted pairs.
        segment: present segment.
        uptime_s: since the start [s].
        frames: stereo frames since the start.
        frames_per_s: over the last second.
        readings_per_s: encoder readings over the last second.
        pairs_per_s: over the last second.
        rejected: frames that did not become pairs, by reason.
        coverage: by joint; empty before the first pair.
        disk_free_bytes: on the store's disk.
        health: problems; empty if none.
        version: of bodyschema.
        servos: by joint; empty without servos.
        buses: by name; empty without servos.
        unreadable: corrupted pairs in the store, left out.
    """

    robot: str
    store: str
    state: str
    pairs: int
    segment: int
    uptime_s: float
    frames: int
    frames_per_s: float
    readings_per_s: float
    pairs_per_s: float
    rejected: dict[str, int]
    coverage: dict[str, JointRange]
    disk_free_bytes: int
    health: list[str]
    version: str
    servos: dict[str, ServoStatus] = {}
    buses: dict[str, BusStatus] = {}
    unreadable: int = 0
    schema: int = SCHEMA


UNDECIDED = "undecided"  # a change whose cause is not known yet


class Change(msgspec.Struct, frozen=True, kw_only=True):
    """The last change of the tool, of the camera or of a joint's offset.

    Attributes:
        first_seq: most probable first pair after it.
        earliest_seq, latest_seq: 95 % interval of that pair.
        noticed_seq: pair at which it was detected, or the last one before it was reported.
        found: detected (true) or reported by a command (false).
        kind: `tool`, `camera`, `joint NAME` (its offset), `other` or `undecided`.
        probabilities: by kind, those above 1 %.
        alike: kind that is equivalent to it: the last joint's offset to a tool, the first one's to a camera; null if
            none.
        moved_m: RMS displacement of the marker at the pairs since [m]; null if unknown.
        can_roll_back: the model before it is kept.
    """

    first_seq: int
    earliest_seq: int
    latest_seq: int
    noticed_seq: int
    found: bool
    kind: str
    probabilities: dict[str, float]
    alike: str | None
    moved_m: float | None
    can_roll_back: bool


# Mean length of a normal vector in three dimensions, in units of its 1-sigma a coordinate.
_MEAN_LENGTH = math.sqrt(8.0 / math.pi)


class LearnerStatus(msgspec.Struct, frozen=True, kw_only=True):
    """State of the learner.

    Attributes:
        robot: its name.
        store: UUID of the pairs' store; null before any.
        state: `waiting` (no pair yet), `aligning` (frame still unknown), `learning` or `paused`.
        pairs: pairs learnt online, each once.
        last_seq: number of the newest of them.
        pairs_since_change: since the last change, or the start.
        sampler_alive: a sampler is visible.
        replayed: replay steps since the start.
        answering: answering model: `prior`, `nlms`, `rigid`, `residual` or `exact`.
        prequential_m: error on new pairs, by model: mean distance between the measurement, its noise included, and the
            prediction made before the pair was learnt, over the last `prequential_pairs`, the same for all models [m].
        claimed_error_m: predicted mean distance to the truth as the cameras see it, without measurement noise, where
            data is [m]; null until a few pairs have been predicted.
        curve: error on new pairs of the answering model.
        model: its hash; empty before the first.
        calibration: camera, tool and joint offsets; null before the first solution with the present tool.
        outlook: expected gain of more data; null before such a solution.
        gaps_recovered: pairs fetched from the sampler's history.
        refused: unusable pairs.
        doubted: suspected outliers.
        changes: changes reported or detected.
        last_change: the last one not rolled back; null if none.
        at_rest: all pairs are fitted, solved and replayed.
        checkpoint_age_s: [s]; null before the first, or after a failed one.
        uptime_s: since the start [s].
        health: problems; empty if none.
        version: of bodyschema.
        orientation: null without orientations with the present tool.
        prequential_pairs: at most 50; fewer after a change or with a new model.
        missed: pairs no longer available from the sampler.
        behind: pairs stored but not yet learnt; a `health` problem from 100 on.
        age_s: as in PredictReply.
        common_error_m: predicted mean error there that all pairs share, so that no pair shows it: of the cameras'
            calibration and of a tag's size [m]; in the sigma of predictions; null where cameras.toml does not tell.
    """

    robot: str
    store: str | None
    state: str
    pairs: int
    last_seq: int
    pairs_since_change: int
    sampler_alive: bool
    replayed: int
    answering: str
    prequential_m: dict[str, float]
    claimed_error_m: float | None
    curve: list[CurvePoint]
    model: str
    calibration: ChainCalibration | None
    outlook: Outlook | None
    gaps_recovered: int
    refused: int
    doubted: int
    changes: int
    last_change: Change | None
    at_rest: bool
    checkpoint_age_s: float | None
    uptime_s: float
    health: list[str]
    version: str
    orientation: OrientationStatus | None = None
    prequential_pairs: int = 0
    missed: int = 0
    behind: int = 0
    age_s: float | None = None
    common_error_m: float | None = None
    schema: int = SCHEMA

    def expected_error_m(self, claimed_m: float | None) -> float | None:
        """Return the mean distance [m] to expect between predictions and new measurements, their noise included.

        People are shown this one: they can check it against `prequential_m`.

        Args:
            claimed_m: mean distance of predictions to the ground truth [m].

        Returns:
            None while the noise of the measurements is not known.
        """
        noise_m = self.noise_m()
        return None if claimed_m is None or noise_m is None else math.hypot(claimed_m, _MEAN_LENGTH * noise_m)

    def noise_m(self) -> float | None:
        """Return the noise of the measurements, 1-sigma per coordinate [m]; None while it is not known.

        The calibration's contains what its chain cannot explain. Errors on new pairs contain the noise, so it is at
        most what the best model has.
        """
        if self.calibration is None:
            return None
        return min([self.calibration.noise_m, *(error_m / _MEAN_LENGTH for error_m in self.prequential_m.values())])
