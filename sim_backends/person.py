"""A person at the simulated table: a hand that the camera sees, and what it does to the parts.

The hand touches nothing by physics: it covers the view while it works, and what it has done shows when it is gone.
"""

from __future__ import annotations

import math

import numpy as np

from sim_backends.parts import Part, WorkArea, placed, somewhere
from sim_backends.parts import gap as gap_between
from sim_backends.solids import Array, Solid, box
from sim_backends.world import World
from sim_backends.world_model import HAND

_SKIN = (118.0, 148.0, 205.0)
_SLEEVE = (96.0, 72.0, 60.0)
SPEED = 900.0  # mm/s of a hand that reaches somewhere
_HEIGHT = 28.0  # of the fingertips over the table, mm: at the upper rim of the parts
_OUT = 420.0  # from the middle of the table to where no camera sees the fingertips, mm
_ROOM = 4.0  # mm that a person leaves between parts, at least
_ARM_NEAR, _ARM_LOW = 90.0, 160.0  # mm: nobody reaches under an arm that comes down
_TRIES = 200
_RIM = 20.0  # mm beyond the work area where a part still is within a person's reach


def hand_solids() -> tuple[Solid, ...]:
    """A right hand with its forearm; the fingertips at the origin, the arm towards -x, mm."""

    def block(low: tuple[float, float, float], high: tuple[float, float, float], colour: tuple[float, ...]) -> Solid:
        return box(low, high, body=HAND, colour=(colour[0], colour[1], colour[2]), chamfer=6.0)

    fingers = [block((-75.0, -40.0 + 20.0 * k, 4.0), (5.0, -22.0 + 20.0 * k, 22.0), _SKIN) for k in range(4)]
    return (
        *fingers,
        block((-105.0, 38.0, 2.0), (-30.0, 58.0, 22.0), _SKIN),
        block((-165.0, -43.0, 4.0), (-70.0, 43.0, 34.0), _SKIN),
        block((-265.0, -30.0, 8.0), (-160.0, 30.0, 54.0), _SKIN),
        block((-640.0, -42.0, 4.0), (-260.0, 42.0, 80.0), _SLEEVE),
    )


class Person:
    """Reaches over the table and takes, lays and swaps parts.

    Args:
        world: The world, built with `hand_solids` as its hand.
        area: Where parts may be laid.
    """

    def __init__(self, world: World, area: WorkArea) -> None:
        self._world = world
        self._area = area
        middle, azimuth = sum(area.radius) / 2.0, sum(area.azimuth) / 2.0
        self._middle = middle * np.array([math.cos(azimuth), math.sin(azimuth)])
        self._side = 0.0

    # --- the hand ---------------------------------------------------------------------------------------

    def come_from(self, side: float) -> None:
        """Choose from where the hand reaches in: rad, 0 from ahead of the arm, positive from its left."""
        self._side = side

    def outside(self) -> Array:
        """Where the fingertips are before they come in and after they have gone, (x, y) in `base`, mm."""
        return self._middle + _OUT * np.array([math.cos(self._side), math.sin(self._side)])

    def show(self, at: Array) -> None:
        """The fingertips are at (x, y) of `base`, mm, the forearm points out of the picture."""
        yaw = self._side + math.pi
        pose = np.eye(4)
        pose[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
        pose[:3, 3] = (*at, _HEIGHT)
        self._world.show_hand(pose)

    def hide(self) -> None:
        """The hand is gone."""
        self._world.show_hand(None)

    # --- what it may do -----------------------------------------------------------------------------------

    def on_table(self) -> list[int]:
        """Parts that stand on the table within the work area and that nobody holds."""
        poses = self._world.loose.poses()
        held, away = self._world.held, self._world.loose.away
        return [
            index
            for index, pose in enumerate(poses)
            if index not in held and index not in away and self._inside(pose[:2]) and self._stands(index, pose)
        ]

    def place(self, index: int) -> Array:
        """Where a part is, (x, y) in `base`, mm."""
        return np.asarray(self._world.loose.poses()[index, :2])

    def yaw(self, index: int) -> float:
        """How a standing part is turned, rad."""
        w, _, _, z = self._world.loose.poses()[index, 3:]
        return 2.0 * math.atan2(float(z), float(w))

    def arm_is_in_the_way(self, at: Array) -> bool:
        """The gripper is at work where the hand would go."""
        tool = self._world.tool_pose()[:3, 3]
        return bool(tool[2] < _ARM_LOW and float(np.linalg.norm(tool[:2] - at)) < _ARM_NEAR)

    def room_for(self, part: Part, random: np.random.Generator) -> tuple[Array, float] | None:
        """A free place and turn for a part, (x, y) in `base`, mm, and rad; None when none is found."""
        others = self._outlines()
        for _ in range(_TRIES):
            x, y, yaw = somewhere(random, self._area)
            at = np.array([x, y])
            if self._fits(part, at, yaw, others, _ROOM):
                return at, yaw
        return None

    def is_free(self, part: Part, at: Array, yaw: float) -> bool:
        """Whether a part can be laid at (x, y) of `base`, mm, turned by `yaw`, without touching another or the arm."""
        return self._fits(part, at, yaw, self._outlines(), 0.0)

    def _fits(self, part: Part, at: Array, yaw: float, others: list[Array], least: float) -> bool:
        if self.arm_is_in_the_way(at):
            return False
        here = placed(part.outline, float(at[0]), float(at[1]), yaw)
        return all(gap_between(here, other) > least for other in others)

    def _outlines(self) -> list[Array]:
        """Where the parts lie, each as (N, 2), `base`, mm."""
        poses = self._world.loose.poses()
        parts = self._world.parts
        return [
            placed(parts[i].outline, float(poses[i, 0]), float(poses[i, 1]), self.yaw(i)) for i in self.on_table()
        ]

    def _inside(self, at: Array) -> bool:
        radius, azimuth = float(np.hypot(*at)), math.atan2(at[1], at[0])
        (near, far), (right, left) = self._area.radius, self._area.azimuth
        return near - _RIM < radius < far + _RIM and right - _RIM / near < azimuth < left + _RIM / near

    def _stands(self, index: int, pose: Array) -> bool:
        return abs(float(pose[2]) - self._world.parts[index].height / 2.0) < 2.0
