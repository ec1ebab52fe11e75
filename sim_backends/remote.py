"""The simulated cell in another process, as seen by the controller: camera, hands and truth over a Unix socket."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from controller.domain import Frame, TruePart
from controller.errors import DeviceError
from controller.ports import Clock
from sim_backends.messages import PORTRAIT, Connection, Header, part_from_json

_START = 30.0
"""s a server may need to build its world."""

# --- the ports ----------------------------------------------------------------------------------------------


class RemoteCamera:
    """The simulated camera behind the Camera port.

    Args:
        path: The server's socket.
        clock: The controller's clock; the server's is the system's monotonic one.
    """

    def __init__(self, path: str | Path, clock: Clock) -> None:
        self._connection = Connection(path, "camera")
        self._clock = clock

    def open(self) -> None:
        """Connect. Raises CameraLost."""
        self._connection.open()

    def close(self) -> None:
        """Disconnect."""
        self._connection.close()

    def capture(self, after: float, timeout: float = 2.0) -> Frame:
        """A frame whose exposure began at or after `after`; blocks.

        Raises:
            FrameStale: None within `timeout` s.
            CameraLost: The other process is gone.
        """
        offset = self._clock.now() - time.monotonic()
        asked = {"after": after - offset, "timeout": timeout}
        header, body = self._connection.ask("capture", asked, patience=timeout)
        image = np.frombuffer(body, np.uint8).reshape(header["shape"])
        image.flags.writeable = False
        return Frame(int(header["frame_id"]), float(header["captured_at"]) + offset, image, "simulated camera")


class RemotePresenter:
    """The simulated hands behind the Presenter port.

    Args:
        path: The server's socket.
    """

    def __init__(self, path: str | Path) -> None:
        self._connection = Connection(path, "presenter")

    def close(self) -> None:
        """Disconnect."""
        self._connection.close()

    def hold(self, print_: NDArray[np.uint8], pixel_mm: float, T_camera_board: NDArray[np.float64]) -> None:
        """Hold a print before the camera."""
        pose = np.asarray(T_camera_board, np.float64).tolist()
        self._show("hold", print_, {"pixel_mm": pixel_mm, "T_camera_board": pose})

    def lay(self, print_: NDArray[np.uint8], pixel_mm: float) -> None:
        """Lay a print on the table."""
        self._show("lay", print_, {"pixel_mm": pixel_mm})

    def remove(self) -> None:
        """Take the print away."""
        self._connection.ask("remove")

    def _show(self, how: str, print_: NDArray[np.uint8], arguments: Header) -> None:
        picture = np.ascontiguousarray(print_, np.uint8)
        self._connection.ask(how, {**arguments, "shape": list(picture.shape)}, picture.tobytes())


class RemoteTruth:
    """What the simulated world knows, and what can be done to it.

    Args:
        path: The server's socket.
        clock: The controller's clock.
    """

    def __init__(self, path: str | Path, clock: Clock) -> None:
        self._connection = Connection(path, "simulated world")
        self._clock = clock

    def close(self) -> None:
        """Disconnect."""
        self._connection.close()

    def now(self) -> Sequence[TruePart]:
        """Every part as it is now."""
        return self._parts({})

    def at(self, at: float) -> Sequence[TruePart]:
        """Every part as it was at a time of the controller's clock."""
        return self._parts({"at": at - self._clock.now() + time.monotonic()})

    def tool(self) -> tuple[float, float, float]:
        """Where the grasp point is now: (x, y, z) in `table`, mm."""
        x, y, z = self._connection.ask("tool")[0]["position"]
        return float(x), float(y), float(z)

    def collisions(self) -> int:
        """Touches of the arm with what it should not touch, so far."""
        return int(self._connection.ask("collisions")[0]["count"])

    def portrait(self) -> NDArray[np.uint8]:
        """A picture of the whole cell for people, (H, W, 3); holds up the world, so ask for it at rest."""
        header, body = self._connection.ask("portrait", patience=PORTRAIT)
        return np.frombuffer(body, np.uint8).reshape(header["shape"])

    def set_aside(self) -> None:
        """Take all parts off the table, e.g. to calibrate."""
        self._connection.ask("set_aside")

    def lay_round_part(self) -> None:
        """Lay the round part that a calibration touches into the middle of the work area."""
        self._connection.ask("lay_round_part")

    def scatter(self) -> None:
        """Put all parts where the seed has them."""
        self._connection.ask("scatter")

    def strike(self, fault: str, servo_id: int | None = None) -> None:
        """Let a fault happen to a servo or the adapter (see `Fault`), now; `heal` undoes it."""
        self._connection.ask("strike", {"fault": fault, "servo_id": servo_id})

    def heal(self) -> None:
        """Undo `strike`."""
        self._connection.ask("heal")

    def servo(self, servo_id: int) -> Header:
        """`angle` (rad, bare shaft), `velocity` (rad/s), `torque` (on), `goal` (ticks) and `watchdog` (register)."""
        return self._connection.ask("servo", {"servo_id": servo_id})[0]

    def shut_down(self) -> None:
        """Ask the other process to end."""
        self._connection.ask("shut_down")

    def _parts(self, arguments: Header) -> Sequence[TruePart]:
        header, _ = self._connection.ask("truth", arguments)
        return tuple(part_from_json(fields) for fields in header["parts"])


# --- the other process --------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ServerSpec:
    """What a server serves and how; goes through JSON unchanged.

    Attributes:
        cell: The cell's own specification as JSON; empty for a bench of servos without a world.
        servos: For a bench: (ID, model) of each.
        baud: Bit rate the servos are set to.
        latency_timer_ms: Of the adapter.
        seed: Of the injected faults.
        idle_limit: s without any client until the server ends by itself.
    """

    cell: Header = dataclasses.field(default_factory=dict)
    servos: tuple[tuple[int, str], ...] = ()
    baud: int = 1_000_000
    latency_timer_ms: float = 0.0
    seed: int = 0
    idle_limit: float = 60.0

    def to_json(self) -> str:
        """As one line of JSON."""
        return json.dumps(dataclasses.asdict(self))

    @classmethod
    def from_json(cls, text: str) -> ServerSpec:
        """The inverse of `to_json`."""
        fields = json.loads(text)
        fields["servos"] = tuple((int(servo_id), str(model)) for servo_id, model in fields.get("servos", ()))
        return cls(**fields)


class ServerHandle:
    """A server started by `spawn_server`; it lives on when this object, or its process, is gone.

    Attributes:
        pid: Process ID.
        pty: Path of the servo bus, to be opened like a serial port.
        socket: Path of the socket.
    """

    def __init__(self, process: subprocess.Popen[bytes], pty: str, socket_path: str) -> None:
        self._process = process
        self.pid = process.pid
        self.pty = pty
        self.socket = socket_path

    def is_running(self) -> bool:
        """It has not ended."""
        return self._process.poll() is None

    def stop(self, timeout: float = 10.0) -> None:
        """Ask it to end and wait; harmless when it has ended."""
        if self.is_running():
            self._process.send_signal(signal.SIGTERM)
        try:
            self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def __enter__(self) -> ServerHandle:
        return self

    def __exit__(self, *unused: object) -> None:
        self.stop()


def spawn_server(spec: ServerSpec) -> ServerHandle:
    """Start a server in a session of its own, which neither Ctrl-C nor the end of this process reaches.

    Blocks until it serves.

    Raises:
        DeviceError: It did not come up.
    """
    handle, name = tempfile.mkstemp(prefix="simulated-cell-", suffix=".json")
    log = Path(name).with_suffix(".log")
    try:
        with os.fdopen(handle, "w") as file:
            file.write(spec.to_json())
        root = str(Path(__file__).resolve().parents[1])
        known = os.environ.get("PYTHONPATH")
        with log.open("wb") as errors:
            process = subprocess.Popen(
                [sys.executable, "-m", "sim_backends.server", "--spec", name],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=errors,
                start_new_session=True,
                env={**os.environ, "PYTHONPATH": root + (os.pathsep + known if known else "")},
            )
        line = _first_line(process)
        if not line:
            process.kill()
            process.wait()
            last = (log.read_text(errors="replace").strip().splitlines() or ["it said nothing"])[-1]
            raise DeviceError("simulated cell", "start", last, "install the extra `sim`, or run without --real-time")
    finally:
        Path(name).unlink(missing_ok=True)
        log.unlink(missing_ok=True)
    where = json.loads(line)
    return ServerHandle(process, where["pty"], where["socket"])


def _first_line(process: subprocess.Popen[bytes]) -> bytes:
    """The line a server prints when it serves; empty when it ended or took too long."""
    assert process.stdout is not None
    with contextlib.closing(process.stdout) as pipe:
        ready, _, _ = select.select([pipe], [], [], _START)
        return pipe.readline() if ready else b""
