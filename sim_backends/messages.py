"""What the simulated cell's process and its clients say to each other over a Unix socket.

A message is a header in JSON and a block of raw bytes: two lengths (4 bytes each, big-endian), then both.
"""

from __future__ import annotations

import dataclasses
import json
import socket
import struct
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from controller.domain import Shape, TruePart
from controller.errors import CameraLost, DeviceError, FrameStale

_LENGTHS = struct.Struct(">II")
LONGEST_HEADER = 4 << 20
LONGEST_BODY = 256 << 20
"""Bytes; more is not one of our messages."""
_MARGIN = 5.0
"""s beyond what was asked for until the other process counts as gone."""

PORTRAIT = 60.0
"""s that painting the whole cell may take: two seconds on a desktop computer with nothing else to do."""

Header = dict[str, Any]


def send(connection: socket.socket, header: Mapping[str, Any], body: bytes | memoryview = b"") -> None:
    """Send one message; blocks until it is handed over."""
    text = json.dumps(header).encode()
    connection.sendall(_LENGTHS.pack(len(text), len(body)) + text)
    if body:
        connection.sendall(body)


def receive(connection: socket.socket) -> tuple[Header, bytearray]:
    """The next message; blocks.

    Raises:
        ConnectionError: The other side has gone, or does not speak this language.
    """
    text_length, body_length = _LENGTHS.unpack(_exactly(connection, _LENGTHS.size))
    if text_length > LONGEST_HEADER or body_length > LONGEST_BODY:
        raise ConnectionError("not a message of the simulated cell")
    try:
        header = json.loads(_exactly(connection, text_length))
    except ValueError as error:
        raise ConnectionError("not a message of the simulated cell") from error
    if not isinstance(header, dict):
        raise ConnectionError("not a message of the simulated cell")
    return header, _exactly(connection, body_length)


def _exactly(connection: socket.socket, size: int) -> bytearray:
    data = bytearray(size)
    view = memoryview(data)
    while view:
        count = connection.recv_into(view)
        if not count:
            raise ConnectionError("the simulated cell has hung up")
        view = view[count:]
    return data


def part_to_json(part: TruePart) -> Header:
    """A true part as JSON has it."""
    return dataclasses.asdict(part)


def part_from_json(fields: Mapping[str, Any]) -> TruePart:
    """The inverse of `part_to_json`."""
    x, y = fields["center"]
    long, short = fields["size"]
    return TruePart(**{**fields, "shape": Shape(fields["shape"]), "center": (x, y), "size": (long, short)})


class Connection:
    """Questions and answers over one socket; threads take turns.

    Args:
        path: The server's socket.
        device: For messages.
    """

    def __init__(self, path: str | Path, device: str) -> None:
        self._path = str(path)
        self._device = device
        self._lock = threading.Lock()
        self._socket: socket.socket | None = None

    def open(self) -> None:
        """Connect; harmless when connected.

        Raises:
            DeviceError: Nobody listens.
        """
        if self._socket is not None:
            return
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            connection.settimeout(_MARGIN)
            connection.connect(self._path)
        except OSError as error:
            connection.close()
            raise self._lost("open", str(error)) from error
        self._socket = connection

    def close(self) -> None:
        """Disconnect; harmless when not connected."""
        connection, self._socket = self._socket, None
        if connection is not None:
            connection.close()

    def ask(
        self, operation: str, arguments: Mapping[str, Any] | None = None, body: bytes = b"", patience: float = 0.0
    ) -> tuple[Header, bytearray]:
        """Have the other process do something and wait for its answer, at most `patience` s and a margin.

        Raises:
            DeviceError: The other process is gone or refused; a camera's errors come as themselves.
        """
        with self._lock:
            self.open()
            connection = self._socket
            assert connection is not None
            try:
                connection.settimeout(patience + _MARGIN)
                send(connection, {"do": operation, **(arguments or {})}, body)
                header, answer = receive(connection)
            except OSError as error:
                self.close()
                raise self._lost(operation, str(error)) from error
        if "error" in header:
            raise _KINDS.get(str(header["error"]), DeviceError)(self._device, operation, str(header["cause"]))
        return header, answer

    def _lost(self, operation: str, cause: str) -> DeviceError:
        kind = CameraLost if self._device == "camera" else DeviceError
        return kind(self._device, operation, f"the simulated cell does not answer ({cause})", "start it again")


_KINDS: Mapping[str, type[DeviceError]] = {"CameraLost": CameraLost, "FrameStale": FrameStale}
