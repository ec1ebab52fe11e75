"""The certificate's picture shows where the misses are."""

from __future__ import annotations

import numpy as np

from controller.calibration.arm import Residual
from controller.calibration.certificate import FAILED, PASSED, Certificate
from controller.calibration.touch_map import touch_map

SQUARE = np.array([[-100.0, -100.0], [100.0, -100.0], [100.0, 100.0], [-100.0, 100.0]])


def certificate(errors: list[list[float]], verdict: str) -> Certificate:
    places = np.array([[60.0, 60.0], [60.0, -60.0], [-60.0, 60.0], [-60.0, -60.0]])
    misses = Residual.of(np.linalg.norm(errors, axis=1))
    return Certificate(misses, misses, misses, places, np.array(errors), 0.0, verdict, "arm-0123456789ab")


def test_a_corner_that_misses_stands_out_on_the_side_where_it_is() -> None:
    # x of the table is up and y to the left: the first place is at the upper left.
    picture = touch_map(certificate([[1.5, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]], FAILED), SQUARE, "2030-01-01")
    assert picture.shape == (500, 870, 3)
    quiet = np.asarray(picture[50:450, 50:450].astype(int))
    brightness = quiet[..., 1]  # green grows along the scale
    corners = [brightness[a : a + 100, b : b + 100].mean() for a, b in ((0, 0), (0, 300), (300, 0), (300, 300))]
    assert corners[0] > max(corners[1:]) + 30.0


def test_passed_and_failed_differ() -> None:
    errors = [[0.1, 0.0]] * 4
    good = touch_map(certificate(errors, PASSED), SQUARE, "2030-01-01")
    bad = touch_map(certificate(errors, FAILED), SQUARE, "2030-01-01")
    assert (good[:, :500] == bad[:, :500]).all()
    assert (good != bad).any()
