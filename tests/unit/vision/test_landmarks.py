"""Corner markers: at their places to a tenth of a pixel, or the cell must hold."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from controller.domain import Frame
from controller.errors import PictureUnusable
from controller.vision.landmarks import DICTIONARY, IDS, Landmarks, find_landmarks
from controller.vision.watch import WatchedCamera
from sim_backends.virtual_clock import VirtualClock

Image = NDArray[np.uint8]


def table(shift: tuple[float, float] = (0.0, 0.0), hidden: tuple[int, ...] = ()) -> Image:
    """A grainy table with markers in its corners, seen from a camera that was shifted by so many px."""
    picture = np.full((720, 1280), 150, np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARY))
    for name, (x, y) in zip(IDS, ((80, 60), (1130, 70), (70, 590), (1120, 600)), strict=True):
        if name not in hidden:
            picture[y - 12 : y + 72, x - 12 : x + 72] = 235
            picture[y : y + 60, x : x + 60] = cv2.aruco.generateImageMarker(dictionary, name, 60)
    move = np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]]])
    picture = np.asarray(cv2.warpAffine(picture, move, (1280, 720), borderValue=(150.0,)), np.uint8)
    soft = cv2.GaussianBlur(picture, (0, 0), 0.8).astype(float)
    noisy = soft + np.random.default_rng(int(10 * shift[0]) + len(hidden)).normal(0.0, 3.0, soft.shape)
    return np.asarray(cv2.cvtColor(np.clip(noisy, 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR), np.uint8)


@pytest.fixture(scope="module")
def landmarks() -> Landmarks:
    return Landmarks(find_landmarks(table()))


def test_every_marker_is_found(landmarks: Landmarks) -> None:
    assert set(landmarks.places) == set(IDS)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (1.5, 0.0), (0.0, -4.0), (200.0, 40.0)])
def test_a_move_is_measured(landmarks: Landmarks, shift: tuple[float, float]) -> None:
    found = landmarks.displacement(table(shift))
    assert found is not None
    # Corners of a marker 60 px wide, with noise: a tenth of a pixel and what interpolation adds.
    assert found == pytest.approx(np.hypot(*shift), abs=0.25)


def test_a_hidden_marker_says_nothing(landmarks: Landmarks) -> None:
    found = landmarks.displacement(table(hidden=(1, 2, 4)))
    assert found is not None
    assert found < 0.3
    assert landmarks.displacement(table(hidden=IDS)) is None


class Shifting:
    """A camera that somebody bumps into after its second picture."""

    def __init__(self) -> None:
        self.shifts = iter(((0.0, 0.0), (0.1, 0.0), (1.6, 0.9)))

    def open(self) -> None: ...

    def close(self) -> None: ...

    def capture(self, after: float, timeout: float = 2.0) -> Frame:
        return Frame(1, after, table(next(self.shifts)), "cam")


def test_a_bumped_camera_is_not_believed(landmarks: Landmarks) -> None:
    camera = WatchedCamera(Shifting(), VirtualClock())
    camera.landmarks = landmarks
    camera.capture(0.0)
    camera.capture(0.1)
    with pytest.raises(PictureUnusable, match="corner markers") as caught:
        camera.capture(0.2)
    assert caught.value.code == "moved"
    assert "recalibrate" in caught.value.remedy
