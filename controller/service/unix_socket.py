"""What a Unix socket's two ends know of each other: a path short enough to be an address, and who is calling."""

from __future__ import annotations

import os
import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

# sizeof(sockaddr_un.sun_path) less its final zero. Source: unix(7).
_LONGEST_ADDRESS = 107
# Groups of the process at the other end. Source: Linux, include/uapi/asm-generic/socket.h; socket(7) of 4.13 on.
_SO_PEERGROUPS = 59
_UCRED = struct.Struct("iII")
_MOST_GROUPS = 256


@dataclass(frozen=True, slots=True)
class Peer:
    """The process at the other end, as the kernel knew it when it connected."""

    pid: int
    uid: int
    gid: int
    groups: tuple[int, ...] = ()

    def may_control(self, group: int | None) -> bool:
        """It runs as the same user as this process, as root, or in `group`."""
        return self.uid in (0, os.geteuid()) or (group is not None and group in (self.gid, *self.groups))


def peer_of(line: socket.socket) -> Peer:
    """Who has connected (SO_PEERCRED), and the groups he is in, as far as he is in no more than 256."""
    pid, uid, gid = _UCRED.unpack(line.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _UCRED.size))
    try:
        raw = line.getsockopt(socket.SOL_SOCKET, _SO_PEERGROUPS, 4 * _MOST_GROUPS)
    except OSError:
        raw = b""
    return Peer(pid, uid, gid, struct.unpack(f"{len(raw) // 4}I", raw))


@contextmanager
def address_of(path: Path) -> Iterator[str]:
    """An address for a socket at `path`, however long the path is; valid inside the block.

    Raises:
        OSError: The folder cannot be opened.
    """
    if len(os.fsencode(path)) <= _LONGEST_ADDRESS:
        yield str(path)
        return
    folder = os.open(path.parent, os.O_PATH | os.O_DIRECTORY)
    try:
        yield f"/proc/self/fd/{folder}/{path.name}"
    finally:
        os.close(folder)


def connect(line: socket.socket, address: str, timeout: float) -> None:
    """Connect a new socket, waiting up to `timeout` seconds for a place in the queue of a busy server.

    A socket with a timeout of Python's is not blocking underneath, and is turned away by a full queue at once.

    Raises:
        BlockingIOError: There was no place in time.
        OSError: Nobody listens, or one may not connect.
    """
    seconds, rest = divmod(timeout, 1.0)
    line.setblocking(True)
    line.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("@ll", int(seconds), int(rest * 1e6)))
    line.connect(address)
