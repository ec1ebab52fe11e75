"""What a real cell remembers of its pictures from one program to the next; kept with the calibration they go with.

The still scenery is learnt from the first picture after a calibration: a camera that was bumped at night must be
noticed in the morning. The table's rim with nothing over it is learnt at every start, and judged by the start before:
a hand that is there already in the first picture is no part of the cell.
"""

from __future__ import annotations

import logging
import os
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.calibration.store import load
from controller.config.cell import CellConfig
from controller.cycle.guard import ClearView
from controller.cycle.view import still_mask
from controller.domain import CellCalibration
from controller.errors import CameraError
from controller.ports import Camera, Clock
from controller.vision.landmarks import Landmarks
from controller.vision.rim import coarse
from controller.vision.watch import WatchedCamera

_log = logging.getLogger(__name__)


def watch_scenery(camera: Camera, config: CellConfig, calibration: CellCalibration, folder: Path | None) -> None:
    """Let a camera that judges its pictures compare their scenery too; others are left alone.

    Args:
        camera: The cell's.
        config: Work area and bins.
        calibration: With which it works; another one begins with a new reference.
        folder: Where the reference is kept; None: only as long as the camera is.
    """
    if not isinstance(camera, WatchedCamera):
        return
    size = calibration.camera.image_size
    still = still_mask(config, calibration, size)
    if folder is None:
        camera.watch_scenery(still)
        return
    path = folder / f"scenery-{calibration.calibration_id}.png"
    kept = cv2.imread(str(path)) if path.is_file() else None
    reference = np.asarray(kept, np.uint8) if kept is not None and kept.shape[1::-1] == size else None

    def keep(image: NDArray[np.uint8]) -> None:
        if reference is None:
            for old in folder.glob("scenery-*.png"):
                old.unlink(missing_ok=True)
            _save(path, image)

    camera.watch_scenery(still, reference, keep)


def watch_landmarks(camera: Camera, folder: Path) -> None:
    """Let a camera that judges its pictures hold the table's corner markers to their places, where it has any.

    Args:
        camera: The cell's.
        folder: Of the calibration with which it works.
    """
    places = load(folder).table.landmarks
    if isinstance(camera, WatchedCamera) and places:
        camera.landmarks = Landmarks(places)


def clear_view(calibration: CellCalibration, folder: Path | None) -> ClearView:
    """How the table of a cell looked with nothing over it at its last start.

    Args:
        calibration: With which it works; another one knows nothing yet.
        folder: Where it is kept; None: only as long as the program runs.
    """
    if folder is None:
        return ClearView()
    path = folder / f"clear-view-{calibration.calibration_id}.png"
    kept = cv2.imread(str(path)) if path.is_file() else None

    def keep(image: NDArray[np.float32]) -> None:
        for old in set(folder.glob("clear-view-*.png")) - {path}:
            old.unlink(missing_ok=True)
        _save(path, np.asarray(np.rint(image), np.uint8))

    return ClearView(None if kept is None else np.asarray(kept, np.float32), keep)


def look_before_work(view: ClearView, camera: Camera, clock: Clock, timeout: float) -> None:
    """Learn how the table looks before anything moves, where no earlier start has left that on record.

    A hand that reaches in between this and the first look is no part of the cell. A camera that gives no picture yet
    is no concern here: the first look will meet it.

    Args:
        view: Learns it.
        camera: The cell's.
        clock: The cell's.
        timeout: s to wait for a picture.
    """
    if view.image is None:
        with suppress(CameraError):
            view.learn(coarse(camera.capture(clock.now(), timeout).image))


def _save(path: Path, image: NDArray[np.uint8]) -> None:
    """Write a picture whole or not at all: half of one would be a reference too."""
    beside = path.with_suffix(".new")
    try:
        with beside.open("wb") as file:
            file.write(cv2.imencode(".png", image)[1].tobytes())
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    except OSError as error:
        _log.warning("%s: %s: it is learnt again at the next start", path, error.strerror or error)
