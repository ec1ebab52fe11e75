from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from controller.errors import CameraError, CameraLost, ConfigError
from drivers.camera.settings import check_names, lock
from drivers.camera.stream import SETTLE, Stream
from sim_backends.virtual_clock import VirtualClock
from tests.fake_capture import WEBCAM, FakeCapture, Step, frame, lost, stall

PERIOD = 1 / 30


def opened(capture: FakeCapture, **settings: float) -> Stream:
    return Stream(capture, "/dev/video9", capture.clock, size=(64, 48), fps=30.0, settings=settings)


def capture_at(start: float = 100.0, **options: Any) -> FakeCapture:
    return FakeCapture(VirtualClock(start), **options)


# --- format -----------------------------------------------------------------------------------------------


def test_plain_frames_are_kept_where_they_are_fast_enough() -> None:
    capture = capture_at(rate={"": 30.0, "MJPG": 30.0})
    assert opened(capture).fps == 30.0
    assert capture._format == ""


def test_compressed_frames_are_used_where_plain_ones_are_too_slow() -> None:
    capture = capture_at(rate={"": 10.0, "MJPG": 30.0})
    assert opened(capture).fps == 30.0
    assert capture._format == "MJPG"


def test_a_slow_camera_is_used_at_its_own_rate() -> None:
    assert opened(capture_at(rate={"": 5.0})).fps == 5.0


def test_an_unknown_rate_is_taken_as_the_wanted_one(monkeypatch: pytest.MonkeyPatch) -> None:
    capture = capture_at()
    monkeypatch.setattr(capture, "get", lambda propId: -1.0)
    assert opened(capture).fps == 30.0


def test_another_size_is_an_error_and_lets_go_of_the_device() -> None:
    capture = capture_at(size=(32, 24))
    with pytest.raises(CameraError, match=r"32x24 pixels, not 64x48: configure a size the camera has"):
        opened(capture)
    assert capture.released


@pytest.mark.parametrize("step", [lost, stall])
def test_a_device_without_frames_is_lost_and_let_go_of(step: Step) -> None:
    capture = capture_at(script=[frame, step])
    with pytest.raises(CameraLost, match="opens but gives no frames"):
        opened(capture)
    assert capture.released


@pytest.mark.parametrize("bad", [None, cv2.error("jpeg")])
def test_a_device_whose_frames_cannot_be_decoded_is_lost_and_let_go_of(
    monkeypatch: pytest.MonkeyPatch, bad: cv2.error | None
) -> None:
    capture = capture_at()

    def retrieve() -> tuple[bool, object]:
        if bad is not None:
            raise bad
        return False, None

    monkeypatch.setattr(capture, "retrieve", retrieve)
    with pytest.raises(CameraLost, match="cannot be decoded"):
        opened(capture)
    assert capture.released


def test_settling_takes_its_time_and_no_longer() -> None:
    capture = capture_at(rate={"": 2.0})
    opened(capture)
    assert SETTLE <= capture.clock.now() - 100.0 <= SETTLE + 0.5  # whole frames at 2/s


# --- time -------------------------------------------------------------------------------------------------


def test_a_frame_ended_when_stamped_and_began_two_periods_before_at_the_earliest() -> None:
    stream = opened(capture_at())
    exposure = stream.grab()
    assert exposure is not None
    assert exposure.ended == pytest.approx(100.0 + 46 * PERIOD)
    assert exposure.ended - exposure.began == pytest.approx(2 * PERIOD)


def test_a_long_exposure_reaches_further_back() -> None:
    stream = opened(capture_at(), exposure=1000.0)  # 100 ms
    exposure = stream.grab()
    assert exposure is not None
    assert exposure.ended - exposure.began == pytest.approx(PERIOD + 0.1)


def delayed(capture: FakeCapture) -> bool:
    """A frame that lay in the queue for two seconds because this program stood still."""
    frame(capture)
    capture.clock.sleep(2.0)
    return True


def test_a_stamp_tells_how_old_a_queued_frame_is() -> None:
    capture = capture_at()
    stream = opened(capture)
    capture.script = [frame, delayed]
    stream.grab()
    exposure = stream.grab()
    assert exposure is not None
    assert capture.clock.now() - exposure.ended == pytest.approx(2.0)


def with_stamp(stamp: float) -> Step:
    def step(capture: FakeCapture) -> bool:
        frame(capture)
        capture.stamp = stamp
        return True

    return step


@pytest.mark.parametrize("stamp", [100.5, 1e6], ids=["repeats or goes back", "lies in the future"])
def test_a_frame_with_an_impossible_stamp_is_dropped_and_counted(stamp: float) -> None:
    capture = capture_at()
    stream = opened(capture)
    capture.script = [frame, with_stamp(stamp), frame]
    assert [stream.grab() is None for _ in range(3)] == [False, True, False]
    assert stream.bad_frames == 1


@pytest.mark.parametrize("stamps", [False, True], ids=["none", "of another clock"])
def test_without_usable_stamps_a_frame_waited_for_is_of_now(stamps: bool) -> None:
    capture = capture_at(stamps=stamps)
    stream = opened(capture)
    capture.script = [with_stamp(1.7e9)] * 2
    for _ in range(2):
        exposure = stream.grab()
        assert exposure is not None
        assert exposure.ended == capture.clock.now()


def ready(_capture: FakeCapture) -> bool:
    """A frame that lay in the queue: it takes no time at all."""
    return True


def test_without_stamps_a_frame_that_lay_ready_is_not_taken_for_new() -> None:
    capture = capture_at(stamps=False)
    stream = opened(capture)
    first = stream.grab()
    capture.clock.sleep(3.0)
    capture.script = [ready, ready]
    second, third = stream.grab(), stream.grab()
    assert first is not None
    assert second is not None
    assert third is not None
    assert second.ended == pytest.approx(first.ended + PERIOD)
    assert third.ended == pytest.approx(first.ended + 2 * PERIOD)


# --- images -----------------------------------------------------------------------------------------------


def test_an_image_is_read_only() -> None:
    stream = opened(capture_at())
    stream.grab()
    image = stream.image()
    assert image is not None
    assert (image.shape, image.flags.writeable) == ((48, 64, 3), False)


@pytest.mark.parametrize(
    "bad", [None, np.zeros((24, 32, 3), np.uint8), np.zeros((48, 64), np.uint8), cv2.error("jpeg")]
)
def test_a_damaged_image_is_dropped_and_counted(monkeypatch: pytest.MonkeyPatch, bad: object) -> None:
    capture = capture_at()
    stream = opened(capture)

    def retrieve() -> tuple[bool, object]:
        if isinstance(bad, cv2.error):
            raise bad
        return bad is not None, bad

    monkeypatch.setattr(capture, "retrieve", retrieve)
    stream.grab()
    assert stream.image() is None
    assert stream.bad_frames == 1


# --- settings ---------------------------------------------------------------------------------------------


def test_what_is_automatic_is_locked_where_it_has_settled() -> None:
    capture = capture_at()
    stream = opened(capture)
    assert stream.refused == ()
    assert stream.settings_in_force == {
        "auto_exposure": 1.0,
        "auto_white_balance": 0.0,
        "autofocus": 0.0,
        "exposure": 157.0,
        "white_balance_temperature": 4600.0,
        "focus": 30.0,
        "gain": 64.0,
        "brightness": 128.0,
    }


def test_switching_off_an_automatic_must_not_move_what_it_governs(monkeypatch: pytest.MonkeyPatch) -> None:
    capture = capture_at()
    plain_set = capture.set

    def forgetful(propId: int, value: float) -> bool:
        """Some webcams jump back to a default exposure when it becomes manual."""
        if propId == cv2.CAP_PROP_AUTO_EXPOSURE:
            capture.controls[cv2.CAP_PROP_EXPOSURE] = 3.0
        return plain_set(propId, value)

    monkeypatch.setattr(capture, "set", forgetful)
    assert opened(capture).settings_in_force["exposure"] == 157.0


def test_settings_are_read_back_and_what_is_not_in_force_is_told() -> None:
    capture = capture_at(fixed=[cv2.CAP_PROP_GAIN, cv2.CAP_PROP_AUTO_WB])
    stream = opened(capture, gain=10.0, exposure=200.4, sharpness=3.0)
    assert stream.settings_in_force["exposure"] == 200.0
    assert stream.settings_in_force["gain"] == 64.0
    assert sorted(str(refused) for refused in stream.refused) == [
        "auto_white_balance = 0: the camera says 1",
        "gain = 10: the camera says 64",
        "sharpness = 3: the camera has no such setting",
    ]


def test_a_camera_without_controls_has_nothing_to_lock() -> None:
    assert lock(capture_at(controls={}), {}) == ({}, ())


def test_the_automatics_are_off_before_their_settings_are_written(monkeypatch: pytest.MonkeyPatch) -> None:
    capture = capture_at()
    order: list[int] = []
    plain_set = capture.set

    def noting(propId: int, value: float) -> bool:
        order.append(propId)
        return plain_set(propId, value)

    monkeypatch.setattr(capture, "set", noting)
    lock(capture, {"exposure": 100.0, "focus": 10.0})
    assert order.index(cv2.CAP_PROP_AUTO_EXPOSURE) < order.index(cv2.CAP_PROP_EXPOSURE)
    assert order.index(cv2.CAP_PROP_AUTOFOCUS) < order.index(cv2.CAP_PROP_FOCUS)
    assert set(order) <= set(WEBCAM)


def test_an_unknown_setting_is_a_configuration_error() -> None:
    with pytest.raises(ConfigError, match=r"exposre: unknown: did you mean exposure\?"):
        check_names({"exposre": 1.0})
    with pytest.raises(ConfigError, match="known are backlight_compensation"):
        check_names({"xyz": 1.0})
