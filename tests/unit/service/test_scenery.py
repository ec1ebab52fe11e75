"""The reference of a real cell's scenery: learnt once a calibration, kept over restarts, never by half."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from controller.backends import nominal_camera
from controller.config.cell import load_cell
from controller.config.files import shipped
from controller.cycle.guard import ClearView
from controller.domain import CellCalibration, Frame
from controller.errors import CameraLost, PictureUnusable
from controller.service.scenery import clear_view, look_before_work, watch_scenery
from controller.vision.watch import WatchedCamera
from sim_backends.virtual_clock import VirtualClock

Image = NDArray[np.uint8]


class OnePicture:
    """Shows one picture again and again, with a sensor's noise."""

    def __init__(self, image: Image, clock: VirtualClock, seed: int) -> None:
        self.image = image
        self._clock = clock
        self._random = np.random.default_rng(seed)

    def open(self) -> None: ...

    def close(self) -> None: ...

    def capture(self, after: float, timeout: float = 2.0) -> Frame:
        noise = self._random.integers(0, 3, self.image.shape, dtype=np.uint8)
        return Frame(1, self._clock.now(), np.asarray(self.image + noise, np.uint8), "still")


@pytest.fixture(scope="module")
def table() -> Image:
    grain = np.random.default_rng(0).normal(0.0, 60.0, (720, 1280)).astype(np.float32)
    gray = np.clip(130.0 + cv2.GaussianBlur(grain, (0, 0), 6.0), 0, 240).astype(np.uint8)
    return np.asarray(cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), np.uint8)


def look(image: Image, folder: Path | None, name: str = "first", seed: int = 1) -> None:
    """Start, watch, and look once."""
    config, clock = load_cell(shipped("sim.toml")), VirtualClock()
    camera, T_table_camera = nominal_camera(config)
    calibration = CellCalibration(name, camera, T_table_camera, config.table.T_base_table())
    watched = WatchedCamera(OnePicture(image, clock, seed), clock)
    watch_scenery(watched, config, calibration, folder)
    watched.capture(clock.now())


def moved(image: Image) -> Image:
    return np.asarray(np.roll(image, 7, axis=1), np.uint8)


def test_a_camera_that_was_moved_between_two_starts_is_noticed(table: Image, tmp_path: Path) -> None:
    look(table, tmp_path)
    look(table, tmp_path, seed=2)
    with pytest.raises(PictureUnusable, match="moved"):
        look(moved(table), tmp_path)


def test_another_calibration_begins_with_another_reference(table: Image, tmp_path: Path) -> None:
    look(table, tmp_path)
    look(moved(table), tmp_path, "second")
    assert [path.name for path in tmp_path.iterdir()] == ["scenery-second.png"]


def test_without_a_folder_every_start_learns_anew(table: Image) -> None:
    look(table, None)
    look(moved(table), None)


def test_a_damaged_reference_is_learnt_again(table: Image, tmp_path: Path) -> None:
    (tmp_path / "scenery-first.png").write_bytes(b"\x89PNG")
    look(table, tmp_path)
    with pytest.raises(PictureUnusable, match="moved"):
        look(moved(table), tmp_path)


def calibrated(name: str) -> CellCalibration:
    config = load_cell(shipped("sim.toml"))
    camera, T_table_camera = nominal_camera(config)
    return CellCalibration(name, camera, T_table_camera, config.table.T_base_table())


@pytest.mark.safety("SR-36")
def test_how_the_table_looks_with_nothing_over_it_outlives_the_program(tmp_path: Path) -> None:
    small = np.random.default_rng(0).uniform(0.0, 255.0, (90, 160, 3)).astype(np.float32)
    clear_view(calibrated("first"), tmp_path).learn(small)
    kept = clear_view(calibrated("first"), tmp_path).image
    assert kept is not None
    np.testing.assert_allclose(kept, small, atol=0.5 + 1e-3)
    assert clear_view(calibrated("second"), tmp_path).image is None
    clear_view(calibrated("second"), tmp_path).learn(small)
    assert [path.name for path in tmp_path.iterdir()] == ["clear-view-second.png"]


def test_half_a_view_is_none(tmp_path: Path) -> None:
    (tmp_path / "clear-view-first.png").write_bytes(b"\x89PNG")
    assert clear_view(calibrated("first"), tmp_path).image is None


@pytest.mark.safety("SR-36")
def test_what_is_seen_before_the_work_is_the_clear_view_of_a_cell_that_knows_none(table: Image) -> None:
    clock, view = VirtualClock(), ClearView()
    look_before_work(view, OnePicture(table, clock, 1), clock, 1.0)
    known = view.image
    assert known is not None
    look_before_work(view, OnePicture(moved(table), clock, 1), clock, 1.0)
    assert view.image is known


def test_a_camera_that_gives_no_picture_before_the_work_leaves_it_to_the_first_look(table: Image) -> None:
    class Lost(OnePicture):
        def capture(self, after: float, timeout: float = 2.0) -> Frame:
            raise CameraLost("/dev/video0", "capture", "unplugged")

    clock, view = VirtualClock(), ClearView()
    look_before_work(view, Lost(table, clock, 1), clock, 1.0)
    assert view.image is None
