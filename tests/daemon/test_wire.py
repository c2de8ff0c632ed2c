from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bodyschema.daemon.transport.wire import (
    JSON,
    LARGEST_BATCH,
    MSGPACK,
    CommandRequest,
    JointsRequest,
    PairMessage,
    decode,
    encode,
    joint_angles,
    pair_from_wire,
    pair_to_wire,
)
from bodyschema.interfaces.errors import RequestError
from bodyschema.interfaces.records import Pair, frozen_array
from bodyschema.robot.hand_eye import MarkerPose
from kbmaps import quaternions

JOINTS = ("waist", "shoulder", "elbow")
finite = st.floats(allow_nan=False, allow_infinity=False)


@given(st.lists(finite, min_size=12, max_size=12), st.sampled_from([JSON, MSGPACK]))
def test_pair_round_trip_is_exact(numbers, encoding) -> None:
    a, b, c, d, e, f = numbers[6:]
    cov = frozen_array([[a, b, c], [b, d, e], [c, e, f]])
    pair = Pair("id", 3, 2, 1.5, "utc", frozen_array(numbers[:3]), frozen_array(numbers[3:6]), cov)
    message = decode(encode(pair_to_wire(pair), encoding), PairMessage, encoding)
    back = pair_from_wire(message, 3)
    assert all(np.array_equal(getattr(pair, name), getattr(back, name)) for name in ("q", "x", "cov"))
    assert (back.store, back.seq, back.segment, back.t, back.utc) == ("id", 3, 2, 1.5, "utc")


@pytest.mark.parametrize("encoding", [JSON, MSGPACK])
def test_orientation_round_trip_is_exact(encoding) -> None:
    turn, cov_R = frozen_array([0.0, 0.6, 0.0, 0.8]), frozen_array(1e-4 * np.eye(3) + 1e-6)
    pair = Pair("id", 3, 2, 1.5, "utc", np.zeros(3), np.zeros(3), np.eye(3), None, turn, cov_R)
    back = pair_from_wire(decode(encode(pair_to_wire(pair), encoding), PairMessage, encoding), 3)
    assert np.array_equal(back.R, turn)
    assert np.array_equal(back.cov_R, cov_R)


@given(
    st.lists(st.floats(1e-6, 1.0), min_size=6, max_size=6),
    st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4).filter(lambda turn: np.linalg.norm(turn) > 0.1),
)
def test_a_pose_has_the_covariance_of_its_sigmas(sigmas, turn) -> None:
    sigma, R = np.array(sigmas), np.array(turn) / np.linalg.norm(turn)
    pose = MarkerPose.rows(
        np.zeros((2, 3)), np.tile(sigma[:3], (2, 1)), np.tile(R, (2, 1)), np.tile(sigma[3:], (2, 1))
    )[1]
    cov, matrix = np.reshape(pose.covariance, (6, 6)), np.array(pose.matrix)
    assert np.array_equal(cov, cov.T)
    assert np.linalg.eigvalsh(cov).min() > 0.0
    assert np.allclose(np.sqrt(cov.diagonal()), sigma, rtol=1e-12)
    assert np.array_equal(np.reshape(pose.translation_covariance, (3, 3)), cov[:3, :3])
    assert np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-12)
    assert abs(abs(quaternions(matrix[None, :3, :3])[0] @ pose.quaternion_xyzw) - 1.0) < 1e-9


def test_a_pair_states_its_pose() -> None:
    cov = np.diag([1.0, 2.0, 3.0]) + 0.1
    pair = Pair("id", 3, 2, 1.5, "utc", np.zeros(3), np.arange(3.0), cov, None, np.array([0.0, 0.6, 0.0, 0.8]))
    pose = pair_to_wire(pair).pose
    assert np.array_equal(np.reshape(pose.translation_covariance, (3, 3)), cov)
    assert np.array(pose.matrix)[:3, 3].tolist() == [0.0, 1.0, 2.0]
    assert pose.covariance is None  # that of the orientation is not known
    rounded = replace(pair, R=1.0009 * pair.R)  # as far off as pairs may be
    assert np.allclose(pair_to_wire(rounded).pose.matrix, pose.matrix)


def message(**changed: object) -> bytes:
    fields = {
        "store": "id",
        "seq": 1,
        "segment": 1,
        "t": 0.0,
        "utc": "",
        "q": [0, 0, 0],
        "x": [0, 0, 0],
        "cov": [0] * 6,
    }
    return encode(fields | changed)


def test_message_with_unknown_extra_keys_is_read() -> None:
    assert decode(message(colour="red"), PairMessage).seq == 1


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"seq": 0}, r"`\$.seq`"),
        ({"x": [0, 0]}, r"`\$.x`"),
        ({"q": ["a"]}, r"`\$.q"),
        ({"cov": [0, 0, None, 0, 0, 0]}, r"`\$.cov"),
    ],
)
def test_invalid_pair_message_is_refused_with_its_field(changed, said) -> None:
    with pytest.raises(RequestError, match=said):
        decode(message(**changed), PairMessage)


def test_pair_with_wrong_joint_count_is_refused() -> None:
    with pytest.raises(RequestError, match="sample 1 has 3 joint angles, this robot has 7"):
        pair_from_wire(decode(message(), PairMessage), 7)


def test_a_pair_with_an_infinite_number_is_refused() -> None:
    with pytest.raises(RequestError, match="sample 1 has a number that is not finite"):
        pair_from_wire(PairMessage("id", 1, 1, 0.0, "", [0, 0, float("inf")], (0, 0, 0), (0,) * 6), 3)


def test_pair_with_unnormalised_quaternion_is_refused() -> None:
    with pytest.raises(RequestError, match="sample 1 has an R of the length 2, not 1"):
        pair_from_wire(decode(message(R=[0, 0, 0, 2]), PairMessage), 3)


def test_a_request_with_an_unknown_key_is_refused() -> None:
    with pytest.raises(RequestError, match="unknown field `angles`"):
        decode(b'{"angles": [1]}', JointsRequest)


@pytest.mark.parametrize("payload", [b"", b"{", b"[]", b"\xff\xfe", b"null", b"[" * 100_000])
@pytest.mark.parametrize("encoding", [JSON, MSGPACK])
def test_bytes_that_are_no_request_are_refused(payload, encoding) -> None:
    with pytest.raises(RequestError, match="not a CommandRequest"):
        decode(payload, CommandRequest, encoding)


def test_one_vector_is_a_batch_of_one() -> None:
    assert joint_angles(JointsRequest([1, 2, 3]), JOINTS).tolist() == [[1.0, 2.0, 3.0]]


@pytest.mark.parametrize(
    ("q", "said"),
    [
        ([], "q is empty"),
        ([[]], "row 0 of q has 0 numbers; this robot has 3 joints: waist, shoulder, elbow"),
        ([1.0, 2.0], "^q has 2 numbers"),
        ([[1, 2, 3], [1, 2]], "row 1 of q has 2 numbers"),
        ([[1, 2, 3], 4.0], "row 1 of q has 1 numbers"),
        ([[0, 0, 0], [0, float("nan"), 0]], "row 1 of q is not finite at joint 'shoulder'"),
        ([0, 1e308, 0], "^q is 1e\\+308 at joint 'shoulder'; angles are in radians"),
        ([[0.0] * 3] * (LARGEST_BATCH + 1), f"send at most {LARGEST_BATCH} at once"),
    ],
)
def test_joint_angles_not_fitting_robot_are_refused(q, said) -> None:
    with pytest.raises(RequestError, match=said):
        joint_angles(JointsRequest(q), JOINTS)
