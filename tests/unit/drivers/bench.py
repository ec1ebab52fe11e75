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
from sim_backends.virtual_dynamixel.servo import ServoSpec
from sim_backends.virtual_dynamixel.stream import BusStream

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
    """The time of a simulated world; sleeping lets it pass."""

    def __init__(self, plant: Plant) -> None:
        self._plant = plant

    def now(self) -> float:
        return self._plant.now()

    def sleep(self, seconds: float) -> None:
        self._plant.advance(max(0.0, seconds))

    charge = sleep


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
        self.stream = BusStream(self.bus)
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

    def goal(self, joint: int) -> int:
        """Goal_Position of a joint's servo."""
        return self.bus.servo(self.description.joints[joint].servo_id).table.get("Goal_Position")

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


def quintic(start: Array, end: Array, duration: float, period: float = 0.01, name: str = "move") -> Trajectory:
    """A move from rest to rest along a straight line in joint space; goals equal positions."""
    share = np.linspace(0.0, 1.0, round(duration / period) + 1)[:, None]
    smooth = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    positions = np.asarray(start) + (np.asarray(end) - np.asarray(start)) * smooth
    return Trajectory(name, period, positions, positions.copy())
