"""Where the arm goes to be looked at, and how far beside its place the camera sees it there."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from controller.calibration.arm_model import MarkerView, Unknowns
from controller.calibration.arm_poses import lowest, visible
from controller.domain import Point
from controller.errors import PlanError, Unreachable
from controller.motion import kinematics
from controller.ports import Camera, Clock

Array = NDArray[np.float64]

#: Places keep this distance from every one that was fitted, mm: nearer ones would repeat its errors.
APART = 15.0
#: Time a pose is given to come to rest, s.
SETTLE = 0.4
_DRAWN = 400


def spread_places(
    view: MarkerView,
    unknowns: Unknowns,
    fitted: Array,
    count: int,
    height: float,
    radius: tuple[float, float],
    azimuth: tuple[float, float],
    seed: int,
    mapped: Sequence[Point] = (),
) -> list[Array]:
    """Joint angles of places drawn evenly over ring and sector, each in a stratum of its own, far from the fit.

    Args:
        view: The cell.
        unknowns: The arm without its joint offsets.
        fitted: ndarray of shape (N, 3): grasp points to keep away from, `table`, mm.
        count: Number of places.
        height: Lowest point of jaws and plate above the table, mm.
        radius: Nearest and farthest distance of a place from the base's z axis, mm.
        azimuth: From, to, about it, rad.
        seed: Of the draw.
        mapped: (x, y) to keep away from at any height, `table`, mm.

    Raises:
        Unreachable: Half of them cannot be reached and seen.
    """
    random = np.random.default_rng(seed)
    flat = np.array(mapped).reshape(-1, 2)
    rings = max(1, round(math.sqrt(count / 3)))
    out: list[Array] = []
    for attempt in range(_DRAWN):
        if len(out) == count:
            break
        # Strata go round by round, so that a place that falls out is drawn again in the next stratum.
        ring, sector = attempt % rings, (attempt // rings) % max(1, count // rings)
        share = (ring + random.uniform()) / rings
        far = math.sqrt(radius[0] ** 2 + share * (radius[1] ** 2 - radius[0] ** 2))
        turn = azimuth[0] + (sector + random.uniform()) / max(1, count // rings) * (azimuth[1] - azimuth[0])
        roll = random.uniform(-math.pi / 2, math.pi / 2) if len(view.arm.joints) > 4 else 0.0
        place = np.array([far * math.cos(turn), far * math.sin(turn), height + view.arm.gripper.jaw_depth])
        try:
            q = kinematics.inverse(view.arm, place, math.pi / 2, roll)[0]
        except Unreachable:
            continue
        tool = view.tools(unknowns, q[None])[0]
        away = min(
            float(np.linalg.norm(fitted - tool, axis=1).min(initial=math.inf)),
            float(np.linalg.norm(flat - tool[:2], axis=1).min(initial=math.inf)),
        )
        if away >= APART and lowest(view, q[None])[0] >= height - 1e-6 and visible(view, q[None], unknowns)[0]:
            out.append(q)
    if 2 * len(out) < count:
        raise Unreachable(
            f"only {len(out)} of {count} places can be reached and seen", "check the work area and the camera's view"
        )
    return out


def visit(
    poses: Sequence[Array], what: str, move_to: Callable[[Array], None], progress: Callable[[str], None]
) -> Iterator[Array]:
    """Stand at one pose after the other; yields each that could be reached, while the arm stands there.

    Args:
        poses: Joint angles (J,) each, rad.
        what: A pose is called in the lines for people.
        move_to: Brings the joints to wanted angles; a PlanError leaves the pose out.
        progress: Called with one line before each move.
    """
    for index, q in enumerate(poses, 1):
        progress(f"{what} {index} of {len(poses)}")
        try:
            move_to(q)
        except PlanError as error:
            progress(f"{what} {index} left out: {error.cause}")
            continue
        yield q


def seen_beside(camera: Camera, clock: Clock, view: MarkerView, unknowns: Unknowns, q: Array) -> Array | None:
    """How far (2,) beside its place the marker is seen once the arm is still, along x and y of `table`, mm.

    None when it is not seen.
    """
    clock.sleep(SETTLE)
    corners = view.marker.find(camera.capture(clock.now()).image, view.camera)
    if corners is None:
        return None
    points = view.in_camera(unknowns, q[None])[0]
    expected = view.camera.project(points)
    depth = float(points[:, 2].mean())
    # The difference of two rays at the marker's depth, turned into the table's directions.
    apart = (view.camera.rays(corners) - view.camera.rays(expected)).mean(axis=0) * depth
    return np.asarray((view.T_table_camera[:3, :3] @ apart)[:2])
