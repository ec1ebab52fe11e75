"""The safety gate: no plan reaches the arm that breaks a limit anywhere along its way.

It judges the sampled moves themselves, not how they were made, and knows nothing of paths.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controller.domain import ArmDescription, Array, Bin, Trajectory
from controller.errors import LimitViolation
from controller.geometry import invert, transform
from controller.motion.kinematics import Chain, chain, points, rotation

# Sampling and the moving average may leave a joint this far over its planned limits; the limits themselves
# are chosen with more in hand.
SPEED_SLACK = 1.02
ACCELERATION_SLACK = 1.08
TOOL_SPEED = 1500.0  # mm/s
TABLE_MARGIN = 1.0  # mm that the jaw tips keep from the table
CAMERA_ROOM = 120.0  # mm between the arm's middle line and the lens
BODY_MARGIN = 30.0  # mm that elbow and wrist keep from the table
COLUMN = (60.0, 15.0)  # mm: radius kept clear about the waist, and how far over the shoulder it reaches
WORK_REACH = 0.8  # share of its full stretch that an arm needs to work top-down
WALL_MARGIN = 2.0  # mm between jaws and bin walls
# mm: how far a bin may stand from where it is said to: laid out with a ruler (2 mm each way) against a sheet laid by
# hand, whose turn of half a degree is 4 mm at the furthest bin of the shipped cells.
BIN_ASTRAY = 5.0
WALL = 4.0  # mm: thickness of a bin wall at most
START_TOLERANCE = 0.1  # rad between measured pose and first sample
LARGEST_OFFSET = 0.35  # rad a goal may lie ahead of its position


@dataclass(frozen=True, slots=True, eq=False)
class Gate:
    """What no move may break.

    Attributes:
        arm: The arm.
        T_base_table: ndarray of shape (4, 4), mm.
        bins: Boxes whose walls the jaws must not touch.
        radius: The grasp point stays within this distance of the waist axis, mm.
        eye: ndarray of shape (3,): where the camera hangs in `base`, mm; None when that is not known.
    """

    arm: ArmDescription
    T_base_table: Array
    bins: tuple[Bin, ...]
    radius: float
    eye: Array | None = None

    def check_moves(self, moves: Sequence[Trajectory], start: Array, opening: float) -> None:
        """Approve moves that follow each other; arguments and errors as of `check`."""
        for move in moves:
            self.check(move, start, opening=opening)
            start = move.positions[-1]

    def check(self, trajectory: Trajectory, start: Array, *, opening: float | None = None) -> None:
        """Approve one move.

        Args:
            trajectory: The move.
            start: ndarray of shape (J,): where the joints are before it, rad.
            opening: Widest clear opening of the jaws during it, mm; the gripper's widest when None.

        Raises:
            LimitViolation: The message names the move, what is broken, its value and its limit.
        """
        name, q = trajectory.name, trajectory.positions
        self._numbers(trajectory, start)
        self._joints(name, q, trajectory.period)
        body = points(self.arm, q)
        self._body(name, body)
        speeds = np.linalg.norm(np.diff(body[:, 3], axis=0), axis=1) / trajectory.period
        if len(speeds) and speeds.max() > TOOL_SPEED:
            raise _violation(name, "tool speed", float(speeds.max()), TOOL_SPEED, "mm/s")
        self._jaws(name, q, body[:, 3], opening if opening is not None else self.arm.gripper.opening[1])

    def jaws_inside(self, bin: Bin, q: Array, opening: float) -> bool:
        """Whether the jaws, opened, stand clear of the walls inside a bin in a posture (J,)."""
        tips = self._tips(q[None], points(self.arm, q)[None, 3], opening)
        return bool(_inside(np.abs(tips[..., :2] - np.array(bin.center)), np.array(bin.size) / 2.0)[0])

    def lowest(self, q: Array, opening: float) -> float:
        """Height over the table (mm) of the lowest corner of the jaw tips, opened, in a posture (J,)."""
        return float(self._tips(q[None], points(self.arm, q)[None, 3], opening)[..., 2].min())

    def _tips(self, q: Array, tool: Array, opening: float) -> Array:
        """Outer corners of the jaw tips in `table`: ndarray of shape (N, 4, 3), mm."""
        gripper = self.arm.gripper
        along = opening / 2.0 + gripper.jaw_size[0]
        across = gripper.jaw_size[1] / 2.0
        corners = np.array([[gripper.jaw_depth, a, b] for a in (-along, along) for b in (-across, across)])
        way = corners @ rotation(q).transpose(0, 2, 1) + tool[:, None]
        return transform(invert(self.T_base_table), way)

    def _numbers(self, trajectory: Trajectory, start: Array) -> None:
        name, q, goals = trajectory.name, trajectory.positions, trajectory.goals
        if q.ndim != 2 or q.shape != goals.shape or q.shape[1] != len(self.arm.joints) or not len(q):
            raise LimitViolation(f"{name}: positions {q.shape} and goals {goals.shape} do not suit {self.arm.title}")
        if not (np.isfinite(q).all() and np.isfinite(goals).all()):
            raise LimitViolation(f"{name}: a joint angle is not a finite number")
        ahead = np.abs(goals - q).max(axis=0)
        for joint, value in zip(self.arm.joints, ahead, strict=True):
            if value > LARGEST_OFFSET:
                raise _violation(name, f"{joint.name} goal ahead by", math.degrees(value), math.degrees(LARGEST_OFFSET))
        for joint, value in zip(self.arm.joints, np.abs(q[0] - start), strict=True):
            if not value <= START_TOLERANCE:
                what = f"{joint.name} away from the start by"
                raise _violation(name, what, math.degrees(value), math.degrees(START_TOLERANCE))

    def _joints(self, name: str, q: Array, period: float) -> None:
        speed = np.diff(q, axis=0) / period
        gain = np.diff(speed, axis=0) / period
        lows, highs = q.min(axis=0).tolist(), q.max(axis=0).tolist()
        speeds, gains = (np.abs(rows).max(axis=0, initial=0.0).tolist() for rows in (speed, gain))
        for joint, low, high, fast, hard in zip(self.arm.joints, lows, highs, speeds, gains, strict=True):
            lowest, highest = joint.limits
            if low < lowest - 1e-9 or high > highest + 1e-9:
                value, limit = (low, lowest) if low < lowest - 1e-9 else (high, highest)
                raise _violation(name, joint.name, math.degrees(value), math.degrees(limit))
            if fast > joint.speed_limit * SPEED_SLACK:
                raise _violation(name, f"{joint.name} speed", fast, joint.speed_limit, "rad/s")
            if hard > joint.acceleration_limit * ACCELERATION_SLACK:
                raise _violation(name, f"{joint.name} acceleration", hard, joint.acceleration_limit, "rad/s^2")

    def _body(self, name: str, body: Array) -> None:
        """Elbow, wrist and grasp point against table, column and workspace; the first sample may be anywhere."""
        c = chain(self.arm)
        low = float(body[:, 1:3, 2].min())
        if low < min(BODY_MARGIN, float(body[0, 1:3, 2].min())) - 1e-6:
            raise _violation(name, "elbow or wrist height", low, BODY_MARGIN, "mm")
        tool = body[:, 3]
        radius = np.hypot(tool[:, 0] - c.axis[0], tool[:, 1])
        # An arm found outside the workspace may come back by any way; one inside stays inside.
        judged = radius if radius[0] <= self.radius else radius[-1:]
        if (far := float(judged.max())) > self.radius:
            raise _violation(name, "distance of the tool from the waist", far, self.radius, "mm")
        share = np.linspace(0.0, 1.0, 6)[:, None]
        hand = body[:, None, 2] + (body[:, None, 3] - body[:, None, 2]) * share
        fore = body[:, None, 1] + (body[:, None, 2] - body[:, None, 1]) * share
        arm = np.concatenate([fore, hand], axis=1)
        if self.eye is not None:
            gap = np.linalg.norm(arm - self.eye, axis=2).min(axis=1)
            if gap.min() < min(CAMERA_ROOM, float(gap[0])) - 1e-6:
                raise _violation(name, "distance from the camera", float(gap.min()), CAMERA_ROOM, "mm")
        # How deep in the column a point is: the shorter way out, to the side or up. An arm that rests on its
        # column may leave it by any way that does not press it further in.
        depth = _column_depth(c, arm)
        if depth.max() <= depth[0] + 1e-6:
            return
        rest = points(self.arm, np.array(self.arm.rest))
        lying = np.concatenate([rest[1] + (rest[2] - rest[1]) * share, rest[2] + (rest[3] - rest[2]) * share])
        allowed = max(float(depth[0]), float(_column_depth(c, lying[None])[0]))
        if depth.max() > allowed + 1e-6:
            raise _violation(name, "depth in the arm's own column", float(depth.max()), allowed, "mm")

    def _jaws(self, name: str, q: Array, tool: Array, opening: float) -> None:
        """Jaw tips against the table and the walls of the bins."""
        gripper = self.arm.gripper
        walls = max([TABLE_MARGIN, *(bin_.height + WALL_MARGIN for bin_ in self.bins)])
        # From the first sample to the last that may be low; the rest is far above everything.
        reach = math.hypot(gripper.jaw_depth, opening, gripper.jaw_size[0])
        low_enough = tool[:, 2] - self.T_base_table[2, 3] < walls + reach
        if not low_enough.any():
            return
        part = slice(int(np.argmax(low_enough)), len(q) - int(np.argmax(low_enough[::-1])))
        q = q[part]
        way = self._tips(q, tool[part], opening)
        height = way[..., 2].min(axis=1)
        if height.min() < min(TABLE_MARGIN, float(height[0])) - 1e-6:
            raise _violation(name, "height of the jaw tips over the table", float(height.min()), TABLE_MARGIN, "mm")
        for bin_ in self.bins:
            low = height < bin_.height + WALL_MARGIN
            if not low.any():
                continue
            about = way[low][..., :2] - np.array(bin_.center)
            half = np.array(bin_.size) / 2.0
            outer = half + WALL + WALL_MARGIN + BIN_ASTRAY
            if (about.min(axis=(0, 1)) > outer).any() or (about.max(axis=(0, 1)) < -outer).any():
                continue
            bad = np.zeros(len(q), bool)
            bad[low] = ~(_inside(np.abs(about), half) | _beside(about, outer))
            # An arm stopped at a wall may leave it straight up, as far as it needs.
            free = int(np.argmin(bad)) if not bad.all() else len(bad)
            if bad[free:].any() or (np.diff(height[: free + 1]) < -1e-6).any():
                what, limit = f"height of the jaws at a wall of bin {bin_.name}", bin_.height + WALL_MARGIN
                raise _violation(name, what, float(height[bad].min()), limit, "mm")


def _column_depth(c: Chain, arm: Array) -> Array:
    """How deep in the column the deepest of the arm's points (N, P, 3) is: ndarray of shape (N,), mm."""
    near = COLUMN[0] - np.hypot(arm[..., 0] - c.axis[0], arm[..., 1])
    under = c.axis[1] + COLUMN[1] - arm[..., 2]
    return np.asarray(np.clip(np.minimum(near, under), 0.0, None).max(axis=1))


def _inside(flat: Array, half: Array) -> NDArray[np.bool_]:
    """Which of the tips (N, 4, 2), given by their distances from a bin's middle, lie clear of its walls inside."""
    return np.asarray((flat <= half - WALL_MARGIN - BIN_ASTRAY).all(axis=(1, 2)))


def _beside(quads: Array, half: Array) -> NDArray[np.bool_]:
    """Which of the quads (N, 4, 2) lie wholly on the outer side of one edge line of a box about the origin."""
    out = np.zeros(len(quads), bool)
    for k in range(2):
        out |= (quads[..., k] > half[k]).all(axis=1) | (quads[..., k] < -half[k]).all(axis=1)
    return out


def workspace(bins: Sequence[Bin], T_base_table: Array, arm: ArmDescription) -> float:
    """Radius about the waist axis (mm) that the arm's work asks for: what lies beyond is forbidden."""
    c = chain(arm)
    reach = c.start + c.upper[0] + c.fore[0] + c.hand
    corners = [
        transform(T_base_table, [b.center[0] + sx * b.size[0] / 2, b.center[1] + sy * b.size[1] / 2, 0.0])
        for b in bins
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    far = max((float(np.hypot(p[0], p[1])) for p in corners), default=0.0)
    return max(far, WORK_REACH * reach)


def _violation(name: str, what: str, value: float, limit: float, unit: str = "deg") -> LimitViolation:
    return LimitViolation(f"{name}: {what} {value:.1f} {unit}, limit {limit:.1f} {unit}", "nothing has moved")
