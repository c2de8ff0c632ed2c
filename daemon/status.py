"""What the two processes say of themselves, under `status/sampler` and `status/learner`."""

from __future__ import annotations

import msgspec

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
        firmware: its version, as it tells it.
        homing_offset: [ticks]; drive_mode: bits; both as its EEPROM has them, 0 where there are none.
        voltage_v, temperature_c: as it told last; null before it did.
        current_a: null where it is not measured.
        troubles: what is wrong with it, and what to do; empty when it is well.
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
        exchanges: questions that were asked.
        answered: the share of them that was answered as it should be.
        troubles: the others, by what was wrong.
        way: with which questions its servos are read, such as Sync Read.
    """

    exchanges: int
    answered: float
    troubles: dict[str, int]
    way: str = ""


class SamplerStatus(msgspec.Struct, frozen=True, kw_only=True):
    """State of the sampler.

    Attributes:
        store: identity of the store.
        state: running, paused, ended (the source is through) or failed.
        pairs: sequence number of the newest pair in the store: so many were accepted.
        segment: number of the current segment.
        frames: frames taken since the start.
        rejected: frames that did not become pairs, by reason.
        coverage: by joint.
        health: sentences about what is wrong; empty when all is well.
        servos: by joint; empty where the joints are no servos.
        buses: by name; the same.
        unreadable: pairs in the store that the disk changed, which are left out.
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


class CurvePoint(msgspec.Struct, frozen=True, array_like=True):
    """One point of the learning curve: prequential error, before the pair was learnt."""

    pairs: int
    error_m: float


class LearntFigure(msgspec.Struct, frozen=True):
    """One number of the robot's files: as drawn and as learnt, with half the width of its 95 % interval."""

    drawn: float
    learnt: float
    half_width: float


class JointZero(msgspec.Struct, frozen=True):
    """What has to be added to a joint's reading, with half the width of its 95 % interval [rad or m]."""

    value: float
    half_width: float


class ChainCalibration(msgspec.Struct, frozen=True, kw_only=True):
    """Where camera and tool are and the joints' zeros, as the learnt rigid chain has them.

    Attributes:
        pairs: pairs with the present tool that it was found from.
        camera_link, camera_xyz, camera_rpy: pose of the measurement frame in this link (URDF convention) [m, rad].
        marker_link, marker_xyz: the marker in this link [m].
        zeros: by joint; null where no motion shows it and it is left as drawn. The other figures are given that.
        axes_rad, points_m: how well the arm seems to be made: 1-sigma of an axis' tilt and of its shift; null
            where the pairs do not tell.
        noise_m: 1-sigma of a measured coordinate.
        outliers: of the last 500 pairs, those too far from the chain for this noise.
    """

    pairs: int
    camera_link: str
    camera_xyz: list[LearntFigure]
    camera_rpy: list[LearntFigure]
    marker_link: str
    marker_xyz: list[LearntFigure]
    zeros: dict[str, JointZero | None]
    axes_rad: float | None
    points_m: float | None
    noise_m: float
    outliers: int


class Outlook(msgspec.Struct, frozen=True, kw_only=True):
    """What further pairs would still gain.

    Attributes:
        pairs: pairs with the present tool that it was foreseen from.
        error_m: expected mean distance to the truth where the arm has been [m].
        least_error_m: the part of it that no further pair mends [m].
        anywhere_m: expected mean distance to the truth over the whole ranges of all joints [m].
        further_pairs: numbers of further pairs, ascending.
        like_so_far_m: what `error_m` would be after so many, moving as so far [m].
        best_motion: the motion that would gain most, in words.
        best_motion_m: what `error_m` would be after so many of it [m].
        enough: whether no motion, with as many pairs as the last of `further_pairs`, would lower `error_m` by a tenth,
            or by a tenth of the noise of a measurement.
    """

    pairs: int
    error_m: float
    least_error_m: float
    anywhere_m: float
    further_pairs: list[int]
    like_so_far_m: list[float]
    best_motion: str
    best_motion_m: list[float]
    enough: bool


class OrientationStatus(msgspec.Struct, frozen=True):
    """How well it is known how the marker is turned.

    Attributes:
        pairs: pairs with the present tool that said it.
        answering: which model answers.
        prequential_rad: recent mean angle between prediction and measurement, before learning [rad], by model.
        claimed_rad: the angle to the truth [rad] that the learner claims where data is; null before a few pairs.
    """

    pairs: int
    answering: str
    prequential_rad: dict[str, float]
    claimed_rad: float | None


UNDECIDED = "undecided"  # a change whose kind is not known yet


class Change(msgspec.Struct, frozen=True, kw_only=True):
    """The last change of the tool, of the camera or of a joint's zero.

    Attributes:
        first_seq: sequence number of the most probable first pair after it.
        earliest_seq, latest_seq: between which that pair is, with 95 % probability.
        noticed_seq: the pair with which it was noticed; of a change that was told, the last one before it.
        found: in the pairs; else it was told.
        kind: `tool`, `camera`, `joint NAME` (its zero), `other` or `undecided`.
        probabilities: by kind, those above 1 %.
        alike: the kind that no motion tells from this one; null where there is none.
        moved_m: by how much it moved the marker at the pairs since, root mean square [m]; null where nobody knows.
        can_roll_back: whether the model before it is kept.
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


class LearnerStatus(msgspec.Struct, frozen=True, kw_only=True):
    """State of the learner.

    Attributes:
        store: identity of the store the pairs came from, or null before any.
        state: waiting (no pair yet), aligning (the frame is not known yet), learning or paused.
        pairs: pairs learnt online, each once.
        last_seq: sequence number of the newest of them.
        replayed: replay steps since the start.
        pairs_since_change: pairs since the last change, or since the beginning.
        answering: which model answers queries.
        prequential_m: error on new pairs, by model: mean distance between the measurement, its noise included, and the
            prediction made before the pair was learnt [m]; over the same pairs for all models.
        claimed_error_m: the mean distance to the truth [m], without the measurement's noise, that the learner claims
            for its predictions where data is.
        curve: the error on new pairs of the model that answered, over the pairs.
        model: hash of the model that answers.
        calibration: camera, tool and joint zeros; null before the first solution with the present tool.
        outlook: whether there is enough data; null while no solution with the present tool answers.
        gaps_recovered: pairs that had to be fetched from the sampler's history.
        refused: pairs that could not be taken.
        doubted: pairs that looked like gross outliers and were learnt with care.
        changes: changes that were told, or found in the pairs.
        last_change: the last of them; null where there was none, or it was rolled back.
        at_rest: whether nothing is left to do with the pairs that came: to fit, to solve, to replay or to find out.
        checkpoint_age_s: time since the last checkpoint, or null before any.
        health: sentences about what is wrong; empty when all is well.
        orientation: null where no pair with the present tool said how the marker is turned.
        prequential_pairs: on how many of the last pairs `prequential_m` was seen.
        missed: pairs that the sampler no longer kept when this learner asked for them.
        behind: pairs that are known to be stored and are not learnt yet.
        age_s: how old the newest learnt pair is, counted from the newest stored one; null before any since the start.
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
