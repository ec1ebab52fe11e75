"""Where free parts of known height are found anywhere in the view, beside the truth of painted pictures.

    python -m tests.benchmarks.localization
    python -m tests.benchmarks.localization --size 1920x1080 --field 80
    python -m tests.benchmarks.localization --dim 0.35

Every seed is another cell: camera, lens, lamp, and five shapes of 10 to 30 mm height. Lens and table are calibrated
from painted boards by the code a user runs; then ten parts are laid anywhere the camera sees them whole. The same
outlines are located with the prism fit and without it (the silhouette's middle on the plane at half height).
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from controller.backends import BackendOptions, Level, PaintedTable
from controller.calibration.arm import by_ruler
from controller.calibration.board_spec import parse_board
from controller.calibration.guided import calibrate_by_showing
from controller.calibration.store import cell_calibration
from controller.config.arm import load_arm
from controller.config.cell import CellConfig, PartSection, load_cell
from controller.config.files import shipped
from controller.domain import CellCalibration, LocatedObject, Point, Shape, TruePart
from controller.geometry import angle_difference
from controller.localization.locate import locate
from controller.vision.detect import detect
from controller.vision.recipe import load_recipe

#: The first seed of the stated figures; smaller ones served while the code was made.
FIRST_SEED = 5000
HEIGHTS = 10.0, 30.0
#: Extents across the flats, mm; a rectangle is 1.4 times as long.
WIDTHS = tuple(float(width) for width in range(24, 51, 2))
_SHAPES = (Shape.SQUARE, Shape.RECTANGLE, Shape.CIRCLE, Shape.HEXAGON, Shape.TRIANGLE)
_REACH = 43.0  # mm from the middle of the largest part to its farthest corner
_APART = 110.0  # mm between two middles: no part hides another's foot, and no shadow reaches one
_BORDER = 12.0  # px
#: Mean and 95th percentile of the position, 95th percentiles of angle and size.
TARGETS = {"position_mm": {"mean": 0.20, "p95": 0.50}, "angle_deg": {"p95": 0.3}, "size_mm": {"p95": 0.3}}
_RIM = 0.2  # of the picture's width and height: nearer to its border, lens and parallax are at their worst
_NEAR = 12.0  # mm: half of the narrowest part; nearer than this, what is located can only be that part


@dataclass(frozen=True, slots=True)
class Miss:
    """What one located part is off by.

    Attributes:
        position: mm.
        angle: deg modulo the shape's symmetry, None for a circle.
        size: The worse of its two sides, mm.
        at_rim: Its middle is seen near the picture's border.
    """

    position: float
    angle: float | None
    size: float
    at_rim: bool


@dataclass(frozen=True, slots=True)
class Cell:
    """What was made of one cell's parts.

    Attributes:
        parts: How many lay there.
        misnamed: Located, as another shape.
        refused: Detected, and refused by the fit.
        refined, rough: Of those located under their right shape, with and without the prism fit.
    """

    parts: int
    misnamed: int
    refused: int
    refined: tuple[Miss, ...]
    rough: tuple[Miss, ...]


@dataclass(frozen=True, slots=True)
class Look:
    """What kind of camera looks, and how.

    Attributes:
        size: (width, height), px.
        field: Horizontal field of view, deg.
        dim: Share of the usual light that is left.
    """

    size: tuple[int, int] = (1280, 720)
    field: float = 65.0
    dim: float = 1.0


USUAL = Look()


def study(seed: int, parts: int, level: Level, look: Look = USUAL) -> Cell:
    """Calibrate one cell, lay parts, look once."""
    random = np.random.default_rng([seed, 97])
    heights = {shape: float(random.uniform(*HEIGHTS)) for shape in _SHAPES}
    config = _with_heights(load_cell(shipped("sim.toml")), heights)
    width, height = look.size
    camera = config.camera.model_copy(update={"width": width, "height": height, "field_of_view_deg": look.field})
    config = config.model_copy(update={"camera": camera})
    arm = load_arm(config.arm.description)
    dim = {"exposure": look.dim} if look.dim != 1.0 else {}
    table = PaintedTable(config, arm, BackendOptions(Path(), seed=seed, level=level), dim)
    board = parse_board(config.table.board)
    lens, plane = calibrate_by_showing(
        table.camera, table.presenter, board, table.clock, field=math.radians(look.field)
    )
    ruler = by_ruler(config.table.T_base_table(), lens.calibration_id, plane.calibration_id, arm.name)
    calibration = cell_calibration(lens, plane, ruler)
    places = _places(calibration, parts, random)
    laid = [
        (_SHAPES[index % len(_SHAPES)], place, float(random.uniform(-math.pi, math.pi)))
        for index, place in enumerate(places)
    ]
    frame, truth = table.show(laid, WIDTHS, seed)
    middle = float(np.mean(list(heights.values()))) / 2
    detected = detect(frame, load_recipe(config.vision.recipe), plane=calibration.plane(middle)).detections
    refined = locate(detected, calibration, config.part_height)
    rough = locate(detected, calibration, config.part_height, refine=False)
    good, misnamed = _compared(refined.objects, truth, look)
    return Cell(len(truth), misnamed, len(refined.refused), good, _compared(rough.objects, truth, look)[0])


def figures(misses: Sequence[Miss]) -> dict[str, dict[str, float]]:
    """Mean, 95th percentile and maximum of position (mm), angle (deg) and size (mm)."""
    columns = {
        "position_mm": [miss.position for miss in misses],
        "angle_deg": [miss.angle for miss in misses if miss.angle is not None],
        "size_mm": [miss.size for miss in misses],
    }
    return {name: _spread(np.array(values)) for name, values in columns.items()}


def _spread(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> dict[str, float]:
    named = {"mean": values.mean(), "p95": np.percentile(values, 95), "max": values.max()}
    return {name: round(float(value), 3) for name, value in named.items()}


def _with_heights(config: CellConfig, heights: Mapping[Shape, float]) -> CellConfig:
    sections = tuple(PartSection(shape=shape, height_mm=height) for shape, height in heights.items())
    return config.model_copy(update={"parts": sections})


def _places(calibration: CellCalibration, count: int, random: np.random.Generator) -> list[Point]:
    """Middles on the table, mm: evenly drawn over the picture, each part whole in view whatever its height and turn."""
    size = np.array(calibration.camera.image_size)
    ring = _REACH * np.array([[math.cos(a), math.sin(a)] for a in np.linspace(0.0, 2 * math.pi, 24, endpoint=False)])
    planes = calibration.plane(0.0), calibration.plane(HEIGHTS[1])
    out: list[Point] = []
    for _ in range(20_000):
        place = planes[0].to_plane(random.uniform(0.0, 1.0, (1, 2)) * size)[0]
        seen = np.vstack([plane.to_pixels(place + ring) for plane in planes])
        inside = ((seen > _BORDER) & (seen < size - 1 - _BORDER)).all()
        if inside and all(math.dist(place, other) > _APART for other in out):
            out.append((float(place[0]), float(place[1])))
            if len(out) == count:
                break
    return out


def _compared(
    objects: Sequence[LocatedObject], truth: Sequence[TruePart], look: Look
) -> tuple[tuple[Miss, ...], int]:
    """The misses of what was located under its right shape, and how many were not."""
    misses, misnamed = [], 0
    for part in truth:
        near = min(objects, key=lambda thing: math.dist(thing.center, part.center), default=None)
        if near is None or (distance := math.dist(near.center, part.center)) > _NEAR:
            continue
        if near.shape is not part.shape:
            misnamed += 1
            continue
        angle = None
        if part.yaw is not None and near.yaw is not None and part.shape.period is not None:
            angle = abs(math.degrees(angle_difference(near.yaw, part.yaw, part.shape.period)))
        size = max(abs(a - b) for a, b in zip(part.size, near.size, strict=True))
        share = np.array(near.detection.center_px) / look.size
        at_rim = bool(np.minimum(share, 1.0 - share).min() < _RIM)
        misses.append(Miss(distance, angle, size, at_rim))
    return tuple(misses), misnamed


def verdict(found: Mapping[str, Mapping[str, float]]) -> str:
    """What is met of the targets, in words."""
    missed = [
        f"{name} {key} {found[name][key]:g} > {limit:g}"
        for name, limits in TARGETS.items()
        for key, limit in limits.items()
        if not found[name][key] <= limit
    ]
    return "met" if not missed else "NOT MET: " + ", ".join(missed)


def _pixels(text: str) -> tuple[int, int]:
    width, height = text.split("x")
    return int(width), int(height)


def main() -> None:
    """Run the study: 50 cells of 10 parts take about five minutes of processor time."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=50)
    parser.add_argument("--parts", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--level", type=Level, default=Level.DYNAMIC, choices=list(Level))
    parser.add_argument("--size", type=_pixels, default=(1280, 720), help="of the pictures, e.g. 800x600")
    parser.add_argument("--field", type=float, default=65.0, help="horizontal field of view, deg")
    parser.add_argument("--dim", type=float, default=1.0, help="share of the usual light")
    asked = parser.parse_args()
    look = Look(asked.size, asked.field, asked.dim)
    cells = []
    for seed in range(asked.first_seed, asked.first_seed + asked.cells):
        cell = study(seed, asked.parts, asked.level, look)
        cells.append(cell)
        worst = max((miss.position for miss in cell.refined), default=0.0)
        line = {"seed": seed, "parts": cell.parts, "located": len(cell.refined), "misnamed": cell.misnamed}
        print(json.dumps(line | {"refused": cell.refused, "worst_mm": round(worst, 3)}), flush=True)
    counts = {
        "parts": sum(cell.parts for cell in cells),
        "located": sum(len(cell.refined) for cell in cells),
        "misnamed": sum(cell.misnamed for cell in cells),
        "refused": sum(cell.refused for cell in cells),
    }
    refined = [miss for cell in cells for miss in cell.refined]
    rough = [miss for cell in cells for miss in cell.rough]
    rim = [miss for miss in refined if miss.at_rim]
    print(json.dumps({"by": "prism fit", "level": str(asked.level), **counts, **figures(refined)}))
    if rim:
        print(json.dumps({"by": "prism fit, near the picture's border", "parts": len(rim), **figures(rim)}))
    print(json.dumps({"by": "half height, without the fit", **figures(rough)}))
    print(f"targets {json.dumps(TARGETS)}: {verdict(figures(refined))}")


if __name__ == "__main__":
    main()
