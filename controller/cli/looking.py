"""A picture file as its objects and their surfaces, the way teaching, testing and training see it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from controller.calibration.camera import CameraCalibration
from controller.calibration.table import TableCalibration
from controller.domain import Detection, Frame
from controller.errors import InputError
from controller.geometry import PlaneMap
from controller.vision.appearance.look import Surfaces, look
from controller.vision.detect import detect
from controller.vision.read import read_image
from controller.vision.recipe import load_recipe


class Looking:
    """Looks at picture files, always in the same way.

    Args:
        recipe: Name or file.
        camera, table: Calibration files; both or none.
        height_mm: Height of the parts.
    """

    def __init__(
        self, recipe: str, camera: Path | None = None, table: Path | None = None, height_mm: float = 20.0
    ) -> None:
        self.recipe = load_recipe(recipe)
        self._plane: PlaneMap | None = None
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
        """What a picture shows; `whole_only`: without what its border cuts and without holes and prints.

        Raises:
            InputError: It cannot be read, or is not of the calibrated size.
        """
        image = read_image(path)
        if self._plane is not None and image.shape[1::-1] != tuple(self._plane.camera.image_size):
            raise InputError(f"{path} is not of the size the lens was calibrated at", "use the same camera as it was")
        found = detect(Frame(1, 0.0, image, str(path)), self.recipe, plane=self._plane).detections
        if whole_only:
            found = tuple(i for i in found if "cut_by_border" not in i.flags and not _within_another(i, found))
        return found, look(image, found, self.recipe.appearance), self._plane


def _within_another(item: Detection, all_: Sequence[Detection]) -> bool:
    """Whether a detection lies inside a larger one: a hole in a part, or a print on it."""
    return any(
        other.area_px > 1.5 * item.area_px
        and cv2.pointPolygonTest(np.asarray(other.outline_px, np.float32), item.center_px, False) > 0.0
        for other in all_
    )
