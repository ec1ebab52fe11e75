"""The simulated cell: in this process as fast as the machine allows, or in one of its own by the wall clock."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from controller.backends.concerns import Concerns
from controller.backends.devices import BackendOptions, Devices, Level, Touch
from controller.backends.simulated_spec import cell_spec, simulated_cell
from controller.config.cell import CellConfig
from controller.cycle.machine import State
from controller.cycle.rig import Observer
from controller.domain import ArmDescription, Array, PickPlan, TruePart
from controller.errors import InputError
from controller.geometry import transform
from controller.ports import Camera
from controller.vision.watch import WatchedCamera

if TYPE_CHECKING:
    from sim_backends.cell import SimulatedCell
    from sim_backends.cell_spec import CellSpec
    from sim_backends.disturbances import Disturber
    from sim_backends.fault_script import FaultDirector

_MINIATURE = (640, 360)
"""Size of a film's pictures of the cell, px."""


def sim_devices(config: CellConfig, arm: ArmDescription, options: BackendOptions) -> Devices:
    """The physics cell: the unmodified driver on virtual servos, painted pictures, simulated time."""
    cell_type = simulated_cell()
    from drivers.arm.dynamixel import DynamixelArm
    from sim_backends.virtual_dynamixel import BusStream, Fault, ServoSpec, VirtualBus

    spec = cell_spec(config, arm, options)
    if options.faults is not None and (options.real_time or options.level is not Level.DYNAMIC):
        raise InputError(
            "faults can be scripted in simulated time and at level dynamic only",
            "leave --real-time out, and use --level dynamic: without noise a frozen picture is like any other",
        )
    if options.real_time and options.disturb:
        raise InputError("nothing disturbs a cell in real time", "leave --real-time or --disturb out")
    if options.real_time:
        return _served_devices(spec, arm, options)
    cell = cell_type(spec)
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
        concerns=Concerns(camera, driver.bus.statistics),
        presenter=cell.presenter,
        truth=_CellTruth(cell),
        clear_table=cell.set_aside,
        lay_parts=cell.scatter,
        portrait=lambda: cell.overview((960, 540)),
        miniature=lambda: cell.overview(_MINIATURE),
        on_step=cell.plant.on_step,
        touches=lambda: [Touch(c.at, f"{c.arm} touched {c.other}", c.disturbed) for c in cell.collisions],
        names=_simulated_names(options),
        lay_round_part=cell.lay_round_part,
        observers=(
            *([] if script is None else [_Prompter(script)]),
            *([] if cell.disturber is None else [_Disturbed(cell.disturber, config.table.T_base_table())]),
        ),
        script=script,
        disturbed=lambda: () if cell.disturber is None else tuple((at, kind) for kind, at in cell.disturber.happened),
    )


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
