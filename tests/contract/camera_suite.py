"""What every camera must do, real, replayed or simulated: the Camera port as tests."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import pytest

from controller.domain import Frame
from controller.errors import CameraLost, FrameStale
from controller.ports import GLANCE_PERIOD, GLANCE_SCALE, Camera, Clock, GlanceSource


@dataclass(frozen=True, slots=True)
class CameraCell:
    """A camera that is closed and has at least eight frames to give, and its cell's clock."""

    camera: Camera
    clock: Clock
    size: tuple[int, int]


class CameraSuite:
    """Inherit, and provide the fixture `cell`."""

    @pytest.fixture
    def camera(self, cell: CameraCell) -> Camera:
        """The camera, open; `cell` closes it."""
        cell.camera.open()
        return cell.camera

    def test_it_is_the_port(self, cell: CameraCell) -> None:
        assert isinstance(cell.camera, Camera)

    def test_a_frame_is_a_read_only_colour_picture_of_the_cameras_size(self, cell: CameraCell, camera: Camera) -> None:
        frame = camera.capture(cell.clock.now())
        assert frame.size == cell.size
        assert frame.image.shape == (cell.size[1], cell.size[0], 3)
        assert frame.image.dtype == np.uint8
        assert frame.image.flags.c_contiguous
        assert not frame.image.flags.writeable
        assert frame.source

    def test_frames_count_up_from_one(self, cell: CameraCell, camera: Camera) -> None:
        assert [camera.capture(cell.clock.now()).frame_id for _ in range(3)] == [1, 2, 3]

    @pytest.mark.parametrize("ahead", [-1.0, 0.0, 0.3])
    @pytest.mark.safety("SR-30")
    def test_a_frame_is_exposed_after_the_asked_time_and_before_now(
        self, cell: CameraCell, camera: Camera, ahead: float
    ) -> None:
        after = cell.clock.now() + ahead
        frame = camera.capture(after)
        assert after <= frame.captured_at <= cell.clock.now()

    def test_frames_are_given_out_in_the_order_of_time(self, cell: CameraCell, camera: Camera) -> None:
        first = camera.capture(0.0)
        second = camera.capture(first.captured_at)
        assert second.captured_at > first.captured_at

    def test_an_earlier_frame_stays_as_it_was(self, cell: CameraCell, camera: Camera) -> None:
        first = camera.capture(cell.clock.now())
        before = first.image.copy()
        camera.capture(cell.clock.now())
        assert np.array_equal(first.image, before)

    @pytest.mark.safety("SR-27")
    def test_a_frame_that_cannot_come_in_time_is_stale_at_the_deadline(self, cell: CameraCell, camera: Camera) -> None:
        began = cell.clock.now()
        with pytest.raises(FrameStale, match="capture"):
            camera.capture(began + 10.0, timeout=0.4)
        assert cell.clock.now() >= began + 0.4
        # Not after the time the frame was asked for, or the deadline would mean nothing.
        assert cell.clock.now() < began + 10.0
        assert camera.capture(cell.clock.now()).captured_at >= began + 0.4

    def test_a_camera_that_is_not_open_is_lost(self, cell: CameraCell) -> None:
        with pytest.raises(CameraLost, match="open"):
            cell.camera.capture(0.0)
        cell.camera.open()
        cell.camera.close()
        with pytest.raises(CameraLost, match="open"):
            cell.camera.capture(0.0)

    def test_closing_is_harmless_at_any_time(self, cell: CameraCell) -> None:
        cell.camera.close()
        cell.camera.open()
        cell.camera.close()
        cell.camera.close()

    def test_opened_again_it_goes_on(self, cell: CameraCell, camera: Camera) -> None:
        first = camera.capture(cell.clock.now())
        camera.close()
        camera.open()
        second = camera.capture(cell.clock.now())
        assert second.frame_id == first.frame_id + 1
        assert second.captured_at > first.captured_at


class GlanceSuite(CameraSuite):
    """For cameras that show what comes while nobody waits for a frame."""

    def test_glances_are_small_come_in_order_and_end(self, cell: CameraCell, camera: Camera) -> None:
        assert isinstance(camera, GlanceSource)
        told: list[Frame] = []
        camera.glance(told.append)
        while len(told) < 3:
            camera.capture(cell.clock.now())
        camera.glance(None)
        for _ in range(2):
            # The first may still be on its way.
            camera.capture(cell.clock.now())
            count = len(told)
        for _ in range(6):
            camera.capture(cell.clock.now())
        assert len(told) == count
        rows, columns = (round(side / GLANCE_SCALE) for side in cell.size[::-1])
        assert all(frame.image.shape == (rows, columns, 3) and frame.image.dtype == np.uint8 for frame in told)
        times = [frame.captured_at for frame in told]
        # A camera exposes on its own beat: a glance may be up to a frame early or late.
        assert all(later - earlier > 0.6 * GLANCE_PERIOD for earlier, later in itertools.pairwise(times))
