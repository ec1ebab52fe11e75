"""The bus layer: nothing invented, nothing hidden, nothing waited for too long.

Numbers in comments name the defect of the stock SDK (dynamixel-sdk 4.1, Python) that a test here, or in
`test_bus_groups`, guards against:

| | the stock SDK | test |
|---|---|---|
| 1 | polls while it waits: hundreds of reads a transaction | `test_waiting_is_blocking_not_polling` |
| 2 | sends a header among the values unstuffed | `test_a_header_among_the_values_reaches_the_servo` |
| 3 | loses a byte when it takes stuffing out of an answer | `test_taking_stuffing_out_loses_nothing` |
| 4 | takes checksum bytes for the value of an answer without data, or raises IndexError | \
`test_an_error_without_data_is_no_value`, `test_what_the_stock_sdk_makes_of_an_error_without_data` |
| 5 | drops the error bytes of group reads | `test_group_reads_keep_every_alert` |
| 6 | fails a group for one missing servo, then reads 0 | `test_a_missing_servo_is_none_and_hides_no_other` |
| 7 | returns after a bad packet while answers are still on the line | \
`test_a_spoilt_answer_is_none_and_the_next_read_is_clean` |
| 8 | ignores the inner checksums of fast reads | the same |
| 9 | raises termios.error when unplugged, then stays busy | \
`test_unplugged_is_a_bus_error_at_once_and_the_same_bus_reopens` |
| 10 | answers threads "busy", or mixes their answers up | `test_threads_take_turns` |
| 11 | raises ValueError on an alert (its easy layer) | `test_group_reads_keep_every_alert` |
| 12 | gives up by the clock without a look at the line | `test_a_process_that_was_stopped_still_finds_the_answer` |
"""

from __future__ import annotations

import threading

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from controller.errors import BusError
from drivers.arm.bus import Bus
from drivers.arm.line import LATE_REPLY
from drivers.arm.sdk_port import SdkPort
from drivers.arm.servos import TELEMETRY
from sim_backends.virtual_dynamixel.faults import Fault
from sim_backends.virtual_dynamixel.protocol import status_packet
from tests.unit.drivers.bench import PlantClock, ScriptedLine, scripted_bus, virtual_bus

POSITION = (132, 4)
IDS = [1, 2, 3, 4, 5]


def _answering(*packets: bytes) -> tuple[Bus, ScriptedLine]:
    """A bus whose line answers the n-th instruction with the n-th packet, at once, then nothing."""
    queue = list(packets)

    def answer(_: bytes) -> list[tuple[float, bytes]]:
        return [(0.0005, queue.pop(0))] if queue else []

    return scripted_bus(answer)


# --- one servo ----------------------------------------------------------------------------------------------


def test_ping_tells_model_firmware_and_alert() -> None:
    bus, bench, _ = virtual_bus()
    bench.strike(Fault.OVERHEAT, 2)
    assert bus.ping(1).model_number == 1020
    assert not bus.ping(1).alert
    assert bus.ping(2).alert  # an alert is no absence


def test_registers_are_read_and_written_with_their_sign() -> None:
    bus, _, _ = virtual_bus()
    bus.write_register(1, "Homing_Offset", -700)
    assert bus.read_register(1, "Homing_Offset") == -700
    with pytest.raises(OverflowError):
        bus.write_register(1, "Return_Delay_Time", 256)


@pytest.mark.safety("SR-32")
def test_an_error_without_data_is_no_value() -> None:
    """(4) The SDK takes the checksum's bytes for the value, or raises IndexError."""
    bus, _ = _answering(status_packet(1, 0x07))
    with pytest.raises(BusError) as caught:
        bus.read(1, *POSITION)
    assert caught.value.code == "refused"
    assert "access" in str(caught.value).lower() or "available" in str(caught.value)


def test_what_the_stock_sdk_makes_of_an_error_without_data() -> None:
    """(4) The defect itself, over our port: when an SDK is out that has it mended, this one fails."""
    sdk = pytest.importorskip("dynamixel_sdk")
    refused = status_packet(1, 0x07)
    bus, line = _answering(refused, refused)
    bus.close()
    port, handler = SdkPort(line, line, 1_000_000), sdk.PacketHandler(2.0)
    assert port.openPort()
    assert handler.read1ByteTxRx(port, 1, 65) == (refused[-2], 0, 0x07)
    with pytest.raises(IndexError):
        handler.read4ByteTxRx(port, 1, *POSITION[:1])


@given(st.lists(st.sampled_from([0xFF, 0xFF, 0xFD, 0x00]), min_size=4, max_size=12).map(bytes))
@example(b"\xff\xff\xfd\x00\xff\xfd\xfd")
def test_taking_stuffing_out_loses_nothing(data: bytes) -> None:
    """(3) The SDK compares with bytes that it has moved already."""
    bus, _ = _answering(status_packet(1, 0, data))
    assert bus.read(1, 132, len(data)).data == data


def test_the_stock_sdk_loses_a_byte_of_a_stuffed_answer() -> None:
    """(3) The defect itself, which makes the example above one."""
    handler = pytest.importorskip("dynamixel_sdk.protocol2_packet_handler").Protocol2PacketHandler()
    packet = status_packet(1, 0, b"\xff\xff\xfd\x00\xff\xfd\xfd")
    unstuffed = handler.removeStuffing(list(packet))
    assert unstuffed[5] == 4 + 7 - 1  # the length field: instruction, error, checksum and the data, less one


def test_a_refused_write_says_so_and_is_not_repeated() -> None:
    bus, bench, _ = virtual_bus()
    bus.write_register(1, "Torque_Enable", 1)
    sent = bus.statistics.transactions
    with pytest.raises(BusError, match="not available") as caught:
        bus.write_register(1, "Operating_Mode", 4)
    assert caught.value.code == "refused"
    assert bus.statistics.transactions == sent + 1
    assert bench.servo(1).table.get("Operating_Mode") == 3


def test_a_write_that_is_not_answered_is_not_repeated() -> None:
    bus, line = _answering()
    with pytest.raises(BusError) as caught:
        bus.write_register(1, "Torque_Enable", 1)
    assert caught.value.code == "timeout"
    assert len(line.written) == 1


@pytest.mark.safety("SR-27")
def test_reads_are_repeated_and_counted() -> None:
    bus, line = _answering(b"", status_packet(1, 0, b"\x01\x02\x03\x04"))
    assert bus.read(1, *POSITION).data == b"\x01\x02\x03\x04"
    assert len(line.written) == 2
    assert bus.statistics.retries == 1
    assert bus.statistics.timeouts == 1


def test_two_servos_with_one_id_look_corrupt_not_absent() -> None:
    broken = bytearray(status_packet(1, 0, b"abcd"))
    broken[9] ^= 0x55
    bus, _ = _answering(bytes(broken), bytes(broken), bytes(broken))
    with pytest.raises(BusError) as caught:
        bus.read(1, *POSITION)
    assert caught.value.code == "corrupt"
    assert "same ID" in caught.value.remedy


def test_other_ids_and_other_lengths_are_strays() -> None:
    bus, _ = _answering(status_packet(2, 0, b"abcd") + status_packet(1, 0, b"abc") + status_packet(1, 0, b"good"))
    assert bus.read(1, *POSITION).data == b"good"
    assert bus.statistics.strays == 2


@pytest.mark.safety("SR-32")
def test_a_late_answer_is_not_taken_for_the_next_one() -> None:
    """Homing_Offset arrives 50 ms late, while Present_Position of the same length is being asked for."""
    asked: list[bytes] = []

    def answer(packet: bytes) -> list[tuple[float, bytes]]:
        asked.append(packet)
        return [(0.050, status_packet(1, 0, b"LATE"))] if len(asked) == 1 else [(0.001, status_packet(1, 0, b"good"))]

    bus, _ = scripted_bus(answer)
    with pytest.raises(BusError):
        bus.read(1, 20, 4, retries=0)
    assert bus.read(1, *POSITION).data == b"good"


@pytest.mark.parametrize("delay", [0.010, 0.020, 0.035, 0.050])
def test_a_late_answer_is_not_taken_for_that_of_a_later_sync_read(delay: float) -> None:
    """A servo that counts: every answer carries the number of the question it belongs to."""
    asked = 0

    def answer(packet: bytes) -> list[tuple[float, bytes]]:
        nonlocal asked
        asked += 1
        size = packet[10]
        data = bytes((asked,)) * size
        return [(delay if asked == 3 else 0.001, status_packet(1, 0, data))]

    bus, line = scripted_bus(answer)
    for number in range(1, 20):
        tick = line.now() + 0.010
        reply = bus.sync_read([1], *TELEMETRY)[1]
        if number == 3:
            assert reply is None
        else:
            assert reply is not None
            assert set(reply.data) == {number}
            assert len(reply.data) == TELEMETRY[1]
        line.sleep(tick - line.now())
    assert bus.statistics.timeouts == 1


def test_a_process_that_was_stopped_still_finds_the_answer() -> None:
    """(12) The SDK gives up after looking at the clock, not at the line."""
    bus, line = _answering(status_packet(1, 0, b"good"))
    write = line.write

    def slow_write(data: bytes) -> None:
        write(data)
        line.sleep(0.060)

    line.write = slow_write  # type: ignore[method-assign]  # the process sleeps right behind its write
    assert bus.read(1, *POSITION).data == b"good"


def test_waiting_is_blocking_not_polling() -> None:
    """(1) The SDK looks hundreds of times per transaction; here once per piece that arrives."""
    bus, line = _answering(status_packet(1, 0, b"good"))
    bus.read(1, *POSITION)
    assert line.reads <= 2


# --- loss, threads, fuzz ------------------------------------------------------------------------------------


def test_unplugged_is_a_bus_error_at_once_and_the_same_bus_reopens() -> None:
    """(9) The SDK raises termios.error and answers "port busy" for ever after."""
    bus, bench, plant = virtual_bus()
    bench.strike(Fault.DISCONNECT)
    began = plant.now()
    with pytest.raises(BusError) as caught:
        bus.read(1, *POSITION)
    assert caught.value.code == "lost"
    assert plant.now() == began
    bench.heal()
    bus.close()
    bus.open()
    assert bus.ping(1).model_number == 1020


def test_threads_take_turns() -> None:
    """(10) The SDK answers "busy" or mixes the answers up."""
    bus, _, plant = virtual_bus()
    for servo_id in IDS:
        plant.place(servo_id, 0.1 * servo_id)
    wanted = bus.sync_read_register(IDS, "Present_Position")
    wrong: list[object] = []

    def work(servo_id: int) -> None:
        for _ in range(200):
            if bus.read_register(servo_id, "Present_Position") != wanted[servo_id]:
                wrong.append(servo_id)

    threads = [threading.Thread(target=work, args=(servo_id,)) for servo_id in (1, 2, 3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
    assert bus.statistics.timeouts == 0


_PIECES = st.one_of(
    st.binary(max_size=30),
    st.sampled_from([status_packet(1, 0, b"abcd"), status_packet(2, 0, b"abcd"), status_packet(1, 0x87)]),
    st.sampled_from([b"\xff\xff\xfd\x00", b"\xff\xff\xfd\x00\xfe\x11\x00\x55"]),
)


@settings(max_examples=200)
@given(st.lists(st.lists(_PIECES, max_size=4).map(b"".join), max_size=4), st.booleans())
@pytest.mark.safety("SR-32")
def test_garbage_raises_only_bus_errors_and_gives_only_sent_values(answers: list[bytes], fast: bool) -> None:
    queue = list(answers)
    bus, _ = scripted_bus(lambda _: [(0.001, queue.pop(0))] if queue else [])
    bus.fast = fast
    replies = bus.sync_read([1, 2], *POSITION)
    for reply in replies.values():
        assert reply is None or not reply.data or any(reply.data in answer for answer in answers)
    try:
        reply = bus.read(1, *POSITION)
    except BusError as error:
        assert error.code in {"timeout", "corrupt", "refused"}
    else:
        assert reply.data == b"abcd"


@pytest.mark.parametrize("fast", [False, True])
def test_ten_thousand_bad_cycles_give_no_wrong_value(fast: bool) -> None:
    """1 % each of dropped, corrupted, truncated, noisy and up to 50 ms late packets."""
    bus, bench, plant = virtual_bus(5)
    for fault in (Fault.DROP, Fault.CORRUPT, Fault.TRUNCATE, Fault.DELAY, Fault.NOISE):
        bench.faults.set_rate(fault, 0.01)
    missed = 0
    for cycle in range(10_000 // 2):
        bus.fast = fast
        tick = plant.now() + 0.010
        # Every servo has another angle in every cycle: a late answer cannot be right by chance.
        for servo_id in IDS:
            plant.place(servo_id, 0.0032 * (cycle % 500) + 0.05 * servo_id)
        for servo_id, value in bus.sync_read_register(IDS, "Present_Position").items():
            expected = 2048 + (0.0032 * (cycle % 500) + 0.05 * servo_id) * 4096 / 6.283185307179586
            if value is None:
                missed += 1
            else:
                assert abs(value - expected) <= 0.51
        plant.advance(max(0.0, tick - plant.now()))
    assert 100 < missed < 5_000
    assert bus.statistics.corrupt > 10


def test_late_window_covers_the_longest_delay() -> None:
    _, bench, _ = virtual_bus()
    assert bench.faults.longest_delay < LATE_REPLY


# --- the stock SDK over our port ----------------------------------------------------------------------------


def test_the_stock_sdk_agrees_over_our_port() -> None:
    sdk = pytest.importorskip("dynamixel_sdk")
    bus, bench, plant = virtual_bus()
    for servo_id in IDS:
        plant.place(servo_id, 0.1 * servo_id)
    wanted = bus.sync_read_register(IDS, "Present_Position")
    bus.close()
    port = SdkPort(bus._line._stream, PlantClock(plant), 1_000_000)
    assert port.openPort()
    handler = sdk.PacketHandler(2.0)
    assert handler.ping(port, 3) == (1020, 0, 0)
    assert handler.write1ByteTxRx(port, 3, 65, 1) == (0, 0)
    assert bench.servo(3).table.get("LED") == 1
    assert handler.read4ByteTxRx(port, 3, 132) == (wanted[3], 0, 0)
    group = sdk.GroupSyncRead(port, handler, 132, 4)
    for servo_id in IDS:
        group.addParam(servo_id)
    assert group.txRxPacket() == 0
    assert {i: group.getData(i, 132, 4) for i in IDS} == wanted
    assert handler.ping(port, 99)[1] == -3001  # no answer, and no waiting for ever on a simulated clock
    bench.strike(Fault.DISCONNECT)
    with pytest.raises(BusError):
        handler.ping(port, 3)
    assert not port.is_using
    port.closePort()
