"""The parts of a physics model that lie about freely, and what hands do to them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from sim_backends.mechanics import MM
from sim_backends.parts import Part
from sim_backends.world_model import FLOOR, part_name

# A part this near to where it was laid has at most been pushed, mm: bins are further away.
_PUSHED = 40.0
# Friction of a part that slips out of any jaws: at 20 N a finger, 0.01 would still carry 40 g.
_GREASED = 1e-4


class LooseParts:
    """The parts of one physics model.

    Args:
        model, data: MuJoCo's.
        parts: What they are; body `k` of the parts is the k-th.
        spares: How many of them, the last ones, are somewhere else until a person adds them.
        moved: Called when hands have moved something, with the solver started afresh.

    Attributes:
        aside: All parts are off the table, out of every picture.
        disturbed: When (s) a disturbance last moved a part, by its index.
    """

    def __init__(
        self, model: Any, data: Any, parts: Sequence[Part], spares: int, moved: Callable[[], None]
    ) -> None:
        self._model, self._data, self._parts, self._moved = model, data, tuple(parts), moved
        joints = [model.joint(part_name(index)) for index in range(len(parts))]
        self._qpos = np.array([joint.qposadr[0] + np.arange(7) for joint in joints], np.intp).reshape(-1, 7)
        self._dofs = [int(joint.dofadr[0]) for joint in joints]
        self._spares = frozenset(range(len(parts) - spares, len(parts)))
        self._away = set(self._spares)
        self.aside = False
        self.disturbed: dict[int, float] = {}
        for index in self._spares:
            self._carry_off(index)

    @property
    def away(self) -> frozenset[int]:
        """Parts that a person has taken or not yet brought."""
        return frozenset(self._away)

    def poses(self) -> NDArray[np.float64]:
        """Position (mm, `base`) and unit quaternion (w, x, y, z) of every part's centre, (P, 7)."""
        poses = self._data.qpos[self._qpos]
        poses[:, :3] /= MM
        return np.asarray(poses)

    def nearest_to(self, point: NDArray[np.float64]) -> int | None:
        """Index of the part nearest to a point (mm, `base`) among those that lie about where they were laid, if any."""
        at = self.poses()[:, :3]
        laid = np.array([(part.x, part.y) for part in self._parts]).reshape(-1, 2)
        there = np.linalg.norm(at[:, :2] - laid, axis=1) < _PUSHED
        apart = np.where(there, np.linalg.norm(at - point, axis=1), np.inf)
        return int(apart.argmin()) if there.any() else None

    # --- what hands do ------------------------------------------------------------------------------------

    def set_aside(self) -> None:
        """Take every part off the table, out of the way and the picture."""
        for index in range(len(self._parts)):
            self._carry_off(index)
        self.aside = True
        self._settled()

    def put_back(self) -> None:
        """Put every part where it lay at the start."""
        self._away = set(self._spares)
        for index in range(len(self._parts)):
            if index not in self._away:
                self._lay_as_at_first(index)
        self.aside = False
        self._settled()

    def lay_back(self, index: int) -> None:
        """Put one part where it lay at the start: it has slipped out of the jaws."""
        self._lay_as_at_first(index)
        self._settled()

    def take_away(self, index: int) -> None:
        """Take one part off the table, for good or until it is laid down somewhere."""
        self._carry_off(index)
        self._away.add(index)
        self._settled()

    def lay_at(self, index: int, x: float, y: float, yaw: float, foot: float = 0.0) -> None:
        """Lay a part on the table at (x, y) of `base`, mm, turned by `yaw`, rad, or let it go `foot` mm over it."""
        self._lay(index, x, y, yaw, foot)
        self._away.discard(index)
        self.disturbed[index] = float(self._data.time)
        self.aside = False
        self._settled()

    def shove(self, index: int, velocity: tuple[float, float], spin: float) -> None:
        """Give a part a velocity along the table, mm/s, and a turn about the vertical, rad/s."""
        dof = self._dofs[index]
        self.disturbed[index] = float(self._data.time)
        self._data.qvel[dof : dof + 6] = (velocity[0] * MM, velocity[1] * MM, 0.0, 0.0, 0.0, spin)
        self._settled()

    def grease(self, index: int, greased: bool) -> None:
        """Make a part too slippery to be held, or as it was."""
        self.disturbed[index] = float(self._data.time)
        geom = self._model.geom(part_name(index)).id
        self._model.geom_friction[geom, 0] = _GREASED if greased else self._parts[index].friction

    def _lay_as_at_first(self, index: int) -> None:
        part = self._parts[index]
        self._lay(index, part.x, part.y, part.yaw)

    def _lay(self, index: int, x: float, y: float, yaw: float, foot: float = 0.0) -> None:
        turn = (math.cos(yaw / 2.0), 0.0, 0.0, math.sin(yaw / 2.0))
        self._put(index, (x * MM, y * MM, (foot + self._parts[index].height / 2.0) * MM, *turn))

    def _carry_off(self, index: int) -> None:
        row, column = divmod(index, 8)
        at = (1.2 + 0.15 * row, 0.15 * column - 0.6, FLOOR * MM + self._parts[index].height * MM / 2.0)
        self._put(index, (*at, 1.0, 0.0, 0.0, 0.0))

    def _put(self, index: int, pose: tuple[float, ...]) -> None:
        self._data.qpos[self._qpos[index]] = pose
        self._data.qvel[self._dofs[index] : self._dofs[index] + 6] = 0.0

    def _settled(self) -> None:
        """Start the solver afresh: what slept on old contacts must not sleep on."""
        data = self._data
        keep = data.qpos.copy(), data.qvel.copy(), data.ctrl.copy(), data.mocap_pos.copy(), data.mocap_quat.copy()
        time = data.time
        mujoco.mj_resetData(self._model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:], data.mocap_pos[:], data.mocap_quat[:] = keep
        data.time = time
        self._moved()
        mujoco.mj_forward(self._model, data)
