"""Seeing what is plugged in, taking one picture, focusing by a figure."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from controller.cli import camera as room
from controller.cli import execute
from controller.config.cell import CellConfig
from controller.domain import Frame
from controller.errors import CameraLost
from drivers.camera.listing import CameraListing
from sim_backends.virtual_clock import VirtualClock

WEBCAM = CameraListing("/dev/video0", "A webcam", ("/dev/v4l/by-id/usb-maker_webcam_1234-video-index0",))


def scene() -> NDArray[np.uint8]:
    random = np.random.default_rng(1)
    return np.asarray(cv2.resize(random.integers(0, 255, (30, 40, 3), np.uint8), (320, 240)), np.uint8)


class Lens:
    """A camera whose lens is turned from far out of focus to sharp and a little beyond."""

    def __init__(self, clock: VirtualClock) -> None:
        self.clock, self.blurs, self.is_open = clock, iter((6.0, 3.0, 0.5, 2.0)), False

    def open(self) -> None:
        self.is_open = True

    def close(self) -> None:
        self.is_open = False

    def capture(self, after: float, timeout: float = 2.0) -> Frame:
        assert self.is_open
        image = np.asarray(cv2.GaussianBlur(scene(), (0, 0), next(self.blurs)), np.uint8)
        return Frame(1, after, image, "/dev/video0")


@pytest.fixture
def lens(monkeypatch: pytest.MonkeyPatch) -> Lens:
    clock = VirtualClock()
    found = Lens(clock)
    asked: list[str] = []

    def lone(_config: CellConfig, device: str) -> tuple[Lens, VirtualClock]:
        asked.append(device)
        assert device == "/dev/video0"
        return found, clock

    monkeypatch.setattr(room, "plugged_in", lambda: (WEBCAM,))
    monkeypatch.setattr(room, "lone_camera", lone)
    return found


def test_what_is_plugged_in_is_listed(lens: Lens, capsys: pytest.CaptureFixture[str]) -> None:
    assert execute(["camera", "list"]) == 0
    shown = capsys.readouterr().out
    assert "/dev/video0" in shown
    assert "A webcam" in shown
    assert WEBCAM.stable[0] in shown
    assert execute(["camera", "list", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {
        "device": "/dev/video0",
        "name": "A webcam",
        "stable": list(WEBCAM.stable),
    }


@pytest.mark.parametrize("words", [["list"], ["snapshot", "a.png"], ["focus", "--frames", "1"]])
def test_without_a_camera_it_says_so(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(room, "plugged_in", lambda: ())
    assert execute(["camera", *words]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert "none is plugged in: plug one in" in err


def test_a_snapshot_is_the_picture(lens: Lens, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert execute(["camera", "snapshot", str(tmp_path / "a.png"), "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["size"] == [320, 240]
    written = cv2.imread(str(tmp_path / "a.png"))
    assert written is not None
    assert np.array_equal(written, cv2.GaussianBlur(scene(), (0, 0), 6.0))
    assert not lens.is_open
    assert execute(["camera", "snapshot", str(tmp_path / "none" / "a.png")]) == 1
    assert execute(["camera", "snapshot", str(tmp_path / "a.xyz")]) == 1


def test_the_figure_is_best_when_the_lens_is(lens: Lens, capsys: pytest.CaptureFixture[str]) -> None:
    assert execute(["camera", "focus", "--frames", "4", "--json"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    sharp = [line["sharpness"] for line in lines]
    assert sharp[0] < sharp[1] < sharp[2] > sharp[3]
    assert [line["best"] for line in lines] == [sharp[0], sharp[1], sharp[2], sharp[2]]
    # One figure a second on the camera's own clock.
    assert [round(line["at_s"]) for line in lines] == [0, 1, 2, 3]
    assert not lens.is_open


def test_light_alone_is_not_sharpness() -> None:
    dim = np.asarray(scene() // 2, np.uint8)
    assert room.sharpness(dim) == pytest.approx(room.sharpness(scene()), rel=0.02)  # rounding to whole levels


def test_a_camera_lost_while_focusing_is_released(lens: Lens, monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(after: float, timeout: float = 2.0) -> Frame:
        raise CameraLost("/dev/video0", "capture", "unplugged")

    monkeypatch.setattr(lens, "capture", gone)
    assert execute(["camera", "focus", "--frames", "2"]) == 1
    assert not lens.is_open
