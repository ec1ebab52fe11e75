"""The other end of the control socket: asks a running cell, and says clearly when there is none."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from controller.errors import SorterError
from controller.service.control import REPLY_TIMEOUT, SOCKET
from controller.service.folders import state_folder
from controller.service.unit import RUNTIME
from controller.service.unix_socket import address_of, connect

_AT_REST = ("STOPPED", "ABORTED")
_MAX_REPLY = 4_000_000  # bytes; a full list of alarms is a twentieth of it


class NotRunning(SorterError):
    """Nobody serves the control socket."""


class CommandFailed(SorterError):
    """The cell has answered, with an error; `code` is the socket's word for it."""

    def __init__(self, code: str, cause: str, remedy: str) -> None:
        super().__init__(cause, remedy)
        self.code = code


def runtime_folder() -> Path:
    """Folder of the control socket that a cell makes: `$RUNTIME_DIRECTORY`, else the state folder."""
    given = os.environ.get("RUNTIME_DIRECTORY")
    return Path(given.split(os.pathsep)[0]) if given else state_folder()


def folder_of_running_cell(service: Path = RUNTIME) -> Path:
    """Folder to look for a cell in: the installed service's when that is running, else as `runtime_folder`."""
    if "RUNTIME_DIRECTORY" not in os.environ and service.is_dir():
        return service
    return runtime_folder()


class ControlClient:
    """Talks to the cell whose control socket lies in a folder; one connection a request.

    Args:
        folder: See `folder_of_running_cell`.
        timeout: s to wait for a reply; longer than the server itself waits.
    """

    def __init__(self, folder: Path, timeout: float = REPLY_TIMEOUT + 2.0) -> None:
        self._path = folder / SOCKET
        self._timeout = timeout

    def ask(self, command: str, **given: object) -> Any:
        """Send a command and return its result.

        Raises:
            NotRunning: Nobody is there, or he went away before the reply.
            CommandFailed: The cell has refused, or failed.
            SorterError: The socket may not be opened, or no reply came in time.
        """
        request = json.dumps({"command": command, **given}).encode() + b"\n"
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as line, address_of(self._path) as address:
                connect(line, address, self._timeout)
                line.settimeout(self._timeout)
                line.sendall(request)
                reply = _read_line(line)
        except PermissionError as error:
            remedy = "ask as root, or as a member of the service's group: sudo usermod -aG sorter $USER"
            raise SorterError(f"{self._path}: you may not control this cell", remedy) from error
        except (TimeoutError, BlockingIOError) as error:
            raise SorterError(f"{self._path}: no reply within {self._timeout:g} s", "see the cell's log") from error
        except (FileNotFoundError, NotADirectoryError, ConnectionError) as error:
            remedy = "start it: systemctl start controller, or controller run --config FILE"
            raise NotRunning(f"no cell is running at {self._path.parent}", remedy) from error
        except OSError as error:
            raise SorterError(f"{self._path}: {error.strerror or error}") from error
        return _result(self._path, reply)

    def wait_for_rest(
        self, timeout: float, *, pause: Callable[[float], None] = time.sleep, now: Callable[[], float] = time.monotonic
    ) -> Mapping[str, Any] | None:
        """Wait until the cell is STOPPED or ABORTED.

        Returns:
            Its status then; None when the program has ended meanwhile, which leaves nothing that could move.

        Raises:
            SorterError: It is still at work after `timeout` seconds.
        """
        until = now() + timeout
        while True:
            try:
                status: Mapping[str, Any] = self.ask("status")
            except NotRunning:
                return None
            if status.get("state") in _AT_REST:
                return status
            if now() >= until:
                remedy = "use the emergency stop, then see the log"
                raise SorterError(f"still {status.get('state')} after {timeout:g} s", remedy)
            pause(0.1)


def _read_line(line: socket.socket) -> bytes:
    data = b""
    while not data.endswith(b"\n"):
        part = line.recv(65536)
        if not part or len(data) > _MAX_REPLY:
            raise ConnectionResetError("the connection ended before the reply")
        data += part
    return data


def _result(path: Path, reply: bytes) -> Any:
    try:
        content = json.loads(reply)
        if content["ok"]:
            return content["result"]
        error = content["error"]
        failed = CommandFailed(str(error["code"]), str(error["cause"]), str(error["remedy"]))
    except (ValueError, KeyError, TypeError) as error:
        raise SorterError(f"{path}: not a reply of a cell", "is another program's socket there?") from error
    raise failed
