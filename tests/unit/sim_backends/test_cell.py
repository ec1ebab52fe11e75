"""The whole simulated cell: its description, its ports, and that equal seeds are equal cells."""

from __future__ import annotations

import json
import math

import cv2
import numpy as np
import pytest

from controller.domain import Shape
from controller.errors import CameraLost, FrameStale
from controller.ports import Camera, Clock, Presenter
from sim_backends.camera import EXPOSURE
from sim_backends.cell import SimulatedCell
from sim_backends.cell_spec import CellSpec
from tests.unit.sim_backends.rig import ARM, BINS


def spec(**changes: object) -> CellSpec:
    options: dict[str, object] = {"parts": 5, "level": "static", "seed": 3, "image_size": (640, 360)}
    return CellSpec(ARM, BINS, **{**options, **changes})  # type: ignore[arg-type]  # a table of options


@pytest.fixture(scope="module")
def cell() -> SimulatedCell:
    made = SimulatedCell(spec())
    made.camera.open()
    return made


def test_a_spec_survives_the_way_through_json() -> None:
    full = spec(overrides={"noise": 2.0, "friction": (0.3, 0.4)}, level="dynamic")
    assert CellSpec.from_json(full.to_json()) == full
    assert json.loads(full.to_json())["arm"]["name"] == "reactorx_150"


def test_the_cell_offers_the_ports(cell: SimulatedCell) -> None:
    assert isinstance(cell.camera, Camera)
    assert isinstance(cell.clock, Clock)
    assert isinstance(cell.presenter, Presenter)
    assert cell.bus_servos == [(n, "XM430-W350" if n <= 3 else "XL430-W250") for n in range(1, 7)]


def test_a_frame_is_exposed_after_the_moment_asked_for_and_delivered_late(cell: SimulatedCell) -> None:
    asked = cell.clock.now() + 0.1
    frame = cell.camera.capture(asked)
    assert frame.captured_at - EXPOSURE >= asked - 1e-9
    assert frame.captured_at - asked < 0.05
    # Delivery: the latency after the end of the exposure, to a step of the world.
    assert cell.clock.now() - frame.captured_at == pytest.approx(cell.imperfections.latency, abs=0.003)
    assert frame.image.shape == (360, 640, 3)
    with pytest.raises(ValueError, match="read-only"):
        frame.image[0, 0] = 0


def test_frames_are_numbered(cell: SimulatedCell) -> None:
    first, second = (cell.camera.capture(cell.clock.now()) for _ in range(2))
    assert second.frame_id == first.frame_id + 1
    assert second.captured_at > first.captured_at


def test_a_frame_from_the_far_future_is_not_waited_for(cell: SimulatedCell) -> None:
    before = cell.clock.now()
    with pytest.raises(FrameStale):
        cell.camera.capture(before + 10.0, timeout=0.5)
    assert cell.clock.now() - before == pytest.approx(0.5, abs=0.003)


def test_what_rounding_leaves_of_a_deadline_is_not_waited_for(cell: SimulatedCell) -> None:
    before = cell.clock.now()
    with pytest.raises(FrameStale):
        cell.camera.capture(before + 10.0, timeout=1e-15)
    assert cell.clock.now() == before


def test_a_closed_camera_has_no_frames() -> None:
    with pytest.raises(CameraLost):
        SimulatedCell(spec(parts=1, image_size=(160, 90))).camera.capture(0.0)


def test_equal_specs_are_equal_cells_and_other_seeds_are_not() -> None:
    def picture(seed: int) -> bytes:
        made = SimulatedCell(spec(seed=seed, level="dynamic"))
        made.camera.open()
        made.clock.sleep(0.2)
        return made.camera.capture(0.0).image.tobytes()

    assert picture(3) == picture(3)
    assert picture(3) != picture(4)


def test_truth_is_told_in_the_frame_of_the_laid_sheet(cell: SimulatedCell) -> None:
    truth = cell.truth()
    assert [t.place for t in truth] == ["table"] * 5
    assert all(t.upright and t.reachable for t in truth)
    for told, part in zip(truth, cell.world.parts, strict=True):
        at = cell.T_base_table @ (*told.center, 0.0, 1.0)
        assert at[:2] == pytest.approx([part.x, part.y], abs=0.05)
        if told.shape is Shape.CIRCLE:
            assert told.yaw is None
        else:
            period = told.shape.period
            assert told.yaw is not None
            assert period is not None
            assert 0.0 <= told.yaw < period
            turn = part.yaw - cell.imperfections.sheet_turn - told.yaw
            assert math.remainder(turn, period) == pytest.approx(0.0, abs=1e-3)
    # The sheet was laid by hand: its frame is not the nominal one.
    assert np.abs(cell.T_base_table - np.array(cell.spec.T_base_table)).max() > 0.1


def test_the_past_of_the_truth_is_kept(cell: SimulatedCell) -> None:
    frame = cell.camera.capture(cell.clock.now())
    before = cell.truth()
    cell.set_aside()
    assert {t.place for t in cell.truth()} == {"floor"}
    assert cell.truth_at(frame.captured_at) == before
    cell.scatter()


def test_the_picture_shows_the_parts_where_the_truth_has_them() -> None:
    """The middle of a coloured blob, against the lens applied to the truth by hand."""
    seen = SimulatedCell(spec(level="static", parts=1, image_size=(1280, 720), overrides={"shadow_depth": 0.0}))
    seen.camera.open()
    image = seen.camera.capture(0.0).image
    told = seen.truth()[0]
    low = seen.T_base_table @ (*told.center, 0.0, 1.0)
    camera = np.linalg.inv(seen.lens.T_base_camera)
    (u, v), = cv2.projectPoints(
        (camera @ (low[0], low[1], told.height / 2.0, 1.0))[:3].reshape(1, 1, 3),
        np.zeros(3), np.zeros(3), seen.lens.matrix, seen.lens.distortion,
    )[0].reshape(-1, 2)  # fmt: skip
    saturation = cv2.cvtColor(image, cv2.COLOR_BGR2HSV)[..., 1]
    rows, columns = np.nonzero(saturation[round(v) - 80 : round(v) + 80, round(u) - 80 : round(u) + 80] > 110)
    # Half the height is a good plane for the silhouette's centroid: 0.4 mm, less than a pixel.
    assert (columns.mean() + round(u) - 80, rows.mean() + round(v) - 80) == pytest.approx((u, v), abs=1.5)


def test_held_boards_are_about_where_they_were_asked_for(cell: SimulatedCell) -> None:
    wanted = np.eye(4)
    wanted[:3, 3] = (20.0, -10.0, 400.0)
    cell.presenter.hold(np.full((210, 297), 255, np.uint8), 1.0, wanted)
    board = cell.presenter.board
    assert board is not None
    off = np.linalg.inv(cell.lens.T_base_camera @ wanted) @ board.T_base_print
    assert 0.1 < np.linalg.norm(off[:3, 3]) < 25.0  # 4 mm of standard deviation an axis
    assert np.degrees(np.arccos((np.trace(off[:3, :3]) - 1.0) / 2.0)) < 15.0
    image = cell.camera.capture(cell.clock.now()).image
    assert image[180, 320].min() > 150  # paper
    cell.presenter.remove()
    assert cell.camera.capture(cell.clock.now()).image[180, 320].max() < 230


def test_the_overview_shows_the_cell(cell: SimulatedCell) -> None:
    picture = cell.overview((640, 360))
    assert picture.shape == (360, 640, 3)
    hues = cv2.cvtColor(picture, cv2.COLOR_BGR2HSV)
    assert (hues[..., 1] > 120).sum() > 2000  # coloured parts
    assert (picture.max(axis=2) < 60).sum() > 5000  # the dark arm
