"""The tool tip: the closed jaws push a round part a little, and the camera sees where it comes to rest.

A marker on the gripper shows where the marker is, never where the jaws are. Where the last joint is the wrist's
pitch, its offset looks like the marker's mount, and a touch is all that tells them apart. The closed jaws are a
V-block: two edges with a gap between them, so that a disc that is pushed comes to rest in the middle before them.
How far before them follows from its diameter and cancels between pushes with the one and the other face of the jaws.
A wrist that rolls pushes with the tool turned to either side: what is the arm's stays where it is, what is the jaws'
changes its sign.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controller.calibration.arm_model import JOINT_SIGMA, MarkerView, has_roll
from controller.domain import ArmDescription, LocatedObject, Trajectory
from controller.errors import PlanError, SafetyStop
from controller.geometry import transform
from controller.motion.kinematics import chain, forward
from controller.motion.planner import Planner
from controller.ports import Arm, Clock

Array = NDArray[np.float64]

#: Pushes, to and fro by turns: eight of an arm whose wrist does not roll leave 0.2 mm where two leave 0.35 (play of the
#: joints).
PUSHES = 8
#: Roll of the wrist (rad) and face of the jaws, push by push. A quarter turn either way is within every wrist's limits.
_STRAIGHT = ((0.0, 1.0), (0.0, -1.0))
_TURNED = ((math.pi / 2, 1.0), (-math.pi / 2, 1.0), (math.pi / 2, -1.0), (-math.pi / 2, -1.0))
#: Fewer than this, or none of one kind, and nothing is made of them.
MIN_TOUCHES = 3
#: How far a part is pushed, mm: enough to slide to the middle of the jaws from 5 mm beside it.
TRAVEL = 15.0
#: The jaws come down this far from the part, mm: an uncalibrated wrist of 2 degrees misses by 4.5.
GAP = 8.0
#: A disc this much wider than the gap between the closed jaws cannot slip between them, mm.
_WIDER = 3.0
#: Of a part's centre, mm per axis: the outline of one picture.
_SEEN_SIGMA = 0.15
#: Of how far before the jaws the disc comes to lie, by the description of the jaws, mm.
REACH_SIGMA = 2.0
_SETTLE = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class Touch:
    """One push.

    Attributes:
        encoders: ndarray of shape (J,), what the servos said while the jaws stood against the part, rad.
        center: (x, y) where its centre was then seen, `table`, mm.
        height: Of the part, mm.
        radius: Of the part, mm.
        side: 1.0 when it was pushed along z of `tool`, -1.0 against it.
    """

    encoders: Array
    center: tuple[float, float]
    height: float
    radius: float
    side: float


def reach(arm: ArmDescription, radius: float) -> float:
    """How far before the middle of the closed jaws the centre of a disc comes to rest, mm."""
    gap, across = arm.gripper.opening[0] / 2.0, arm.gripper.jaw_size[1] / 2.0
    return across + math.sqrt(max(radius**2 - gap**2, 0.0))


def predict(view: MarkerView, parameters: Array, touches: Sequence[Touch], encoders: Array) -> Array:
    """Where the parts come to rest, (N, 2) in `table`, mm.

    Args:
        view: The cell.
        parameters: ndarray of shape (P + 1,): those of the view, then what is added to `reach`, mm.
        touches: The pushes.
        encoders: ndarray of shape (N, J), rad: those of the touches, or near them.
    """
    found = view.unknowns(parameters[:-1])
    T = found.T_table_base @ forward(view.arm, encoders - found.offsets)
    T[:, :3, 3] += T[:, :3, :3] @ [0.0, *found.jaws]
    side = np.array([touch.side for touch in touches])
    down, out = T[:, :3, 0], T[:, :2, 2] * side[:, None]
    ahead = out / np.linalg.norm(out, axis=1)[:, None]
    depth = view.arm.gripper.jaw_depth
    # A tool that leans touches with the tips of its jaws or at the part's upper rim, whichever is further ahead.
    rim = (np.array([touch.height for touch in touches]) - T[:, 2, 3]) / down[:, 2]
    rows = np.stack([T[:, :2, 3] + x[:, None] * down[:, :2] for x in (np.full(len(T), depth), np.minimum(rim, depth))])
    first = np.einsum("kni,ni->kn", rows, ahead).argmax(axis=0)
    before = np.array([reach(view.arm, touch.radius) for touch in touches]) + parameters[-1]
    return np.asarray(rows[first, np.arange(len(T))] + before[:, None] * ahead)


def whitener(view: MarkerView, parameters: Array, touches: Sequence[Touch]) -> Array:
    """Inverse Cholesky factors (N, 2, 2): a stretched arm's touch counts less, for its joints have play."""
    encoders = np.array([touch.encoders for touch in touches])
    step = 1e-5
    by_joint = np.empty((len(touches), 2, encoders.shape[1]))
    for joint in range(encoders.shape[1]):
        turn = np.zeros(encoders.shape[1])
        turn[joint] = step
        ahead = predict(view, parameters, touches, encoders + turn)
        by_joint[:, :, joint] = (ahead - predict(view, parameters, touches, encoders - turn)) / (2 * step)
    covariance = _SEEN_SIGMA**2 * np.eye(2) + JOINT_SIGMA**2 * by_joint @ by_joint.transpose(0, 2, 1)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


def push_part(
    arm: Arm,
    clock: Clock,
    planner: Planner,
    look: Callable[[], LocatedObject | None],
    pushes: int,
    progress: Callable[[str], None],
) -> list[Touch]:
    """Push the round part on the table to and fro, and look at it after each push.

    Moves metal; blocks for about five seconds a push. An empty list, after a word of `progress`, when there is no
    such part.

    Args:
        arm: Energised; it must stand where a plan may start.
        clock: The cell's.
        planner: With the arm as far as it is calibrated.
        look: The only round part in the work area, or None; the arm stands out of the view.
        pushes: How many.
        progress: Called with one line before each push.

    Raises:
        SafetyStop: A stop was requested.
        ArmError, CameraError: A device failed.
    """
    _follow(arm, planner.home(arm.state().positions))
    clock.sleep(_SETTLE)
    part = look()
    if part is None:
        progress("no single round part lies in the work area: the tool tip is not measured")
        return []
    if part.size[0] < arm.description.gripper.opening[0] + _WIDER:
        progress(f"a part of {part.size[0]:.0f} mm would slip between the closed jaws: the tool tip is not measured")
        return []
    touches: list[Touch] = []
    ways = _TURNED if has_roll(arm.description) else _STRAIGHT
    for index in range(pushes):
        progress(f"push {index + 1} of {pushes}")
        roll, side = ways[index % len(ways)]
        encoders = _push(arm, planner, part, roll, side, progress)
        if encoders is None:
            continue
        clock.sleep(_SETTLE)
        part = look()
        if part is None:
            progress("the round part is not seen any more")
            break
        touches.append(Touch(encoders, part.center, part.height, part.size[0] / 2.0, side))
    return touches


def _push(
    arm: Arm, planner: Planner, part: LocatedObject, roll: float, side: float, progress: Callable[[str], None]
) -> Array | None:
    """Push once; what the servos said at the end of the push, or None when it cannot be planned."""
    T_base_table = planner.calibration.T_base_table
    x, y, _ = transform(T_base_table, [*part.center, 0.0])
    axis = chain(arm.description).axis[0]
    # The tool's z in `base`: outwards, less the wrist's roll.
    heading = math.atan2(y, x - axis) - roll
    ahead = side * (T_base_table[:3, :3].T @ [math.cos(heading), math.sin(heading), 0.0])[:2]
    start = np.array(part.center) - ahead * (reach(arm.description, part.size[0] / 2.0) + GAP)
    beside = float(start[0]), float(start[1])
    x, y, _ = transform(T_base_table, [*start, 0.0])
    turned = math.atan2(y, x - axis) - heading if roll else 0.0
    try:
        approach, push, retreat = planner.plan_touch(
            part, beside, ahead * (GAP + TRAVEL), turned, arm.state().positions
        )
    except PlanError as error:
        progress(f"push left out: {error.cause}")
        return None
    _follow(arm, approach, arm.description.gripper.opening[0])
    _follow(arm, push)
    encoders = np.asarray(arm.state().positions)
    _follow(arm, retreat)
    return encoders


def _follow(arm: Arm, move: Trajectory, opening: float | None = None) -> None:
    if not arm.follow(move, opening).finished:
        raise SafetyStop("stopped on request", "start again")
