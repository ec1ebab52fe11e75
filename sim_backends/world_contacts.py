"""What the arm touches: the part between its jaws is held, everything else is a collision."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from controller.domain import ArmDescription
from sim_backends.arm_shape import LEFT, RIGHT, link_name
from sim_backends.mechanics import MM
from sim_backends.world_model import CRADLE, part_name

# Touching again within this time is the same collision, s.
_SAME_COLLISION = 0.25
# A part that both jaws held this short a time ago may brush them while it falls, s.
_LETTING_GO = 0.5

_OTHER, _LINK, _JAW, _PART, _FIXED = range(5)


@dataclass(frozen=True, slots=True)
class Collision:
    """The arm touched something else than the part between its jaws.

    Attributes:
        at: When it began, s.
        arm: What of the arm: `link3`, `finger_left`, ...
        other: What it touched: `table`, the name of a bin, or `part4`.
        disturbed: When a disturbance last moved that, s; None: never.
    """

    at: float
    arm: str
    other: str
    disturbed: float | None


class Contacts:
    """Watches the contacts of one physics model.

    Args:
        model, data: MuJoCo's.
        arm: The arm in it.
        parts: How many parts there are.
        opening: Tells the clear opening of the jaws, mm.

    Attributes:
        collisions: Every collision so far.
        held: The parts that both jaws touch.
        welcome: Parts that are there to be touched.
        disturbed: When (s) a disturbance last moved a part, by its index; kept by others.
    """

    def __init__(
        self, model: Any, data: Any, arm: ArmDescription, parts: int, opening: Callable[[], float]
    ) -> None:
        self._data = data
        self._arm = arm
        self._opening = opening
        self._tool_body = model.body(link_name(len(arm.joints) - 1)).id
        self._part_bodies = [model.body(part_name(index)).id for index in range(parts)]
        self._last_touch: dict[tuple[str, str], float] = {}
        self._last_held: dict[int, float] = {}
        self.collisions: list[Collision] = []
        self.held: frozenset[int] = frozenset()
        self.welcome: frozenset[int] = frozenset()
        self.disturbed: Mapping[int, float] = {}
        self._kinds = [_OTHER] * model.ngeom
        self._part_of = [-1] * model.ngeom
        self._names: list[str] = []
        self._classify(model)
        self._of_arm = np.isin(self._kinds, (_LINK, _JAW))

    def look(self, now: float) -> None:
        """Note who touches whom at this moment, s."""
        data = self._data
        count = data.ncon
        held: dict[int, set[str]] = {}
        between: dict[int, bool] = {}
        if count:
            pairs = data.contact.geom[:count]
            of_arm = self._of_arm[pairs]
            for first, second in pairs[of_arm[:, 0] | of_arm[:, 1]].tolist():
                mine, other = (first, second) if self._kinds[first] in (_LINK, _JAW) else (second, first)
                if self._kinds[other] < _PART:
                    continue  # the arm leans on itself
                part = self._part_of[other]
                if part >= 0 and part not in between:
                    between[part] = self._between_jaws(part)
                if part >= 0 and between[part]:
                    if self._kinds[mine] == _JAW:
                        held.setdefault(part, set()).add(self._names[mine])
                    continue
                if part not in self.welcome and now - self._last_held.get(part, -math.inf) > _LETTING_GO:
                    self._collide(self._names[mine], self._names[other], now, self.disturbed.get(part))
        self.held = frozenset(part for part, jaws in held.items() if len(jaws) == 2)
        self._last_held.update(dict.fromkeys(self.held, now))

    def forget(self) -> None:
        """Nothing is held any more: the parts were taken away by other hands."""
        self.held = frozenset()

    def _classify(self, model: Any) -> None:
        """Kind, name and part index of every geom."""
        for geom in range(model.ngeom):
            own, body = model.geom(geom).name, model.body(model.geom_bodyid[geom]).name
            self._names.append(own.split("/")[0])
            if own == CRADLE:
                continue
            if body.startswith("link"):
                self._kinds[geom] = _LINK
            elif body in (LEFT, RIGHT):
                self._kinds[geom] = _JAW
            elif body.startswith("part"):
                self._kinds[geom], self._part_of[geom] = _PART, int(body[4:])
            elif body == "world" and own != "floor":
                self._kinds[geom] = _FIXED

    def _between_jaws(self, part: int) -> bool:
        """The centre of the part lies in the space between the jaws."""
        data = self._data
        rotation = data.xmat[self._tool_body].reshape(3, 3)
        offset = data.xpos[self._part_bodies[part]] - data.xpos[self._tool_body]
        x, y, z = rotation.T @ offset / MM - self._arm.tool
        gripper = self._arm.gripper
        return bool(
            abs(y) < self._opening() / 2.0
            and abs(z) < 1.5 * gripper.jaw_size[1]
            and -25.0 < x < gripper.jaw_depth + 5.0
        )

    def _collide(self, arm: str, other: str, now: float, disturbed: float | None) -> None:
        last = self._last_touch.get((arm, other), -math.inf)
        self._last_touch[arm, other] = now
        if now - last > _SAME_COLLISION:
            self.collisions.append(Collision(now, arm, other, disturbed))
