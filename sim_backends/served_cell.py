"""What can be served in real time: a whole physics cell, or a bench of servos without a world."""

from __future__ import annotations

import os
import pickle
import signal
import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from controller.domain import TruePart
from controller.errors import CameraLost, DeviceError
from controller.ports import Presenter
from sim_backends.messages import receive, send
from sim_backends.plant import Plant
from sim_backends.virtual_dynamixel import ServoSpec
from sim_backends.virtual_dynamixel.bench import IdealPlant


@dataclass(frozen=True, slots=True)
class CameraBeat:
    """When a camera exposes and delivers.

    Attributes:
        period: Between exposures, s.
        exposure: Length of one, s.
        latency: From the end of an exposure to the delivery of the frame, s.
    """

    period: float
    exposure: float
    latency: float


class ServedCell(Protocol):
    """What a server needs of a cell. All but `paint` is called in the thread that owns the physics."""

    @property
    def plant(self) -> Plant:
        """The mechanical world."""
        ...

    @property
    def servos(self) -> Sequence[ServoSpec]:
        """What is mounted on the bus."""
        ...

    @property
    def presenter(self) -> Presenter:
        """The hands."""
        ...

    @property
    def beat(self) -> CameraBeat:
        """When the camera exposes and delivers."""
        ...

    @property
    def packet_loss(self) -> float:
        """Fraction of the servos' answers that the bus loses."""
        ...

    def expose(self) -> Any:
        """A copy of all that a picture of this moment needs."""
        ...

    def paint(self, shot: Any) -> NDArray[np.uint8]:
        """The picture of what `expose` gave; in any thread, but in one at a time."""
        ...

    def truth(self) -> Sequence[TruePart]:
        """Every part now."""
        ...

    def truth_at(self, at: float) -> Sequence[TruePart]:
        """Every part at a time of the plant."""
        ...

    def tool(self) -> tuple[float, float, float]:
        """Where the grasp point is: (x, y, z) in `table`, mm."""
        ...

    def collisions(self) -> int:
        """Touches so far."""
        ...

    def portrait(self) -> NDArray[np.uint8]:
        """A picture of the whole cell for people."""
        ...

    def set_aside(self) -> None:
        """Take the parts off the table."""
        ...

    def lay_round_part(self) -> None:
        """Lay the round part that a calibration touches."""
        ...

    def scatter(self) -> None:
        """Put the parts back."""
        ...


class PhysicsCell:
    """A whole simulated cell behind `ServedCell`; its pictures are painted in a process of their own.

    Painting takes tens of milliseconds of Python, which would hold up the bus's thread however they share it.

    Args:
        text: Its specification, as `CellSpec.to_json` writes it.
    """

    def __init__(self, text: str) -> None:
        from sim_backends.camera import EXPOSURE, PERIOD
        from sim_backends.cell import CellSpec, SimulatedCell

        self._cell = SimulatedCell(CellSpec.from_json(text))
        self.plant = self._cell.plant
        self.servos = [ServoSpec(servo_id, model) for servo_id, model in self._cell.bus_servos]
        self.presenter = self._cell.presenter
        self.beat = CameraBeat(PERIOD, EXPOSURE, self._cell.imperfections.latency)
        self.packet_loss = self._cell.imperfections.packet_loss
        self.truth = self._cell.truth
        self.truth_at = self._cell.truth_at
        self.tool = self._cell.tool
        self.portrait = self._cell.overview
        self.set_aside = self._cell.set_aside
        self.lay_round_part = self._cell.lay_round_part
        self.scatter = self._cell.scatter
        self._easel = _fork(self._paint_for_others)

    def expose(self) -> Any:
        """The poses of all bodies and the prints shown; the truth is kept for this moment."""
        world, hands = self._cell.world, self._cell.presenter
        world.remember()
        return world.snapshot(), hands.sheet, hands.board

    def paint(self, shot: Any) -> NDArray[np.uint8]:
        """The picture, (H, W, 3)."""
        try:
            send(self._easel, {}, pickle.dumps(shot))
            header, body = receive(self._easel)
        except OSError as error:
            raise CameraLost("camera", "capture", f"the painter has died ({error})", "start again") from error
        return np.frombuffer(body, np.uint8).reshape(header["shape"])

    def _paint_for_others(self, easel: socket.socket) -> None:
        """The painter's whole life: it ends with the process it paints for."""
        os.nice(5)
        hands = self._cell.presenter
        while True:
            try:
                _, shot = receive(easel)
            except OSError:
                return
            snapshot, hands.sheet, hands.board = pickle.loads(shot)
            image = np.ascontiguousarray(self._cell._paint(snapshot))
            send(easel, {"shape": list(image.shape)}, image.data.cast("B"))

    def collisions(self) -> int:
        """Touches so far."""
        return len(self._cell.collisions)


def _fork(live: Callable[[socket.socket], None]) -> socket.socket:
    """Start a process that runs `live` on one end of a pair of sockets; the other end.

    To be called while there is one thread only.
    """
    ours, theirs = socket.socketpair()
    if os.fork() == 0:
        code = 1
        try:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            ours.close()
            live(theirs)
            code = 0
        finally:
            os._exit(code)
    theirs.close()
    return ours


class Bench:
    """Servos without a world: nothing to see, nobody there.

    Args:
        servos: What is mounted.
    """

    beat = CameraBeat(1.0 / 30.0, 0.008, 0.0)
    packet_loss = 0.0

    def __init__(self, servos: Sequence[ServoSpec]) -> None:
        self.servos = tuple(servos)
        self.plant = IdealPlant([spec.servo_id for spec in servos])

    @property
    def presenter(self) -> Presenter:
        """Nobody is there."""
        raise DeviceError("presenter", "show", "a bench of servos has no hands")

    def expose(self) -> Any:
        """There is no camera."""
        raise CameraLost("camera", "capture", "a bench of servos has no camera")

    def paint(self, shot: Any) -> NDArray[np.uint8]:
        """There is no camera."""
        raise CameraLost("camera", "capture", "a bench of servos has no camera")

    def truth(self) -> Sequence[TruePart]:
        """No parts."""
        return ()

    def truth_at(self, at: float) -> Sequence[TruePart]:
        """No parts."""
        return ()

    def tool(self) -> tuple[float, float, float]:
        """There is no arm."""
        raise DeviceError("arm", "look", "a bench of servos has no arm")

    def collisions(self) -> int:
        """None."""
        return 0

    def portrait(self) -> NDArray[np.uint8]:
        """There is nothing to see."""
        raise CameraLost("camera", "portrait", "a bench of servos has no camera")

    def set_aside(self) -> None:
        """There is nothing."""

    def lay_round_part(self) -> None:
        """There is nothing."""

    def scatter(self) -> None:
        """There is nothing."""
