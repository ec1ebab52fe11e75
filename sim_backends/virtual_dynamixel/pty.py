"""The simulated bus on a pseudo-terminal, in real time: any program may open it like a USB adapter.

One thread owns the plant: it lets simulated time follow the wall clock, hears what the client writes, and
hands every answer over when its last byte would have arrived. POSIX only; import it where it is needed.
"""

from __future__ import annotations

import heapq
import math
import os
import select
import termios
import threading
import time
import tty
from bisect import bisect_right
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import TypeVar

from sim_backends.virtual_dynamixel.bus import VirtualBus
from sim_backends.virtual_dynamixel.instructions import BAUD_RATES

T = TypeVar("T")

TICK = 0.004
"""s; physics follows the wall clock at least so often, and exactly whenever bytes arrive."""
LONGEST_STEP = 0.02
"""s of physics between two looks at the line, so that a machine that fell behind still answers."""
GIVE_UP = 2.0
"""s the physics may lag behind the wall clock before simulated time slips instead of catching up."""

_BAUD = {getattr(termios, f"B{rate}"): rate for rate in BAUD_RATES if hasattr(termios, f"B{rate}")}


class PtyBus:
    """Serves a bus on a pseudo-terminal.

    A client that sets another bit rate than the servos' hears nothing, as on metal. When the adapter is
    unplugged (`Fault.DISCONNECT`) the terminal hangs up; plugged in again (`VirtualBus.heal`), a new one appears
    under the same link.

    Args:
        bus: What to serve; after `start` only this object's thread may touch it or its plant: use `call`.
        link: Symbolic link to keep pointing at the terminal, which changes its name when it is replugged.
        awake: s before an answer is due and after it during which the thread does not sleep: where speed is
            measured, the system's wake-up must not make it late.
    """

    def __init__(self, bus: VirtualBus, link: Path | None = None, awake: float = 0.0) -> None:
        self.bus = bus
        """The bus it serves."""
        self._plant = bus.plant
        self._link = link
        self._awake = awake
        self._awake_until = -math.inf
        self._master = self._slave = -1
        self._terminal = ""
        self._replies: list[tuple[float, int, bytes]] = []
        self._count = 0
        self._jobs: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._wake_in, self._wake_out = -1, -1
        self._thread: threading.Thread | None = None
        self._stopping = threading.Event()
        # Monotonic wall clock minus the plant's time, now and since when.
        self._offset = 0.0
        self._slips: list[tuple[float, float]] = []
        # Simulated time as the line knows it; a plant may tell it in whole steps only.
        self._time = 0.0
        self.last_heard = -math.inf
        """When a client last wrote something, s of the monotonic clock."""
        self.slipped = 0.0
        """s of simulated time given up because the machine was too slow."""

    @property
    def path(self) -> str:
        """What a client opens: the link, or the terminal itself."""
        return str(self._link) if self._link else self._terminal

    @property
    def alive(self) -> bool:
        """The bus is served."""
        return self._thread is not None and self._thread.is_alive()

    def plant_time(self, wall: float) -> float:
        """The plant's time at a moment of the monotonic clock, s: past slips are taken into account."""
        index = max(0, bisect_right(self._slips, (wall, math.inf)) - 1)
        return wall - self._slips[index][1]

    def wall_time(self, at: float) -> float:
        """The moment of the monotonic clock when the plant has its time `at`, as things stand, s."""
        return at + self._offset

    # --- life ---------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Open the terminal and serve it in a thread until `stop`; returns when a client may open it."""
        self._wake_out, self._wake_in = os.pipe()
        self._plug()
        self._stopping.clear()
        self._time = self._plant.now()
        self._offset = time.monotonic() - self._time
        self._slips = [(-math.inf, self._offset)]
        self._thread = threading.Thread(target=self._run, name="virtual-bus", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Hang up, remove the link and end the thread; harmless when not started."""
        if self._thread is None:
            return
        self._stopping.set()
        self._wake()
        self._thread.join()
        self._thread = None
        self._unplug()
        os.close(self._wake_out)
        os.close(self._wake_in)

    def __enter__(self) -> PtyBus:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def call(self, function: Callable[[], T], timeout: float = 5.0) -> T:
        """Run a function in the thread that owns the plant, between two steps, and return what it returns.

        Blocks the caller until then; what the function raises is raised here.
        """
        future: Future[T] = Future()

        def job() -> None:
            try:
                future.set_result(function())
            except Exception as error:
                future.set_exception(error)

        self._jobs.put(job)
        self._wake()
        return future.result(timeout)

    def _wake(self) -> None:
        os.write(self._wake_in, b"!")

    def _plug(self) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._terminal = os.ttyname(self._slave)
        if self._link:
            fresh = self._link.with_name(f".{self._link.name}.new")
            fresh.unlink(missing_ok=True)
            fresh.symlink_to(self._terminal)
            fresh.replace(self._link)

    def _unplug(self) -> None:
        if self._master < 0:
            return
        os.close(self._slave)
        os.close(self._master)
        self._master = self._slave = -1
        self._replies.clear()
        if self._link:
            self._link.unlink(missing_ok=True)

    # --- the thread ---------------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._stopping.is_set():
            readable = self._wait()
            wall = time.monotonic()
            # First what is due and what has come, then physics: it may take as long as the bytes are on the wire.
            self._deliver(wall)
            heard = self._hear() if self._master in readable else b""
            self._follow(wall)
            if heard:
                self._answer(heard, wall)
            if self._wake_out in readable:
                os.read(self._wake_out, 4096)
                self._work()
            if self.bus.connected != (self._master >= 0):
                if self.bus.connected:
                    self._plug()
                else:
                    self._unplug()

    def _wait(self) -> list[int]:
        """Sleep until bytes or a job arrive, an answer is due, or a tick has passed."""
        watched = [self._wake_out] if self._master < 0 else [self._master, self._wake_out]
        due = self._replies[0][0] if self._replies else math.inf
        # A tick is no reason to stay awake: what spins all the way to a distant answer is off the processor by then.
        while (now := time.monotonic()) >= due - self._awake or now < self._awake_until:
            if due <= now:
                self._awake_until = due + self._awake
                return []
            if readable := select.select(watched, [], [], 0.0)[0]:
                return readable
        wake = min(self._time + self._offset + TICK, due - self._awake)
        return select.select(watched, [], [], max(0.0, wake - now))[0]

    def _follow(self, wall: float) -> None:
        """Let the plant catch up with the wall clock, a short stretch at most."""
        self._time = max(self._time, self._plant.now())
        behind = wall - self._offset - self._time
        if behind > GIVE_UP:
            self._offset += behind
            self._slips.append((wall, self._offset))
            self.slipped += behind
            self.bus.clear_line()
            return
        if behind > 0.0:
            behind = min(behind, LONGEST_STEP)
            self._plant.advance(behind)
            self._time += behind

    def _work(self) -> None:
        while True:
            try:
                job = self._jobs.get_nowait()
            except Empty:
                return
            job()

    def _hear(self) -> bytes:
        try:
            data = os.read(self._master, 4096)
        except OSError:
            return b""
        self.last_heard = time.monotonic()
        rate = _BAUD.get(termios.tcgetattr(self._slave)[5])
        if rate is not None:
            self.bus.host_baud = rate
        return data

    def _answer(self, data: bytes, wall: float) -> None:
        for arrival, packet in self.bus.handle(data, wall - self._offset):
            heapq.heappush(self._replies, (arrival + self._offset, self._count, packet))
            self._count += 1

    def _deliver(self, wall: float) -> None:
        while self._replies and self._replies[0][0] <= wall:
            data = heapq.heappop(self._replies)[2]
            if self._master >= 0:
                try:
                    os.write(self._master, data)
                except BlockingIOError:
                    continue  # nobody reads: a serial port's buffer would overrun too
