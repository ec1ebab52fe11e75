"""The vendor's unmodified SDK as a client of the simulated bus on a pseudo-terminal."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from dynamixel_sdk import (
    COMM_SUCCESS,
    GroupBulkRead,
    GroupBulkWrite,
    GroupSyncRead,
    GroupSyncWrite,
    PacketHandler,
    PortHandler,
)

if sys.platform == "win32":
    pytest.skip("pseudo-terminals are POSIX", allow_module_level=True)

from sim_backends.virtual_dynamixel import Fault, ServoSpec, VirtualBus
from sim_backends.virtual_dynamixel.bench import IdealPlant
from sim_backends.virtual_dynamixel.pty import PtyBus

IDS = (1, 2, 3, 4, 5)
ATTEMPTS = 10
"""A busy machine may hold up either side for longer than the SDK waits; a real defect fails every time."""


@pytest.fixture(autouse=True)
def _fair_threads() -> Iterator[None]:
    """The SDK spins while it waits; the bus's thread must get its turn within a byte or two nevertheless."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(0.0002)
    yield
    sys.setswitchinterval(before)


@pytest.fixture
def awake() -> float:
    return 0.0


@pytest.fixture(params=[57_600, 1_000_000, 4_000_000])
def baud(request: pytest.FixtureRequest) -> int:
    return int(request.param)


@pytest.fixture
def served(baud: int, awake: float) -> Iterator[PtyBus]:
    specs = [ServoSpec(servo_id, "XM430-W350", (("Return_Delay_Time", 0),)) for servo_id in IDS]
    with PtyBus(VirtualBus(IdealPlant(IDS), specs, baud=baud), awake=awake) as served_:
        yield served_


@pytest.fixture
def port(served: PtyBus, baud: int) -> Iterator[PortHandler]:
    port_ = PortHandler(served.path)
    assert port_.openPort()
    assert port_.setBaudRate(baud)
    yield port_
    port_.closePort()


packets = PacketHandler(2.0)


def insist(port: PortHandler, ask: Callable[[], tuple[Any, ...]], comm: int) -> tuple[Any, ...]:
    """The first answer that came through, of ATTEMPTS; `comm` is where it says so.

    The SDK takes a late answer for the next one, so after a miss the line must fall silent first.
    """
    answer = ask()
    for _ in range(ATTEMPTS - 1):
        if answer[comm] == COMM_SUCCESS:
            break
        threading.Event().wait(0.1)
        port.clearPort()
        answer = ask()
    return answer


def test_ping_and_broadcast_ping(port: PortHandler) -> None:
    assert insist(port, lambda: packets.ping(port, 3), 1) == (1020, COMM_SUCCESS, 0)
    found, result = insist(port, lambda: packets.broadcastPing(port), 1)
    assert result == COMM_SUCCESS
    assert sorted(found) == list(IDS)


def test_registers_one_by_one(port: PortHandler) -> None:
    done = (COMM_SUCCESS, 0)
    assert insist(port, lambda: packets.write1ByteTxRx(port, 1, 64, 1), 0) == done
    assert insist(port, lambda: packets.write1ByteTxRx(port, 1, 9, 5), 0) == (COMM_SUCCESS, 7)
    assert insist(port, lambda: packets.read4ByteTxRx(port, 1, 132), 1) == (2048, *done)
    assert insist(port, lambda: packets.regWriteTxRx(port, 1, 65, 1, [1]), 0) == done
    assert packets.action(port, 0xFE) == COMM_SUCCESS
    assert insist(port, lambda: packets.read1ByteTxRx(port, 1, 65), 1)[0] == 1
    assert insist(port, lambda: packets.clearMultiTurn(port, 2), 0) == done
    assert insist(port, lambda: packets.reboot(port, 1), 0) == done


@pytest.mark.parametrize("fast", [False, True])
def test_sync_read_and_write(port: PortHandler, fast: bool) -> None:
    write = GroupSyncWrite(port, packets, 112, 4)
    read = GroupSyncRead(port, packets, 112, 4)
    for servo_id in IDS:
        write.addParam(servo_id, [servo_id, 1, 0, 0])
        read.addParam(servo_id)
    assert write.txPacket() == COMM_SUCCESS
    ask = read.fastSyncRead if fast else read.txRxPacket
    assert insist(port, lambda: (ask(),), 0) == (COMM_SUCCESS,)
    assert [read.getData(servo_id, 112, 4) for servo_id in IDS] == [256 + servo_id for servo_id in IDS]


@pytest.mark.parametrize("fast", [False, True])
def test_bulk_read_and_write(port: PortHandler, fast: bool) -> None:
    write = GroupBulkWrite(port, packets)
    read = GroupBulkRead(port, packets)
    write.addParam(1, 65, 1, [1])
    write.addParam(2, 108, 4, [7, 0, 0, 0])
    read.addParam(1, 65, 1)
    read.addParam(2, 108, 4)
    assert write.txPacket() == COMM_SUCCESS
    ask = read.fastBulkRead if fast else read.txRxPacket
    assert insist(port, lambda: (ask(),), 0) == (COMM_SUCCESS,)
    assert (read.getData(1, 65, 1), read.getData(2, 108, 4)) == (1, 7)


@pytest.mark.parametrize("baud", [1_000_000], indirect=True)
def test_another_baud_rate_is_met_with_silence(served: PtyBus, port: PortHandler) -> None:
    assert port.setBaudRate(57_600)
    assert packets.ping(port, 1)[1] != COMM_SUCCESS
    assert port.setBaudRate(1_000_000)
    assert insist(port, lambda: packets.ping(port, 1), 1)[1] == COMM_SUCCESS


@pytest.mark.parametrize("baud", [1_000_000], indirect=True)
def test_time_follows_the_wall_clock_and_jobs_run_in_between(served: PtyBus) -> None:
    first = served.call(served.bus.plant.now)
    later = served.call(served.bus.plant.now)
    assert later > first
    with pytest.raises(KeyError):
        served.call(lambda: served.bus.servo(99))


@pytest.mark.parametrize(("baud", "awake"), [(9_600, 0.0003)], indirect=["baud"])
def test_a_server_kept_awake_sleeps_while_the_bytes_are_on_the_wire(port: PortHandler, served: PtyBus) -> None:
    """Spinning all the way to a distant answer uses up a thread's turn, and the answer is then late."""
    answers = 3
    port.ser.timeout = 5.0
    before = served.call(time.thread_time)
    for _ in range(answers):
        packets.syncWriteTxOnly(port, 116, 4, [1, 0, 8, 0, 0], 5)  # 19 bytes that nobody answers: 20 ms
        packets.readTx(port, 1, 132, 4)  # 14 bytes, and the answer's 15: 30 ms
        assert len(port.ser.read(15)) == 15
        port.is_using = False
    # It spins 0.6 ms around an answer and looks at the line every tick: a tenth of the wire's time is plenty.
    assert served.call(time.thread_time) - before < 0.1 * answers * 0.050


@pytest.mark.parametrize("baud", [1_000_000], indirect=True)
def test_a_machine_too_slow_lets_time_slip_and_remembers_when(served: PtyBus, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sim_backends.virtual_dynamixel.pty.GIVE_UP", 0.05)
    early = time.monotonic()
    before = served.plant_time(early)
    served.call(lambda: threading.Event().wait(0.2))  # the physics stands still
    served.call(lambda: None)

    def look() -> tuple[float, float, float]:
        now = time.monotonic()
        assert served.wall_time(served.plant_time(now)) == pytest.approx(now, abs=1e-9)
        return now, served.plant_time(now), served.slipped

    now, later, slipped = served.call(look)
    assert slipped >= 0.1
    assert served.plant_time(early) == before
    assert later - before == pytest.approx(now - early - slipped, abs=1e-9)


@pytest.mark.parametrize("baud", [1_000_000], indirect=True)
def test_unplugging_hangs_up_and_replugging_returns_under_the_same_link(tmp_path: Path, baud: int) -> None:
    link = tmp_path / "servo-bus"
    bus = VirtualBus(IdealPlant(IDS), [ServoSpec(1, "XL430-W250")], baud=baud)
    with PtyBus(bus, link=link) as served:
        assert served.path == str(link)
        line = os.open(link, os.O_RDWR | os.O_NOCTTY)
        served.call(lambda: bus.strike(Fault.DISCONNECT))
        served.call(lambda: None)  # the loop has gone round and hung up
        assert not link.exists()
        assert read_end(line) == b""
        os.close(line)
        served.call(bus.heal)
        served.call(lambda: None)
        port = PortHandler(str(link))
        assert port.openPort()
        assert port.setBaudRate(baud)
        assert insist(port, lambda: packets.ping(port, 1), 1)[1] == COMM_SUCCESS
        port.closePort()
    assert not link.is_symlink()


def read_end(line: int) -> bytes:
    """What a read of a hung-up terminal gives: nothing, or EIO where the system says so."""
    try:
        return os.read(line, 1)
    except OSError:
        return b""
