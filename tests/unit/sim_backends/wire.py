"""A bus of five servos and the bytes on its line."""

from __future__ import annotations

import struct

from sim_backends.virtual_dynamixel import BusStream, ServoSpec, VirtualBus
from sim_backends.virtual_dynamixel.bench import IdealPlant

from .bus_client import packet

IDS = (1, 2, 3, 4, 5)
BYTE = 10e-6  # s at 1 Mbaud


def rig(
    ids: tuple[int, ...] = IDS, delay: int = 0, baud: int = 1_000_000, latency_timer_ms: float = 0, seed: int = 0
) -> tuple[VirtualBus, BusStream, IdealPlant]:
    plant = IdealPlant(ids)
    specs = [ServoSpec(servo_id, "XM430-W350", (("Return_Delay_Time", delay),)) for servo_id in ids]
    bus = VirtualBus(plant, specs, baud=baud, latency_timer_ms=latency_timer_ms, seed=seed)
    stream = BusStream(bus)
    stream.open(1_000_000)
    return bus, stream, plant


def sync_read(ids: tuple[int, ...] = IDS, fast: bool = False) -> bytes:
    return packet(0xFE, 0x8A if fast else 0x82, struct.pack("<HH", 126, 10) + bytes(ids))


def drain(stream: BusStream, timeout: float = 0.02) -> bytes:
    out = b""
    while data := stream.read(4096, timeout):
        out += data
    return out
