"""The composition root: the only module that knows which drivers and which simulated backends exist.

Camera, arm and clock come as a set. A simulated set is asked for by name; nothing falls back to one.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from controller.config.cell import CellConfig, KindSection
from controller.cycle.machine import State
from controller.cycle.rehearsal import EmptyHanded, ImaginedPart, OneLook, Rehearsal
from controller.cycle.rig import Observer
from controller.domain import ArmDescription, Array, Frame, PickPlan, Point, Shape, TruePart
from controller.errors import DeviceError, InputError
from controller.geometry import CameraModel, transform
from controller.ports import Arm, Camera, Clock, Presenter, Truth
from controller.vision.watch import WatchedCamera

if TYPE_CHECKING:
    from drivers.arm.replies import BusStatistics
    from drivers.camera.listing import CameraListing
    from sim_backends.cell import SimulatedCell
    from sim_backends.cell_spec import CellSpec
    from sim_backends.disturbances import Disturber
    from sim_backends.fault_script import FaultDirector


_LANDMARKS = ((1, 110.0, 290.0), (2, 110.0, -290.0), (3, -80.0, 305.0), (4, -80.0, -305.0))
"""Where the simulated table's corner markers lie, (id, x, y) in `table`, mm: in view, out of the work area."""
_MINIATURE = (640, 360)
"""Size of a film's pictures of the cell, px."""

_ENOUGH_ANSWERS, _MOST_FAILED = 500, 0.01
"""Answers of servos from which a share is told, and the share that failed from which somebody should look: a sound
line loses one of ten thousand.
"""


class Mode(StrEnum):
    """Which set of devices a run works with."""

    REAL = "real"
    SIM = "sim"
    REPLAY = "replay"


class Level(StrEnum):
    """How imperfect the simulated world is."""

    IDEAL = "ideal"
    STATIC = "static"
    DYNAMIC = "dynamic"


@dataclass(frozen=True, slots=True)
class BackendOptions:
    """What only some sets need.

    Attributes:
        out: Folder of the run.
        replay: Folder of pictures to replay.
        parts: Parts on the simulated table.
        seed: Seed of the simulated world.
        level: Imperfections of the simulated world.
        real_time: Simulated world in a process of its own, paced by the wall clock, bus on a pseudo-terminal.
        faults: Script of what goes wrong in the simulated cell.
        disturb: What disturbs the simulated cell, as a wish of `sim_backends.disturbances`.
        watch_clock: Wraps the devices' clock, for whoever watches that the cell makes progress.
    """

    out: Path
    replay: Path | None = None
    parts: int = 8
    seed: int = 0
    level: Level = Level.DYNAMIC
    real_time: bool = False
    faults: Path | None = None
    disturb: str = ""
    watch_clock: Callable[[Clock], Clock] = lambda clock: clock


@dataclass(slots=True)
class Devices:
    """A set of devices behind the ports.

    Attributes:
        presenter: Hands that show calibration boards, where somebody has them.
        truth: The simulated world's truth, where there is one.
        clear_table, lay_parts: Take all parts off the table and put them back, where the table is simulated.
        portrait: A picture of the whole cell for people, where there is one.
        miniature: The same, small and quick to make, for films.
        on_step: Has something called before every step of simulated time, with the step's length (s); None where
            the clock is not simulated here.
        touches: When (s) the arm touched what it should not touch, and what touched what; where that can be known.
        concerns: What is not in order and no reason to stop yet: causes in words by code of the fault catalogue.
        observers: Watchers a set needs for itself.
        script: Lets a script's faults happen, where one was given.
        disturbed: What has disturbed the cell so far: kind and s after the work began.
        names: What stands for the serial numbers of simulated devices, by what they are.
        lay_round_part: Puts a round part into the middle of the work area, where the table is simulated; a person does
            so on a real cell.
        closers: Called in reverse order by `close`.
    """

    camera: Camera
    arm: Arm
    clock: Clock
    presenter: Presenter | None = None
    truth: Truth | None = None
    clear_table: Callable[[], None] = lambda: None
    lay_parts: Callable[[], None] = lambda: None
    portrait: Callable[[], NDArray[np.uint8]] | None = None
    miniature: Callable[[], NDArray[np.uint8]] | None = None
    on_step: Callable[[Callable[[float], None]], None] | None = None
    touches: Callable[[], Sequence[tuple[float, str]]] = lambda: ()
    concerns: Callable[[], Mapping[str, str]] = dict
    observers: tuple[Observer, ...] = ()
    script: FaultDirector | None = None
    disturbed: Callable[[], Sequence[tuple[float, str]]] = lambda: ()
    names: Mapping[str, str] = field(default_factory=dict)
    lay_round_part: Callable[[], None] = lambda: None
    closers: list[Callable[[], None]] = field(default_factory=list)

    def open(self) -> None:
        """Open camera and arm; when both fail, the error names both.

        Raises:
            DeviceError: One of them is not there or not in order.
        """
        failures: list[DeviceError] = []
        for device in (self.camera, self.arm):
            try:
                device.open()
                self.closers.append(device.close)
            except DeviceError as error:
                failures.append(error)
        if failures:
            first = failures[0]
            first.cause = "; and ".join(failure.cause for failure in failures)
            first.remedy = "; ".join(dict.fromkeys(failure.remedy for failure in failures if failure.remedy))
            raise first

    def reopen(self) -> None:
        """Open camera and arm again, whatever has become of them. Moves nothing.

        Raises:
            DeviceError: One of them is not there or not in order; the other is open.
        """
        for device in (self.camera, self.arm):
            device.close()
            if device.close in self.closers:
                self.closers.remove(device.close)
        self.open()

    def close(self) -> None:
        """Release everything, last opened first."""
        while self.closers:
            self.closers.pop()()


Factory = Callable[[CellConfig, ArmDescription, BackendOptions], Devices]


def nominal_camera(config: CellConfig) -> tuple[CameraModel, Array]:
    """Lens and pose by data sheet and ruler: looking straight down, the picture's long side along the table's y
    axis (its left edge towards +y). Good to some centimetres only.

    Returns:
        The lens; `T_table_camera`, shape (4, 4), mm.
    """
    width, height = config.camera.width, config.camera.height
    focal = width / 2 / math.tan(math.radians(config.camera.field_of_view_deg) / 2)
    matrix = np.array([[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]])
    looking_down = np.array([[0.0, -1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    looking_down[:3, 3] = *config.camera.above_mm, config.camera.height_mm
    return CameraModel(matrix, np.zeros(5), (width, height)), looking_down


def real_devices(config: CellConfig, arm: ArmDescription, options: BackendOptions) -> Devices:
    """Webcam, servo bus and the machine's own clock."""
    from drivers.arm.dynamixel import DynamixelArm
    from drivers.arm.serial_stream import SerialStream
    from drivers.camera.v4l2 import V4l2Camera
    from drivers.clock import MonotonicClock

    clock = options.watch_clock(MonotonicClock())
    camera = V4l2Camera(
        config.camera.device,
        clock,
        size=(config.camera.width, config.camera.height),
        fps=config.camera.frames_per_second,
        settings=config.camera.settings,
    )
    watched, driver = WatchedCamera(camera, clock), DynamixelArm(arm, SerialStream(config.arm.port), clock)
    return Devices(watched, driver, clock, concerns=_Concerns(watched, driver.bus.statistics))


def replay_devices(config: CellConfig, arm: ArmDescription, options: BackendOptions) -> Devices:
    """Pictures from a folder, an arm that only writes down what it is told, and a clock that moves by itself."""
    from sim_backends.recording_arm import CommandFile, RecordingArm
    from sim_backends.replay_camera import ReplayCamera
    from sim_backends.virtual_clock import VirtualClock

    assert options.replay is not None
    clock = VirtualClock()
    imagined = ImaginedPart()
    moves = CommandFile(options.out / "moves.jsonl")
    recorder = RecordingArm(arm, clock, on_command=moves, grip_model=imagined.grip)
    camera = ReplayCamera(options.replay, clock)
    return Devices(camera, recorder, clock, observers=(imagined,), closers=[moves.close])


def rehearsed(devices: Devices, arm: ArmDescription, options: BackendOptions, rehearsal: Rehearsal) -> Devices:
    """The same devices for a rehearsal: one look, and an arm that only writes down its moves, or grips nothing.

    They are to be opened and closed by themselves. The world's truth is left out: nothing that the cell believes
    to have done was done.
    """
    from sim_backends.recording_arm import CommandFile, RecordingArm

    imagined = ImaginedPart()
    closers: list[Callable[[], None]] = []
    stand_in: Arm = EmptyHanded(devices.arm, imagined)
    if rehearsal is Rehearsal.DRY:
        moves = CommandFile(options.out / "moves.jsonl")
        closers.append(moves.close)
        stand_in = RecordingArm(arm, devices.clock, on_command=moves, grip_model=imagined.grip)
    camera = OneLook(devices.camera)
    observers = (*devices.observers, imagined)
    return replace(devices, camera=camera, arm=stand_in, truth=None, observers=observers, closers=closers)


def sim_devices(config: CellConfig, arm: ArmDescription, options: BackendOptions) -> Devices:
    """The physics cell: the unmodified driver on virtual servos, painted pictures, simulated time."""
    simulated_cell = _simulated_cell()
    from drivers.arm.dynamixel import DynamixelArm
    from sim_backends.virtual_dynamixel import BusStream, Fault, ServoSpec, VirtualBus

    spec = _cell_spec(config, arm, options)
    if options.faults is not None and (options.real_time or options.level is not Level.DYNAMIC):
        raise InputError(
            "faults can be scripted in simulated time and at level dynamic only",
            "leave --real-time out, and use --level dynamic: without noise a frozen picture is like any other",
        )
    if options.real_time and options.disturb:
        raise InputError("nothing disturbs a cell in real time", "leave --real-time or --disturb out")
    if options.real_time:
        return _served_devices(spec, arm, options)
    cell = simulated_cell(spec)
    servos = [ServoSpec(*servo) for servo in cell.bus_servos]
    bus = VirtualBus(cell.plant, servos, baud=arm.baud, seed=options.seed)
    bus.faults.set_rate(Fault.DROP, cell.imperfections.packet_loss)
    clock = options.watch_clock(cell.clock)
    camera: Camera = cell.camera
    script = None
    if options.faults is not None:
        from sim_backends.fault_script import FaultDirector, load_script
        from sim_backends.faulty_camera import FaultyCamera

        faulty = FaultyCamera(camera, cell.clock, ())
        camera, script = faulty, FaultDirector(load_script(options.faults), cell.world, bus, faulty)
    if options.level is Level.DYNAMIC:
        # Pictures without noise may equal one another to the bit when nothing has moved.
        camera = WatchedCamera(camera, clock)
    driver = DynamixelArm(arm, BusStream(bus), clock)
    return Devices(
        camera,
        driver,
        clock,
        concerns=_Concerns(camera, driver.bus.statistics),
        presenter=cell.presenter,
        truth=_CellTruth(cell),
        clear_table=cell.set_aside,
        lay_parts=cell.scatter,
        portrait=lambda: cell.overview((960, 540)),
        miniature=lambda: cell.overview(_MINIATURE),
        on_step=cell.plant.on_step,
        touches=lambda: [(touch.at, f"{touch.arm} touched {touch.other}") for touch in cell.collisions],
        names=_simulated_names(options),
        lay_round_part=cell.lay_round_part,
        observers=(
            *([] if script is None else [_Prompter(script)]),
            *([] if cell.disturber is None else [_Disturbed(cell.disturber, config.table.T_base_table())]),
        ),
        script=script,
        disturbed=lambda: () if cell.disturber is None else tuple((at, kind) for kind, at in cell.disturber.happened),
    )


class _Concerns:
    """What camera and servo bus say is not in order, asked once a look."""

    def __init__(self, camera: Camera, bus: BusStatistics) -> None:
        self._camera = camera
        self._bus = bus
        self._answered = self._failed = 0
        self._share = 0.0

    def __call__(self) -> Mapping[str, str]:
        found = dict(self._camera.concerns) if isinstance(self._camera, WatchedCamera) else {}
        answered, failed = self._bus.replies, self._bus.timeouts
        total = answered + failed - self._answered - self._failed
        if total >= _ENOUGH_ANSWERS:
            self._share = (failed - self._failed) / total
            self._answered, self._failed = answered, failed
        if self._share > _MOST_FAILED:
            found["bus_noisy"] = f"{self._share:.1%} of the servos' answers were lost or damaged"
        return found


class _Prompter(Observer):
    """Tells a script of faults what the cell does."""

    def __init__(self, script: FaultDirector) -> None:
        self._script = script

    def entered(self, state: State, at: float) -> None:
        """The cell entered a state."""
        self._script.entered(state.value)


@dataclass(frozen=True, slots=True)
class _Disturbed(Observer):
    """Tells what disturbs a cell where the cell is in its work."""

    disturber: Disturber
    T_base_table: Array

    def entered(self, state: State, at: float) -> None:
        """The cell entered a state."""
        self.disturber.entered(state.value)

    def planned(self, plan: PickPlan) -> None:
        """The arm is about to take a part."""
        self.disturber.aimed(transform(self.T_base_table, [*plan.target.center, 0.0])[:2])


@dataclass(frozen=True, slots=True)
class _CellTruth:
    """The truth of a simulated cell in this process."""

    cell: SimulatedCell

    def now(self) -> Sequence[TruePart]:
        """Every part as it is now."""
        return self.cell.truth()

    def at(self, at: float) -> Sequence[TruePart]:
        """Every part as it was."""
        return self.cell.truth_at(at)

    def tool(self) -> tuple[float, float, float]:
        """Where the grasp point is."""
        return self.cell.tool()

    def collisions(self) -> int:
        """Touches so far."""
        return len(self.cell.collisions)


def plugged_in() -> tuple[CameraListing, ...]:
    """Cameras that the system knows; opens none."""
    from drivers.camera.listing import list_cameras

    return list_cameras()


def lone_camera(config: CellConfig, device: str) -> tuple[Camera, Clock]:
    """A camera without its cell, to aim and to focus it; not open."""
    from drivers.camera.v4l2 import V4l2Camera
    from drivers.clock import MonotonicClock

    clock, section = MonotonicClock(), config.camera
    size = section.width, section.height
    return V4l2Camera(device, clock, size=size, fps=section.frames_per_second, settings=section.settings), clock


class PaintedTable:
    """A simulated camera over a table on which parts are laid at will: for studies of seeing alone.

    Args:
        config: The cell.
        arm: It stands out of view.
        options: Of the simulated world.
        imperfections: Single ones that replace the level's, by name.

    Attributes:
        camera, clock, presenter: The ports, over an empty table; the camera is open.
    """

    def __init__(
        self,
        config: CellConfig,
        arm: ArmDescription,
        options: BackendOptions,
        imperfections: Mapping[str, float] | None = None,
    ) -> None:
        cell_type = _simulated_cell()
        # The arm stands away from the scene, turned to the side: neither it nor its shadow is in the picture.
        table = config.table.model_copy(update={"origin_in_base_mm": (380.0, 0.0, 0.0)})
        aside = replace(arm, rest=(math.pi / 2, *arm.rest[1:]))
        spec = _cell_spec(config.model_copy(update={"table": table}), aside, options)
        self._spec = replace(spec, bins=(), overrides=imperfections or {}, round_part=False)
        empty = cell_type(self._spec, ())
        self._T_base_table = empty.T_base_table
        empty.camera.open()
        self.camera: Camera = empty.camera
        self.clock: Clock = empty.clock
        self.presenter: Presenter = empty.presenter

    def show(
        self,
        parts: Sequence[tuple[Shape, Point, float]],
        widths: Sequence[float],
        seed: int,
        kind: KindSection | None = None,
    ) -> tuple[Frame, Sequence[TruePart]]:
        """A picture of parts laid at (shape, (x, y) in `table`, yaw), mm and rad; and where they truly are.

        Args:
            parts: What to lay.
            widths: Extents between the jaws to choose from, mm.
            seed: Of widths and colours.
            kind: All are of this kind.
        """
        from sim_backends.parts import COLOURS, Part

        random = np.random.default_rng([seed, 11])
        turn = math.atan2(self._T_base_table[1, 0], self._T_base_table[0, 0])
        laid = []
        for shape, center, yaw in parts:
            x, y, _ = transform(self._T_base_table, [*center, 0.0])
            colour, grip = random.choice(list(COLOURS)), random.choice(widths)
            part = Part(shape, str(colour), float(grip), self._spec.heights[shape], 0.02, 0.5, x, y, yaw + turn)
            if kind is not None:
                part = replace(part, colour=kind.colour, marking=kind.marking, kind=kind.name)
            laid.append(part)
        cell = _simulated_cell()(self._spec, laid)
        cell.camera.open()
        frame = cell.camera.capture(cell.clock.now())
        return frame, cell.truth_at(frame.captured_at)


def _simulated_cell() -> type[SimulatedCell]:
    try:
        from sim_backends.cell import SimulatedCell
    except ImportError as error:
        raise InputError(
            f"the simulation cannot start: {error}", "install its extra: pip install 'sorting-controller[sim]'"
        ) from error
    return SimulatedCell


def _served_devices(spec: CellSpec, arm: ArmDescription, options: BackendOptions) -> Devices:
    """The physics cell in a process of its own, paced by the wall clock; the stock serial path to its servos."""
    from drivers.arm.dynamixel import DynamixelArm
    from drivers.arm.serial_stream import SerialStream
    from drivers.clock import MonotonicClock
    from sim_backends.remote import RemoteCamera, RemotePresenter, RemoteTruth, ServerSpec, spawn_server

    server = spawn_server(ServerSpec(cell=json.loads(spec.to_json()), baud=arm.baud, seed=options.seed))
    clock = MonotonicClock()
    presenter, truth = RemotePresenter(server.socket), RemoteTruth(server.socket, clock)
    return Devices(
        RemoteCamera(server.socket, clock),
        DynamixelArm(arm, SerialStream(server.pty), clock),
        clock,
        presenter=presenter,
        truth=truth,
        clear_table=truth.set_aside,
        lay_parts=truth.scatter,
        lay_round_part=truth.lay_round_part,
        portrait=truth.portrait,
        names=_simulated_names(options),
        closers=[server.stop, truth.close, presenter.close],
    )


def _simulated_names(options: BackendOptions) -> Mapping[str, str]:
    """Another seed is another camera and another arm."""
    return {"camera": f"simulated camera {options.seed}", "port": f"simulated arm {options.seed}"}


def _cell_spec(config: CellConfig, arm: ArmDescription, options: BackendOptions) -> CellSpec:
    from sim_backends.cell_spec import CellSpec
    from sim_backends.parts import Kind, WorkArea

    area = config.table.work_area
    T_base_table = config.table.T_base_table()
    _, T_table_camera = nominal_camera(config)
    return CellSpec(
        arm=arm,
        bins=config.bin_values(),
        T_base_table=_rows(T_base_table),
        T_base_camera=_rows(T_base_table @ T_table_camera),
        image_size=(config.camera.width, config.camera.height),
        field_of_view=math.radians(config.camera.field_of_view_deg),
        parts=options.parts,
        seed=options.seed,
        level=str(options.level),
        disturb=options.disturb,
        round_part=True,
        heights={shape: config.part(shape).height_mm for shape in Shape},
        landmarks=_LANDMARKS if config.table.corner_markers else (),
        kinds=tuple(
            Kind(kind.name, kind.shape, kind.colour, kind.marking, kind.width_mm) for kind in config.simulated_kinds
        ),
        # The controller knows its own place to some mm and a degree: what lies on the rim may be out for it.
        work_area=WorkArea(
            radius=(area.inner_radius_mm + 4.0, area.outer_radius_mm - 4.0),
            azimuth=(math.radians(area.azimuth_deg[0] + 2.0), math.radians(area.azimuth_deg[1] - 2.0)),
        ),
    )


def _rows(pose: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(value) for value in row) for row in pose)


DEVICES: Mapping[Mode, Factory] = {Mode.REAL: real_devices, Mode.SIM: sim_devices, Mode.REPLAY: replay_devices}
