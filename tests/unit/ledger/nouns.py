"""A ledger, and a plan and its outcome with distinct values in every field, so that a swapped column shows."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from controller.domain import (
    Bin,
    Descriptors,
    Detection,
    Frame,
    Grasp,
    LocatedObject,
    Outcome,
    PickPlan,
    Result,
    Shape,
    Trajectory,
)
from controller.ledger import SqliteLedger
from sim_backends.virtual_clock import VirtualClock

WALL = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
FRAME = Frame(17, 3.25, np.zeros((4, 6, 3), np.uint8), "camera")
_MOVE = Trajectory("approach", 0.01, np.zeros((2, 5)), np.zeros((2, 5)))


def opened(path: Path, *, begin: bool = True) -> SqliteLedger:
    ledger = SqliteLedger(path, clock=VirtualClock(100.0), wall=lambda: WALL)
    if begin:
        ledger.begin_run(software_version="1.2", config_hash="abc", calibration_id="cal-1", mode="sim", arm="a", seed=7)
    return ledger


def target(target_id: str = "t1", *, yaw: float | None = math.radians(30.0)) -> LocatedObject:
    detection = Detection(
        frame=FRAME,
        shape=Shape.HEXAGON,
        score=0.75,
        outline_px=np.zeros((6, 2)),
        center_px=(1.0, 2.0),
        size_px=(40.0, 35.0),
        angle=0.1,
        area_px=1200.0,
        bbox_px=(0.0, 0.0, 40.0, 35.0),
        descriptors=Descriptors(1.3, 1.1, 2.0),
        label="nut",
        colour="red",
    )
    return LocatedObject(
        detection, (12.5, -40.25), yaw, (46.0, 39.0), 22.0, np.zeros((6, 2)), 0.3, "cal-1", target_id
    )


def plan(target_id: str = "t1") -> PickPlan:
    grasp = Grasp((12.0, -41.0), 11.0, math.radians(60.0), 39.5, 52.0, 4.5, 39.5)
    bin_ = Bin("left", (0.0, 200.0), (90.0, 90.0), 35.0, 20)
    return PickPlan(target(target_id), bin_, grasp, _MOVE, _MOVE, _MOVE)


def outcome(target_id: str = "t1", result: Result = Result.PLACED, *, attempts: int = 1) -> Outcome:
    return Outcome(target(target_id), plan(target_id), result, "seen in the bin", attempts, 4.0, 8.5)
