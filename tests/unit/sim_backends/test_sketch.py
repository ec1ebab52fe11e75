"""Glances of the simulated camera show what its frames show."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from controller.config.arm import load_arm
from controller.ports import GLANCE_SCALE
from sim_backends.cell_spec import CellSpec

pytest.importorskip("mujoco", reason="the extra `sim` is not installed")
from sim_backends.cell import SimulatedCell
from sim_backends.person import Person


def test_a_glance_is_the_picture_made_small() -> None:
    arm = load_arm("reactorx_150")
    cell = SimulatedCell(CellSpec(arm, parts=6, seed=3, level="dynamic", image_size=(640, 360), disturb="hand"))
    person = Person(cell.world, cell.spec.work_area)
    person.come_from(0.9)
    person.show(np.array([220.0, 60.0]))
    cell.world.advance(0.01)
    moment = cell.world.snapshot()
    scale = 1.0 / GLANCE_SCALE
    picture = cell._painter.paint(moment)
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA).astype(np.float64)
    off = np.abs(cell._painter.glance(moment) - small).max(axis=2)
    # Rims, lit sides and the marker's pattern differ, and shadows are harder; the table and the hand do not.
    assert np.percentile(off, 75) < 6.0
    person.hide()
    cell.world.advance(0.01)
    assert (np.abs(cell._painter.glance(cell.world.snapshot()) - small).max(axis=2) > 30.0).mean() > 0.04
