from __future__ import annotations

import cv2
import numpy as np
import pytest

from controller.domain import Frame
from controller.errors import CameraLost, FrameStale, PictureUnusable
from controller.ports import Camera
from controller.vision.scenery import Scenery
from controller.vision.watch import WatchedCamera, is_black, is_clipped, is_torn
from sim_backends.faulty_camera import CameraFault, FaultyCamera
from sim_backends.virtual_clock import VirtualClock

PERIOD = 0.1


class NoisyCamera:
    """A grey table with the noise of a sensor, ten pictures a second."""

    def __init__(self, clock: VirtualClock, *, noise: int = 3) -> None:
        self._clock = clock
        self._noise = noise
        self._random = np.random.default_rng(1)
        self._count = 0

    def open(self) -> None: ...

    def close(self) -> None: ...

    def capture(self, after: float, timeout: float = 2.0) -> Frame:
        now = self._clock.now()
        if max(now, after) + PERIOD > now + timeout:
            self._clock.sleep(timeout)
            raise FrameStale("noisy", "capture", "late")
        self._clock.sleep(max(now, after) + PERIOD - now)
        image = (120 + self._random.integers(0, self._noise, (480, 640, 3))).astype(np.uint8)
        self._count += 1
        return Frame(self._count, self._clock.now(), image, "noisy")


def watched(*faults: CameraFault, noise: int = 3) -> tuple[WatchedCamera, VirtualClock]:
    clock = VirtualClock()
    camera = WatchedCamera(FaultyCamera(NoisyCamera(clock, noise=noise), clock, faults), clock)
    camera.open()
    return camera, clock


def test_it_is_a_camera_and_passes_good_pictures_on() -> None:
    camera, clock = watched()
    assert isinstance(camera, Camera)
    assert [camera.capture(clock.now()).frame_id for _ in range(20)] == list(range(1, 21))


@pytest.mark.parametrize(
    ("kind", "says"),
    [("black", "black: check the light"), ("overexposed", "overexposed"), ("torn", "lower part of every picture")],
)
@pytest.mark.safety("SR-31")
def test_an_unusable_picture_is_refused_while_it_lasts(kind: str, says: str) -> None:
    camera, clock = watched(CameraFault(kind, 1.0, 20.0))
    camera.capture(clock.now())
    clock.sleep(1.0)
    for _ in range(3):
        with pytest.raises(PictureUnusable, match=says):
            camera.capture(clock.now())
    clock.sleep(20.0)
    camera.capture(clock.now())


@pytest.mark.safety("SR-31")
def test_a_torn_picture_is_passed_over_and_counted() -> None:
    camera, _ = watched(CameraFault("torn", 0.0, 0.35))
    assert camera.capture(0.0).frame_id == 4
    assert camera.torn == 3


@pytest.mark.safety("SR-31")
def test_a_frozen_stream_is_refused_at_its_first_repetition_and_as_long_as_it_lasts() -> None:
    camera, clock = watched(CameraFault("frozen", 1.0, 10.0))
    camera.capture(0.0)
    clock.sleep(1.0)
    for _ in range(3):
        with pytest.raises(PictureUnusable, match="frozen"):
            camera.capture(clock.now())
    clock.sleep(10.0)
    camera.capture(clock.now())


def test_a_single_changed_pixel_in_the_sample_is_a_new_picture() -> None:
    camera, clock = watched(noise=2)
    for _ in range(50):
        camera.capture(clock.now())


def test_opening_again_does_not_make_a_frozen_picture_new() -> None:
    camera, clock = watched(CameraFault("frozen", 0.15, 5.0))
    camera.capture(clock.now())
    for _ in range(2):
        camera.close()
        camera.open()
        with pytest.raises(PictureUnusable, match="frozen"):
            camera.capture(clock.now())


@pytest.mark.parametrize(("kind", "error"), [("lost", CameraLost), ("stalled", FrameStale)])
def test_what_the_camera_says_itself_is_passed_on(kind: str, error: type[Exception]) -> None:
    camera, clock = watched(CameraFault(kind, 0.1, 5.0))
    clock.sleep(0.2)
    with pytest.raises(error):
        camera.capture(clock.now())


def test_a_lost_camera_cannot_be_opened_until_it_is_back() -> None:
    camera, clock = watched(CameraFault("lost", 1.0, 2.0))
    clock.sleep(1.0)
    with pytest.raises(CameraLost):
        camera.open()
    clock.sleep(1.0)
    camera.open()
    camera.capture(clock.now())


@pytest.mark.parametrize("kind", ["dimmed", "blurred"])
def test_a_worse_but_usable_picture_is_passed_on_changed(kind: str) -> None:
    sound, _ = watched()
    spoiled, _ = watched(CameraFault(kind, 0.0, 5.0))
    before, after = sound.capture(0.0).image, spoiled.capture(0.0).image
    assert not np.array_equal(before, after)
    assert not after.flags.writeable


def test_an_unknown_fault_is_a_mistake() -> None:
    clock = VirtualClock()
    with pytest.raises(ValueError, match="no camera fault 'blak'"):
        FaultyCamera(NoisyCamera(clock), clock, [CameraFault("blak", 0.0, 1.0)])


@pytest.mark.safety("SR-31")
def test_a_camera_that_was_moved_is_refused_while_its_scenery_is_known() -> None:
    camera, clock = watched()
    table = np.zeros((480, 640, 3), np.uint8)
    table[::40] = table[:, ::40] = 200
    camera.scenery = Scenery(cv2.GaussianBlur(table, (0, 0), 3.0).astype(np.uint8), np.full((480, 640), 255, np.uint8))
    with pytest.raises(PictureUnusable):
        camera.capture(clock.now())
    camera.scenery = None
    camera.capture(clock.now())


def test_dark_and_bright_scenes_are_not_taken_for_dead() -> None:
    picture = np.full((90, 160, 3), 12, np.uint8)
    assert is_black(picture)
    picture[:9, :16] = 60  # one part in a hundred is lit
    picture[:9, 16:32] = 60
    assert not is_black(picture)
    white = np.full((90, 160, 3), 255, np.uint8)
    assert is_clipped(white)
    white[:, :, 0] = 250  # a bright table that still has a colour
    assert not is_clipped(white)


def test_a_flat_bottom_is_torn_only_in_the_decoders_grey() -> None:
    picture = np.random.default_rng(2).integers(0, 255, (64, 64, 3)).astype(np.uint8)
    assert not is_torn(picture)
    for value, torn in ((128, True), (200, False), (0, False)):
        picture[-20:] = value
        assert is_torn(picture) is torn
    picture[-1, 0] = 90
    assert not is_torn(picture)
