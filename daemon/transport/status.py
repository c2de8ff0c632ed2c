"""Status messages of the two processes, under `status/sampler` and `status/learner`."""

from __future__ import annotations

import math

import msgspec

from bodyschema.learning.status import ChainCalibration, CurvePoint, OrientationStatus, Outlook

from .wire import SCHEMA


class JointRange(msgspec.Struct, frozen=True):
    """The part of one joint's range that accepted pairs have covered [rad or m]."""

    low: float
    high: float
    lower_limit: float
    upper_limit: float


class ServoStatus(msgspec.Struct, frozen=True):
    """One joint's servo.

    Attributes:
        firmware: version that it reports.
        homing_offset: [ticks]; drive_mode: bits; both as stored in its EEPROM, 0 where it has none.
        voltage_v, temperature_c: last reported values; null before the first.
        current_a: null where it is not measured.
        troubles: problems, with remedies; empty when it is well.
    """

    bus: str
    id: int
    model: str
    firmware: int
    homing_offset: int
    drive_mode: int
    voltage_v: float | None
    temperature_c: float | None
    current_a: float | None
    troubles: list[str]


class BusStatus(msgspec.Struct, frozen=True):
    """One bus of servos since the start.

    Attributes:
        exchanges: number of requests sent.
        answered: share of them with a valid answer.
        troubles: the failed ones, by kind of failure.
        way: type of request used for reading its servos, such as Sync Read.
    """

    exchanges: int
    answered: float
    troubles: dict[str, int]
    way: str = ""


class SamplerStatus(msgspec.Struct, frozen=True, kw_only=True):
    """State of the sampler.

    Attributes:
        store: identity of the store.
        state: running, paused, ended (the source is at its end) or failed.
        pairs: sequence number of the newest pair in the store, which is the number of accepted pairs.
        segment: number of the current segment.
        frames: frames taken since the start.
        rejected: frames that did not become pairs, by reason.
        coverage: by joint.
        health: sentences about problems; empty when all is well.
        servos: by joint; empty if the joints are no servos.
        buses: by name; likewise.
        unreadable: pairs in the store that the disk corrupted; they are left out.
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
        first_seq: sequence number of the most probable first pair after it.
        earliest_seq, latest_seq: 95 % interval of that pair.
        noticed_seq: the pair with which it was detected; for a change that was reported by a command, the last pair
            before it.
        found: True if it was detected in the pairs; False if it was reported by a command.
        kind: `tool`, `camera`, `joint NAME` (its offset), `other` or `undecided`.
        probabilities: by kind, those above 1 %.
        alike: the kind that no motion can distinguish from this one; null if there is none.
        moved_m: RMS displacement of the marker at the pairs since [m]; null where unknown.
        can_roll_back: True if the previous model is kept.
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
        store: identity of the store the pairs came from, or null before any.
        state: waiting (no pair yet), aligning (the measurement frame is not known yet), learning or paused.
        pairs: number of pairs learnt online, each once.
        last_seq: sequence number of the newest of them.
        replayed: replay steps since the start.
        pairs_since_change: pairs since the last change, or since the start.
        answering: the model that answers queries.
        prequential_m: error on new pairs, by model: mean distance [m] between the measurement, its noise included, and
            the prediction made before the pair was learnt; over the same pairs for all models.
        claimed_error_m: predicted mean distance to the ground truth [m], without measurement noise, within the support
            of the data.
        curve: error on new pairs of the answering model, over the number of pairs.
        model: hash of the answering model.
        calibration: camera and tool pose and joint offsets; null before the first solution with the present tool.
        outlook: expected gain of further pairs; null until a solution with the present tool answers.
        gaps_recovered: pairs that had to be fetched from the sampler's history.
        refused: pairs that were not accepted.
        doubted: pairs treated as likely outliers.
        changes: changes reported by a command, or detected in the pairs.
        last_change: the last change; null if there was none, or it was rolled back.
        at_rest: True if all work on the received pairs is done: fitting, solving, replay and findings.
        checkpoint_age_s: time since the last checkpoint, or null before any.
        health: sentences about problems; empty when all is well.
        orientation: null if no pair with the present tool has an orientation.
        prequential_pairs: number of recent pairs that `prequential_m` averages over.
        missed: pairs that the sampler had already deleted when this learner requested them.
        behind: pairs known to be stored and not learnt yet.
        age_s: age of the newest learnt pair, relative to the newest stored one; null before any since the start.
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
