"""How fast a control cycle goes over the bus, and what it costs, beside the stock SDK.

A cycle is a sync read of 10 bytes (load, velocity, position) and a sync write of Goal_Position, five servos.
The servos are simulated in a process of their own behind a pseudo-terminal, in real time, with Return_Delay_Time
0 and an ideal adapter. Printed: the median cycle's rate in the best of six windows, its share of what the wire
allows, the processor time of the driver's process as a share of one core, and what one missing servo costs. Ends in
verdicts on our own driver; 1 when something wanted is missed.

    python -m tests.benchmarks.bus_speed [--seconds S] [--baud B ...] [--json]
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from dynamixel_sdk import GroupSyncRead, GroupSyncWrite, PacketHandler, PortHandler

from drivers.arm.bus import Bus
from drivers.arm.sdk_port import SdkPort
from drivers.arm.serial_stream import SerialStream

IDS = [1, 2, 3, 4, 5]
FEEDBACK = (126, 10)
GOAL = 2048

# Header to checksum: sync read 14 + IDs, status 11 + data; fast: one status of 10 + (4 + data) each; sync write.
READ = 14 + len(IDS) + len(IDS) * (11 + FEEDBACK[1])
FAST_READ = 14 + len(IDS) + 8 + len(IDS) * (4 + FEEDBACK[1])
WRITE = 14 + 5 * len(IDS)

Cycle = Callable[[], bool]

OF_WIRE, CORE, MISSING_MS = 0.90, 0.15, 12.0  # what is wanted: at least, at most, at most

_AWAKE = 0.0003  # s
_WINDOWS = 6  # the best of them counts: other programs on the machine make single ones slow, never fast


class WallClock:
    now = staticmethod(time.monotonic)
    sleep = staticmethod(time.sleep)

    def charge(self, seconds: float) -> None:
        """Real computing takes real time."""


def serve(baud: int, missing: int | None) -> None:
    """The simulated bus, until standard input closes."""
    from sim_backends.virtual_dynamixel.bench import IdealPlant
    from sim_backends.virtual_dynamixel.bus import VirtualBus
    from sim_backends.virtual_dynamixel.faults import Fault
    from sim_backends.virtual_dynamixel.pty import PtyBus
    from sim_backends.virtual_dynamixel.servo import ServoSpec

    servos = [ServoSpec(i, "XM430-W350", (("Return_Delay_Time", 0),)) for i in IDS]
    # Nothing moves here: coarse physics, and a server that is awake when an answer is due, measure the driver alone.
    bus = VirtualBus(IdealPlant(IDS, dt=0.05), servos, baud=baud)
    if missing is not None:
        bus.strike(Fault.SILENT, missing)
    with PtyBus(bus, awake=_AWAKE) as pty:
        print(pty.path, flush=True)
        sys.stdin.read()


@contextmanager
def served(baud: int, missing: int | None = None) -> Iterator[str]:
    """Path of a terminal with the bus behind it, in another process."""
    command = [sys.executable, "-m", "tests.benchmarks.bus_speed", "--serve", str(baud), str(missing or 0)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        try:
            yield process.stdout.readline().strip()
        finally:
            process.stdin.close()


@contextmanager
def own(path: str, baud: int, fast: bool) -> Iterator[Cycle]:
    """Our bus."""
    bus = Bus(SerialStream(path), WallClock(), baud=baud)
    bus.open()
    bus.fast = fast

    def cycle() -> bool:
        replies = bus.sync_read(IDS, *FEEDBACK)
        bus.sync_write("Goal_Position", dict.fromkeys(IDS, GOAL))
        return all(reply is not None for reply in replies.values())

    yield cycle
    bus.close()


@contextmanager
def sdk(path: str, baud: int, fast: bool, own_port: bool) -> Iterator[Cycle]:
    """The SDK's groups, over its own port or over ours."""
    port = SdkPort(SerialStream(path), WallClock(), baud) if own_port else PortHandler(path)
    port.baudrate = baud
    assert port.openPort()
    handler = PacketHandler(2.0)
    read = GroupSyncRead(port, handler, *FEEDBACK)
    write = GroupSyncWrite(port, handler, 116, 4)
    for servo_id in IDS:
        read.addParam(servo_id)
        write.addParam(servo_id, list(GOAL.to_bytes(4, "little")))

    def cycle() -> bool:
        ok = (read.fastSyncRead() if fast else read.txRxPacket()) == 0
        for servo_id in IDS:
            read.getData(servo_id, 132, 4)
        write.txPacket()
        return bool(ok)

    yield cycle
    port.closePort()


def measure(cycle: Cycle, seconds: float) -> tuple[float, float, int]:
    """(median seconds of a cycle in the best window, processor share of this process, failed cycles)."""
    for _ in range(20):
        cycle()
    medians = []
    failed = 0
    used, began = time.process_time(), time.monotonic()
    for _ in range(_WINDOWS):
        times = []
        window = time.monotonic()
        while (now := time.monotonic()) - window < seconds / _WINDOWS:
            failed += not cycle()
            times.append(time.monotonic() - now)
        medians.append(statistics.median(times))
    share = (time.process_time() - used) / (time.monotonic() - began)
    return min(medians), share, failed


def _verdict(row: dict[str, Any]) -> bool:
    """Hold a row of our own driver against what is wanted, and say so."""
    good = row["of_wire"] >= OF_WIRE and row["core"] <= CORE and row["missing_ms"] <= MISSING_MS and not row["failed"]
    print(
        f"{row['baud']} baud, {row['read']} read: {row['of_wire']:.1%} of the wire (wanted {OF_WIRE:.0%}), "
        f"{row['core']:.1%} of a core ({CORE:.0%}), a missing servo {row['missing_ms']} ms ({MISSING_MS:g}), "
        f"{row['failed']} failed: {'pass' if good else 'FAIL'}",
        file=sys.stderr,
    )
    return bool(good)


def main() -> int:
    """Print the table and the verdicts; 1 when something wanted is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--baud", type=int, nargs="*", default=[57_600, 1_000_000])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--serve", type=int, nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve(options.serve[0], options.serve[1] or None)
        return 0
    rows: list[dict[str, Any]] = []
    if not options.json:
        print(f"{'baud':>8} {'read':5} {'driver':14} {'Hz':>7} {'of wire':>8} {'core':>6} {'missing servo':>14}")
    for baud in options.baud:
        for fast in (False, True):
            wire = ((FAST_READ if fast else READ) + WRITE) * 10 / baud
            drivers = {
                "own": partial(own, baud=baud, fast=fast),
                "SDK, our port": partial(sdk, baud=baud, fast=fast, own_port=True),
                "SDK": partial(sdk, baud=baud, fast=fast, own_port=False),
            }
            for name, driver in drivers.items():
                with served(baud) as path, driver(path) as cycle:
                    usual, share, failed = measure(cycle, options.seconds)
                with served(baud, missing=3) as path, driver(path) as cycle:
                    gap = measure(cycle, options.seconds / 3)[0] - usual
                row = {
                    "baud": baud, "read": "fast" if fast else "sync", "driver": name, "hz": round(1 / usual, 1),
                    "of_wire": round(wire / usual, 3), "core": round(share, 3), "missing_ms": round(gap * 1e3, 1),
                    "failed": failed,
                }  # fmt: skip
                rows.append(row)
                if options.json:
                    print(json.dumps(row))
                else:
                    print(
                        f"{baud:8} {row['read']:5} {name:14} {row['hz']:7} {row['of_wire']:8.0%} {share:6.0%}"
                        f" {row['missing_ms']:11} ms" + (f"  {failed} failed" if failed else "")
                    )


    return 0 if all([_verdict(row) for row in rows if row["driver"] == "own"]) else 1


if __name__ == "__main__":
    sys.exit(main())
