"""An arm gets to know itself: ordinary moves, their log, and the figures that explain it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from controller.domain import Array, ServoCycle, Trajectory
from controller.errors import InputError, SafetyStop
from controller.motion.identification import Identification, identify, ordinary_moves
from controller.motion.planner import Planner
from controller.ports import CycleSource
from controller.service.manual import ManualCell

_LOWEST = 90.0
"""mm over the table of the grasp point in these moves: above the parts and the bins' walls."""


def identify_arm(cell: ManualCell, speed: float, progress: Callable[[str], None]) -> Identification:
    """Let the arm make its moves, log them, and fit its dynamics; parks and relaxes it at the end.

    Blocks; moves metal, empty-handed and above the parts.

    Args:
        cell: The cell, its arm open.
        speed: Share of the arm's speed limits, in (0, 1].
        progress: Takes lines for people.

    Raises:
        SafetyStop: A stop was requested; the arm holds.
        CalibrationPoorFit: The moves do not explain the arm.
        ArmError: The arm failed.
    """
    arm, description = cell.arm, cell.arm.description
    if not isinstance(arm, CycleSource):
        raise InputError(f"{description.title}: its driver keeps no log of the servos", "use a Dynamixel arm")
    planner = Planner(description, cell.calibration, cell.config.bin_values(), speed=speed)
    cycles: list[ServoCycle] = []
    moves: list[list[ServoCycle]] = []
    places = ordinary_moves(description, _LOWEST + float(cell.calibration.T_base_table[2, 3]))

    def go(plan: Callable[[Array], Trajectory]) -> None:
        if not cell.follow(plan):
            raise SafetyStop("stopped before the moves were done; the arm holds", "controller home --park, or again")

    arm.energise()
    go(planner.home)
    for count, goal in enumerate((*places, np.array(description.ready)), 1):
        cycles.clear()
        arm.listen(cycles.append)
        try:
            go(partial(planner.plan_move, "identify", goal=goal))
        finally:
            arm.listen(None)
        moves.append(list(cycles))
        progress(f"move {count} of {len(places) + 1}")
    found = identify(description, moves)
    go(planner.park)
    arm.relax()
    return found
