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
from sim_backends.mechanics import MM, servo_angle
from sim_backends.parts import COLOURS, Part
from sim_backends.solids import Array, Solid
from sim_backends.world_contacts import Collision, Contacts
from sim_backends.world_model import HAND_AWAY, STEP, bin_solids, build, part_solid
from sim_backends.world_parts import LooseParts
from sim_backends.world_servos import Shafts

# Contacts are looked at and play is redistributed every so many steps: 10 ms, in which a fast arm moves 5 mm.
_LOOK_EVERY = 5
TICK = _LOOK_EVERY * STEP
# The past of the parts is kept at this spacing, in steps: 0.1 s.
_REMEMBER_EVERY = 50


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
        self._T_table_base = np.linalg.inv(T_base_table)
        self.parts = tuple(parts)
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
        self.shafts = Shafts(self._model, self._data, arm, imperfections)
        self.shaft, self.drive = self.shafts.shaft, self.shafts.drive
        self._tool_body = self._model.body(link_name(len(arm.joints) - 1)).id
        self._jaw_qpos = self._model.joint(LEFT).qposadr[0]
        self._contacts = Contacts(self._model, self._data, arm, len(parts), self.opening)
        self.loose = LooseParts(self._model, self._data, parts, spares, self._disturbed)
        self._contacts.disturbed = self.loose.disturbed
        self._past_times: list[float] = []
        self._past: list[tuple[NDArray[np.float64], frozenset[int]]] = []
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
                self.shafts.shift_play()
                self._contacts.look(self.now())
                if self._steps % _REMEMBER_EVERY == 0:
                    self.remember()
                if self.on_tick is not None:
                    self.on_tick()

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
            self.now(), data.xpos / MM, data.xmat.reshape(-1, 3, 3).copy(), self.loose.aside
        )

    def fixed_groups(self) -> list[str]:
        """For every solid the bin it belongs to, `base` for the arm's foot, or "" when it can move."""
        return [*self._bin_of_solid, *(BASE if s.body == BASE else "" for s in self.solids[len(self._bin_of_solid) :])]

    def body(self, name: str) -> int:
        """Index of a body in a snapshot; `world` is 0."""
        return int(self._model.body(name).id)

    def over_bin(self, point: Array) -> bool:
        """Whether a point (mm, `base`) is above a bin."""
        at = (self._T_table_base[:3, :3] @ point + self._T_table_base[:3, 3])[:2]
        return any((np.abs(at - bin_.center) < np.array(bin_.size) / 2.0).all() for bin_ in self.bins)

    def tool_pose(self) -> Array:
        """True pose of the grasp point in `base`, shape (4, 4), mm."""
        mujoco.mj_kinematics(self._model, self._data)
        out = np.eye(4)
        out[:3, :3] = self._data.xmat[self._tool_body].reshape(3, 3)
        out[:3, 3] = self._data.xpos[self._tool_body] / MM + out[:3, :3] @ np.array(self.arm.tool)
        return out

    def joint_angles(self) -> Array:
        """True joint angles, base to tool, rad."""
        return np.array([self.shafts.angle(j.servo_id) for j in self.arm.joints])

    def opening(self) -> float:
        """True clear opening of the jaws, mm."""
        return 2.0 * float(self._data.qpos[self._jaw_qpos]) / MM

    @property
    def collisions(self) -> list[Collision]:
        """Every time the arm touched something else than the part between its jaws."""
        return self._contacts.collisions

    def may_touch(self, index: int) -> None:
        """Touching this part is no collision: it is there for that."""
        self._contacts.welcome |= {index}

    @property
    def held(self) -> frozenset[int]:
        """Parts that both jaws touch."""
        return self._contacts.held

    def past(self, at: float) -> tuple[NDArray[np.float64], frozenset[int]]:
        """`loose.poses` and `held` at the remembered moment nearest to `at`; exact where `remember` was called."""
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
        self._past.append((self.loose.poses(), self.held))

    def forget(self, before: float) -> None:
        """Keep no more of the past than from a time (s) on; a long run would fill the memory with it."""
        first = bisect_left(self._past_times, before)
        del self._past_times[:first], self._past[:first]

    def show_hand(self, pose: Array | None) -> None:
        """Bring the hand to a pose in `base`, shape (4, 4), mm; None: out of every sight."""
        data = self._data
        data.mocap_pos[0] = np.array(HAND_AWAY) * MM if pose is None else pose[:3, 3] * MM
        yaw = 0.0 if pose is None else math.atan2(pose[1, 0], pose[0, 0])
        data.mocap_quat[0] = (math.cos(yaw / 2.0), 0.0, 0.0, math.sin(yaw / 2.0))

    # --- inside -------------------------------------------------------------------------------------------

    def _disturbed(self) -> None:
        """Hands have moved a part."""
        self._contacts.forget()
        self.remember()

    def _pose_at_rest(self) -> None:
        """Stand at rest, jaws open, held there until a bus takes over."""
        data = self._data
        wanted = {j.servo_id: angle for j, angle in zip(self.arm.joints, self.arm.rest, strict=True)}
        wanted |= {j.shadow_id: wanted[j.servo_id] for j in self.arm.joints if j.shadow_id is not None}
        wanted[self.arm.gripper.servo_id] = servo_angle(self.arm.gripper, self.arm.gripper.opening[1])
        for servo_id, angle in wanted.items():
            self.shafts.turn(servo_id, angle)
        half = self.arm.gripper.opening[1] / 2.0 * MM
        for jaw in (LEFT, RIGHT):
            data.qpos[self._model.joint(jaw).qposadr[0]] = half
        mujoco.mj_forward(self._model, data)
