"""A simulated cell in a process of its own, in real time: it goes on when the controller has died.

    python -m sim_backends.server --spec FILE

The servo bus is a pseudo-terminal, everything else (pictures, hands, truth, faults) a Unix socket. One JSON line
with both paths is printed when they can be opened. The process ends on SIGTERM, when asked to, or when no
client has been there for a while. One thread owns the physics and the bus; pictures are painted by a second
process from copies of the scene.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import signal
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.errors import CameraLost, FrameStale, SorterError
from sim_backends.messages import PORTRAIT, Header, part_to_json, receive, send
from sim_backends.remote import ServerSpec
from sim_backends.served_cell import Bench, PhysicsCell, ServedCell
from sim_backends.virtual_dynamixel import Fault, ServoSpec, VirtualBus
from sim_backends.virtual_dynamixel.pty import PtyBus

SWITCH_INTERVAL = 0.0005
"""s until another thread lets the bus's thread run, which has to answer within a millisecond or so."""
LOOK = 0.2
"""s between two looks at the reasons to end."""


class CellServer:
    """Serves a cell until told to end.

    Args:
        cell: The cell.
        spec: Bus and life span.
        folder: Where the socket and the link to the terminal are made.
    """

    def __init__(self, cell: ServedCell, spec: ServerSpec, folder: Path) -> None:
        self._cell = cell
        self._idle_limit = spec.idle_limit
        bus = VirtualBus(
            cell.plant, cell.servos, baud=spec.baud, latency_timer_ms=spec.latency_timer_ms, seed=spec.seed
        )
        bus.faults.set_rate(Fault.DROP, cell.packet_loss)
        self._line = PtyBus(bus, link=folder / "servo-bus")
        self._path = folder / "socket"
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._clients: dict[threading.Thread, socket.socket] = {}
        self._guard = threading.Lock()
        self._easel = threading.Lock()
        self._frames = 0
        self.ending = threading.Event()
        """Set it to end `serve`."""

    @property
    def where(self) -> dict[str, str]:
        """Paths of the terminal and of the socket."""
        return {"pty": self._line.path, "socket": str(self._path)}

    def start(self) -> None:
        """Begin to serve; returns when clients may connect."""
        self._listener.bind(str(self._path))
        self._listener.listen()
        self._listener.settimeout(LOOK)
        self._line.start()

    def serve(self) -> None:
        """Accept clients until `ending` is set or nobody has been there for the idle limit; then clean up."""
        last_seen = time.monotonic()
        try:
            while not self.ending.is_set() and self._line.alive:
                with self._guard:
                    present = bool(self._clients)
                now = time.monotonic()
                last_seen = max(last_seen, now if present else self._line.last_heard)
                if now - last_seen > self._idle_limit:
                    return
                try:
                    connection, _ = self._listener.accept()
                except TimeoutError:
                    continue
                thread = threading.Thread(target=self._attend, args=(connection,), name="client", daemon=True)
                with self._guard:
                    self._clients[thread] = connection
                thread.start()
        finally:
            self._end()

    def _end(self) -> None:
        self.ending.set()
        self._listener.close()
        with self._guard:
            clients = dict(self._clients)
        for connection in clients.values():
            connection.shutdown(socket.SHUT_RDWR)
        for thread in clients:
            thread.join()
        self._line.stop()

    def _attend(self, connection: socket.socket) -> None:
        """Answer one client until it hangs up."""
        try:
            while not self.ending.is_set():
                header, body = receive(connection)
                try:
                    answer, picture = self._answer(header, body)
                except SorterError as error:
                    answer, picture = {"error": type(error).__name__, "cause": error.cause}, b""
                except (KeyError, TypeError, ValueError) as error:
                    answer, picture = {"error": "refused", "cause": f"{type(error).__name__}: {error}"}, b""
                send(connection, answer, picture)
        except OSError:
            pass  # the client is gone, which is its right
        finally:
            with self._guard:
                self._clients.pop(threading.current_thread(), None)
            connection.close()

    def _answer(self, asked: Header, body: bytearray) -> tuple[Header, bytes | memoryview]:
        """Do what a client asks.

        Raises:
            SorterError: It went wrong.
            KeyError, TypeError, ValueError: It makes no sense.
        """
        cell, line = self._cell, self._line
        match asked["do"]:
            case "capture":
                return self._capture(float(asked["after"]), float(asked["timeout"]))
            case "hold":
                pose = np.array(asked["T_camera_board"], np.float64).reshape(4, 4)
                line.call(lambda: cell.presenter.hold(_picture(asked, body), float(asked["pixel_mm"]), pose))
            case "lay":
                line.call(lambda: cell.presenter.lay(_picture(asked, body), float(asked["pixel_mm"])))
            case "remove":
                line.call(cell.presenter.remove)
            case "truth":
                at = asked.get("at")
                parts = line.call(cell.truth if at is None else lambda: cell.truth_at(line.plant_time(float(at))))
                return {"parts": [part_to_json(part) for part in parts]}, b""
            case "tool":
                return {"position": line.call(cell.tool)}, b""
            case "collisions":
                return {"count": line.call(cell.collisions)}, b""
            case "portrait":
                # Painted where the physics runs, which it holds up: for a cell at rest.
                picture = np.ascontiguousarray(line.call(cell.portrait, PORTRAIT))
                return {"shape": list(picture.shape)}, picture.data.cast("B")
            case "set_aside":
                line.call(cell.set_aside)
            case "lay_round_part":
                line.call(cell.lay_round_part)
            case "scatter":
                line.call(cell.scatter)
            case "strike":
                fault, servo_id = Fault(asked["fault"]), asked["servo_id"]
                line.call(lambda: line.bus.strike(fault, None if servo_id is None else int(servo_id)))
            case "heal":
                line.call(line.bus.heal)
            case "servo":
                return line.call(lambda: self._servo(int(asked["servo_id"]))), b""
            case "shut_down":
                self.ending.set()
            case unknown:
                raise ValueError(f"unknown request {unknown!r}")
        return {}, b""

    def _servo(self, servo_id: int) -> Header:
        servo = self._line.bus.servo(servo_id)
        shaft = self._cell.plant.shaft(servo.shaft_id)
        get = servo.table.get
        return {
            "angle": shaft.angle,
            "velocity": shaft.velocity,
            "torque": bool(get("Torque_Enable")),
            "goal": get("Goal_Position"),
            "watchdog": get("Bus_Watchdog"),
        }

    def _capture(self, after: float, timeout: float) -> tuple[Header, memoryview]:
        """Wait for the next exposure, copy the scene in its middle, paint it here, deliver it late as cameras do.

        Args:
            after: Earliest beginning of the exposure, s of the monotonic clock.
            timeout: s.
        """
        beat = self._cell.beat
        now, line = time.monotonic(), self._line
        beats = math.ceil(line.plant_time(max(after, now)) / beat.period - 1e-9)
        begin = line.wall_time(beats * beat.period)
        delivery = begin + beat.exposure + beat.latency
        if delivery > now + timeout:
            self._wait(now + timeout)
            raise FrameStale("camera", "capture", f"no frame within {timeout:g} s")
        self._wait(begin + beat.exposure / 2.0)
        shot = line.call(self._cell.expose)
        with self._easel:
            image = np.ascontiguousarray(self._cell.paint(shot))
            self._frames += 1
            count = self._frames
        self._wait(delivery)
        header = {"frame_id": count, "captured_at": begin + beat.exposure, "shape": list(image.shape)}
        return header, image.data.cast("B")

    def _wait(self, until: float) -> None:
        while (missing := until - time.monotonic()) > 0.0:
            if self.ending.wait(missing):
                raise CameraLost("camera", "capture", "the simulated cell is ending")


def _picture(asked: Header, body: bytearray) -> NDArray[np.uint8]:
    return np.frombuffer(body, np.uint8).reshape(asked["shape"])


def _cell(spec: ServerSpec) -> ServedCell:
    if spec.cell:
        return PhysicsCell(json.dumps(spec.cell))
    return Bench([ServoSpec(servo_id, model) for servo_id, model in spec.servos])


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve one cell; the exit code."""
    parser = argparse.ArgumentParser(prog="python -m sim_backends.server", description=__doc__)
    parser.add_argument("--spec", type=Path, required=True, help="ServerSpec as JSON")
    spec = ServerSpec.from_json(parser.parse_args(arguments).spec.read_text())
    sys.setswitchinterval(SWITCH_INTERVAL)
    cv2.setNumThreads(1)  # a pool of threads would not survive the fork of the painter
    folder = Path(tempfile.mkdtemp(prefix="simulated-cell-"))
    try:
        server = CellServer(_cell(spec), spec, folder)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: server.ending.set())
        server.start()
        print(json.dumps({**server.where, "pid": os.getpid()}), flush=True)
        _let_go_of_stdout()
        server.serve()
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return 0


def _let_go_of_stdout() -> None:
    """Nobody needs to keep the other end of the pipe."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, sys.stdout.fileno())
    os.close(null)


if __name__ == "__main__":
    sys.exit(main())
