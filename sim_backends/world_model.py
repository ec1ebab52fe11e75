"""The physics model: an MJCF text from an arm description, bins and parts.

MuJoCo's own units inside (m, kg); everything else in this package speaks mm. Contact settings are the ones
under which friction grasps of prisms hold: elliptic cones, impratio 100, condim 4, stiff contacts, 2 ms.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from controller.domain import ArmDescription, Bin
from sim_backends.arm_shape import BASE, LEFT, RIGHT, link_name
from sim_backends.imperfections import Imperfections
from sim_backends.mechanics import MM, coupling, half_opening, horn_range, mechanics
from sim_backends.parts import Part
from sim_backends.solids import Array, Solid, box, prism

STEP = 0.002

# Collision classes: what may touch what.
_PART, _FIXED, _ARM, _BASE, _CRADLE = 1, 2, 4, 8, 16

TABLE_LOW, TABLE_HIGH = (-420.0, -600.0), (660.0, 600.0)  # the table's top in `base`, mm
TABLE_THICKNESS = 25.0
FLOOR = -700.0
WALL = 3.0  # bins: thickness of walls and floor, mm
HORN = "horn"
_SIDES = ((LEFT, 1.0), (RIGHT, -1.0))
HAND = "hand"
HAND_AWAY = (3000.0, 0.0, 100.0)  # where nobody sees it, mm
CRADLE = "cradle"
_AXES = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}
# The stops lie beyond the described limits, as the horn of a real servo may sit askew.
_STOP_MARGIN = math.radians(3.0)
# Without torque an arm leans on itself: on stops this far beyond its rest pose where a limit is near, and with its
# hand on a pad of the turret.
_LEAN, _NEAR = math.radians(1.0), math.radians(10.0)
_PAD = (15.0, 17.0, 8.0)  # mm: along the hand from the last joint, below its axis, radius


def bin_solids(bins: Sequence[Bin], T_base_table: Array) -> dict[str, tuple[Solid, ...]]:
    """Floor and four walls of every bin, in `base` coordinates."""
    out: dict[str, tuple[Solid, ...]] = {}
    for bin_ in bins:
        a, b = bin_.size[0] / 2.0, bin_.size[1] / 2.0
        t, h = WALL, bin_.height
        colour = (122.0, 112.0, 104.0)
        walls = [
            ((-a, -b), (a, b), t),
            ((-a - t, -b - t), (a + t, -b), h),
            ((-a - t, b), (a + t, b + t), h),
            ((-a - t, -b), (-a, b), h),
            ((a, -b), (a + t, b), h),
        ]
        placed = []
        for low, high, top in walls:
            # The floor is a little darker than the rims, as the inside of a box is.
            shade = 0.72 if top == t else 1.0
            flat = box((*low, 0.0), (*high, top), body="world", colour=tuple(c * shade for c in colour))  # type: ignore[arg-type]
            local = flat.vertices + np.array([*bin_.center, 0.0])
            vertices = local @ T_base_table[:3, :3].T + T_base_table[:3, 3]
            placed.append(Solid("world", vertices, flat.faces, flat.colour, flat.split))
        out[bin_.name] = tuple(placed)
    return out


def part_solid(index: int, part: Part, colour: tuple[float, float, float]) -> Solid:
    """The prism of a part about its centre."""
    half = part.height / 2.0
    ring = part.outline
    # Long straight sides bend in the lens; the short ones of a round part need no splitting.
    name = part_name(index)
    split = 1 if len(ring) > 12 else 4
    return prism(ring, -half, half, body=name, colour=colour, split=split, decal=name if part.marking else "")


def part_name(index: int) -> str:
    """Name of the body of part `index`."""
    return f"part{index}"


def build(
    arm: ArmDescription,
    arm_solids: Sequence[Solid],
    bins: dict[str, tuple[Solid, ...]],
    parts: Sequence[Part],
    imperfections: Imperfections,
    hand: bool = False,
) -> str:
    """The MJCF text of the whole cell, with a hand that only the camera sees where one is asked for."""
    meshes: list[str] = []
    world = [_plane(), _table(), *(_fixed(name, solids) for name, solids in bins.items())]
    world.append(_fixed(BASE, [s for s in arm_solids if s.body == BASE], arm=True))
    world.append(_chain(arm, arm_solids, imperfections, 0))
    for index, part in enumerate(parts):
        body, mesh = _part(index, part)
        world.append(body)
        meshes += mesh
    if hand:
        world.append(f'<body name="{HAND}" mocap="true" pos="{_numbers(np.array(HAND_AWAY) * MM)}"/>')
    constant, *rest = coupling(arm.gripper)
    # MuJoCo counts both joints from their references: the servo's 0, the jaw's half opening there.
    coefficients = _numbers((constant - half_opening(arm.gripper, 0.0) * MM, *rest))
    equality = "".join(
        f'<joint joint1="{finger}" joint2="{HORN}" polycoef="{coefficients}" solref="0.004 1" '
        f'solimp="0.999 0.9999 0.001"/>'
        for finger in (LEFT, RIGHT)
    )
    actuators = "".join(
        f'<general name="{name}" joint="{joint}" gaintype="fixed" biastype="affine" gainprm="0" biasprm="0 0 0" '
        f'forcerange="-1e-9 1e-9"/>'
        for name, joint in servo_joints(arm)
    )
    return f"""<mujoco model="cell">
<compiler angle="radian" autolimits="true" boundmass="1e-6" boundinertia="1e-10"/>
<option timestep="{STEP}" integrator="implicitfast" cone="elliptic" impratio="100">
<flag sleep="enable" multiccd="enable"/></option>
<size memory="16M"/>
<default><geom condim="4" solref="0.004 1" solimp="0.95 0.99 0.001" friction="0.3 0.003 0.0001"/></default>
<asset>{"".join(meshes)}</asset>
<worldbody>{"".join(world)}</worldbody>
<equality>{equality}</equality>
<contact><exclude body1="{LEFT}" body2="{RIGHT}"/></contact>
<actuator>{actuators}</actuator>
</mujoco>"""


def servo_joints(arm: ArmDescription) -> list[tuple[str, str]]:
    """(actuator, joint) for every servo: joints base to tool, their shadows, the gripper."""
    out = []
    for joint in arm.joints:
        out.append((f"servo{joint.servo_id}", joint.name))
        if joint.shadow_id is not None:
            out.append((f"servo{joint.shadow_id}", joint.name))
    return [*out, (f"servo{arm.gripper.servo_id}", HORN)]


def _numbers(values: Sequence[float] | Array) -> str:
    return " ".join(f"{float(v):.9g}" for v in np.asarray(values).ravel())


def _plane() -> str:
    return (
        f'<geom name="floor" type="plane" pos="0 0 {FLOOR * MM}" size="5 5 0.1" '
        f'contype="{_FIXED}" conaffinity="{_PART}"/>'
    )


def _table() -> str:
    low, high = np.array(TABLE_LOW) * MM, np.array(TABLE_HIGH) * MM
    size = (*((high - low) / 2.0), TABLE_THICKNESS * MM / 2.0)
    at = (*((high + low) / 2.0), -TABLE_THICKNESS * MM / 2.0)
    return (
        f'<geom name="table" type="box" pos="{_numbers(at)}" size="{_numbers(size)}" '
        f'contype="{_FIXED}" conaffinity="{_PART | _ARM}"/>'
    )


def _geom(name: str, solid: Solid, kind: int, touches: int) -> str:
    """A box geom around a solid whose edges are along the axes or turned about z only."""
    edges = solid.vertices[list(solid.faces[0])]
    axis = edges[1] - edges[0]
    yaw = math.atan2(axis[1], axis[0]) if kind == _FIXED and abs(axis[2]) < 1e-9 else 0.0
    c, s = math.cos(yaw), math.sin(yaw)
    local = solid.vertices @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    low, high = local.min(axis=0), local.max(axis=0)
    middle = (low + high) / 2.0
    at = np.array([c * middle[0] - s * middle[1], s * middle[0] + c * middle[1], middle[2]])
    return (
        f'<geom name="{name}" type="box" pos="{_numbers(at * MM)}" size="{_numbers((high - low) / 2.0 * MM)}" '
        f'euler="0 0 {yaw:.9g}" contype="{kind}" conaffinity="{touches}"/>'
    )


def _fixed(name: str, solids: Sequence[Solid], *, arm: bool = False) -> str:
    # The arm never reaches its own base within its joint limits: only parts can touch it.
    kind, touches = (_BASE, _PART) if arm else (_FIXED, _PART | _ARM)
    geoms = "".join(_geom(f"{name}/{i}", s, kind, touches) for i, s in enumerate(solids))
    return f'<body name="{name}">{geoms}</body>' if arm else geoms


def _stops(arm: ArmDescription, index: int) -> tuple[float, float]:
    """Mechanical stops of a joint, rad."""
    (low, high), rest = arm.joints[index].limits, arm.rest[index]
    low = rest - _LEAN if 0.0 <= rest - low < _NEAR else low - _STOP_MARGIN
    high = rest + _LEAN if 0.0 <= high - rest < _NEAR else high + _STOP_MARGIN
    return low, high


def _cradle(arm: ArmDescription) -> str:
    """A pad on the turret, under the hand of the arm at rest."""
    along, below, radius = _PAD
    place, pitch = np.zeros(2), 0.0
    for index, joint in enumerate(arm.joints[1:], 1):
        x, z = joint.offset[0], joint.offset[2]
        c, s = math.cos(pitch), math.sin(pitch)
        place += (c * x + s * z, c * z - s * x)
        if joint.axis == "y":
            pitch += arm.rest[index]
    c, s = math.cos(pitch), math.sin(pitch)
    depth = -(below + radius)
    x, z = place + np.array([c * along + s * depth, c * depth - s * along])
    return (
        f'<geom name="{CRADLE}" type="capsule" fromto="{_numbers((x * MM, -0.014, z * MM, x * MM, 0.014, z * MM))}" '
        f'size="{radius * MM}" contype="{_CRADLE}" conaffinity="0"/>'
    )


def _chain(arm: ArmDescription, solids: Sequence[Solid], imperfections: Imperfections, index: int) -> str:
    joint, link = arm.joints[index], arm.links[index]
    gear = mechanics(joint.model)
    servos = 1 if joint.shadow_id is None else 2
    name = link_name(index)
    low, high = _stops(arm, index)
    touches = _PART | _FIXED | (_CRADLE if index + 1 == len(arm.joints) else 0)
    own = [s for s in solids if s.body == name]
    vertices = np.vstack([s.vertices for s in own]) * MM
    finger_mass = 0.016 if index == len(arm.joints) - 1 else 0.0  # kg each; [rx150 URDF] gripper_finger
    mass = link.mass * imperfections.link_scale[index] - 2.0 * finger_mass
    # A solid block of the link's outer size: within a third of the published inertias, and small beside the rotor's.
    a, b, c = (vertices.max(axis=0) - vertices.min(axis=0)) ** 2 / 12.0
    inertia = (mass * (b + c), mass * (a + c), mass * (a + b))
    inside = [
        f'<joint name="{joint.name}" type="hinge" axis="{_AXES[joint.axis]}" '
        f'range="{low:.9g} {high:.9g}" '
        f'armature="{gear.inertia * servos}" frictionloss="{gear.friction * servos}" solreflimit="0.008 1"/>',
        f'<inertial pos="{_numbers(np.array(link.center) * MM)}" mass="{mass:.9g}" diaginertia="{_numbers(inertia)}"/>',
        *(_geom(f"{name}/{i}", s, _ARM, touches) for i, s in enumerate(own)),
    ]
    if index == 0:
        inside.append(_cradle(arm))
    if index + 1 < len(arm.joints):
        inside.append(_chain(arm, solids, imperfections, index + 1))
    else:
        inside += [_jaw(arm, solids, name, side, finger_mass, imperfections.jaw_shift) for name, side in _SIDES]
        inside.append(_horn(arm))
    return f'<body name="{name}" pos="{_numbers(np.array(joint.offset) * MM)}">{"".join(inside)}</body>'


def _jaw(
    arm: ArmDescription, solids: Sequence[Solid], name: str, side: float, mass: float, shift: Sequence[float]
) -> str:
    own = [s for s in solids if s.body == name]
    middle = np.vstack([s.vertices for s in own]).mean(axis=0) * MM
    geoms = "".join(_geom(f"{name}/{i}", s, _ARM, _PART | _FIXED) for i, s in enumerate(own))
    start = half_opening(arm.gripper, 0.0) * MM
    # The joint's reference is the half opening at servo angle 0, so that the coupling needs no shift.
    return (
        f'<body name="{name}" pos="0 {side * start + shift[0] * MM:.9g} {shift[1] * MM:.9g}">'
        f'<joint name="{name}" type="slide" axis="0 {side} 0" ref="{start:.9g}" damping="2"/>'
        f'<inertial pos="{_numbers(middle)}" mass="{mass}" diaginertia="3e-6 3e-6 3e-6"/>{geoms}</body>'
    )


def _horn(arm: ArmDescription) -> str:
    gear = mechanics(arm.gripper.model)
    low, high = horn_range(arm.gripper)
    return (
        f'<body name="{HORN}"><joint name="{HORN}" type="hinge" axis="1 0 0" range="{low:.9g} {high:.9g}" '
        f'armature="{gear.inertia}" frictionloss="{gear.friction}"/>'
        f'<inertial pos="0.05 0 0" mass="0.001" diaginertia="1e-6 1e-6 1e-6"/></body>'
    )


def _part(index: int, part: Part) -> tuple[str, list[str]]:
    name = part_name(index)
    half = part.height / 2.0 * MM
    ring = part.outline * MM
    mesh: list[str] = []
    if len(ring) == 4:
        geom = f'type="box" size="{ring[2][0]:.9g} {ring[2][1]:.9g} {half:.9g}"'
    elif len(ring) > 12:
        geom = f'type="cylinder" size="{part.grip / 2.0 * MM:.9g} {half:.9g}"'
    else:
        vertices = np.vstack([np.column_stack([ring, np.full(len(ring), z)]) for z in (-half, half)])
        mesh.append(f'<mesh name="{name}" vertex="{_numbers(vertices)}" inertia="convex"/>')
        geom = f'type="mesh" mesh="{name}"'
    # Priority: the part's own friction decides every contact it takes part in.
    return (
        f'<body name="{name}" pos="{part.x * MM:.9g} {part.y * MM:.9g} {half:.9g}" euler="0 0 {part.yaw:.9g}">'
        f'<freejoint name="{name}"/><geom name="{name}" {geom} mass="{part.mass:.9g}" priority="1" '
        f'friction="{part.friction:.9g} 0.005 0.0001" contype="{_PART}" '
        f'conaffinity="{_PART | _FIXED | _ARM | _BASE}"/></body>'
    ), mesh
