"""Where views of a new part come from: picture files, the simulated cell, or the camera of a real one."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from controller.backends import BackendOptions, Level, PaintedTable, lone_camera
from controller.calibration.arm import by_ruler
from controller.calibration.board_spec import parse_board
from controller.calibration.guided import calibrate_by_showing
from controller.calibration.store import cell_calibration, load_calibration
from controller.cli.detect import picture_files
from controller.cli.looking import Looking
from controller.config.arm import load_arm
from controller.config.cell import CellConfig
from controller.cycle.view import region_mask
from controller.errors import InputError
from controller.geometry import invert, transform
from controller.service.folders import state_folder
from controller.vision.classes.features import Floats32, features
from controller.vision.classes.markings import tiles_of
from controller.vision.read import read_image

_A_PICTURE = 3
"""Parts in a simulated picture: each lies somewhere in its own third of the work area."""
_ALONG, _ACROSS = 0.1, 0.18
"""How far they keep from the work area's borders, and how far they may stray along its arc, shares of the whole."""
_WIDTHS = (36.0, 43.0, 50.0)


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """What one picture showed.

    Attributes:
        picture: Its name.
        views: ndarray of shape (n, features.LENGTH): a row for each part in it.
        prints: ndarray of shape (n, markings.SIDE, markings.SIDE), dtype uint8: their tops.
    """

    picture: str
    views: Floats32
    prints: NDArray[np.uint8]


def from_pictures(images: list[Path], looking: Looking) -> Iterator[Shown]:
    """Views in picture files.

    Raises:
        InputError: A picture cannot be read, or shows nothing.
    """
    for path in picture_files(images):
        yield _shown(looking, read_image(path), path.name)


def from_simulation(
    name: str, config: CellConfig, level: Level, seed: int, views: int, recipe: str, say: Callable[[str], None]
) -> tuple[Looking, Iterator[Shown]]:
    """Views of a kind that the configuration lays on its simulated table, and how they are looked at.

    Raises:
        InputError: There is no kind of this name.
    """
    kind = next((kind for kind in config.simulated_kinds if kind.name == name), None)
    if kind is None:
        names = ", ".join(repr(kind.name) for kind in config.simulated_kinds) or "none"
        raise InputError(f"the simulated table holds no {name!r}", f"simulated_kinds of the configuration: {names}")
    arm = load_arm(config.arm.description)
    say("calibrating the simulated camera by showing it boards")
    table = PaintedTable(config, arm, BackendOptions(Path(), seed=seed, level=level))
    board, field = parse_board(config.table.board), math.radians(config.camera.field_of_view_deg)
    lens, plane = calibrate_by_showing(table.camera, table.presenter, board, table.clock, field=field)
    ruler = by_ruler(config.table.T_base_table(), lens.calibration_id, plane.calibration_id, arm.name)
    calibration = cell_calibration(lens, plane, ruler)
    region = region_mask(config, calibration, (config.camera.width, config.camera.height))
    looking = Looking(recipe, plane=calibration.plane(config.shape_plane_mm), region=region)
    widths = _WIDTHS if kind.width_mm is None else (kind.width_mm,)

    def show() -> Iterator[Shown]:
        random = np.random.default_rng([seed, 31])
        for number in range(math.ceil(views / _A_PICTURE)):
            places = _places(config, random)[: views - number * _A_PICTURE]
            laid = [(kind.shape, place, float(random.uniform(-math.pi, math.pi))) for place in places]
            frame, _ = table.show(laid, widths, 1000 * seed + number, kind)
            yield _shown(looking, frame.image, f"simulated {number + 1}")

    return looking, show()


def _places(config: CellConfig, random: np.random.Generator) -> list[tuple[float, float]]:
    """Where parts are laid for one picture, mm of `table`."""
    area = config.table.work_area
    low, high = area.azimuth_deg
    edge = _ALONG * (area.outer_radius_mm - area.inner_radius_mm)
    share = (np.arange(_A_PICTURE) + 0.5 + random.uniform(-_ACROSS, _ACROSS, _A_PICTURE)) / _A_PICTURE
    azimuth = np.radians(low + share * (high - low))
    radius = random.uniform(area.inner_radius_mm + edge, area.outer_radius_mm - edge, _A_PICTURE)
    places = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.zeros(_A_PICTURE)], axis=1)
    return [(float(x), float(y)) for x, y, _ in transform(invert(config.table.T_base_table()), places)]


def from_camera(
    name: str, config: CellConfig, views: int, recipe: str, say: Callable[[str], None]
) -> tuple[Looking, Iterator[Shown]]:
    """Views through the camera of a real cell, one picture each time Enter is pressed; nothing moves.

    Raises:
        CameraError: The camera cannot be opened, or gives no picture.
        InputError: Nobody can press Enter, or a picture shows nothing.
    """
    if not sys.stdin.isatty():
        raise InputError("nobody is there to lay parts and press Enter", "name pictures, or run it in a terminal")
    stored = state_folder() / "calibration"
    if stored.is_dir():
        calibration = load_calibration(stored)
        region = region_mask(config, calibration, (config.camera.width, config.camera.height))
        looking = Looking(recipe, plane=calibration.plane(config.shape_plane_mm), region=region)
    else:
        say("warning: the cell is not calibrated: sizes are in pixels, good at this height of the camera only")
        looking = Looking(recipe)

    def show() -> Iterator[Shown]:
        camera, clock = lone_camera(config, config.camera.device)
        camera.open()
        try:
            seen = 0
            while seen < views:
                say(f"{seen} of {views} views of {name!r}: lay it in another place and turn, then press Enter")
                if not sys.stdin.readline():
                    return
                frame = camera.capture(clock.now(), config.camera.frame_timeout_s)
                try:
                    shown = _shown(looking, frame.image, f"live {seen + 1}")
                except InputError as error:
                    say(str(error))
                    continue
                seen += len(shown.views)
                yield shown
        finally:
            camera.close()

    return looking, show()


def _shown(looking: Looking, image: NDArray[np.uint8], picture: str) -> Shown:
    detections, surfaces, plane = looking.see(image, picture)
    if not surfaces.which:
        raise InputError(f"{picture} shows nothing", "take pictures with the part whole in view, on a plain table")
    prints = tiles_of(image, [detections[k] for k in surfaces.which])
    return Shown(picture, features(detections, surfaces, plane), prints)
