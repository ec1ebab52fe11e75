"""The control socket: operators and programs ask for the cell's state and tell it what to do.

A Unix stream socket, `control.sock`. A request is one line, a JSON object; so is its reply:

    {"command": "status", "id": 7}   ->  {"id": 7, "ok": true, "result": {"state": "EXECUTE", ...}}
    {"command": "start"}             ->  {"id": null, "ok": false,
                                          "error": {"code": "refused", "cause": "...", "remedy": "..."}}

| command | does | result |
|---|---|---|
| `status` | | `Status.to_json`: state (PackML), what is going on, counts, alarms that want attention |
| `alarms` | | every alarm that is kept, oldest first |
| `start` (`view_clear`: true: nothing is over the table, whatever it looks like) | sorts, from STOPPED | the status |
| `pause`, `resume` | holds on the path of the move, torque on (HOLDING, then HELD); goes on from there | the status |
| `stop` | slows down along the path, parks, torque off | null: it is under way; ask for the status |
| `reset` | clears a latched fault; nothing moves | the status |
| `acknowledge` (`alarm`: its number; left out: all) | notes that alarms were seen; clears nothing | how many |
| `emptied` (`bin`: its name; left out: all) | counts what lies in a bin from nothing again | null |
| `reload` | reads the configuration again, for the next cycle | what has changed |

`id` is the caller's and comes back with the reply. Replies come as they get ready: a `stop` behind a slow command
is answered first. Error codes: `bad_request`, `unknown_command`, `forbidden`, `too_large`, `too_fast`, `busy`
(another command that changes something is still being worked on: it is refused, never kept for later), `refused`
(not possible in this state), `timeout` (the command goes on, its reply is lost), `failed`.

Who may talk: the user the service runs as, root, and members of the group it was given. Requests are limited in
size and rate; `stop` is exempt from the rate, is carried out by the thread that reads it, and makes void a `start`
or `resume` that is still being worked on.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import selectors
import socket
import stat
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType

from controller.errors import SorterError
from controller.service.controls import Controls
from controller.service.requests import READING, BadRequest, Commands, Request, failure, outcome, parse
from controller.service.unix_socket import Peer, address_of, peer_of
from controller.service.worker import Worker

_log = logging.getLogger(__name__)

SOCKET = "control.sock"
MAX_LINE = 4096
"""Longest request, bytes."""
MAX_CLIENTS = 64
"""Connections at a time; a further one takes the place of the one that was silent for longest."""
RATE, BURST = 50.0, 100.0
"""Requests a second and user, and how many at once."""
LINE_TIMEOUT = 5.0
"""s in which a begun request must be complete."""
REPLY_TIMEOUT = 10.0
"""s after which a command that has not ended is answered with `timeout`."""
_MAX_UNSENT = 256 * 1024  # bytes of replies that a client may leave unread
_CLOSE_PATIENCE = 1.0  # s for a command under way at the end: the service manager's patience is for the arm
_POLL = 0.5  # s between looks at deadlines; also the loop's heartbeat


@dataclass(eq=False, slots=True)
class _Client:
    line: socket.socket
    peer: Peer
    heard_at: float
    unread: bytearray = field(default_factory=bytearray)
    unsent: bytearray = field(default_factory=bytearray)
    begun_at: float | None = None
    """When the request that is still incomplete began to arrive."""
    leaving: bool = False
    """Nothing more is read from it; it is dropped when it has got its replies."""


@dataclass(eq=False, slots=True)
class _Job:
    client: _Client
    request: Request
    since: float


class ControlServer:
    """Serves the control socket from threads of its own; a context manager.

    Args:
        folder: Where the socket is made; the caller holds the cell's lock, so that what lies there is a leftover.
        controls: The cell.
        group: Group whose members may talk to it besides the service's own user and root, see `operators`;
            None for none.
        progress: Called at least twice a second while the server is alive, for the supervisor.
        commanded: Told every command that has changed something, and the user who gave it; never waited for.
        now: Monotonic seconds.

    Raises:
        SorterError: The socket cannot be made.
    """

    def __init__(
        self,
        folder: Path,
        controls: Controls,
        *,
        group: int | None = None,
        progress: Callable[[], None] = lambda: None,
        commanded: Callable[[str, int], None] = lambda command, uid: None,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.path = folder / SOCKET
        self._commands = Commands(controls)
        self._group = group
        self._progress = progress
        self._commanded = commanded
        self._now = now
        self._clients: set[_Client] = set()
        self._budget: dict[int, tuple[float, float]] = {}
        self._pending: set[_Job] = set()
        self._finished: list[tuple[_Job, dict[str, object]]] = []
        self._lock = threading.Lock()
        self._ended = False
        self._listener = _listen(self.path, group)
        self._inode = self.path.stat().st_ino
        self._bell, self._bell_end = socket.socketpair()
        self._selector = selectors.DefaultSelector()
        for line in (self._listener, self._bell):
            line.setblocking(False)
            self._selector.register(line, selectors.EVENT_READ)
        self._bell_end.setblocking(False)
        self._reading = Worker("control-read", waiting=MAX_CLIENTS)
        self._changing = Worker("control-change", waiting=0)
        self._thread = threading.Thread(target=self._serve, name="control", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Serve no longer and take the socket away; harmless when closed."""
        if self._ended:
            return
        self._ended = True
        self._ring()
        self._thread.join()
        for worker in (self._changing, self._reading):
            worker.close(_CLOSE_PATIENCE)
        for client in tuple(self._clients):
            self._drop(client)
        self._selector.close()
        for line in (self._listener, self._bell, self._bell_end):
            line.close()
        with contextlib.suppress(OSError):
            if self.path.stat().st_ino == self._inode:
                self.path.unlink()

    def __enter__(self) -> ControlServer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Serve no longer."""
        self.close()

    # --- the serving thread ---------------------------------------------------------------------------

    def _serve(self) -> None:
        while not self._ended:
            for key, events in self._selector.select(_POLL):
                if key.fileobj is self._listener:
                    self._accept()
                elif key.fileobj is self._bell:
                    with contextlib.suppress(BlockingIOError):
                        self._bell.recv(4096)
                elif key.data in self._clients:
                    self._attend(key.data, events)
            self._answer_finished()
            self._keep_deadlines()
            self._progress()

    def _accept(self) -> None:
        try:
            line, _ = self._listener.accept()
        except OSError:
            return
        line.setblocking(False)
        if len(self._clients) >= MAX_CLIENTS:
            self._drop(min(self._clients, key=lambda client: client.heard_at))
        client = _Client(line, peer_of(line), self._now())
        self._clients.add(client)
        if not client.peer.may_control(self._group):
            _log.warning("user %d may not control the cell", client.peer.uid)
            remedy = "ask as the service's user, as root, or as a member of its group"
            self._leave(client, BadRequest("forbidden", "you may not control this cell", remedy))
        self._send(client)

    def _attend(self, client: _Client, events: int) -> None:
        if events & selectors.EVENT_READ and not client.leaving:
            try:
                data = client.line.recv(2 * MAX_LINE)
            except BlockingIOError:
                return
            except OSError:
                self._drop(client)
                return
            client.heard_at = self._now()
            # One who says no more may still wait for replies.
            client.leaving = not data
            client.unread += data
            self._read_lines(client)
        self._send(client)

    def _read_lines(self, client: _Client) -> None:
        while b"\n" in client.unread[: MAX_LINE + 1]:
            line, _, client.unread = client.unread.partition(b"\n")
            client.begun_at = None
            if line.strip():
                self._handle(client, bytes(line))
        if len(client.unread) > MAX_LINE:
            self._leave(client, BadRequest("too_large", f"a request is longer than {MAX_LINE} bytes"))
        elif client.unread and client.begun_at is None:
            client.begun_at = self._now()

    def _handle(self, client: _Client, line: bytes) -> None:
        request = Request(None, None, {})
        try:
            request = parse(line)
            if request.command == "stop" and not request.given:
                # Before anything is said of it: a terminal or a journal that is stuck may hold up whoever logs.
                done = outcome(self._commands.stop)
                _log.warning("stop asked for by user %d, process %d", client.peer.uid, client.peer.pid)
                self._answer(client, request, done)
                self._reading.offer(lambda: self._commanded("stop", client.peer.uid), lambda: None)
                return
            self._spend(client)
            self._hand_over(client, request, self._commands.call(request))
        except BadRequest as error:
            self._answer(client, request, failure(error.error))

    def _hand_over(self, client: _Client, request: Request, call: Callable[[], object]) -> None:
        """Let a worker carry a request out."""
        job = _Job(client, request, self._now())

        reply: dict[str, object] = {}

        def then() -> None:
            with self._lock:
                self._finished.append((job, reply))
            self._ring()

        def work() -> None:
            reply.update(outcome(call))
            if worker is self._changing and reply["ok"]:
                self._commanded(str(request.command), client.peer.uid)

        worker = self._reading if request.command in READING else self._changing
        if not worker.offer(work, then):
            raise BadRequest("busy", "another command is still being worked on", "ask again when it has ended")
        self._pending.add(job)

    def _spend(self, client: _Client) -> None:
        """Take one request from the user's budget."""
        now = self._now()
        left, at = self._budget.get(client.peer.uid, (BURST, now))
        left = min(BURST, left + (now - at) * RATE)
        self._budget[client.peer.uid] = (max(left - 1.0, 0.0), now)
        if left < 1.0:
            raise BadRequest("too_fast", f"more than {RATE:g} requests a second", "ask less often")

    # --- replies --------------------------------------------------------------------------------------

    def _ring(self) -> None:
        """Wake the serving thread; from any thread."""
        with contextlib.suppress(OSError):
            self._bell_end.send(b".")

    def _answer_finished(self) -> None:
        with self._lock:
            finished, self._finished = self._finished, []
        for job, reply in finished:
            if job in self._pending:
                self._pending.remove(job)
                self._answer(job.client, job.request, reply)
                self._send(job.client)

    def _keep_deadlines(self) -> None:
        now = self._now()
        for job in [job for job in self._pending if now - job.since > REPLY_TIMEOUT]:
            self._pending.remove(job)
            late = BadRequest("timeout", f"no answer within {REPLY_TIMEOUT:g} s", "it goes on: ask for the status")
            self._answer(job.client, job.request, failure(late.error))
            self._send(job.client)
        for client in tuple(self._clients):
            if client.begun_at is not None and now - client.begun_at > LINE_TIMEOUT:
                self._drop(client)

    def _answer(self, client: _Client, request: Request, reply: Mapping[str, object]) -> None:
        client.unsent += json.dumps({"id": request.id, **reply}).encode() + b"\n"

    def _leave(self, client: _Client, error: BadRequest) -> None:
        """Say why nothing more is read from a client."""
        client.unread.clear()
        client.begun_at = None
        client.leaving = True
        self._answer(client, Request(None, None, {}), failure(error.error))

    def _send(self, client: _Client) -> None:
        """Send what a client will take, and watch it for what it can do next."""
        if client not in self._clients:
            return
        if client.unsent:
            try:
                del client.unsent[: client.line.send(client.unsent)]
            except BlockingIOError:
                pass
            except OSError:
                self._drop(client)
                return
        waits = any(job.client is client for job in self._pending)
        if len(client.unsent) > _MAX_UNSENT or (client.leaving and not client.unsent and not waits):
            self._drop(client)
            return
        wanted = 0 if client.leaving else selectors.EVENT_READ
        wanted |= selectors.EVENT_WRITE if client.unsent else 0
        with contextlib.suppress(KeyError):
            self._selector.unregister(client.line)
        if wanted:
            self._selector.register(client.line, wanted, client)

    def _drop(self, client: _Client) -> None:
        self._clients.discard(client)
        with contextlib.suppress(KeyError):
            self._selector.unregister(client.line)
        client.line.close()


def operators() -> int | None:
    """Group whose members operate the cell: the service's own under a service manager, else none.

    Outside one the process's group may be one that everybody is in.
    """
    return os.getegid() if "RUNTIME_DIRECTORY" in os.environ else None


def _listen(path: Path, group: int | None) -> socket.socket:
    line = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileNotFoundError):
            if stat.S_ISSOCK(path.lstat().st_mode):
                path.unlink()
        with address_of(path) as address:
            line.bind(address)
        # The unit's system call filter has no chown: there the service's own group is already the right one.
        if group not in (None, path.stat().st_gid):
            os.chown(path, -1, group)
        path.chmod(0o600 if group is None else 0o660)
        line.listen(2 * MAX_CLIENTS)
    except OSError as error:
        line.close()
        raise SorterError(f"{path}: {error.strerror or error}", "name a folder that can be written") from error
    return line
