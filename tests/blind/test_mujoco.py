"""Diagnoses of public arms simulated by MuJoCo: causes hidden as hinges, springs and masses."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from .dense import Checkout
from .mujoco_cases import HERE, judged, models_of, outcome, placed_mm, run
from .mujoco_hide import KINDS, STYLES, Truth, _beside_one_flank, hide
from .mujoco_urdf import MARKER, MODELS, Urdf
from .mujoco_world import STEP_S, Hinge, World

MODEL = MODELS[0]
SHOULDER = MODEL.joints[1]
PLAY = 0.01


def driven(hinge: Hinge) -> tuple[np.ndarray, np.ndarray]:
    """Return angles of the shoulder's motor, and the lead of its link, during one swing to and fro."""
    urdf = Urdf(MODEL, (0.0, 0.0, 0.0))
    give = urdf.add_give(SHOULDER)
    world = World(urdf.text_for_mujoco, MODEL.joints, {give: hinge}, MARKER)
    rigid = World(Urdf(MODEL, (0.0, 0.0, 0.0)).text_for_mujoco, MODEL.joints, {}, MARKER)
    t = np.arange(0.0, 8.0, STEP_S)
    path = np.zeros((len(t), len(MODEL.joints)))
    path[:, 1] = -0.6 * np.sin(2.0 * np.pi * t / 8.0)
    rows = np.arange(100, len(t), 100)
    _, turns = world.run(path, rows)
    _, nominal = rigid.run(path, rows)
    ahead = np.arctan2(turns[:, 0, 2], turns[:, 0, 0]) - np.arctan2(nominal[:, 0, 2], nominal[:, 0, 0])
    return path[rows, 1], ahead


def test_loaded_backlash_rests_on_the_gravity_side() -> None:
    q, ahead = driven(Hinge(half_width=0.5 * PLAY))
    leaning = np.abs(q) > 0.1  # else the arm stands upright
    np.testing.assert_allclose(ahead[leaning], 0.5 * PLAY * np.sign(q[leaning]), atol=0.02 * PLAY)


def test_a_play_held_by_friction_trails_its_motor() -> None:
    q, ahead = driven(Hinge(half_width=0.5 * PLAY, bearing_friction=300.0, motor=SHOULDER))
    moving = np.abs(np.gradient(q)) > 0.03
    np.testing.assert_allclose(ahead[moving], -0.5 * PLAY * np.sign(np.gradient(q)[moving]), atol=0.05 * PLAY)


def test_friction_holds_link_while_motor_reverses() -> None:
    q, ahead = driven(Hinge(half_width=0.5 * PLAY, bearing_friction=300.0, motor=SHOULDER))
    held = [-0.5 * PLAY * np.sign(q[1] - q[0])]
    for step in np.diff(q):
        held.append(np.clip(held[-1] - step, -0.5 * PLAY, 0.5 * PLAY))
    np.testing.assert_allclose(ahead, held, atol=0.001 * PLAY)


def test_late_images_of_static_poses_change_nothing(tmp_path: Path) -> None:
    case = hide(list(KINDS).index("late"), "static", tmp_path, rows=40)
    assert case.truth == ()
    assert placed_mm(case) < 1e3 * case.noise_m  # this seed has no tolerances


@pytest.mark.parametrize(("angles", "same"), [([1e-3, 1e-3], ("joint_offset@elbow",)), ([1e-3, -1e-3], ())])
def test_backlash_on_one_flank_equals_joint_offset(angles, same) -> None:
    world = SimpleNamespace(angles={"elbow_give": angles})
    assert _beside_one_flank(Truth("gravity_backlash@elbow", "play"), world).same == same


def hinge(name: str, parent: str, child: str, kind: str = "continuous", limit: str = "") -> str:
    return f"""<link name="{child}"/><joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
        <origin xyz="0 0 0.3" rpy="1 0 0"/><axis xyz="0 0 1"/>{limit}</joint>"""


@pytest.fixture
def lifted(tmp_path: Path) -> Path:
    """Write an arm of three joints on a lift, with a gripper."""
    parts = [
        hinge("lift", "floor_plate", "column", "prismatic"),
        hinge("turn", "column", "upper"),
        hinge("elbow", "upper", "fore", "revolute", '<limit lower="-1" upper="2"/>'),
        hinge("wrist", "fore", "palm"),
        hinge("left_finger_joint", "palm", "left_finger", "revolute", '<limit lower="0" upper="1"/>'),
        hinge("other", "column", "head"),
    ]
    file = tmp_path / "lifted.urdf"
    file.write_text(f'<robot name="lifted"><link name="floor_plate"/>{"".join(parts)}</robot>', encoding="utf-8")
    return file


def test_arm_is_longest_chain_of_revolute_joints(lifted) -> None:
    (model,) = models_of(str(lifted.parent))
    assert (model.root, model.hand, model.joints) == ("column", "palm", ("turn", "elbow", "wrist"))
    np.testing.assert_allclose(Urdf(model, (0.0, 0.0, 0.0)).limits(), [[-np.pi, np.pi], [-1, 2], [-np.pi, np.pi]])


def test_an_arm_may_come_from_robot_descriptions(lifted, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "robot_descriptions", SimpleNamespace(__path__=[]))
    monkeypatch.setitem(sys.modules, "robot_descriptions.lift_description", SimpleNamespace(URDF_PATH=str(lifted)))
    assert models_of("lift_description") == models_of(str(lifted))


def test_cause_is_hidden_in_a_given_arm(lifted, tmp_path) -> None:
    case = hide(1, "static", tmp_path / "case", rows=10, kind="marker_loose", models=models_of(str(lifted)))
    assert case.model == "lifted"
    assert case.taken.q.shape == (10, 3)
    assert np.isfinite(case.taken.x).all()


def told(*causes: dict, verdict: str = "explained", depends_on: tuple[str, ...] = ()) -> dict:
    return {"causes": causes, "verdict": verdict, "unexplained": {"depends_on": depends_on}}


def cause(effect: str, where: str, *rivals: dict, share: float = 100.0, probability: float = 0.99) -> dict:
    return {
        "effect": effect,
        "where": where,
        "source": None,
        "probability": probability,
        "share_of_gain_percent": share,
        "rivals": rivals,
        "indistinguishable_from": (),
    }


PLAYS = (Truth("backlash@elbow", "play"),)
BENDS = (Truth("", "bends", joints=("elbow", "wrist")),)


@pytest.mark.parametrize(
    ("truth", "answer", "expected"),
    [
        (PLAYS, told(cause("backlash", "elbow")), "right"),
        (PLAYS, told(cause("settling", "elbow")), "wrong"),
        (PLAYS, told(cause("settling", "elbow", cause("backlash", "elbow"), probability=0.6)), "honest"),
        (PLAYS, told(verdict="unexplained", depends_on=("elbow",)), "honest"),
        (PLAYS, told(verdict="nothing_found"), "vague"),
        (BENDS, told(verdict="unexplained", depends_on=("wrist",)), "right"),
        (BENDS, told(cause("link_geometry", "elbow")), "wrong"),
    ],
)
def test_outcome_follows_from_truth_and_answer(truth, answer, expected) -> None:
    assert outcome(truth, (), answer)[0] == expected


# Each with and without tolerances at every link.
@pytest.mark.parametrize(
    ("kind", "style", "rows", "dense"), [("play_by_gravity", "static", 80, 1.0), ("dahl", "walk", 150, 0.0)]
)
@pytest.mark.soak
def test_a_simulated_cause_is_named(kind, style, rows, dense, tmp_path: Path) -> None:
    case = hide(0, style, tmp_path, rows=rows, kind=kind, dense=dense)
    record = judged(case, Checkout(HERE.parents[1], 120.0))
    assert record.outcome == "right", record


@pytest.mark.soak
@pytest.mark.parametrize("dense", [0.0, 1.0])
@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("kind", ["play_by_friction", "play_by_gravity", "dahl", "lugre", "payload", "wave"])
@pytest.mark.parametrize("seed", range(3))
def test_cause_behind_motor_is_right_or_honest(seed, kind, style, dense, tmp_path: Path) -> None:
    case = hide(seed, style, tmp_path, kind=kind, dense=dense)
    record = judged(case, Checkout(HERE.parents[1], 300.0))
    assert record.outcome in ("right", "honest"), record


@pytest.mark.soak
@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("seed", range(len(KINDS)))
def test_no_simulated_cause_is_named_wrongly_for_sure(seed, style, tmp_path: Path) -> None:
    record = run(seed, style, tmp_path, Checkout(HERE.parents[1], 300.0))
    assert record.outcome not in ("wrong", "crashed"), record
