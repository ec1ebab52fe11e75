"""A picture file as its objects and their surfaces, the way teaching, testing and training see it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.calibration.camera import CameraCalibration
from controller.calibration.table import TableCalibration
from controller.domain import Detection, Frame
from controller.errors import InputError
from controller.geometry import PlaneMap
from controller.vision.appearance.look import Surfaces, look
from controller.vision.detect import detect
from controller.vision.read import read_image
from controller.vision.recipe import load_recipe

_LARGER = 1.5
"""A part is this many times as large as what belongs to it."""
_BESIDE_PX = 4.0


class Looking:
    """Looks at picture files, always in the same way.

    Args:
        recipe: Name or file.
        camera, table: Calibration files; both or none.
        height_mm: Height of the parts.
        plane: The calibrated plane itself, in place of files.
        region: ndarray of shape (H, W), dtype uint8: only what lies where it is not 0 is looked at.
    """

    def __init__(
        self,
        recipe: str,
        camera: Path | None = None,
        table: Path | None = None,
        height_mm: float = 20.0,
        plane: PlaneMap | None = None,
        region: NDArray[np.uint8] | None = None,
    ) -> None:
        self.recipe = load_recipe(recipe)
        self._plane = plane
        self._region = region
        if camera is not None and table is not None:
            lens = CameraCalibration.load(camera)
            self._plane = PlaneMap(lens.camera, TableCalibration.load(table, lens).T_table_camera, height_mm / 2.0)
        elif camera is not None or table is not None:
            raise InputError("--camera and --table belong together", "give both, or neither")

    @property
    def calibrated(self) -> bool:
        """Sizes are mm."""
        return self._plane is not None

    def at(
        self, path: Path, *, whole_only: bool = True
    ) -> tuple[Sequence[Detection], Surfaces, PlaneMap | None]:
        """What a picture file shows; see `see`.

        Raises:
            InputError: It cannot be read, or is not of the calibrated size.
        """
        return self.see(read_image(path), str(path), whole_only=whole_only)

    def see(
        self, image: NDArray[np.uint8], path: str, *, whole_only: bool = True
    ) -> tuple[Sequence[Detection], Surfaces, PlaneMap | None]:
        """What a picture (H, W, 3) shows; `whole_only`: without what its border cuts, holes, prints and shadows.

        Raises:
            InputError: It is not of the calibrated size.
        """
        if self._plane is not None and image.shape[1::-1] != tuple(self._plane.camera.image_size):
            raise InputError(f"{path} is not of the size the lens was calibrated at", "use the same camera as it was")
        found = detect(Frame(1, 0.0, image, path), self.recipe, plane=self._plane, region=self._region).detections
        if whole_only:
            found = tuple(i for i in found if "cut_by_border" not in i.flags and not _of_another(i, found))
        return found, look(image, found, self.recipe.appearance), self._plane


def _of_another(item: Detection, all_: Sequence[Detection]) -> bool:
    """Whether a detection belongs to a larger one: a hole in it, a print on it, or the shadow or wall beside it."""
    for other in all_:
        if other.area_px <= _LARGER * item.area_px:
            continue
        ring = np.asarray(other.outline_px, np.float32)
        if cv2.pointPolygonTest(ring, item.center_px, False) > 0.0:
            return True
        # Its corners reach the other's edge: nothing that was laid there to be shown does.
        nearest = max(cv2.pointPolygonTest(ring, (float(x), float(y)), True) for x, y in item.outline_px)
        if nearest > -_BESIDE_PX:
            return True
    return False
