"""A whole simulated cell: one world, and the camera, clock and hands that belong to it.

The servo bus is attached by whoever composes the cell: `VirtualBus(cell.plant, cell.bus_servos, ...)`.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from controller.domain import TruePart
from sim_backends.arm_shape import MarkerMount, link_name
from sim_backends.camera import SimulatedCamera
from sim_backends.cell_spec import CellSpec
from sim_backends.clock import SimClock
from sim_backends.disturbances import Disturber, disturbances
from sim_backends.hands import Hands, displacement
from sim_backends.imperfections import Imperfections, draw
from sim_backends.lens import Lens
from sim_backends.markings import marking_of
from sim_backends.painter import Image, Painter
from sim_backends.painter_surface import Print
from sim_backends.parts import Part, round_part, scatter, spare_parts
from sim_backends.person import Person, hand_solids
from sim_backends.plant import Plant
from sim_backends.solids import Array
from sim_backends.truth import can_reach, true_parts
from sim_backends.world import Snapshot, World
from sim_backends.world_contacts import Collision
from sim_backends.world_model import part_name

_MODULE_PX = 20  # pixels of the printed marker per module


class SimulatedCell:
    """Camera, clock and hands of one simulated world.

    Parts lie on the table from the start; `set_aside` and `scatter` take them off and put them back.

    Args:
        spec: What to build.
        laid: What lies on the table instead of what the seed scatters.

    Attributes:
        spec: What it was built from.
        imperfections: What the controller is not told.
        world: The physics; also the `Plant` of the servo bus.
        clock, camera, presenter: The ports.
        lens: The true camera.
        T_base_table: True pose of `table` in `base`: where the sheet comes to lie, shape (4, 4), mm.
        T_tool_marker: True pose of the marker in `tool`, shape (4, 4), mm.
        disturber: What disturbs its work, if anything does.
    """

    def __init__(self, spec: CellSpec, laid: Sequence[Part] | None = None) -> None:
        self.spec = spec
        self.imperfections = imperfections = draw(spec.level, spec.seed, spec.overrides)
        nominal_table = np.array(spec.T_base_table)
        self.T_base_table: Array = nominal_table @ displacement(
            np.array([*imperfections.sheet_shift, 0.0]), np.array([0.0, 0.0, imperfections.sheet_turn])
        )
        self.T_tool_marker: Array = spec.marker.T_tool_marker @ displacement(
            np.array(imperfections.marker_shift), np.array(imperfections.marker_turn)
        )
        if laid is None:
            laid = scatter(
                spec.parts, spec.seed, imperfections, spec.heights, spec.grips, spec.work_area, spec.kinds
            )
        script = disturbances(spec.disturb, spec.seed, spec.parts)
        spares = spare_parts(
            sum(event.kind == "add" for event in script),
            spec.seed, imperfections, spec.heights, spec.grips, spec.work_area,
        )  # fmt: skip
        self._sorted = len(laid) + len(spares)
        parts = (*laid, *spares)
        if spec.round_part:
            parts = (*parts, round_part(spec.seed, spec.heights, spec.work_area))
        self.world = World(
            spec.arm,
            spec.bins,
            nominal_table,
            parts,
            imperfections,
            spec.marker,
            self.T_tool_marker,
            spares=len(parts) - len(laid),
            hand=hand_solids() if script else (),
        )
        person = Person(self.world, spec.work_area)
        self.disturber = Disturber(script, self.world, person, spec.seed) if script else None
        self._reachable = tuple(can_reach(spec.arm, part.x, part.y) for part in parts)
        self.lens = _true_lens(spec, imperfections)
        self.clock = SimClock(self.world)
        self.presenter = Hands(self.lens, self.T_base_table, imperfections, spec.seed)
        self._painter = self._make_painter(self.lens, imperfections)
        self._overview: tuple[object, Painter] | None = None
        self.camera = SimulatedCamera(self.world, self._paint, self._painter.glance, imperfections.latency)

    @property
    def plant(self) -> Plant:
        """The shafts that the servo bus turns."""
        return self.world

    @property
    def bus_servos(self) -> list[tuple[int, str]]:
        """(id, model) of every servo on the bus, shadows included."""
        found: list[tuple[int, str]] = []
        for joint in self.spec.arm.joints:
            found.append((joint.servo_id, joint.model))
            if joint.shadow_id is not None:
                found.append((joint.shadow_id, joint.model))
        return [*found, (self.spec.arm.gripper.servo_id, self.spec.arm.gripper.model)]

    @property
    def collisions(self) -> tuple[Collision, ...]:
        """Every time the arm touched something else than the part between its jaws."""
        return tuple(self.world.collisions)

    def truth(self) -> tuple[TruePart, ...]:
        """Where every part is now."""
        return self._truth(self.world.loose.poses(), self.world.held, self.world.loose.away)

    def truth_at(self, at: float) -> tuple[TruePart, ...]:
        """Where every part was at a past time: exact at captures, within 0.05 s else."""
        return self._truth(*self.world.past(at))

    def tool(self) -> tuple[float, float, float]:
        """Where the grasp point, the middle of the jaws, is now: (x, y, z) in the true `table`, mm."""
        grasp_point = np.array([0.0, *self.imperfections.jaw_shift, 1.0])
        x, y, z, _ = np.linalg.inv(self.T_base_table) @ self.world.tool_pose() @ grasp_point
        return float(x), float(y), float(z)

    def set_aside(self) -> None:
        """Take all parts off the table, e.g. to calibrate."""
        self.world.loose.set_aside()

    def lay_round_part(self) -> None:
        """Lay the round part that a calibration touches onto the table; the next hand takes it away."""
        part = self.world.parts[self._sorted]
        self.world.may_touch(self._sorted)
        self.world.loose.lay_at(self._sorted, part.x, part.y, part.yaw)

    def scatter(self) -> None:
        """Put all parts where the seed has them."""
        self.world.loose.put_back()

    def overview(self, size: tuple[int, int] = (1280, 720), lens: Lens | None = None) -> Image:
        """A picture of the whole cell for people, (H, W, 3), dtype uint8, BGR.

        Args:
            size: (width, height), px.
            lens: Another point of view than from ahead of the arm and to its right.
        """
        fine = lens or overview_lens((2 * size[0], 2 * size[1]))
        light = draw("ideal", 0, {"shadow_depth": 0.3, "vignette": 0.25, "lamp_azimuth": -1.3, "blur": 0.0})
        if self._overview is None or self._overview[0] != (size, lens):
            self._overview = (size, lens), self._make_painter(fine, light)
        picture = self._overview[1].paint(self.world.snapshot(), self.presenter.sheet, self.presenter.board)
        return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)

    def _truth(
        self, poses: Array, held: frozenset[int], away: frozenset[int] = frozenset()
    ) -> tuple[TruePart, ...]:
        world = self.world
        nominal = np.array(self.spec.T_base_table)
        parts, poses = world.parts[: self._sorted], poses[: self._sorted]
        return true_parts(parts, poses, held, world.bins, nominal, self.T_base_table, self._reachable, away)

    def _paint(self, snapshot: Snapshot) -> Image:
        return self._painter.paint(snapshot, self.presenter.sheet, self.presenter.board)

    def _make_painter(self, lens: Lens, look: Imperfections) -> Painter:
        world, arm = self.world, self.spec.arm
        bodies = [0 if s.body == "world" else world.body(s.body) for s in world.solids]
        parts = [s.body.startswith("part") for s in world.solids]
        groups = world.fixed_groups()
        at_gripper = np.eye(4)
        at_gripper[:3, 3] = arm.tool
        picture, pixel_mm = marker_picture(self.spec.marker)
        marker = Print(picture, pixel_mm, at_gripper @ self.T_tool_marker, y_up=True)
        assert link_name(len(arm.joints) - 1) in {s.body for s in world.solids if s.decal}
        decals = {"marker": marker}
        decals |= {part_name(i): marking_of(part) for i, part in enumerate(world.parts) if part.marking}
        on_table = [self._landmark(*place) for place in self.spec.landmarks]
        return Painter(world.solids, bodies, parts, groups, lens, look, self.spec.seed, decals, on_table)

    def _landmark(self, name: int, x: float, y: float) -> Print:
        """A printed marker on the table."""
        picture, pixel_mm = marker_picture(MarkerMount(marker_id=name))
        place = np.eye(4)
        place[:2, 3] = x, y
        return Print(picture, pixel_mm, self.T_base_table @ place, y_up=True)


def marker_picture(marker: MarkerMount) -> tuple[Image, float]:
    """The printed marker with its white border, (H, W), dtype uint8, and the size of its pixels, mm."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, marker.dictionary))
    modules = dictionary.markerSize + 2
    black = cv2.aruco.generateImageMarker(dictionary, marker.marker_id, modules * _MODULE_PX)
    pixel_mm = marker.size / (modules * _MODULE_PX)
    border = round(marker.margin / pixel_mm)
    white = cv2.copyMakeBorder(black, border, border, border, border, cv2.BORDER_CONSTANT, value=255)
    return np.asarray(white, np.uint8), pixel_mm


def _true_lens(spec: CellSpec, imperfections: Imperfections) -> Lens:
    matrix = spec.nominal_matrix()
    matrix[0, 0] *= imperfections.focal_scale
    matrix[1, 1] *= imperfections.focal_scale
    matrix[:2, 2] += np.array(imperfections.principal_shift) * spec.image_size[0]
    place = np.array(spec.T_base_camera) @ displacement(np.zeros(3), np.array(imperfections.camera_turn))
    place[:3, 3] += imperfections.camera_shift
    return Lens(matrix, np.array([*imperfections.distortion, 0.0]), spec.image_size, place)


def overview_lens(size: tuple[int, int]) -> Lens:
    """An undistorted camera ahead of the arm and to its right that sees the whole table."""
    eye, target = np.array([800.0, -600.0, 640.0]), np.array([40.0, 0.0, 85.0])
    ahead = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    place = np.eye(4)
    place[:3, :3] = np.column_stack([right, np.cross(ahead, right), ahead])
    place[:3, 3] = eye
    focal = 1.2 * size[0]
    matrix = np.array([[focal, 0.0, (size[0] - 1) / 2.0], [0.0, focal, (size[1] - 1) / 2.0], [0.0, 0.0, 1.0]])
    return Lens(matrix, np.zeros(5), size, place)


__all__ = ["CellSpec", "SimulatedCell", "marker_picture", "overview_lens"]
