"""A hand, or anything else that is large and unknown, over the table: nothing may move before it is gone."""

from __future__ import annotations

import math
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.config.cell import CellConfig
from controller.cycle.view import MARGIN_MM, region_mask
from controller.domain import Array, CellCalibration, Frame
from controller.errors import Intruder
from controller.geometry import transform
from controller.localization.locate import Located
from controller.vision.rim import Rim, coarse

_ASIDE = math.radians(15.0)
"""Beyond the work area by more than this to either side stand bins, and the arm over them."""

_LARGE = 1.5
"""Something whose short side is longer than the widest part the jaws can take, times this, is no part."""

_STEP_PX = 8
"""The strip's border is found this coarsely: it is looked at no finer."""


def strip_mask(config: CellConfig, calibration: CellCalibration, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Mask (H, W), 255 beyond the work area and its margin where neither bins nor the arm over them are to be seen."""
    area = config.table.work_area
    low, high = np.radians(area.azimuth_deg)
    columns, rows = np.meshgrid(np.arange(0, size[0], _STEP_PX), np.arange(0, size[1], _STEP_PX))
    flat = calibration.plane(0.0).to_plane(np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64))
    base = transform(calibration.T_base_table, np.column_stack([flat, np.zeros(len(flat))]))
    radius, azimuth = np.hypot(base[:, 0], base[:, 1]), np.arctan2(base[:, 1], base[:, 0])
    free = (radius > area.outer_radius_mm + MARGIN_MM) & (azimuth > low - _ASIDE) & (azimuth < high + _ASIDE)
    found = np.where(free, 255, 0).astype(np.uint8).reshape(rows.shape)
    mask = cv2.resize(found, size, interpolation=cv2.INTER_NEAREST)
    for bin_ in config.bin_values():
        half = np.array(bin_.size) / 2.0 + MARGIN_MM
        corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * half + bin_.center
        ends = np.vstack([calibration.plane(z).to_pixels(corners) for z in (0.0, bin_.height)])
        if np.isfinite(ends).all():
            cv2.fillConvexPoly(mask, cv2.convexHull(np.rint(ends).astype(np.int32)), (0,))
    return np.asarray(mask, np.uint8)


Hidden = Callable[[float], Array]
"""What of the table the arm hides at a time (s of the cell's clock); see `Planner.hidden`."""


class ClearView:
    """How the table looks with nothing over it: known from one start to the next, so that a hand is seen at once.

    Args:
        image: ndarray of shape (h, w, 3), dtype float32, see `vision.rim.coarse`; None: nobody knows yet.
        keep: Told of every new one.

    Attributes:
        image: The newest one.
    """

    def __init__(
        self, image: NDArray[np.float32] | None = None, keep: Callable[[NDArray[np.float32]], None] = lambda image: None
    ) -> None:
        self.image = image
        self._keep = keep

    def learn(self, image: NDArray[np.float32]) -> None:
        """Nothing is over the table in this picture."""
        self.image = image
        self._keep(image)

    def forget(self) -> None:
        """Somebody has looked: what the next frame shows is how it looks with nothing over it."""
        self.image = None


class Guard:
    """Tells when a hand or something else that is large and unknown is over the table.

    Args:
        config: The cell.
        calibration: Of its camera.
        clear_view: How the table looked before this start; learns how it looks now.
        widest: What the jaws can take at most, mm.
    """

    def __init__(self, config: CellConfig, calibration: CellCalibration, clear_view: ClearView, widest: float) -> None:
        self._config = config
        self._calibration = calibration
        self._clear_view = clear_view
        self._largest = _LARGE * widest
        self._rim: Rim | None = None
        self._learnt = False

    def check_frame(self, frame: Frame, hidden: Hidden) -> None:
        """Look for whatever reaches over the table.

        The first frame with nothing over the table tells how its rim looks in today's light. Where no earlier start
        has left a clear view to judge it by, that is the first frame.

        Args:
            frame: What the camera sees.
            hidden: Tells what the arm hid.

        Raises:
            Intruder: Something reaches over the table.
        """
        small = coarse(frame.image)
        if self._rim is None:
            strip = strip_mask(self._config, self._calibration, frame.size)
            inside = region_mask(self._config, self._calibration, frame.size)
            known = self._clear_view.image
            self._rim = Rim(known if known is not None and known.shape == small.shape else small, strip, inside)
        shows_nothing = self._check(small, frame.captured_at, hidden)
        if shows_nothing and not self._learnt:
            self._learnt = True
            self._rim.learn(small)
            self._clear_view.learn(small)

    def check_glance(self, glance: Frame, hidden: Hidden) -> None:
        """Look at a glance as at a frame; nothing is known before the first frame.

        Raises:
            Intruder: Something reaches over the table.
        """
        self._check(glance.image, glance.captured_at, hidden)

    def _check(self, small: NDArray[np.uint8] | NDArray[np.float32], at: float, hidden: Hidden) -> bool:
        """Whether nothing shows in the strip, not even the arm.

        Raises:
            Intruder: More than the arm does.
        """
        rim = self._rim
        # Where the arm stands is asked for only when something shows: most looks show nothing.
        if rim is None or not rim.crossed(small):
            return True
        if rim.crossed(small, self._under(rim, hidden(at))):
            remedy = "clear the view, then controller resume; it is to stay there: stop, then start --view-clear"
            raise Intruder("something reaches over the table", remedy)
        return False

    def _under(self, rim: Rim, arm: Array) -> NDArray[np.bool_]:
        """Which pixels of the strip the arm and what it carries may hide."""
        at = self._calibration.plane(0.0).to_plane(rim.pixels)
        under = np.zeros(len(at), bool)
        for x, y, radius in arm:
            under |= np.hypot(at[:, 0] - x, at[:, 1] - y) < radius + MARGIN_MM
        return under

    def check_things(self, found: Located) -> None:
        """Look for things that no part can be.

        Raises:
            Intruder: There is one.
        """
        T_base_table, reach = self._calibration.T_base_table, self._config.table.work_area.outer_radius_mm
        for thing in (*found.objects, *found.in_the_way):
            # Outside the area the arm and its shadow may look like anything; what is longer than it crosses the rim.
            there = thing.size[0] < reach and self._config.in_work_area(thing.center, T_base_table)
            if there and thing.size[1] > self._largest:
                x, y = thing.center
                raise Intruder(
                    f"something of {thing.size[0]:.0f} x {thing.size[1]:.0f} mm lies at ({x:.0f}, {y:.0f}) mm",
                    "take it away, then controller resume",
                )
