"""The cell in a process of its own: it outlives its client, stops its servos and ends by itself."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

if sys.platform == "win32":
    pytest.skip("pseudo-terminals are POSIX", allow_module_level=True)

from controller.domain import Shape, TruePart
from controller.errors import CameraLost, DeviceError, FrameStale
from controller.geometry import pose
from controller.ports import Camera, Presenter
from sim_backends.messages import Connection, part_from_json, part_to_json, receive, send
from sim_backends.remote import RemoteCamera, RemotePresenter, RemoteTruth, ServerSpec, spawn_server
from sim_backends.served_cell import Bench, CameraBeat
from sim_backends.server import CellServer
from sim_backends.virtual_dynamixel import ServoSpec

SERVOS = ((1, "XM430-W350"), (2, "XL430-W250"))
PART = TruePart(3, Shape.HEXAGON, "red", (12.5, -7.0), 0.25, (40.0, 34.6), 25.0, True, "table", True)


class SystemClock:
    """The controller's clock, with an origin of its own."""

    def now(self) -> float:
        return time.monotonic() - 1000.0

    def sleep(self, seconds: float) -> None:
        raise AssertionError("nobody sleeps here")

    def charge(self, seconds: float) -> None:
        raise AssertionError("nobody charges here")


class Hands:
    def __init__(self) -> None:
        self.shown: list[tuple[str, tuple[int, ...], float]] = []

    def lay(self, print_: NDArray[np.uint8], pixel_mm: float) -> None:
        self.shown.append(("lay", print_.shape, pixel_mm))

    def hold(self, print_: NDArray[np.uint8], pixel_mm: float, T_camera_board: NDArray[np.float64]) -> None:
        self.shown.append(("hold", print_.shape, float(T_camera_board[2, 3])))

    def remove(self) -> None:
        self.shown.append(("remove", (), 0.0))


class Picturesque(Bench):
    """A bench with hands, one part, and a camera that sees gray."""

    beat = CameraBeat(0.02, 0.004, 0.01)
    packet_loss = 0.0

    def __init__(self) -> None:
        super().__init__([ServoSpec(*servo) for servo in SERVOS])
        self.hands = Hands()
        self.on_table = True

    @property
    def presenter(self) -> Hands:
        return self.hands

    def expose(self) -> float:
        return self.plant.now()

    def paint(self, shot: float) -> NDArray[np.uint8]:
        return np.full((4, 6, 3), 7, np.uint8)

    def truth(self) -> tuple[TruePart, ...]:
        return (PART,) if self.on_table else ()

    def truth_at(self, at: float) -> tuple[TruePart, ...]:
        assert abs(at - self.plant.now()) < 60.0  # asked in the world's own time, not the client's
        return (PART,)

    def portrait(self) -> NDArray[np.uint8]:
        return np.full((2, 3, 3), 9, np.uint8)

    def set_aside(self) -> None:
        self.on_table = False

    def scatter(self) -> None:
        self.on_table = True


@pytest.fixture
def cell() -> Picturesque:
    return Picturesque()


@pytest.fixture
def path(cell: Picturesque, tmp_path: Path) -> Iterator[str]:
    server = CellServer(cell, ServerSpec(), tmp_path)
    server.start()
    thread = threading.Thread(target=server.serve, name="server")
    thread.start()
    yield server.where["socket"]
    server.ending.set()
    thread.join()


def test_messages_survive_the_socket() -> None:
    left, right = socket.socketpair()
    with left, right:
        send(left, {"a": [1, 2.5, "x"]}, b"raw")
        send(left, {})
        assert receive(right) == ({"a": [1, 2.5, "x"]}, bytearray(b"raw"))
        assert receive(right) == ({}, bytearray())
        left.sendall(b"\xff" * 64)
        with pytest.raises(ConnectionError, match="not a message"):
            receive(right)


def test_parts_and_specs_survive_json() -> None:
    assert part_from_json(part_to_json(PART)) == PART
    spec = ServerSpec({"seed": 3}, SERVOS, 57_600, 1.0, 4, 5.0)
    assert ServerSpec.from_json(spec.to_json()) == spec


def test_the_ports_work_through_the_socket(cell: Picturesque, path: str) -> None:
    clock = SystemClock()
    camera, presenter, truth = RemoteCamera(path, clock), RemotePresenter(path), RemoteTruth(path, clock)
    assert isinstance(camera, Camera)
    assert isinstance(presenter, Presenter)
    camera.open()
    asked = clock.now() + 0.02
    frame = camera.capture(asked)
    assert camera.capture(asked).frame_id == frame.frame_id + 1
    assert frame.image.shape == (4, 6, 3)
    assert int(frame.image.max()) == 7
    assert not frame.image.flags.writeable
    assert asked <= frame.captured_at <= clock.now()
    with pytest.raises(FrameStale):
        camera.capture(clock.now() + 5.0, timeout=0.1)
    board = np.zeros((3, 2), np.uint8)
    presenter.lay(board, 0.5)
    presenter.hold(board, 0.5, pose(z=7.0))
    presenter.remove()
    assert cell.hands.shown == [("lay", (3, 2), 0.5), ("hold", (3, 2), 7.0), ("remove", (), 0.0)]
    assert list(truth.now()) == [PART]
    assert list(truth.at(clock.now())) == [PART]
    truth.set_aside()
    assert list(truth.now()) == []
    truth.scatter()
    assert list(truth.now()) == [PART]
    assert truth.portrait().tolist() == np.full((2, 3, 3), 9).tolist()
    assert truth.collisions() == 0
    assert truth.servo(1)["torque"] is False
    for remote in (camera, presenter, truth):
        remote.close()


def test_nonsense_is_refused_and_the_server_goes_on(path: str) -> None:
    connection = Connection(path, "test")
    for operation in ("dance", "hold", "strike"):
        with pytest.raises(DeviceError):
            connection.ask(operation)
    with socket.socket(socket.AF_UNIX) as rude:
        rude.connect(path)
        rude.sendall(b"GET / HTTP/1.1\r\n\r\n")
    assert connection.ask("collisions")[0] == {"count": 0}
    connection.close()


def test_a_camera_without_its_world_is_lost(tmp_path: Path) -> None:
    camera = RemoteCamera(tmp_path / "nothing", SystemClock())
    with pytest.raises(CameraLost):
        camera.open()


def test_nobody_there_ends_the_server(cell: Picturesque, tmp_path: Path) -> None:
    server = CellServer(cell, ServerSpec(idle_limit=0.05), tmp_path)
    server.start()
    server.serve()
    assert not Path(server.where["pty"]).is_symlink()


# --- a process of its own -----------------------------------------------------------------------------------

MOVER = """
import sys, time
from dynamixel_sdk import PacketHandler, PortHandler
port, packets = PortHandler(sys.argv[1]), PacketHandler(2.0)
port.openPort(); port.setBaudRate(1_000_000)
for address, size, value in ((64, 1, 1), (112, 4, 20), (98, 1, 10), (116, 4, 4000)):
    while packets.writeTxRx(port, 1, address, size, list(value.to_bytes(size, "little"))) != (0, 0):
        pass
while True:
    packets.read4ByteTxRx(port, 1, 132)
    print("moving", flush=True)
    time.sleep(0.02)
"""


def eventually(condition: Callable[[], bool], seconds: float = 10.0) -> bool:
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            return False
        threading.Event().wait(0.01)
    return True


@pytest.mark.safety("SR-25")
def test_the_servos_stop_by_themselves_when_the_controller_is_killed() -> None:
    with spawn_server(ServerSpec(servos=SERVOS)) as server:
        truth = RemoteTruth(server.socket, SystemClock())
        mover = subprocess.Popen([sys.executable, "-c", MOVER, server.pty], stdout=subprocess.PIPE)
        assert mover.stdout is not None
        with mover.stdout:
            assert mover.stdout.readline() == b"moving\n"
            assert eventually(lambda: truth.servo(1)["velocity"] > 0.3)
            mover.send_signal(signal.SIGKILL)
            mover.wait()
        # 200 ms by register; the wait is long because the machine may be busy, the register says who stopped it.
        assert eventually(lambda: truth.servo(1)["watchdog"] == -1)
        assert eventually(lambda: abs(truth.servo(1)["velocity"]) < 0.01)
        assert truth.servo(1)["angle"] < 2.0
        truth.close()
        assert server.is_running()
    assert not server.is_running()
    assert not os.path.exists(server.socket)


def test_a_server_ends_when_asked() -> None:
    with spawn_server(ServerSpec(servos=SERVOS)) as server:
        truth = RemoteTruth(server.socket, SystemClock())
        truth.shut_down()
        truth.close()
        assert eventually(lambda: not server.is_running())


def test_a_server_that_cannot_start_says_why() -> None:
    with pytest.raises(DeviceError, match="no-such-model"):
        spawn_server(ServerSpec(servos=((1, "no-such-model"),)))
