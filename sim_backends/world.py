"""The mechanical world: an arm, parts, bins and a table in MuJoCo, turned by the shafts of virtual servos.

The world owns simulated time. Whatever else is simulated (servos, camera, clock) asks it to advance.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from controller.domain import ArmDescription, Bin
from sim_backends.arm_shape import BASE, LEFT, RIGHT, MarkerMount, arm_solids, link_name
from sim_backends.imperfections import Imperfections
from sim_backends.parts import COLOURS, Part
from sim_backends.plant import Drive, Shaft
from sim_backends.solids import Array, Solid
from sim_backends.world_contacts import Collision, Contacts
from sim_backends.world_model import (
    FLOOR,
    HAND_AWAY,
    MM,
    STEP,
    bin_solids,
    build,
    part_name,
    part_solid,
    servo_angle,
    servo_joints,
)

# Contacts are looked at and play is redistributed every so many steps: 10 ms, in which a fast arm moves 5 mm.
_LOOK_EVERY = 5
TICK = _LOOK_EVERY * STEP
# The past of the parts is kept at this spacing, in steps: 0.1 s.
_REMEMBER_EVERY = 50
# Torque at which the play of a gear lies wholly on one flank, Nm.
_FLANK_TORQUE = 0.04
# Friction that no servo overcomes, Nm: 20 times the stall torque of the strongest.
_BLOCKED = 200.0
# A part this near to where it was laid has at most been pushed, mm: bins are further away.
_PUSHED = 40.0
# Friction of a part that slips out of any jaws: at 20 N a finger, 0.01 would still carry 40 g.
_GREASED = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """Where everything is at one moment; what pictures are painted from.

    Attributes:
        at: s.
        positions: ndarray of shape (B, 3): origins of all bodies in `base`, mm.
        rotations: ndarray of shape (B, 3, 3): body into `base`.
        aside: The parts are off the table, out of every picture.
    """

    at: float
    positions: Array
    rotations: Array
    aside: bool


@dataclass(slots=True)
class _Servo:
    joint: str
    actuator: int
    position: int
    dof: int
    sign: float
    offset: float
    play: float
    drive: Drive


class World:
    """Physics of one cell; a `Plant` for the servo bus. Not thread-safe.

    Attributes:
        on_tick: Called every `TICK` s of simulated time, for whoever looks at the world on a beat of his own.

    Args:
        arm: The arm as described; its links and mounting get the imperfections.
        bins: Boxes on the table, given in `table`.
        T_base_table: Where the bins' `table` is (nominal), shape (4, 4).
        parts: What lies on the table.
        imperfections: What is not as described.
        marker: The plate on the gripper.
        T_tool_marker: Where it truly is; None for its nominal place.
        spares: How many of the parts, the last ones, are somewhere else until a person adds them.
        hand: Solids of a person's hand in its own coordinates; it is seen and touches nothing.
    """

    def __init__(
        self,
        arm: ArmDescription,
        bins: Sequence[Bin],
        T_base_table: Array,
        parts: Sequence[Part],
        imperfections: Imperfections,
        marker: MarkerMount | None = None,
        T_tool_marker: Array | None = None,
        spares: int = 0,
        hand: Sequence[Solid] = (),
    ) -> None:
        marker = marker or MarkerMount()
        self.arm = arm
        self.bins = tuple(bins)
        self.parts = tuple(parts)
        self._T_bins = T_base_table
        shape = arm_solids(arm, marker, marker.T_tool_marker if T_tool_marker is None else T_tool_marker)
        boxes = bin_solids(bins, T_base_table)
        self.solids: tuple[Solid, ...] = (
            *(s for solids in boxes.values() for s in solids),
            *shape,
            *(part_solid(i, p, COLOURS[p.colour]) for i, p in enumerate(parts)),
            *hand,
        )
        self._bin_of_solid = [name for name, solids in boxes.items() for _ in solids]
        self._model = mujoco.MjModel.from_xml_string(build(arm, shape, boxes, parts, imperfections, bool(hand)))
        self._data = mujoco.MjData(self._model)
        self._steps = 0
        self._carry = 0.0
        self._callbacks: list[Callable[[float], None]] = []
        self.on_tick: Callable[[], None] | None = None
        self._friction_damping = self._model.dof_damping.copy()
        self._servos = self._find_servos(imperfections)
        self._friction: dict[int, float] = {}
        self._part_qpos = np.array(
            [self._model.joint(part_name(i)).qposadr[0] + np.arange(7) for i in range(len(parts))], dtype=np.intp
        ).reshape(-1, 7)
        self._tool_body = self._model.body(link_name(len(arm.joints) - 1)).id
        self._jaw_qpos = self._model.joint(LEFT).qposadr[0]
        self._contacts = Contacts(self._model, self._data, arm, len(parts), self.opening)
        self._aside = False
        self._spares = frozenset(range(len(parts) - spares, len(parts)))
        self._away: set[int] = set(self._spares)
        self._past_times: list[float] = []
        self._past: list[tuple[NDArray[np.float64], frozenset[int]]] = []
        for index in self._spares:
            self._carry_off(index)
        self._pose_at_rest()
        self.remember()

    # --- the plant -------------------------------------------------------------------------------------

    def now(self) -> float:
        """Simulated time, s."""
        return self._steps * STEP

    def advance(self, seconds: float) -> None:
        """Let `seconds` of simulated time pass in whole steps of 2 ms; the remainder is carried over."""
        self._carry += max(0.0, seconds)
        steps = int(self._carry / STEP + 1e-6)
        self._carry -= steps * STEP
        model, data = self._model, self._data
        while steps > 0:
            run = min(steps, _LOOK_EVERY - self._steps % _LOOK_EVERY)
            if self._callbacks:
                for _ in range(run):
                    for callback in self._callbacks:
                        callback(STEP)
                    mujoco.mj_step(model, data)
                    self._steps += 1
            else:
                mujoco.mj_step(model, data, run)
                self._steps += run
            steps -= run
            if self._steps % _LOOK_EVERY == 0:
                self._shift_play()
                self._contacts.look(self.now())
                if self._steps % _REMEMBER_EVERY == 0:
                    self.remember()
                if self.on_tick is not None:
                    self.on_tick()

    def shaft(self, servo_id: int) -> Shaft:
        """The shaft of one servo: joint angle plus mounting offset plus play, turned as the servo is mounted."""
        servo = self._servos[servo_id]
        data = self._data
        velocity = float(data.qvel[servo.dof])
        torque = float(data.actuator_force[servo.actuator])
        return Shaft(
            servo.sign * (float(data.qpos[servo.position]) + servo.offset + servo.play),
            servo.sign * velocity,
            servo.sign * (torque - servo.drive.damping * velocity),
        )

    def drive(self, servo_id: int, drive: Drive) -> None:
        """Let a servo do this from now on."""
        servo = self._servos[servo_id]
        before, servo.drive = servo.drive, drive
        model, a = self._model, servo.actuator
        self._aim(servo)
        if drive.stiffness != before.stiffness:
            model.actuator_gainprm[a, 0] = drive.stiffness
            model.actuator_biasprm[a, 1] = -drive.stiffness
        if drive.bias != before.bias:
            model.actuator_biasprm[a, 0] = servo.sign * drive.bias
        if drive.limit != before.limit:
            # A range of zero width would mean no limit at all to MuJoCo.
            limit = max(drive.limit, 1e-9)
            model.actuator_forcerange[a] = (-limit, limit)
        if drive.damping != before.damping:
            together = sum(s.drive.damping for s in self._servos.values() if s.dof == servo.dof)
            model.dof_damping[servo.dof] = self._friction_damping[servo.dof] + together

    def on_step(self, callback: Callable[[float], None]) -> None:
        """Have `callback(dt)` called before every physics step of `dt` s."""
        self._callbacks.append(callback)

    # --- what can be known about it -----------------------------------------------------------------------

    def snapshot(self) -> Snapshot:
        """Where every body is now."""
        data = self._data
        # mj_step leaves poses one step behind the joint angles.
        mujoco.mj_kinematics(self._model, data)
        return Snapshot(
            self.now(), data.xpos / MM, data.xmat.reshape(-1, 3, 3).copy(), self._aside
        )

    def fixed_groups(self) -> list[str]:
        """For every solid the bin it belongs to, `base` for the arm's foot, or "" when it can move."""
        return [*self._bin_of_solid, *(BASE if s.body == BASE else "" for s in self.solids[len(self._bin_of_solid) :])]

    def body(self, name: str) -> int:
        """Index of a body in a snapshot; `world` is 0."""
        return int(self._model.body(name).id)

    def tool_pose(self) -> Array:
        """True pose of the grasp point in `base`, shape (4, 4), mm."""
        mujoco.mj_kinematics(self._model, self._data)
        out = np.eye(4)
        out[:3, :3] = self._data.xmat[self._tool_body].reshape(3, 3)
        out[:3, 3] = self._data.xpos[self._tool_body] / MM + out[:3, :3] @ np.array(self.arm.tool)
        return out

    def joint_angles(self) -> Array:
        """True joint angles, base to tool, rad."""
        return np.array([self._data.qpos[self._servos[j.servo_id].position] for j in self.arm.joints])

    def opening(self) -> float:
        """True clear opening of the jaws, mm."""
        return 2.0 * float(self._data.qpos[self._jaw_qpos]) / MM

    @property
    def collisions(self) -> list[Collision]:
        """Every time the arm touched something else than the part between its jaws."""
        return self._contacts.collisions

    @property
    def held(self) -> frozenset[int]:
        """Parts that both jaws touch."""
        return self._contacts.held

    @property
    def aside(self) -> bool:
        """The parts are off the table."""
        return self._aside

    def part_poses(self) -> NDArray[np.float64]:
        """Position (mm, `base`) and unit quaternion (w, x, y, z) of every part's centre, (P, 7)."""
        poses = self._data.qpos[self._part_qpos]
        poses[:, :3] /= MM
        return np.asarray(poses)

    def past(self, at: float) -> tuple[NDArray[np.float64], frozenset[int]]:
        """`part_poses` and `held` at the remembered moment nearest to `at`; exact where `remember` was called."""
        index = bisect_left(self._past_times, at)
        near = [i for i in (index - 1, index) if 0 <= i < len(self._past_times)]
        return self._past[min(near, key=lambda i: abs(self._past_times[i] - at))]

    def remember(self) -> None:
        """Keep where the parts are now, for `past`."""
        now = self.now()
        if self._past_times and self._past_times[-1] == now:
            self._past_times.pop()
            self._past.pop()
        self._past_times.append(now)
        self._past.append((self.part_poses(), self.held))

    def forget(self, before: float) -> None:
        """Keep no more of the past than from a time (s) on; a long run would fill the memory with it."""
        first = bisect_left(self._past_times, before)
        del self._past_times[:first], self._past[:first]

    # --- what people do to it ---------------------------------------------------------------------------

    def set_aside(self) -> None:
        """Take every part off the table, out of the way and the picture."""
        for index in range(len(self.parts)):
            self._carry_off(index)
        self._aside = True
        self._settled()

    def put_back(self) -> None:
        """Put every part where it lay at the start."""
        self._away = set(self._spares)
        for index in range(len(self.parts)):
            if index not in self._away:
                self._lay(index)
        self._aside = False
        self._settled()

    def lay_back(self, index: int) -> None:
        """Put one part where it lay at the start: it has slipped out of the jaws."""
        self._lay(index)
        self._settled()

    def take_away(self, index: int) -> None:
        """Take one part off the table, for good or until it is laid down somewhere."""
        self._carry_off(index)
        self._away.add(index)
        self._settled()

    def lay_at(self, index: int, x: float, y: float, yaw: float) -> None:
        """Lay a part on the table at (x, y) of `base`, mm, turned by `yaw`, rad."""
        turn = (math.cos(yaw / 2.0), 0.0, 0.0, math.sin(yaw / 2.0))
        self._put(self._part_qpos[index], (x * MM, y * MM, self.parts[index].height * MM / 2.0, *turn))
        self._away.discard(index)
        self._settled()

    def shove(self, index: int, velocity: tuple[float, float], spin: float) -> None:
        """Give a part a velocity along the table, mm/s, and a turn about the vertical, rad/s."""
        dof = self._part_dof(index)
        self._data.qvel[dof : dof + 6] = (velocity[0] * MM, velocity[1] * MM, 0.0, 0.0, 0.0, spin)
        self._settled()

    def grease(self, index: int, greased: bool) -> None:
        """Make a part too slippery to be held, or as it was."""
        geom = self._model.geom(part_name(index)).id
        self._model.geom_friction[geom, 0] = _GREASED if greased else self.parts[index].friction

    def show_hand(self, pose: Array | None) -> None:
        """Bring the hand to a pose in `base`, shape (4, 4), mm; None: out of every sight."""
        data = self._data
        data.mocap_pos[0] = np.array(HAND_AWAY) * MM if pose is None else pose[:3, 3] * MM
        yaw = 0.0 if pose is None else math.atan2(pose[1, 0], pose[0, 0])
        data.mocap_quat[0] = (math.cos(yaw / 2.0), 0.0, 0.0, math.sin(yaw / 2.0))

    @property
    def away(self) -> frozenset[int]:
        """Parts that a person has taken or not yet brought."""
        return frozenset(self._away)

    def nearest_to_tool(self) -> int | None:
        """Index of the part nearest to the grasp point among those that lie about where they were laid, if any."""
        poses = self.part_poses()[:, :3]
        laid = np.array([(part.x, part.y) for part in self.parts]).reshape(-1, 2)
        there = np.linalg.norm(poses[:, :2] - laid, axis=1) < _PUSHED
        apart = np.where(there, np.linalg.norm(poses - self.tool_pose()[:3, 3], axis=1), np.inf)
        return int(apart.argmin()) if there.any() else None

    def block(self, servo_id: int, blocked: bool) -> None:
        """Hold one shaft as if something solid stood in its way, or let it go again."""
        dof = self._servos[servo_id].dof
        if dof not in self._friction:
            self._friction[dof] = float(self._model.dof_frictionloss[dof])
        self._model.dof_frictionloss[dof] = _BLOCKED if blocked else self._friction[dof]

    # --- inside -------------------------------------------------------------------------------------------

    def _lay(self, index: int) -> None:
        part = self.parts[index]
        turn = (math.cos(part.yaw / 2.0), 0.0, 0.0, math.sin(part.yaw / 2.0))
        self._put(self._part_qpos[index], (part.x * MM, part.y * MM, part.height * MM / 2.0, *turn))

    def _carry_off(self, index: int) -> None:
        row, column = divmod(index, 8)
        at = (1.2 + 0.15 * row, 0.15 * column - 0.6, FLOOR * MM + self.parts[index].height * MM / 2.0)
        self._put(self._part_qpos[index], (*at, 1.0, 0.0, 0.0, 0.0))

    def _put(self, address: NDArray[np.intp], pose: tuple[float, ...]) -> None:
        self._data.qpos[address] = pose
        dof = self._model.jnt_dofadr[self._model.jnt_qposadr.tolist().index(address[0])]
        self._data.qvel[dof : dof + 6] = 0.0

    def _part_dof(self, index: int) -> int:
        return int(self._model.joint(part_name(index)).dofadr[0])

    def _settled(self) -> None:
        """Start the solver afresh: what slept on old contacts must not sleep on."""
        data = self._data
        keep = data.qpos.copy(), data.qvel.copy(), data.ctrl.copy(), data.mocap_pos.copy(), data.mocap_quat.copy()
        mujoco.mj_resetData(self._model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:], data.mocap_pos[:], data.mocap_quat[:] = keep
        data.time = self.now()
        self._contacts.forget()
        mujoco.mj_forward(self._model, data)
        self.remember()

    def _find_servos(self, imperfections: Imperfections) -> dict[int, _Servo]:
        ids: list[tuple[int, float, float, float]] = []
        for index, joint in enumerate(self.arm.joints):
            sign = -1.0 if joint.reverse else 1.0
            ids.append((joint.servo_id, sign, imperfections.joint_offsets[index], imperfections.backlash[index]))
            if joint.shadow_id is not None:
                # The shadow faces its partner across the joint, so its shaft turns the other way.
                ids.append((joint.shadow_id, -sign, *ids[-1][2:]))
        ids.append((self.arm.gripper.servo_id, -1.0 if self.arm.gripper.reverse else 1.0, 0.0, 0.0))
        servos = {}
        self._backlash = {}
        for (servo_id, sign, offset, backlash), (actuator, joint_name) in zip(
            ids, servo_joints(self.arm), strict=True
        ):
            handle = self._model.joint(joint_name)
            servos[servo_id] = _Servo(
                joint_name,
                self._model.actuator(actuator).id,
                int(handle.qposadr[0]),
                int(handle.dofadr[0]),
                sign,
                offset,
                0.0,
                Drive(),
            )
            if backlash > 0.0:
                self._backlash[servo_id] = backlash
        return servos

    def _aim(self, servo: _Servo) -> None:
        self._data.ctrl[servo.actuator] = servo.sign * servo.drive.target - servo.offset - servo.play

    def _pose_at_rest(self) -> None:
        """Stand at rest, jaws open, held there until a bus takes over."""
        data = self._data
        wanted = {j.servo_id: angle for j, angle in zip(self.arm.joints, self.arm.rest, strict=True)}
        wanted |= {j.shadow_id: wanted[j.servo_id] for j in self.arm.joints if j.shadow_id is not None}
        wanted[self.arm.gripper.servo_id] = servo_angle(self.arm.gripper, self.arm.gripper.opening[1])
        for servo_id, angle in wanted.items():
            data.qpos[self._servos[servo_id].position] = angle
        half = self.arm.gripper.opening[1] / 2.0 * MM
        for jaw in (LEFT, RIGHT):
            data.qpos[self._model.joint(jaw).qposadr[0]] = half
        mujoco.mj_forward(self._model, data)

    def _shift_play(self) -> None:
        """The encoder sits on the motor's side of the play; the link leans on the flank its load presses it to.

        The play moves towards its place by a part each time: gears do not jump, and the loop through the
        servo's stiffness stays tame.
        """
        for servo_id, backlash in self._backlash.items():
            servo = self._servos[servo_id]
            torque = float(self._data.actuator_force[servo.actuator])
            wanted = 0.5 * backlash * math.tanh(torque / _FLANK_TORQUE)
            servo.play += 0.4 * (wanted - servo.play)
            self._aim(servo)

