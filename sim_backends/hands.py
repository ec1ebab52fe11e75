"""Hands that show calibration boards to the simulated camera, about as exactly as a person does."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_backends.imperfections import Imperfections
from sim_backends.lens import Lens
from sim_backends.painter_surface import Print
from sim_backends.solids import Array


def displacement(shift: NDArray[np.float64], turn: NDArray[np.float64]) -> Array:
    """Rigid pose, shape (4, 4), of a small move (mm) and turn (Rodrigues vector, rad)."""
    out = np.eye(4)
    out[:3, :3] = cv2.Rodrigues(np.asarray(turn, np.float64).reshape(3, 1))[0]
    out[:3, 3] = shift
    return out


class Hands:
    """A `Presenter`: holds boards roughly where asked, lays the sheet on its mark as well as the draw has it.

    Args:
        lens: The true camera; a person who holds a board looks at its live picture.
        T_base_sheet: Where a sheet comes to lie when it is laid on the mark.
        imperfections: How steady the hands are.
        seed: The same seed holds the same boards in the same way.
    """

    def __init__(self, lens: Lens, T_base_sheet: Array, imperfections: Imperfections, seed: int) -> None:
        self._lens = lens
        self._T_base_sheet = T_base_sheet
        self._shift, self._turn = imperfections.hand_shift, imperfections.hand_turn
        self._random = np.random.default_rng([seed, 7])
        self.board: Print | None = None
        self.sheet: Print | None = None

    def hold(self, print_: NDArray[np.uint8], pixel_mm: float, T_camera_board: NDArray[np.float64]) -> None:
        """Hold a stiff print before the camera, a few mm and degrees off the wanted pose, until told otherwise."""
        off = displacement(self._random.normal(0.0, self._shift, 3), self._random.normal(0.0, self._turn, 3))
        self.board = Print(print_, pixel_mm, self._lens.T_base_camera @ T_camera_board @ off, y_up=False)
        self.sheet = None

    def lay(self, print_: NDArray[np.uint8], pixel_mm: float) -> None:
        """Lay a print on the mark; every sheet of one cell comes to lie in the same place."""
        self.sheet = Print(print_, pixel_mm, self._T_base_sheet, y_up=True)
        self.board = None

    def remove(self) -> None:
        """Take the print away."""
        self.board = self.sheet = None
