"""Messages over zenoh: JSON, or MessagePack if the request asks for it. Every message has a schema number.

Requests are checked for unknown keys. Replies and publications may gain keys, so readers ignore unknown ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, cast

import msgspec
from msgspec import Meta

from bodyschema.daemon.transport.keys import CommandName
from bodyschema.interfaces.errors import RequestError
from bodyschema.robot.hand_eye import MarkerPose
from bodyschema.robot.suggest import with_choices

# numpy is imported where it is used: clients that send and read messages do without.
if TYPE_CHECKING:
    from bodyschema.interfaces.records import FloatArray, Pair

JSON = "application/json"
MSGPACK = "application/msgpack"
OCTETS = "application/octet-stream"
SCHEMA = 1
LARGEST_BATCH = 10_000

M = TypeVar("M")

_json_encoder = msgspec.json.Encoder()
_msgpack_encoder = msgspec.msgpack.Encoder()


class PairMessage(msgspec.Struct, frozen=True):
    """One sample, published once, after it was stored."""

    store: str  # UUID of the store that numbered it
    seq: Annotated[int, Meta(ge=1)]  # its number in that store, from 1, without gaps
    segment: int  # shared by a run of samples, each one step from its predecessor
    t: float  # frame time on the sampler's monotonic clock [s]; may restart with the sampler
    utc: str  # wall-clock time of acceptance, ISO 8601
    q: list[float]  # joint angles at `t` [rad], d numbers
    x: tuple[float, float, float]  # marker position [m]
    cov: tuple[float, float, float, float, float, float]  # its covariance [m²]
    R: tuple[float, float, float, float] | None = None  # marker orientation, a unit quaternion; null for a ball
    # covariance of a small rotation about the axes [rad²]; null if unknown
    cov_R: tuple[float, float, float, float, float, float] | None = None
    # `x` and `R` with their covariances once more, in the form of all messages; null from a sampler of an earlier
    # version
    pose: MarkerPose | None = None
    schema: int = SCHEMA


class PairsReply(msgspec.Struct, frozen=True):
    """Stored samples in order, at most 1000; `from` and `to` are inclusive and optional.

    A reply that begins after `from` means that older samples were deleted (`[daemon] keep_days`, `keep_mb`).
    """

    store: str  # UUID of the store
    last_seq: int  # newest sample in the store, 0 if empty
    pairs: list[PairMessage]  # continue from where they end
    schema: int = SCHEMA


class JointsRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Joint angles, of one configuration or of several."""

    q: list[float | list[float]]  # joint angles [rad]: d numbers, or up to 10,000 such lists


class PredictReply(msgspec.Struct, frozen=True):
    """One row for each of the n rows of the request, also for a single vector.

    Sigmas are errors against the truth, without the measurement's noise.
    """

    x: list[list[float]]  # marker positions [m], n × 3
    sigma: list[list[float]]  # 1-sigma per axis [m], n × 3
    in_support: list[bool]  # false where extrapolated, away from all data
    model: str  # hash of the answering model
    pairs: int  # samples that it has learnt
    # age of the newest learnt sample: from it to the newest sample known to be stored, plus the time since the learner
    # heard of that one [s]; null before any sample
    age_s: float | None
    R: list[list[float]] | None = None  # marker orientations, n × 4; null where no sample with the present tool had one
    sigma_R: list[list[float]] | None = None  # 1-sigma of a small rotation about each axis [rad], n × 3; null with `R`
    # the rows once more, in the form of all messages, with the covariances of `sigma` and `sigma_R`; null from a
    # learner of an earlier version
    poses: list[MarkerPose] | None = None
    schema: int = SCHEMA


class JacobianReply(msgspec.Struct, frozen=True):
    """Jacobians dx/dq of the marker position."""

    J: list[list[list[float]]]  # a 3 × d matrix for each row of the request [m/rad]
    model: str  # hash of the answering model
    pairs: int  # samples that it has learnt
    schema: int = SCHEMA


class IkRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The requested marker position."""

    x: tuple[float, float, float]  # wanted marker position [m]
    # present joint angles [rad]; tried first, so that the answer is close to them if possible
    start: list[float] | None = None
    # preferred angles as far as `x` leaves a choice [rad], or "middle" of the limits
    posture: Literal["middle"] | list[float] | None = None


class IkReply(msgspec.Struct, frozen=True):
    """Joint angles within the URDF's limits, of a deterministic, bounded search.

    If the position is unreachable, `q` is the nearest configuration found. Collisions are not checked, and nothing
    moves.
    """

    q: list[float]  # joint angles [rad], d numbers
    x: list[float]  # predicted marker position there [m]
    distance: float  # from it to the requested one [m]
    converged: bool  # `distance` is at most 1e-7 m
    reason: str  # `reached`, `out_of_reach` (a local minimum from every start) or `steps_ran_out`
    sigma: list[float]  # 1-sigma of `x` per axis against the truth [m]
    in_support: bool  # `q` lies where data was
    model: str  # hash of the answering model
    pairs: int  # samples that it has learnt
    # the predicted pose at `q`, as `predict` has it; null from a learner of an earlier version
    pose: MarkerPose | None = None
    schema: int = SCHEMA


class CommandRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A command to one of the processes."""

    command: CommandName  # its name


class CommandReply(msgspec.Struct, frozen=True):
    """Confirmation of a command."""

    command: str  # the command, which was carried out
    message: str  # its effect, for people
    schema: int = SCHEMA


class ErrorReply(msgspec.Struct, frozen=True):
    """Zenoh's error reply to a query that could not be carried out. Nothing was changed."""

    error: str  # the error and its remedy, for people
    schema: int = SCHEMA


def encode(message: object, encoding: str = JSON) -> bytes:
    """Return a message's bytes in `encoding`."""
    return _msgpack_encoder.encode(message) if encoding == MSGPACK else _json_encoder.encode(message)


def decode(payload: bytes, kind: type[M], encoding: str = JSON) -> M:
    """Return the message in `payload`.

    Raises:
        RequestError: it is not of this type; the message names the place.
    """
    try:
        decoder: Any = msgspec.msgpack if encoding == MSGPACK else msgspec.json
        return decoder.decode(payload, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise RequestError(f"not a {kind.__name__}: {with_choices(str(error), kind)}") from error


def pair_to_wire(pair: Pair) -> PairMessage:
    return pairs_to_wire([pair])[0]


def pairs_to_wire(pairs: Sequence[Pair]) -> list[PairMessage]:
    """Return pairs as their messages; their poses are computed at once."""
    return [
        _as_message(pair, pose)
        for _, alike in groupby(pairs, lambda pair: (pair.R is None, pair.cov_R is None))
        for pair, pose in _with_poses(list(alike))
    ]


def _with_poses(pairs: Sequence[Pair]) -> Iterable[tuple[Pair, MarkerPose]]:
    """Return pairs with their poses; all or none have an orientation and its covariance."""
    import numpy as np

    R = [pair.R for pair in pairs if pair.R is not None]
    cov_R = [pair.cov_R for pair in pairs if pair.cov_R is not None]
    x, cov = np.array([pair.x for pair in pairs]), np.array([pair.cov for pair in pairs])
    poses = MarkerPose.rows(x, cov, np.array(R) if R else None, np.array(cov_R) if cov_R else None)
    return zip(pairs, poses, strict=True)


def _as_message(pair: Pair, pose: MarkerPose) -> PairMessage:
    from bodyschema.interfaces.covariance import upper_triangle

    x, y, z = pair.x.tolist()
    return PairMessage(
        store=pair.store,
        seq=pair.seq,
        segment=pair.segment,
        t=pair.t,
        utc=pair.utc,
        q=pair.q.tolist(),
        x=(x, y, z),
        cov=upper_triangle(pair.cov),
        R=None if pair.R is None else _quaternion(pair.R),
        cov_R=None if pair.cov_R is None else upper_triangle(pair.cov_R),
        pose=pose,
    )


def pair_from_wire(message: PairMessage, joints: int) -> Pair:
    """Return a message as a pair.

    Raises:
        RequestError: it has another number of joints, a non-finite number, or an invalid quaternion.
    """
    import numpy as np

    from bodyschema.interfaces.covariance import from_upper
    from bodyschema.interfaces.records import Pair, frozen_array
    from bodyschema.recordings.columns import ColumnLimits

    q = np.array(message.q)
    numbers = np.concatenate([q, message.x, message.cov, [message.t], message.R or (), message.cov_R or ()])
    if len(q) != joints:
        raise RequestError(f"sample {message.seq} has {len(q)} joint angles, this robot has {joints}")
    if not np.isfinite(numbers).all():
        raise RequestError(f"sample {message.seq} has a number that is not finite")
    if message.R is not None and abs(math.hypot(*message.R) - 1.0) > ColumnLimits.quaternion_tolerance:
        raise RequestError(f"sample {message.seq} has an R of the length {math.hypot(*message.R):.6g}, not 1")
    return Pair(
        store=message.store,
        seq=message.seq,
        segment=message.segment,
        t=message.t,
        utc=message.utc,
        q=frozen_array(q),
        x=frozen_array(message.x),
        cov=frozen_array(from_upper(message.cov)),
        R=None if message.R is None else frozen_array(message.R),
        cov_R=None if message.cov_R is None else frozen_array(from_upper(message.cov_R)),
    )


def _quaternion(turn: FloatArray) -> tuple[float, float, float, float]:
    x, y, z, w = turn.tolist()
    return x, y, z, w


def position(name: str, values: Sequence[float]) -> FloatArray:
    """Return a requested position, shape (3,) [m].

    Raises:
        RequestError: a number is not finite, or too large to be in metres.
    """
    import numpy as np

    from bodyschema.interfaces.records import PairLimits

    x = np.array(values, dtype=np.float64)
    if not np.isfinite(x).all():
        raise RequestError(f"{name} is not finite")
    farthest = float(np.abs(x).max())
    if farthest > PairLimits.farthest_m:
        most = f"at most {PairLimits.farthest_m:.0f} on each axis"
        raise RequestError(f"{name} lies {farthest:.3g} m away; positions are in metres, {most}")
    return x


def joint_vector(name: str, values: Sequence[float], joints: tuple[str, ...]) -> FloatArray:
    """Return one number for each joint, shape (d,) [rad].

    Raises:
        RequestError: the count is wrong, or a value is impossible for its joint.
    """
    import numpy as np

    if len(values) != len(joints):
        raise RequestError(
            f"{name} has {len(values)} numbers; this robot has {len(joints)} joints: {', '.join(joints)}"
        )
    vector = np.array(values, dtype=np.float64)
    _require_angles(vector[None], joints, lambda _: name)
    return vector


def joint_angles(request: JointsRequest, joints: tuple[str, ...]) -> FloatArray:
    """Return the request's joint angles, shape (n, d) [rad].

    Raises:
        RequestError: as in `joint_rows`, or if a value is impossible for a joint.
    """
    import numpy as np

    q = np.array(joint_rows(request, joints), dtype=np.float64)
    _require_angles(q, joints, lambda row: _row_named(request, row))
    return q


def joint_rows(request: JointsRequest, joints: tuple[str, ...]) -> list[list[float]]:
    """Return the rows of the request.

    Raises:
        RequestError: a row has the wrong length, or the batch is empty or too large.
    """
    if not request.q:
        raise RequestError("q is empty; send one vector of joint angles or a list of them")
    rows = [request.q] if _is_one_vector(request) else request.q
    if len(rows) > LARGEST_BATCH:
        raise RequestError(f"q has {len(rows)} rows; send at most {LARGEST_BATCH} at once")
    checked: list[list[float]] = []
    for number, row in enumerate(rows):
        if not isinstance(row, list) or len(row) != len(joints):
            length = len(row) if isinstance(row, list) else 1
            raise RequestError(
                f"{_row_named(request, number)} has {length} numbers; this robot has {len(joints)} joints: "
                f"{', '.join(joints)}"
            )
        checked.append(cast("list[float]", row))
    return checked


def _is_one_vector(request: JointsRequest) -> bool:
    return not any(isinstance(entry, list) for entry in request.q)


def _row_named(request: JointsRequest, row: int) -> str:
    return "q" if _is_one_vector(request) else f"row {row} of q"


def _require_angles(q: FloatArray, joints: tuple[str, ...], named: Callable[[int], str]) -> None:
    import numpy as np

    from bodyschema.interfaces.records import PairLimits

    wrong = np.argwhere(~(np.abs(q) <= PairLimits.largest_q))
    if len(wrong) == 0:
        return
    row, column = wrong[0].tolist()
    value = float(q[row, column])
    if math.isfinite(value):
        raise RequestError(f"{named(row)} is {value:.3g} at joint {joints[column]!r}; angles are in radians")
    raise RequestError(f"{named(row)} is not finite at joint {joints[column]!r}")
