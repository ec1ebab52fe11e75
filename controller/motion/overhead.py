"""How high the tool passes: over parts and walls everywhere, over what lies in a bin where it passes that bin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from controller.domain import ArmDescription, Array, Bin, Point
from controller.geometry import invert, transform
from controller.motion.gate import BIN_ASTRAY
from controller.motion.grasps import TIP_HEIGHT
from controller.motion.kinematics import chain

CLEARANCE = 10.0  # mm over walls and parts in transit
TALLEST_PART = 30.0  # mm: assumed to lie where nothing was seen
PART_BELOW_TIPS = TIP_HEIGHT
_SAMPLES = 33  # of a way: 25 mm apart on half a turn at 260 mm, a quarter of a bin


@dataclass(frozen=True, slots=True, eq=False)
class Overhead:
    """Heights of the grasp point over the table at which jaw tips and a held part pass over what is below.

    Attributes:
        arm: The arm.
        T_base_table: ndarray of shape (4, 4), mm.
        bins: All bins.
        piles: Height over the table that what lies in a bin may reach, mm, by its name; unknown where missing.
    """

    arm: ArmDescription
    T_base_table: Array
    bins: Sequence[Bin]
    piles: Mapping[str, float] = field(default_factory=dict)

    @property
    def walls(self) -> float:
        """Over all parts on the table and the walls of all bins, mm."""
        return self._over(max([TALLEST_PART, *(bin_.height for bin_ in self.bins)]))

    def between(self, first: Point, last: Point) -> float:
        """Over what lies in the bins on the way as well, mm.

        Bins at its ends do not count: the arm leaves and enters them straight up and down.

        Args:
            first: (x, y) where the way begins, `table`, mm.
            last: Where it ends.
        """
        way = self._way(first, last)
        jaws = self.arm.gripper.opening[1] / 2.0 + self.arm.gripper.jaw_size[0] + BIN_ASTRAY
        highest = self.walls
        for bin_ in self.bins:
            beside = np.maximum(np.abs(way - bin_.center) - np.array(bin_.size) / 2.0, 0.0)
            gap = np.hypot(*beside.T)
            if gap.min() < jaws and gap[0] > 0.0 and gap[-1] > 0.0:
                highest = max(highest, self._over(self.piles.get(bin_.name, bin_.height)))
        return highest

    def _over(self, height: float) -> float:
        return height + CLEARANCE + PART_BELOW_TIPS + self.arm.gripper.jaw_depth

    def _way(self, first: Point, last: Point) -> Array:
        """Points (N, 2) in `table` that the tool passes while the waist turns and the reach changes evenly, mm."""
        axis = chain(self.arm).axis[0]
        out = transform(self.T_base_table, np.array([[*first, 0.0], [*last, 0.0]])) - (axis, 0.0, 0.0)
        polar = np.column_stack([np.arctan2(out[:, 1], out[:, 0]), np.hypot(out[:, 0], out[:, 1]), out[:, 2]])
        turn, reach, level = (polar[0] + np.linspace(0.0, 1.0, _SAMPLES)[:, None] * (polar[1] - polar[0])).T
        base = np.column_stack([axis + reach * np.cos(turn), reach * np.sin(turn), level])
        return transform(invert(self.T_base_table), base)[:, :2]
