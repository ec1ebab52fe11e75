"""Settings of a camera: asked for, then read back, because set() says yes to what it does not do.

A picture that dims or refocuses by itself changes outlines by more than the accuracy asked for; so what is
automatic is locked, at the wanted value or where it has settled.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass

import cv2

from controller.errors import ConfigError
from drivers.camera.capture import Capture

# Names are V4L2's controls; values are the device's own (exposure in units of 100 us).
PROPERTIES: Mapping[str, int] = {
    "brightness": cv2.CAP_PROP_BRIGHTNESS,
    "contrast": cv2.CAP_PROP_CONTRAST,
    "saturation": cv2.CAP_PROP_SATURATION,
    "hue": cv2.CAP_PROP_HUE,
    "gain": cv2.CAP_PROP_GAIN,
    "gamma": cv2.CAP_PROP_GAMMA,
    "sharpness": cv2.CAP_PROP_SHARPNESS,
    "backlight_compensation": cv2.CAP_PROP_BACKLIGHT,
    "exposure": cv2.CAP_PROP_EXPOSURE,
    "white_balance_temperature": cv2.CAP_PROP_WB_TEMPERATURE,
    "focus": cv2.CAP_PROP_FOCUS,
    "zoom": cv2.CAP_PROP_ZOOM,
    "pan": cv2.CAP_PROP_PAN,
    "tilt": cv2.CAP_PROP_TILT,
}


@dataclass(frozen=True, slots=True)
class Automatic:
    """Something a camera may do by itself.

    Attributes:
        name: For reports.
        switch: The property that turns it on and off.
        off: Value of the switch for `off`. Source: V4L2 menu V4L2_EXPOSURE_MANUAL = 1, the others are booleans.
        governs: The setting it changes.
    """

    name: str
    switch: int
    off: float
    governs: str


AUTOMATICS = (
    Automatic("auto_exposure", cv2.CAP_PROP_AUTO_EXPOSURE, 1.0, "exposure"),
    Automatic("auto_white_balance", cv2.CAP_PROP_AUTO_WB, 0.0, "white_balance_temperature"),
    Automatic("autofocus", cv2.CAP_PROP_AUTOFOCUS, 0.0, "focus"),
)


@dataclass(frozen=True, slots=True)
class Refused:
    """A setting that is not in force.

    Attributes:
        name: The setting.
        wanted: What was asked for.
        got: What the device says instead; None when it has no such setting.
    """

    name: str
    wanted: float
    got: float | None

    def __str__(self) -> str:
        got = "the camera has no such setting" if self.got is None else f"the camera says {self.got:g}"
        return f"{self.name} = {self.wanted:g}: {got}"


def check_names(settings: Mapping[str, float]) -> None:
    """Refuse a setting nobody knows.

    Raises:
        ConfigError: There is one.
    """
    for name in settings:
        if name not in PROPERTIES:
            close = difflib.get_close_matches(name, PROPERTIES, 1)
            hint = f"did you mean {close[0]}?" if close else f"known are {', '.join(sorted(PROPERTIES))}"
            raise ConfigError(f"camera settings: {name}: unknown", hint)


def lock(capture: Capture, settings: Mapping[str, float]) -> tuple[dict[str, float], tuple[Refused, ...]]:
    """Switch off what is automatic, apply the settings, and read everything back.

    What is automatic and not set is held at its present value, so let it settle first.

    Returns:
        Every setting in force that the device has; what was asked for and is not in force.
    """
    wanted = dict(settings)
    for automatic in AUTOMATICS:
        if _get(capture, automatic.switch) is None:
            continue
        settled = _get(capture, PROPERTIES[automatic.governs])
        capture.set(automatic.switch, automatic.off)
        if settled is not None:
            wanted.setdefault(automatic.governs, settled)
    for name, value in wanted.items():
        capture.set(PROPERTIES[name], value)
    in_force = {name: got for name, prop in PROPERTIES.items() if (got := _get(capture, prop)) is not None}
    refused = [
        Refused(name, value, in_force.get(name))
        for name, value in wanted.items()
        # Controls are integers: anything nearer than a half is what the device can do.
        if name not in in_force or abs(in_force[name] - value) > 0.5
    ]
    for automatic in AUTOMATICS:
        got = _get(capture, automatic.switch)
        if got is not None:
            in_force[automatic.name] = got
            if got != automatic.off:
                refused.append(Refused(automatic.name, automatic.off, got))
    return in_force, tuple(refused)


def _get(capture: Capture, prop: int) -> float | None:
    """A property, or None when the device has it not (OpenCV says -1)."""
    value = capture.get(prop)
    return None if value == -1.0 else value
