"""What the arm looks like and where it can bump into things: boxes along the chain of its description."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from controller.domain import ArmDescription
from sim_backends.solids import Array, Colour, Solid, box, disc, prism

BLACK: Colour = (52.0, 48.0, 46.0)
SERVO: Colour = (74.0, 68.0, 66.0)
METAL: Colour = (148.0, 142.0, 138.0)
PAPER: Colour = (236.0, 238.0, 238.0)

LEFT, RIGHT = "finger_left", "finger_right"
BASE = "base"
# How far the grasp point lies beyond the rail that carries the fingers, mm (ReactorX-150: ee_gripper
# 0.093575 - fingers 0.066, both from wrist_rotate).
_BEYOND_RAIL = 27.5 + 8.5


@dataclass(frozen=True, slots=True)
class MarkerMount:
    """A printed ArUco marker on a plate that sticks out of the gripper.

    The plate stands out along z of `tool` (away from the arm's base when the tool points down with its last
    joint at zero) and faces back along -x, so that a camera above the table sees it while the tool points
    down or up to about 50 deg off.

    Attributes:
        dictionary: OpenCV's name of the dictionary.
        marker_id: Which of its markers.
        size: Side of the marker's black square, mm.
        margin: White border around it, mm.
        position: Its centre in `tool`, mm. Its axes in `tool` are fixed: x = -y, y = z, z = -x (x to the
            marker's right, y to its top, z towards the reader).
    """

    dictionary: str = "DICT_4X4_50"
    marker_id: int = 0
    size: float = 30.0
    margin: float = 5.0
    position: tuple[float, float, float] = (-60.0, 0.0, 62.0)

    @property
    def T_tool_marker(self) -> Array:
        """Nominal pose of the marker in `tool`, shape (4, 4), mm."""
        out = np.eye(4)
        out[:3, :3] = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        out[:3, 3] = self.position
        return out


def link_name(index: int) -> str:
    """Name of the body that joint `index` (from 0, at the base) carries."""
    return f"link{index + 1}"


def arm_solids(arm: ArmDescription, marker: MarkerMount, T_tool_marker: Array) -> tuple[Solid, ...]:
    """Everything of the arm that can be seen or touched.

    Args:
        arm: Its description.
        marker: The plate on the gripper.
        T_tool_marker: Where the marker truly is.
    """
    out: list[Solid] = []
    first = arm.joints[0].offset[2]
    out += [
        box((-75, -52, 0), (52, 52, 0.55 * first), body=BASE, colour=BLACK, chamfer=8.0),
        prism(disc(76.0)[::3], 0.55 * first, first - 3.0, body=BASE, colour=SERVO, split=1),
    ]
    last = len(arm.joints) - 1
    for index in range(last):
        out += _link(link_name(index), arm.joints[index].axis, arm.joints[index + 1].offset)
    out += _gripper(arm, link_name(last))
    out += _plate(arm, link_name(last), marker, T_tool_marker)
    return tuple(out)


def _link(body: str, axis: str, to: tuple[float, float, float]) -> list[Solid]:
    """A link from its joint to the next one's origin: a block around its own servo, beams up and ahead."""
    x, _, z = to
    if axis == "z":
        # The turret: two cheeks that hold the shoulder's servo.
        top = z + 21.0
        return [
            box((-26, -34, 0), (26, 34, 14), body=body, colour=BLACK, chamfer=6.0),
            box((-20, -36, 8), (20, -27, top), body=body, colour=BLACK, chamfer=4.0),
            box((-20, 27, 8), (20, 36, top), body=body, colour=BLACK, chamfer=4.0),
            box((-16, -26, 12), (16, 26, top - 4), body=body, colour=SERVO, chamfer=4.0),
        ]
    out: list[Solid] = []
    if z > 1.0:
        out.append(box((-15, -25, -15), (15, 25, z + 15), body=body, colour=BLACK, chamfer=6.0))
    if x > 1.0:
        y = 22.0 if x > 100.0 else 19.0
        out.append(box((-15, -y, z - 15), (x - 2.0, y, z + 15), body=body, colour=BLACK, chamfer=6.0))
        out.append(box((x - 40.0, -y - 5, z - 12), (x - 10.0, y + 5, z + 12), body=body, colour=SERVO, chamfer=3.0))
    return out


def _gripper(arm: ArmDescription, body: str) -> list[Solid]:
    tool, gripper = arm.tool[0], arm.gripper
    thickness, width = gripper.jaw_size
    rail = tool - _BEYOND_RAIL
    half = gripper.opening[1] / 2.0 + thickness + 3.0
    reach = tool + gripper.jaw_depth
    # Until the rail, what the last joint carries: motor and bracket.
    out = [
        box((4, -19, -17), (rail - 14.0, 19, 20), body=body, colour=SERVO, chamfer=5.0),
        box((rail - 16.0, -half, -12), (rail, half, 12), body=body, colour=BLACK, chamfer=4.0),
    ]
    for name, low, high in ((LEFT, 0.0, thickness), (RIGHT, -thickness, 0.0)):
        out.append(box((rail, low, -width / 2), (reach, high, width / 2), body=name, colour=METAL, chamfer=1.5))
    return out


def _plate(arm: ArmDescription, body: str, marker: MarkerMount, T_tool_marker: Array) -> list[Solid]:
    half = marker.size / 2.0 + marker.margin
    ring = np.array([[half, -half], [half, half], [-half, half], [-half, -half]])
    flat = prism(ring, -3.0, 0.0, body=body, colour=PAPER, decal="marker")
    tool = np.asarray(arm.tool, np.float64)
    place = flat.vertices @ T_tool_marker[:3, :3].T + T_tool_marker[:3, 3] + tool
    plate = Solid(body, place, flat.faces, flat.colour, flat.split, flat.decal)
    x, _, z = tool + np.asarray(marker.position)
    # Behind the plate, however it is mounted: a dark bracket over the white margin would hide the marker.
    bracket = box((x + 1.5, -8, 14), (x + 11.0, 8, z - half + 3.0), body=body, colour=BLACK)
    return [bracket, plate]
