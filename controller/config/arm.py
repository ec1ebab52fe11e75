"""Arms are data: one TOML file an arm, strictly read into the description every room shares."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from controller.config.files import named_or_path
from controller.config.loader import StrictModel, load_toml
from controller.domain import ArmDescription, Gripper, Joint, Link, ServoDynamics

Vector = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0.0)]
ServoId = Annotated[int, Field(ge=0, le=252)]


class JointTable(StrictModel):
    """One `[[joints]]` table."""

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]
    """Name of the joint, from base to tool."""
    servo_id: ServoId
    """Address on the bus."""
    shadow_id: ServoId | None = None
    """Address of the servo that mirrors it on the same shaft."""
    model: str
    """Model of the servo, e.g. `XM430-W350`."""
    axis: Literal["z", "y", "x"]
    """Axis of rotation in the parent's coordinates."""
    offset_mm: Vector
    """Origin in the parent joint's coordinates at angle zero."""
    limits_deg: tuple[float, float]
    """Lowest and highest angle."""
    reverse: bool
    """Drive_Mode bit 0."""
    speed_limit_deg_s: Positive
    """Highest planned speed."""
    acceleration_limit_deg_s2: Positive
    """Highest planned acceleration."""
    stiffness_nm_rad: Positive
    """Torque per angle between goal and position, all servos of the joint together."""
    damping_nm_s_rad: Annotated[float, Field(ge=0.0)]
    """Back-EMF."""
    friction_nm: Annotated[float, Field(ge=0.0)]
    """Coulomb friction."""
    inertia_kg_m2: Annotated[float, Field(ge=0.0)]
    """Rotor inertia at the output."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        low, high = self.limits_deg
        if not -360.0 <= low < high <= 360.0:
            raise ValueError(f"limits_deg {low:g}..{high:g} is no range within +-360")
        return self

    def build(self) -> Joint:
        """The joint in core units."""
        return Joint(
            name=self.name,
            servo_id=self.servo_id,
            model=self.model,
            axis=self.axis,
            offset=self.offset_mm,
            limits=(math.radians(self.limits_deg[0]), math.radians(self.limits_deg[1])),
            reverse=self.reverse,
            speed_limit=math.radians(self.speed_limit_deg_s),
            acceleration_limit=math.radians(self.acceleration_limit_deg_s2),
            shadow_id=self.shadow_id,
            dynamics=ServoDynamics(
                stiffness=self.stiffness_nm_rad,
                damping=self.damping_nm_s_rad,
                friction=self.friction_nm,
                inertia=self.inertia_kg_m2,
            ),
        )


class LinkTable(StrictModel):
    """One `[[links]]` table: the body a joint carries."""

    mass_g: Annotated[float, Field(ge=0.0)]
    """Mass."""
    center_mm: Vector
    """Centre of mass in the joint's own coordinates."""


class GripperTable(StrictModel):
    """The `[gripper]` table."""

    servo_id: ServoId
    """Address on the bus."""
    model: str
    """Model of the servo."""
    mechanism: Literal["crank", "rack"]
    """How the servo's angle becomes an opening."""
    parameters: tuple[float, ...]
    """crank: horn radius, link length, jaw inset (mm); rack: mm a radian, opening at angle zero (mm)."""
    opening_mm: tuple[Positive, Positive]
    """Narrowest and widest clear opening."""
    reverse: bool
    """Drive_Mode bit 0."""
    jaw_size_mm: tuple[Positive, Positive]
    """Thickness of a jaw along the closing direction, and its width across it."""
    jaw_depth_mm: Annotated[float, Field(ge=0.0)]
    """How far the pads reach below the grasp point."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        wanted = {"crank": 3, "rack": 2}[self.mechanism]
        if len(self.parameters) != wanted:
            raise ValueError(f"a {self.mechanism} has {wanted} parameters, not {len(self.parameters)}")
        low, high = self.opening_mm
        if low >= high:
            raise ValueError(f"opening_mm {low:g}..{high:g} is no range")
        if self.mechanism == "crank":
            radius, link, inset = self.parameters
            if not 0.0 < radius < link or high > 2.0 * (radius + link - inset) or low < 2.0 * (link - radius - inset):
                raise ValueError("opening_mm lies outside what this crank can do")
        elif self.parameters[0] == 0.0:
            raise ValueError("a rack moves by more than 0 mm a radian")
        return self

    def build(self) -> Gripper:
        """The gripper in core units."""
        return Gripper(
            servo_id=self.servo_id,
            model=self.model,
            mechanism=self.mechanism,
            parameters=self.parameters,
            opening=self.opening_mm,
            reverse=self.reverse,
            jaw_size=self.jaw_size_mm,
            jaw_depth=self.jaw_depth_mm,
        )


class ArmFile(StrictModel):
    """An arm description: yaw, a planar chain of three, and optionally a roll at the wrist."""

    title: str
    """Name for people."""
    baud: Annotated[int, Field(ge=9600, le=4_500_000)]
    """Bus speed, bit/s."""
    payload_g: Positive
    """What the maker allows at half stretch."""
    tool_mm: Vector
    """Grasp point in the last joint's coordinates."""
    rest_deg: tuple[float, ...]
    """Joint angles where torque may go off."""
    ready_deg: tuple[float, ...]
    """Joint angles out of the camera's view of the work area."""
    joints: tuple[JointTable, ...]
    """From base to tool."""
    links: tuple[LinkTable, ...]
    """One for each joint."""
    gripper: GripperTable
    """The gripper."""

    @model_validator(mode="after")
    def _chain(self) -> Self:
        axes = "".join(joint.axis for joint in self.joints)
        if axes not in ("zyyy", "zyyyx"):
            raise ValueError(f"joint axes {axes} are not supported: zyyy (4 joints) or zyyyx (5)")
        if any(joint.offset_mm[1] != 0.0 for joint in self.joints) or self.tool_mm[1:] != (0.0, 0.0):
            raise ValueError("offset_mm must have y = 0, and tool_mm must lie on x: the arm is a planar chain")
        if axes.endswith("x") and self.joints[-1].offset_mm[2] != 0.0:
            raise ValueError("the wrist's roll axis must pass through the joint before it (offset_mm z = 0)")
        count = len(self.joints)
        if len(self.links) != count:
            raise ValueError(f"{len(self.links)} links for {count} joints")
        for key, angles in (("rest_deg", self.rest_deg), ("ready_deg", self.ready_deg)):
            if len(angles) != count:
                raise ValueError(f"{key} has {len(angles)} angles for {count} joints")
            for joint, angle in zip(self.joints, angles, strict=True):
                if not joint.limits_deg[0] <= angle <= joint.limits_deg[1]:
                    raise ValueError(f"{key}: {joint.name} {angle:g} is outside its limits")
        ids = [i for joint in self.joints for i in (joint.servo_id, joint.shadow_id) if i is not None]
        ids.append(self.gripper.servo_id)
        if len(set(ids)) != len(ids):
            raise ValueError(f"servo ids {ids} are not all different")
        if len({joint.name for joint in self.joints}) != count:
            raise ValueError("joint names are not all different")
        return self


def load_arm(name_or_path: str) -> ArmDescription:
    """The description of an arm that ships with the program, or of a file of your own.

    Args:
        name_or_path: e.g. `reactorx_150`, or the path of a TOML file.

    Raises:
        ConfigError: There is no such arm, or its file is not a valid description.
    """
    path: Path = named_or_path(name_or_path, "arms")
    table = load_toml(path, ArmFile)
    return ArmDescription(
        name=path.stem,
        title=table.title,
        baud=table.baud,
        joints=tuple(joint.build() for joint in table.joints),
        links=tuple(Link(link.mass_g / 1000.0, link.center_mm) for link in table.links),
        tool=table.tool_mm,
        gripper=table.gripper.build(),
        rest=tuple(math.radians(angle) for angle in table.rest_deg),
        ready=tuple(math.radians(angle) for angle in table.ready_deg),
        payload=table.payload_g / 1000.0,
    )
