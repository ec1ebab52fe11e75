"""The control socket's file, and the client: whom it finds there, and how long it waits."""

from __future__ import annotations

import socket
import threading
from pathlib import Path

import pytest

from controller.cycle.machine import State
from controller.errors import SorterError
from controller.service.client import ControlClient, NotRunning, folder_of_running_cell
from controller.service.control import SOCKET, ControlServer
from tests.unit.service.cell_double import PretendedCell


def test_a_socket_left_behind_is_replaced_and_the_own_one_is_taken_away(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as old:
        old.bind(str(tmp_path / SOCKET))
    with ControlServer(tmp_path, PretendedCell()):
        assert ControlClient(tmp_path).ask("status")["state"] == "STOPPED"
    assert not (tmp_path / SOCKET).exists()


def test_a_file_that_is_no_socket_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / SOCKET).write_text("precious")
    with pytest.raises(SorterError, match=SOCKET):
        ControlServer(tmp_path, PretendedCell())
    assert (tmp_path / SOCKET).read_text() == "precious"


def test_a_folder_with_a_long_name_will_do(tmp_path: Path) -> None:
    folder = tmp_path / ("long" * 40)
    with ControlServer(folder, PretendedCell()):
        assert ControlClient(folder).ask("status")["state"] == "STOPPED"


# --- the client ---------------------------------------------------------------------------------------------


def test_no_cell_is_a_clear_error(tmp_path: Path) -> None:
    with pytest.raises(NotRunning, match=r"no cell is running at .*: start it"):
        ControlClient(tmp_path).ask("status")
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(tmp_path / SOCKET))
    with pytest.raises(NotRunning):
        ControlClient(tmp_path).ask("status")


def test_a_server_that_takes_nobody_in_is_given_up_in_time(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as asleep, socket.socket(socket.AF_UNIX) as first:
        asleep.bind(str(tmp_path / SOCKET))
        asleep.listen(0)
        first.connect(str(tmp_path / SOCKET))
        with pytest.raises(SorterError, match="no reply within"):
            ControlClient(tmp_path, timeout=0.05).ask("status")


@pytest.mark.parametrize("reply", [b"hello\n", b"[]\n", b'{"ok": false}\n', b'{"ok": true}\n', b"\xff\n"])
def test_what_is_no_reply_of_a_cell_is_called_so(tmp_path: Path, reply: bytes) -> None:
    with socket.socket(socket.AF_UNIX) as other:
        other.bind(str(tmp_path / SOCKET))
        other.listen(1)

        def answer() -> None:
            line, _ = other.accept()
            with line:
                line.recv(4096)
                line.sendall(reply)

        thread = threading.Thread(target=answer)
        thread.start()
        with pytest.raises(SorterError, match="not a reply of a cell"):
            ControlClient(tmp_path).ask("status")
        thread.join()


def test_waiting_for_rest_ends_with_the_rest_the_program_or_the_patience(tmp_path: Path) -> None:
    cell, client = PretendedCell(), ControlClient(tmp_path)

    def rest(seconds: float) -> None:
        cell.state = State.STOPPED

    with ControlServer(tmp_path, cell):
        client.ask("start")
        found = client.wait_for_rest(5.0, pause=rest)
        assert found is not None
        assert found["state"] == "STOPPED"
        cell.state = State.PICK
        times = iter([0.0, 3.0, 6.0])
        with pytest.raises(SorterError, match="still EXECUTE after 5 s"):
            client.wait_for_rest(5.0, pause=lambda seconds: None, now=lambda: next(times))
    assert client.wait_for_rest(5.0) is None


def test_the_service_is_looked_for_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/mine")
    assert folder_of_running_cell(tmp_path) == tmp_path
    assert folder_of_running_cell(tmp_path / "none") == Path("/var/lib/mine")
    monkeypatch.setenv("RUNTIME_DIRECTORY", "/run/mine")
    assert folder_of_running_cell(tmp_path) == Path("/run/mine")
