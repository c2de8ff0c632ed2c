"""The torque-free arm: guided joints without motor, gazing joints on position servos."""

from __future__ import annotations

from bodyschema.interfaces.records import FloatArray

from .bullet import Body
from .roles import JointRoles

_SERVO_GAIN = 0.3
_SERVO_FORCE = 200.0


class TorqueFreeArm:
    """Drives a body's joints: what is guided gets gravity compensation at most.

    Args:
        friction: viscous friction of each joint [N·m·s or N·s/m], shape (d,).
        gravity_compensation: bear the arm's weight.
    """

    def __init__(self, body: Body, roles: JointRoles, friction: FloatArray, *, gravity_compensation: bool) -> None:
        self._body = body
        self._guided = list(roles.guided)
        self._gaze = list(roles.gaze)
        self._compensate = gravity_compensation
        for joint, damping in zip(body.joints, friction, strict=True):
            body.bullet.changeDynamics(
                body.id, joint, jointDamping=damping, linearDamping=0, angularDamping=0, physicsClientId=body.client
            )
        self._motors_off()

    def step(self, gaze_target: FloatArray) -> None:
        """One step of physics with the gazing joints' servos at the true angles `gaze_target` (g,) [rad]."""
        body = self._body
        if self._compensate:
            torques = body.gravity_torques(body.angles())
            body.bullet.setJointMotorControlArray(
                body.id,
                [body.joints[k] for k in self._guided],
                body.bullet.TORQUE_CONTROL,
                forces=torques[self._guided].tolist(),
                physicsClientId=body.client,
            )
        if self._gaze:
            body.bullet.setJointMotorControlArray(
                body.id,
                [body.joints[k] for k in self._gaze],
                body.bullet.POSITION_CONTROL,
                targetPositions=gaze_target.tolist(),
                positionGains=[_SERVO_GAIN] * len(self._gaze),
                forces=[_SERVO_FORCE] * len(self._gaze),
                physicsClientId=body.client,
            )
        body.bullet.stepSimulation(physicsClientId=body.client)

    def _motors_off(self) -> None:
        """pybullet gives every joint a braking motor; take it away from the guided ones."""
        body = self._body
        for k in self._guided:
            body.bullet.setJointMotorControl2(
                body.id, body.joints[k], body.bullet.VELOCITY_CONTROL, force=0.0, physicsClientId=body.client
            )
