"""The paper's Table 1 again: its four shapes at its four places, by its method and by ours, on the same pictures.

The paper gives one measurement a shape; here every place is seen many times, from several mountings of a camera
with a real lens, each part turned anew every time. Both methods get what they ask for: the paper's the true focal
length and depth and the point its axis meets, ours the boards shown to the camera.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from controller.backends import BackendOptions, Level, PaintedTable
from controller.calibration.arm import by_ruler
from controller.calibration.board_spec import parse_board
from controller.calibration.guided import calibrate_by_showing
from controller.calibration.store import cell_calibration
from controller.config.arm import load_arm
from controller.config.cell import CellConfig
from controller.domain import Array, CellCalibration, Detection, Frame, Point, Shape
from controller.geometry import angle_difference
from controller.localization.locate import locate
from controller.localization.paper import PaperModel
from controller.vision.detect import detect
from controller.vision.recipe import load_recipe


@dataclass(frozen=True, slots=True)
class Printed:
    """One row of the paper's table, mm."""

    actual: Point
    detected: Point


#: Source: the paper, Table 1.
TABLE_1 = {
    Shape.RECTANGLE: Printed((-325.0, -82.0), (-338.25, -90.54)),
    Shape.HEXAGON: Printed((-258.0, -87.0), (-273.89, -94.61)),
    Shape.SQUARE: Printed((-232.0, -200.0), (-253.81, -191.74)),
    Shape.CIRCLE: Printed((-169.0, -118.0), (-203.57, -118.27)),
}
#: Its averages: percent in X, in Y, and of the orientation (section VI).
PRINTED_PERCENT, PRINTED_ORIENTATION = (10.017, 5.875), 2.79
#: The platform's upper right corner from the middle of the picture, mm to the right and up: the paper does not say
#: how large its platform is; one of 500 x 300 mm lies in the middle of the view.
CORNER = (250.0, 150.0)
#: The paper's recipe and equations; its equations on the outlines that ours finds; ours.
METHODS = ("paper", "model", "ours")
#: Across their flats, mm: wider ones would touch, for its rectangle and hexagon lie 67 mm apart.
WIDTHS = (36.0, 43.0)
#: Pictures from one mounting of the camera.
A_MOUNTING = 5
_NEAR = 40.0  # mm: a detection further off is of another part
_SHAPE_PLANE = 12.0  # mm: half the height of a common part, where vision judges shapes


@dataclass(frozen=True, slots=True)
class Measured:
    """What one method made of one part.

    Attributes:
        point: (X, Y) in the paper's frame, mm.
        shape: What it took it for.
        yaw: rad about z of `table`; None where it gives none.
    """

    point: Point
    shape: Shape
    yaw: float | None


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """One picture and what was made of it.

    Attributes:
        frame: The picture.
        truth: What lies there, by shape.
        measured: By method, then by the shape of the part; a part that was not found is missing.
        detections: Ours.
    """

    frame: Frame
    truth: Mapping[Shape, Measured]
    measured: Mapping[str, Mapping[Shape, Measured]]
    detections: tuple[Detection, ...]


def looks(
    config: CellConfig, frames: int, seed: int, level: Level, progress: Callable[[str], None] = lambda line: None
) -> Iterator[Look]:
    """Paint and measure `frames` pictures, `A_MOUNTING` from every mounting of the camera."""
    arm = load_arm(config.arm.description)
    recipes = load_recipe("paper"), load_recipe("precise")
    right, up = CORNER
    # The picture's right is -y of `table`, its top +x; its middle lies at `above_mm`.
    origin = config.camera.above_mm[0] + up, config.camera.above_mm[1] - right
    random = np.random.default_rng([seed, 51])
    for index in range(frames):
        if index % A_MOUNTING == 0:
            mounting = seed + index // A_MOUNTING
            progress(f"mounting {index // A_MOUNTING + 1} of {math.ceil(frames / A_MOUNTING)}: calibrating")
            table = PaintedTable(config, arm, BackendOptions(Path(), seed=mounting, level=level))
            board = parse_board(config.table.board)
            field = math.radians(config.camera.field_of_view_deg)
            lens, plane = calibrate_by_showing(table.camera, table.presenter, board, table.clock, field=field)
            ruler = by_ruler(config.table.T_base_table(), lens.calibration_id, plane.calibration_id, arm.name)
            calibration = cell_calibration(lens, plane, ruler)
            model = _paper_model(calibration, origin)
        laid = [
            (shape, _to_table(row.actual, origin), float(random.uniform(-math.pi, math.pi)))
            for shape, row in TABLE_1.items()
        ]
        frame, parts = table.show(laid, WIDTHS, seed=1000 * seed + index)
        truth = {part.shape: Measured(_to_paper(part.center, origin), part.shape, part.yaw) for part in parts}
        theirs = detect(frame, recipes[0]).detections
        detected = detect(frame, recipes[1], plane=calibration.plane(_SHAPE_PLANE)).detections
        located = locate(detected, calibration, config.part_height).objects
        measured = {
            "paper": _by_model(theirs, model),
            "model": _by_model(detected, model),
            "ours": [Measured(_to_paper(item.center, origin), item.shape, item.yaw) for item in located],
        }
        yield Look(frame, truth, {name: _matched(items, truth) for name, items in measured.items()}, detected)


def table(found: Sequence[Look]) -> dict[str, Any]:
    """The figures of both methods beside the printed ones: percent, mm and degrees, by shape and in the mean."""
    rows = {str(shape): _row(shape, found) for shape in TABLE_1}
    methods = {}
    for method in METHODS:
        mine = [row[method] for row in rows.values()]
        both = [_errors(method, shape, found) for shape in TABLE_1]
        percents = np.array([row["error_percent"] for row in mine if row["found"]]).reshape(-1, 2)
        methods[method] = {
            "found": sum(row["found"] for row in mine),
            "named": sum(row["named"] for row in mine),
            "error_percent": [round(float(value), 4) for value in percents.mean(axis=0)] if len(percents) else None,
            **_figures(np.vstack([errors for errors, _ in both]), np.concatenate([turns for _, turns in both])),
        }
    printed = np.array([np.subtract(row.detected, row.actual) for row in TABLE_1.values()])
    return {
        "frames": len(found),
        "parts": len(found) * len(TABLE_1),
        "rows": rows,
        "mean": {
            "printed": {
                "error_percent": list(PRINTED_PERCENT),
                "error_mm": round(float(np.linalg.norm(printed, axis=1).mean()), 2),
                "orientation_percent": PRINTED_ORIENTATION,
            },
            **methods,
        },
    }


def _row(shape: Shape, found: Sequence[Look]) -> dict[str, Any]:
    printed = TABLE_1[shape]
    share = np.abs(np.subtract(printed.detected, printed.actual) / np.array(printed.actual)) * 100.0
    row: dict[str, Any] = {
        "actual_mm": list(printed.actual),
        "printed": {"detected_mm": list(printed.detected), "error_percent": [round(float(v), 2) for v in share]},
    }
    for method in METHODS:
        errors, turns = _errors(method, shape, found)
        seen = [look.measured[method][shape] for look in found if shape in look.measured[method]]
        row[method] = {"found": len(seen), "named": sum(item.shape is shape for item in seen)}
        row[method] |= {"detected_mm": None, "error_percent": None, **_figures(errors, turns)}
        if seen:
            percent = np.abs(errors / np.array(printed.actual)).mean(axis=0) * 100.0
            row[method]["detected_mm"] = [round(float(v), 3) for v in np.mean([s.point for s in seen], axis=0)]
            row[method]["error_percent"] = [round(float(v), 4) for v in percent]
    return row


def _errors(method: str, shape: Shape, found: Sequence[Look]) -> tuple[Array, Array]:
    """Detected minus actual (N, 2), mm, and how far the direction is off (M,), deg, for one shape."""
    errors, turns = [], []
    for look in found:
        true, seen = look.truth[shape], look.measured[method].get(shape)
        if seen is None:
            continue
        errors.append(np.subtract(seen.point, true.point))
        if true.yaw is not None and seen.yaw is not None and shape.period is not None:
            turns.append(math.degrees(abs(angle_difference(seen.yaw, true.yaw, shape.period))))
    return np.array(errors).reshape(-1, 2), np.array(turns)


def _figures(errors: Array, turns: Array) -> dict[str, Any]:
    sizes = np.linalg.norm(errors, axis=1)
    return {
        "error_mm": round(float(sizes.mean()), 3) if len(sizes) else None,
        "p95_mm": round(float(np.percentile(sizes, 95)), 3) if len(sizes) else None,
        "orientation_deg": round(float(turns.mean()), 3) if len(turns) else None,
        "orientation_p95_deg": round(float(np.percentile(turns, 95)), 3) if len(turns) else None,
    }


def _paper_model(calibration: CellCalibration, origin: Point) -> PaperModel:
    """The paper's model with a perfect ruler: focal length, depth, and the point of the platform its axis meets."""
    camera, T = calibration.camera, calibration.T_table_camera
    width, height = camera.image_size
    depth = -T[2, 3] / T[2, 2]
    axis = T[:3, 3] + depth * T[:3, 2]
    x, y = _to_paper((float(axis[0]), float(axis[1])), origin)
    # X runs with the picture's x, against the equations' sign.
    focal = -float(camera.matrix[0, 0]), float(camera.matrix[1, 1])
    return PaperModel(focal, ((width - 1) / 2, (height - 1) / 2), float(depth), (-x, -y))


def _to_table(point: Point, origin: Point) -> Point:
    """(X, Y) of the paper's frame in `table`: X is -y, Y is x."""
    return origin[0] + point[1], origin[1] - point[0]


def _to_paper(point: Point, origin: Point) -> Point:
    return origin[1] - point[1], point[0] - origin[0]


def _by_model(detections: Sequence[Detection], model: PaperModel) -> list[Measured]:
    """Detections placed by the paper's equations; the picture's horizontal is -y of `table`, a quarter turn on."""
    places = model.world([item.center_px for item in detections]) if detections else np.empty((0, 2))
    return [
        Measured((float(x), float(y)), item.shape, None if item.angle is None else item.angle - math.pi / 2)
        for item, (x, y) in zip(detections, places, strict=True)
    ]


def _matched(items: Sequence[Measured], truth: Mapping[Shape, Measured]) -> dict[Shape, Measured]:
    """By the shape of the part: what was found nearest to it, where anything was found near it."""
    out = {}
    for shape, true in truth.items():
        best = min(items, key=lambda item: math.dist(item.point, true.point), default=None)
        if best is not None and math.dist(best.point, true.point) < _NEAR:
            out[shape] = best
    return out
