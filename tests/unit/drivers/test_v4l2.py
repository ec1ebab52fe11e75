from __future__ import annotations

import os
import sys
import threading
from pathlib import Path

import pytest

from controller.errors import CameraError, CameraLost, ConfigError, FrameStale
from drivers.camera.capture import open_capture
from drivers.camera.listing import list_cameras
from drivers.camera.v4l2 import V4l2Camera
from sim_backends.virtual_clock import VirtualClock
from tests.fake_capture import FakeCapture, Plug, Step, frame, lost, stall

PERIOD = 1 / 30
SETTLING = 45  # frames read while opening
# A reader on a virtual clock would never wait; half a millisecond a frame keeps it from spinning.
_pause = threading.Event()


def pace() -> None:
    _pause.wait(0.0005)


def device(clock: VirtualClock, *steps: Step) -> FakeCapture:
    return FakeCapture(clock, script=[frame] * SETTLING + list(steps), pace=pace)


def camera_on(plug: Plug, clock: VirtualClock) -> V4l2Camera:
    return V4l2Camera("/dev/video9", clock, size=(64, 48), fps=30.0, capture=plug)


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock(100.0)


@pytest.mark.safety("SR-30")
def test_a_frame_was_exposed_after_the_asked_time(clock: VirtualClock) -> None:
    camera = camera_on(Plug(device(clock)), clock)
    camera.open()
    try:
        for ahead in (0.0, 0.5, -3.0):
            after = clock.now() + ahead
            shown = camera.capture(after)
            # Two periods: the stamp may be of the end of the read-out, before which lies the exposure.
            assert shown.captured_at >= after + 2 * PERIOD - 1e-9
            assert clock.now() - shown.captured_at < 0.5
    finally:
        camera.close()


def test_only_what_is_asked_for_is_decoded(clock: VirtualClock) -> None:
    capture = device(clock)
    camera = camera_on(Plug(capture), clock)
    camera.open()
    camera.capture(0.0)
    camera.capture(clock.now() + 5.0, timeout=8.0)  # 150 frames pass meanwhile
    camera.close()
    # One while opening to see the size; while a request is being answered one more may be on its way.
    assert capture.decoded <= 1 + 2 * 2
    assert capture.released


def test_frames_too_old_are_passed_over(clock: VirtualClock) -> None:
    def queued(capture: FakeCapture) -> bool:
        capture.stamp += 1e-3  # five seconds old by now
        return True

    def program_stalls(capture: FakeCapture) -> bool:
        frame(capture)
        capture.clock.sleep(5.0)
        return True

    camera = camera_on(Plug(device(clock, program_stalls, queued, queued, queued)), clock)
    camera.open()
    shown = camera.capture(0.0, timeout=20.0)
    assert clock.now() - shown.captured_at < 0.5
    camera.close()


@pytest.mark.safety("SR-27")
def test_no_frame_young_enough_is_stale(clock: VirtualClock) -> None:
    camera = camera_on(Plug(device(clock)), clock)
    camera.open()
    with pytest.raises(FrameStale, match=r"within 1 s; the newest ended at"):
        camera.capture(clock.now() + 10.0, timeout=1.0)
    camera.close()


@pytest.mark.parametrize("step", [lost, stall])
def test_a_camera_that_comes_back_within_the_time_is_no_fault(clock: VirtualClock, step: Step) -> None:
    first, second = device(clock, step), device(clock)
    plug = Plug(first, None, second)
    camera = camera_on(plug, clock)
    camera.open()
    lost_at = clock.now()
    shown = camera.capture(lost_at + 2.0, timeout=30.0)
    assert shown.captured_at > lost_at + 2.0
    assert camera.reopened == 1
    assert len(plug.opened) == 3
    assert first.released
    camera.close()
    assert second.released


def test_a_camera_that_stays_away_is_lost_and_says_why(clock: VirtualClock) -> None:
    camera = camera_on(Plug(device(clock, lost)), clock)
    camera.open()
    with pytest.raises(CameraLost, match=r"not back within 4 s \(/dev/video9: open: there is no such device\): plug"):
        camera.capture(clock.now(), timeout=4.0)
    camera.close()


def test_a_lost_camera_is_tried_less_and_less_often(clock: VirtualClock) -> None:
    plug = Plug(device(clock, lost))
    camera = camera_on(plug, clock)
    began = clock.now()  # the reader may be far on by the time that open() returns
    camera.open()
    with pytest.raises(CameraLost):
        camera.capture(began, timeout=40.0)
    attempts, passed = len(plug.opened) - 1, clock.now() - began
    camera.close()
    # 0.5 + 1 + 2 + 4 + 8 + 10 + 10 + ... s
    assert attempts <= 6 + (passed - 15.5) / 10.0


@pytest.mark.safety("SR-30")
def test_after_a_loss_no_frame_from_before_is_given_out(clock: VirtualClock) -> None:
    first = device(clock, lost)
    camera = camera_on(Plug(first), clock)
    camera.open()
    for _ in range(2):
        with pytest.raises(CameraLost):
            camera.capture(0.0, timeout=1.0)
    camera.close()


def test_another_size_after_a_replug_is_told(clock: VirtualClock) -> None:
    small = [FakeCapture(clock, size=(32, 24), pace=pace) for _ in range(4)]
    camera = camera_on(Plug(device(clock, lost), *small), clock)
    camera.open()
    with pytest.raises(CameraLost, match=r"32x24 pixels, not 64x48"):
        camera.capture(clock.now(), timeout=6.0)
    camera.close()


def test_damaged_frames_are_passed_over_and_counted(clock: VirtualClock, monkeypatch: pytest.MonkeyPatch) -> None:
    capture = device(clock)
    good, answers = capture.retrieve, [(False, None), (False, None)]
    camera = camera_on(Plug(capture), clock)
    camera.open()
    monkeypatch.setattr(capture, "retrieve", lambda: answers.pop() if answers else good())
    assert camera.capture(0.0).image.shape == (48, 64, 3)
    assert (camera.good_frames, camera.bad_frames) == (1, 2)
    camera.close()


def test_settings_in_force_and_refused_are_told(clock: VirtualClock) -> None:
    camera = V4l2Camera(
        "/dev/video9", clock, size=(64, 48), fps=30.0, settings={"gain": 10.0, "tilt": 1.0}, capture=Plug(device(clock))
    )
    camera.open()
    camera.close()
    assert camera.settings_in_force["gain"] == 10.0
    assert [refused.name for refused in camera.refused_settings] == ["tilt"]


def test_an_unknown_setting_is_refused_at_once(clock: VirtualClock) -> None:
    with pytest.raises(ConfigError, match="did you mean gain"):
        V4l2Camera("/dev/video9", clock, settings={"gian": 1.0})


def test_closing_ends_a_wait(clock: VirtualClock) -> None:
    camera = camera_on(Plug(device(clock)), clock)
    camera.open()
    ended: list[Exception] = []

    def wait() -> None:
        try:
            camera.capture(clock.now() + 1e9, timeout=2e9)
        except CameraError as error:
            ended.append(error)

    waiter = threading.Thread(target=wait)
    waiter.start()
    while camera._request is None:
        _pause.wait(0.001)
    camera.close()
    waiter.join(5.0)
    assert [type(error) for error in ended] == [FrameStale]


def test_a_device_that_cannot_be_opened_leaves_nothing_behind(clock: VirtualClock) -> None:
    camera = camera_on(Plug(), clock)
    with pytest.raises(CameraLost, match="no such device: plug the camera in"):
        camera.open()
    with pytest.raises(CameraLost, match="not open"):
        camera.capture(0.0)
    camera.close()


def test_opening_twice_is_harmless(clock: VirtualClock) -> None:
    plug = Plug(device(clock))
    camera = camera_on(plug, clock)
    camera.open()
    camera.open()
    assert len(plug.opened) == 1
    camera.close()
    camera.close()


# --- the real opener ----------------------------------------------------------------------------------------


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="V4L2 is Linux's")
def test_a_missing_device_names_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(CameraLost, match=r"video77: open: there is no such device: plug the camera in; `controller"):
        open_capture(str(tmp_path / "video77"))


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="V4L2 is Linux's")
def test_a_file_that_is_no_camera_is_refused(tmp_path: Path) -> None:
    (tmp_path / "video0").write_bytes(b"")
    with pytest.raises(CameraLost, match="does not answer as a camera"):
        open_capture(str(tmp_path / "video0"))


def test_a_device_without_permission_names_the_group(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "video0").write_bytes(b"")
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(CameraLost, match="group `video`"):
        open_capture(str(tmp_path / "video0"))


def test_without_linux_the_simulation_is_pointed_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    with pytest.raises(CameraLost, match="only Linux has: use --sim or --replay"):
        open_capture("/dev/video0")


# --- the list -----------------------------------------------------------------------------------------------


def plugged(root: Path, number: int, name: str, index: int = 0) -> None:
    folder = root / f"sys/class/video4linux/video{number}"
    folder.mkdir(parents=True)
    (folder / "name").write_text(f"{name}\n", encoding="utf-8")
    (folder / "index").write_text(f"{index}\n", encoding="ascii")
    (root / "dev").mkdir(exist_ok=True)
    (root / f"dev/video{number}").touch()


def linked(root: Path, kind: str, link: str, number: int) -> None:
    folder = root / "dev/v4l" / kind
    folder.mkdir(parents=True, exist_ok=True)
    (folder / link).symlink_to(f"../../video{number}")


def test_cameras_are_listed_with_their_stable_links_and_without_metadata_nodes(tmp_path: Path) -> None:
    plugged(tmp_path, 10, "Overhead")
    plugged(tmp_path, 2, "Laptop: Läptop")
    plugged(tmp_path, 3, "Laptop: Läptop", index=1)
    linked(tmp_path, "by-path", "pci-0-video-index0", 10)
    linked(tmp_path, "by-id", "usb-Maker_Overhead_1234-video-index0", 10)
    linked(tmp_path, "by-id", "usb-Laptop-video-index1", 3)
    first, second = list_cameras(tmp_path)
    assert (first.device, first.name, first.stable) == ("/dev/video2", "Laptop: Läptop", ())
    assert (second.device, second.name) == ("/dev/video10", "Overhead")
    assert second.stable == (
        "/dev/v4l/by-id/usb-Maker_Overhead_1234-video-index0",
        "/dev/v4l/by-path/pci-0-video-index0",
    )


def test_without_cameras_the_list_is_empty(tmp_path: Path) -> None:
    assert list_cameras(tmp_path) == ()
