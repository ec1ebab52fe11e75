"""The shafts of a physics model as the servos' plant sees them: mounted askew, with play, told what to do by drives."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from controller.domain import ArmDescription
from sim_backends.imperfections import Imperfections
from sim_backends.plant import Drive, Shaft
from sim_backends.world_model import servo_joints

# Torque at which the play of a gear lies wholly on one flank, Nm.
_FLANK_TORQUE = 0.04
# Friction that no servo overcomes, Nm: 20 times the stall torque of the strongest.
_BLOCKED = 200.0


@dataclass(slots=True)
class _Servo:
    actuator: int
    position: int
    dof: int
    sign: float
    offset: float
    backlash: float
    play: float
    drive: Drive


class Shafts:
    """Every servo's shaft in one physics model.

    Args:
        model, data: MuJoCo's.
        arm: The arm in it.
        imperfections: How its servos are mounted, and their play.
    """

    def __init__(self, model: Any, data: Any, arm: ArmDescription, imperfections: Imperfections) -> None:
        # MuJoCo makes a new view at every access; these stay good as long as model and data do.
        self._qpos, self._qvel, self._ctrl, self._force = data.qpos, data.qvel, data.ctrl, data.actuator_force
        self._gain, self._bias, self._range = model.actuator_gainprm, model.actuator_biasprm, model.actuator_forcerange
        self._damping, self._friction_loss = model.dof_damping, model.dof_frictionloss
        self._friction_damping = model.dof_damping.copy()
        self._friction: dict[int, float] = {}
        mounted: list[tuple[int, float, float, float]] = []
        for index, joint in enumerate(arm.joints):
            sign = -1.0 if joint.reverse else 1.0
            mounted.append((joint.servo_id, sign, imperfections.joint_offsets[index], imperfections.backlash[index]))
            if joint.shadow_id is not None:
                # The shadow faces its partner across the joint, so its shaft turns the other way.
                mounted.append((joint.shadow_id, -sign, *mounted[-1][2:]))
        mounted.append((arm.gripper.servo_id, -1.0 if arm.gripper.reverse else 1.0, 0.0, 0.0))
        self._servos: dict[int, _Servo] = {}
        for (servo_id, sign, offset, backlash), (actuator, name) in zip(mounted, servo_joints(arm), strict=True):
            joint = model.joint(name)
            self._servos[servo_id] = _Servo(
                model.actuator(actuator).id, int(joint.qposadr[0]), int(joint.dofadr[0]),
                sign, offset, backlash, 0.0, Drive(),
            )  # fmt: skip
        self._with_play = [servo for servo in self._servos.values() if servo.backlash > 0.0]

    def shaft(self, servo_id: int) -> Shaft:
        """The shaft of one servo: joint angle plus mounting offset plus play, turned as the servo is mounted."""
        servo = self._servos[servo_id]
        velocity = float(self._qvel[servo.dof])
        torque = float(self._force[servo.actuator])
        return Shaft(
            servo.sign * (float(self._qpos[servo.position]) + servo.offset + servo.play),
            servo.sign * velocity,
            servo.sign * (torque - servo.drive.damping * velocity),
        )

    def drive(self, servo_id: int, drive: Drive) -> None:
        """Let a servo do this from now on."""
        servo = self._servos[servo_id]
        before, servo.drive = servo.drive, drive
        a = servo.actuator
        self._aim(servo)
        if drive.stiffness != before.stiffness:
            self._gain[a, 0] = drive.stiffness
            self._bias[a, 1] = -drive.stiffness
        if drive.bias != before.bias:
            self._bias[a, 0] = servo.sign * drive.bias
        if drive.limit != before.limit:
            # A range of zero width would mean no limit at all to MuJoCo.
            limit = max(drive.limit, 1e-9)
            self._range[a] = (-limit, limit)
        if drive.damping != before.damping:
            together = sum(s.drive.damping for s in self._servos.values() if s.dof == servo.dof)
            self._damping[servo.dof] = self._friction_damping[servo.dof] + together

    def angle(self, servo_id: int) -> float:
        """True angle of the joint that a servo turns, rad."""
        return float(self._qpos[self._servos[servo_id].position])

    def turn(self, servo_id: int, angle: float) -> None:
        """Put the joint that a servo turns at an angle, rad."""
        self._qpos[self._servos[servo_id].position] = angle

    def block(self, servo_id: int, blocked: bool) -> None:
        """Hold one shaft as if something solid stood in its way, or let it go again."""
        dof = self._servos[servo_id].dof
        friction = self._friction.setdefault(dof, float(self._friction_loss[dof]))
        self._friction_loss[dof] = _BLOCKED if blocked else friction

    def shift_play(self) -> None:
        """The encoder sits on the motor's side of the play; the link leans on the flank its load presses it to.

        The play moves towards its place by a part each time: gears do not jump, and the loop through the
        servo's stiffness stays tame.
        """
        for servo in self._with_play:
            wanted = 0.5 * servo.backlash * math.tanh(float(self._force[servo.actuator]) / _FLANK_TORQUE)
            servo.play += 0.4 * (wanted - servo.play)
            self._aim(servo)

    def _aim(self, servo: _Servo) -> None:
        self._ctrl[servo.actuator] = servo.sign * servo.drive.target - servo.offset - servo.play
