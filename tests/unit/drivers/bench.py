"""Lines and arms for the tests of the arm driver: a scripted line, and arms on the simulated servo bus."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from controller.config.arm import load_arm
from controller.domain import ArmDescription, Array, Trajectory
from controller.errors import BusError
from drivers.arm.bus import Bus
from drivers.arm.dynamixel import DynamixelArm
from sim_backends.plant import Plant
from sim_backends.virtual_dynamixel.bench import IdealPlant
from sim_backends.virtual_dynamixel.bus import VirtualBus
from sim_backends.virtual_dynamixel.protocol import Instruction, InstructionParser
from sim_backends.virtual_dynamixel.servo import ServoSpec
from sim_backends.virtual_dynamixel.stream import BusStream
from tests.contract.arm_suite import quintic

WAIST, SHOULDER, ELBOW, WRIST, _, JAW = range(1, 7)
"""IDs of the servos of an arm with five joints."""

Answer = Callable[[bytes], list[tuple[float, bytes]]]


class ScriptedLine:
    """A byte stream, and the clock that goes with it, on which a function answers what is written.

    Args:
        answer: (bytes written) -> [(seconds until it arrives, bytes)].
    """

    def __init__(self, answer: Answer) -> None:
        self.answer = answer
        self.written: list[bytes] = []
        self.reads = 0
        self.plugged = True
        self._now = 0.0
        self._coming: list[tuple[float, bytes]] = []

    name = "line"

    def now(self) -> float:
        return self._now

    def sleep(self, seconds: float) -> None:
        self._now += max(0.0, seconds)

    charge = sleep

    def open(self, baud: int) -> None:
        self._check("open")

    def close(self) -> None:
        self._coming.clear()

    def write(self, data: bytes) -> None:
        self._check("write")
        self.written.append(data)
        self._coming += [(self._now + delay, reply) for delay, reply in self.answer(data)]
        self._coming.sort(key=lambda coming: coming[0])

    def read(self, size: int, timeout: float) -> bytes:
        self._check("read")
        self.reads += 1
        if not self._coming or self._coming[0][0] > self._now + timeout:
            self._now += timeout
            return b""
        arrival, data = self._coming.pop(0)
        self._now = max(self._now, arrival)
        if len(data) > size:
            self._coming.insert(0, (arrival, data[size:]))
        return data[:size]

    def discard_input(self) -> None:
        self._check("discard input")
        self._coming = [(arrival, data) for arrival, data in self._coming if arrival > self._now]

    def _check(self, operation: str) -> None:
        if not self.plugged:
            raise BusError(self.name, operation, "lost", "unplugged")


def scripted_bus(answer: Answer, baud: int = 1_000_000) -> tuple[Bus, ScriptedLine]:
    """An open bus on a scripted line."""
    line = ScriptedLine(answer)
    bus = Bus(line, line, baud=baud)
    bus.open()
    return bus, line


class PlantClock:
    """The time of a simulated world; sleeping lets it pass.

    Attributes:
        stall: s that the next sleep takes longer than asked, as if the process had been stopped.
    """

    def __init__(self, plant: Plant) -> None:
        self._plant = plant
        self.stall = 0.0

    def now(self) -> float:
        return self._plant.now()

    def sleep(self, seconds: float) -> None:
        stall, self.stall = self.stall, 0.0
        self._plant.advance(max(0.0, seconds) + stall)

    charge = sleep


class WireTap(BusStream):
    """The simulated line, and every Goal_Position that went over it.

    Attributes:
        goals: (time, {servo: ticks}) of every sync write of Goal_Position.
    """

    def __init__(self, bus: VirtualBus, plant: Plant) -> None:
        super().__init__(bus)
        self._world = plant
        self.goals: list[tuple[float, dict[int, int]]] = []

    def write(self, data: bytes) -> None:
        for packet in InstructionParser().feed(data):
            if packet.instruction == Instruction.SYNC_WRITE and packet.params[:4] == b"\x74\x00\x04\x00":
                body = packet.params[4:]
                items = [body[at : at + 5] for at in range(0, len(body), 5)]
                goals = {item[0]: int.from_bytes(item[1:], "little", signed=True) for item in items}
                self.goals.append((self._world.now(), goals))
        super().write(data)


def virtual_bus(count: int = 5, baud: int = 1_000_000, model: str = "XM430-W350") -> tuple[Bus, VirtualBus, IdealPlant]:
    """An open bus with servos 1..count on the simulated line."""
    ids = range(1, count + 1)
    plant = IdealPlant(ids)
    bench = VirtualBus(plant, [ServoSpec(i, model) for i in ids], baud=baud)
    bus = Bus(BusStream(bench), PlantClock(plant), baud=baud)
    bus.open()
    return bus, bench, plant


class ArmBench:
    """An arm on the simulated servo bus, standing at rest, torque off, not open.

    Args:
        name: Which arm.
        settings: Registers that differ from the factory's, by servo ID.
    """

    def __init__(
        self, name: str = "reactorx_150", settings: dict[int, tuple[tuple[str, int], ...]] | None = None
    ) -> None:
        self.description: ArmDescription = load_arm(name)
        specs = servo_specs(self.description, settings or {})
        self.plant = IdealPlant([spec.servo_id for spec in specs])
        place_at_rest(self.plant, self.description)
        self.bus = VirtualBus(self.plant, specs, baud=self.description.baud)
        self.clock = PlantClock(self.plant)
        self.stream = WireTap(self.bus, self.plant)
        self.arm = DynamixelArm(self.description, self.stream, self.clock)

    @contextmanager
    def ready(self) -> Iterator[DynamixelArm]:
        """The arm, open and energised."""
        self.arm.open()
        try:
            self.arm.energise()
            yield self.arm
        finally:
            self.arm.close()

    def at(self, time: float, action: Callable[[], None]) -> None:
        """Do something when the simulated time has come."""
        due = [time]

        def on_step(_: float) -> None:
            if due and self.plant.now() >= due[0]:
                due.clear()
                action()

        self.plant.on_step(on_step)

    def later(self, seconds: float, action: Callable[[], None]) -> None:
        """Do something so many seconds from now."""
        self.at(self.plant.now() + seconds, action)

    def positions(self) -> Array:
        """Where the joints really are, rad, looked up past the bus; shadows left out."""
        angles = [self.plant.shaft(joint.servo_id).angle for joint in self.description.joints]
        return np.array([-a if joint.reverse else a for a, joint in zip(angles, self.description.joints, strict=True)])

    def register(self, servo_id: int, name: str) -> int:
        """Any register of any servo, looked up past the bus."""
        return self.bus.servo(servo_id).table.get(name)


def servo_specs(
    description: ArmDescription, settings: dict[int, tuple[tuple[str, int], ...]]
) -> list[ServoSpec]:
    """The servos an arm is built of, as from the factory but for `settings`."""
    specs = []
    for joint in description.joints:
        for servo_id in (joint.servo_id, joint.shadow_id):
            if servo_id is not None:
                specs.append(ServoSpec(servo_id, joint.model, settings.get(servo_id, ())))
    gripper = description.gripper
    specs.append(ServoSpec(gripper.servo_id, gripper.model, settings.get(gripper.servo_id, ())))
    return specs


def place_at_rest(plant: IdealPlant, description: ArmDescription) -> None:
    """Turn every shaft to the arm's rest; a reversed servo is mounted the other way round, a shadow opposite."""
    for joint, angle in zip(description.joints, description.rest, strict=True):
        plant.place(joint.servo_id, -angle if joint.reverse else angle)
        if joint.shadow_id is not None:
            plant.place(joint.shadow_id, angle if joint.reverse else -angle)


def a_move(bench: ArmBench, duration: float = 1.0) -> Trajectory:
    """A move of every joint from where the arm stands."""
    start = bench.arm.state().positions
    return quintic(start, start + np.array([0.8, 0.6, -0.6, 0.3, 0.5])[: len(start)], duration)


def goals_told(bench: ArmBench, servo_id: int = WAIST) -> tuple[Array, Array]:
    """(times, ticks) of what a servo was told by sync writes."""
    told = [(at, goals[servo_id]) for at, goals in bench.stream.goals if servo_id in goals]
    return np.array([at for at, _ in told]), np.array([ticks for _, ticks in told])
