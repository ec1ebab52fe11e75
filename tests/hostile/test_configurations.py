"""Configurations, recipes, arms, taught bins and fault scripts with anything in them: refused with words, or usable."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.backends import nominal_camera
from controller.config.arm import load_arm
from controller.config.cell import load_cell
from controller.config.files import shipped
from controller.config.taught import load_taught, with_taught
from controller.cycle.preflight import check
from controller.domain import CellCalibration
from controller.errors import PlanError, SorterError
from controller.motion.planner import Planner
from controller.vision.recipe import load_recipe
from sim_backends.fault_script import load_script
from tests.hostile.mutations import HOSTILE, as_toml, mutated, spoiled


def document(name: str) -> dict[str, Any]:
    return tomllib.loads(shipped(name).read_text(encoding="utf-8"))


def _bins_file() -> dict[str, Any]:
    return {"bins": [{"name": "squares", "center_mm": [-190.0, 226.0]}, {"name": "circles", "center_mm": [0.0, 200.0]}]}


READERS: dict[str, tuple[dict[str, Any], Callable[[Path], object]]] = {
    "cell": (document("cell.toml"), load_cell),
    "recipe": (document("recipes/precise.toml"), lambda path: load_recipe(str(path))),
    "arm": (document("arms/reactorx_150.toml"), lambda path: load_arm(str(path))),
    "bins": (_bins_file(), load_taught),
    "faults": (document("faults/bad_day.toml"), load_script),
}


def test_the_documents_are_in_order_before_they_are_spoiled(tmp_path: Path) -> None:
    for name, (content, read) in READERS.items():
        (tmp_path / "file.toml").write_text(as_toml(content), encoding="utf-8")
        assert read(tmp_path / "file.toml"), name


@pytest.mark.safety("SR-43")
@pytest.mark.parametrize("name", READERS)
@HOSTILE
@given(data=st.data())
def test_any_content_is_read_or_refused_in_one_line(name: str, data: st.DataObject, tmp_path: Path) -> None:
    content, read = READERS[name]
    text = as_toml(data.draw(mutated(content)))
    path = tmp_path / "file.toml"
    raw = text.encode("utf-8", "surrogatepass")
    path.write_bytes(data.draw(spoiled(raw)) if data.draw(st.booleans()) else raw)
    _read_or_refused(read, path)


def _read_or_refused(read: Callable[[Path], object], path: Path) -> None:
    try:
        read(path)
    except SorterError as error:
        assert "\n" not in str(error).strip()


@pytest.mark.safety("SR-43", "SR-11")
@HOSTILE
@given(data=st.data())
def test_a_configuration_that_is_accepted_yields_only_moves_within_limits(data: st.DataObject, tmp_path: Path) -> None:
    """What gets through the reader goes on as in a run: judged with the arm, planned with, approved by the gate."""
    path = tmp_path / "cell.toml"
    path.write_bytes(as_toml(data.draw(mutated(document("cell.toml")))).encode("utf-8", "surrogatepass"))
    try:
        config = load_cell(path)
        arm = load_arm(config.arm.description)
        camera, T_table_camera = nominal_camera(config)
        calibration = CellCalibration("by ruler", camera, T_table_camera, config.table.T_base_table())
        speed = config.arm.speed_percent / 100.0
        planner = Planner(arm, calibration, config.bin_values(), speed=speed)
        check(config, arm, planner)
        moves = [planner.home(np.array(arm.rest)), planner.park(np.array(arm.ready))]
    except (SorterError, PlanError):
        return
    for move in moves:
        assert np.isfinite(move.goals).all()
        step = np.abs(np.diff(move.positions, axis=0)).max(axis=0) / move.period
        limits = np.array([joint.speed_limit for joint in arm.joints])
        # The gate allows sampling two percent over the planned limit.
        assert (step <= 1.02 * speed * limits).all()


@HOSTILE
@given(data=st.data())
def test_taught_bins_never_make_a_cell_that_its_own_checks_refuse_to_name(data: st.DataObject, tmp_path: Path) -> None:
    path = tmp_path / "bins.toml"
    path.write_bytes(as_toml(data.draw(mutated(_bins_file()))).encode("utf-8", "surrogatepass"))
    cell = load_cell(shipped("cell.toml"))
    try:
        moved = with_taught(cell, path)
    except SorterError:
        return
    assert {bin_.name for bin_ in moved.bins} == {bin_.name for bin_ in cell.bins}
    assert all(np.isfinite(bin_.center_mm).all() for bin_ in moved.bins)
