"""The paper's equations, as they are printed."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from controller.localization.paper import PaperModel

MODEL = PaperModel((-1000.0, 1000.0), (639.5, 359.5), 600.0, (260.0, 140.0))
_far = st.floats(-400.0, 400.0)


def test_equations_5_and_6_by_hand() -> None:
    # u - u0 = 100 px to the right are 100 * 600 / 1000 = 60 mm; X0 = 260 puts the axis at X = -260.
    assert np.allclose(MODEL.world([[739.5, 359.5]]), [[-200.0, -140.0]])
    # 50 px down are 30 mm; Y counts up.
    assert np.allclose(MODEL.world([[639.5, 409.5]]), [[-260.0, -170.0]])


@given(_far, _far)
def test_the_equations_undo_each_other(x: float, y: float) -> None:
    assert np.allclose(MODEL.world(MODEL.pixels([[x, y]])), [[x, y]], atol=1e-9)


def test_its_frame_is_left_handed() -> None:
    # Right and up in the picture, as the camera sees them (x right, y down, z into the table).
    (ox, oy), (xx, xy), (yx, yy) = MODEL.pixels([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    along_x, along_y, into_table = [xx - ox, xy - oy, 0.0], [yx - ox, yy - oy, 0.0], [0.0, 0.0, 1.0]
    assert np.linalg.det(np.array([along_x, along_y, into_table])) < 0.0
