"""A nominal cell and made-up parts for the motion tests."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from controller.config.arm import load_arm
from controller.domain import (
    ArmDescription,
    Array,
    Bin,
    CellCalibration,
    Descriptors,
    Detection,
    Frame,
    LocatedObject,
    Point,
    Shape,
)
from controller.geometry import CameraModel, pose, wrap

ARMS = ("reactorx_150", "pincherx_100", "widowx_200", "widowx_250", "open_manipulator_x")
RX150: ArmDescription = load_arm("reactorx_150")
TABLE_X = 230.0  # base x of the table's origin, mm
PARTS = (Shape.SQUARE, Shape.RECTANGLE, Shape.CIRCLE, Shape.HEXAGON, Shape.TRIANGLE)


def calibration(joint_offsets: dict[str, float] | None = None, yaw: float = 0.0) -> CellCalibration:
    matrix = np.array([[1005.0, 0.0, 640.0], [0.0, 1005.0, 360.0], [0.0, 0.0, 1.0]])
    camera = CameraModel(matrix, np.zeros(5), (1280, 720))
    looking_down = np.diag([0.0, 0.0, -1.0, 1.0])
    looking_down[0, 1] = looking_down[1, 0] = -1.0
    looking_down[2, 3] = 600.0
    return CellCalibration("test", camera, looking_down, pose(TABLE_X, yaw=yaw), joint_offsets or {}, 0.2)


def bins(radius: float = 230.0) -> tuple[Bin, ...]:
    angles = (80, 110, 140, -80, -110, -140)
    places = [(radius * math.cos(math.radians(a)) - TABLE_X, radius * math.sin(math.radians(a))) for a in angles]
    return tuple(Bin(f"bin{k}", place, (90.0, 90.0), 35.0, 6) for k, place in enumerate(places))


def outline(shape: Shape, size: float) -> Array:
    """A footprint `size` mm across the grip, its first edge along x."""
    if shape is Shape.RECTANGLE:
        corners = np.array([[-0.7, -0.5], [0.7, -0.5], [0.7, 0.5], [-0.7, 0.5]]) * size
        return corners
    count = {Shape.SQUARE: 4, Shape.HEXAGON: 6, Shape.TRIANGLE: 3, Shape.CIRCLE: 48}[shape]
    across = {Shape.SQUARE: math.cos(math.pi / 4), Shape.HEXAGON: math.cos(math.pi / 6), Shape.CIRCLE: 1.0}
    radius = size / 1.5 if shape is Shape.TRIANGLE else size / 2.0 / across[shape]
    angles = 2.0 * math.pi * np.arange(count) / count - math.pi / 2 - math.pi / count
    return radius * np.column_stack([np.cos(angles), np.sin(angles)])


def part(
    shape: Shape, size: float, center: Point, yaw: float = 0.0, height: float = 25.0, sigma: float = 0.3
) -> LocatedObject:
    c, s = math.cos(yaw), math.sin(yaw)
    footprint = outline(shape, size) @ np.array([[c, s], [-s, c]]) + center
    angle = None if shape.period is None else wrap(yaw, shape.period)
    box = (1.4 * size if shape is Shape.RECTANGLE else size, size)
    frame = Frame(1, 0.0, np.zeros((2, 2, 3), np.uint8))
    detection = Detection(
        frame, shape, 1.0, footprint, center, box, angle, 1.0, (0.0, 0.0, 1.0, 1.0), Descriptors(1.0, 1.0, 0.0)
    )
    return LocatedObject(detection, center, angle, box, height, footprint, sigma, "test")


def at(radius: float, azimuth_deg: float) -> Point:
    """A place about the waist axis, in `table`, mm."""
    a = math.radians(azimuth_deg)
    return radius * math.cos(a) - TABLE_X, radius * math.sin(a)


def scatter(rng: np.random.Generator, count: int, gap: float = 0.0) -> list[LocatedObject]:
    """Parts in the work area whose outer circles keep `gap` mm apart (bounding circles, so never touching)."""
    found: list[LocatedObject] = []
    radii: list[float] = []
    while len(found) < count:
        size = float(rng.uniform(34.0, 45.0))
        place = at(math.sqrt(float(rng.uniform(150.0**2, 260.0**2))), float(rng.uniform(-50.0, 50.0)))
        shape = PARTS[int(rng.integers(len(PARTS)))]
        thing = part(shape, size, place, float(rng.uniform(0.0, 2.0 * math.pi)), float(rng.uniform(20.0, 30.0)))
        reach = float(np.linalg.norm(thing.footprint - np.array(place), axis=1).max())
        if all(math.dist(place, o.center) > reach + r + gap for o, r in zip(found, radii, strict=True)):
            found.append(thing)
            radii.append(reach)
    return found


def polygon_gap(first: Array, second: Array) -> float:
    """Distance of two convex polygons, 0 when they overlap (separating axes, then corners to edges), mm."""
    for a, b in ((first, second), (second, first)):
        edges = np.roll(a, -1, axis=0) - a
        normals = np.column_stack([edges[:, 1], -edges[:, 0]])
        if any((b @ n).min() > (a @ n).max() or (b @ n).max() < (a @ n).min() for n in normals):
            break
    else:
        return 0.0
    return min(_corner_gap(first, second), _corner_gap(second, first))


def _corner_gap(corners: Array, polygon: Array) -> float:
    start, edge = polygon, np.roll(polygon, -1, axis=0) - polygon
    offset = corners[:, None] - start
    t = np.clip((offset * edge).sum(2) / (edge * edge).sum(1), 0.0, 1.0)
    return float(np.linalg.norm(offset - t[..., None] * edge, axis=2).min())


def jaw_sweeps(center: Sequence[float], direction: float, width: float, opening: float) -> tuple[Array, Array]:
    """Corners of the two rectangles that RX150's jaws sweep from open to contact, mm."""
    thickness, across = RX150.gripper.jaw_size
    axis = np.array([math.cos(direction), math.sin(direction)])
    side = np.array([-axis[1], axis[0]])
    near, far, half = width / 2.0, opening / 2.0 + thickness, across / 2.0
    corners = ((near, -half), (far, -half), (far, half), (near, half))
    first, second = (np.array([center + s * a * axis + b * side for a, b in corners]) for s in (1.0, -1.0))
    return first, second[::-1]
