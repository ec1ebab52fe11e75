"""A minimal bus master for tests, with its own reading of the protocol."""

from __future__ import annotations

from sim_backends.virtual_dynamixel import BusStream, ServoSpec, VirtualBus
from sim_backends.virtual_dynamixel.bench import IdealPlant
from sim_backends.virtual_dynamixel.models import MODELS
from sim_backends.virtual_dynamixel.registers import Register, register_table

DATA_RANGE, DATA_LENGTH, DATA_LIMIT, ACCESS = 4, 5, 6, 7

_NUMBERS = {model.number: model for model in MODELS.values()}


def crc(data: bytes) -> int:
    """CRC-16 of the protocol by long division, bit by bit."""
    remainder = 0
    for byte in data:
        remainder ^= byte << 8
        for _ in range(8):
            remainder = ((remainder << 1) ^ (0x8005 if remainder & 0x8000 else 0)) & 0xFFFF
    return remainder


def packet(servo_id: int, instruction: int, params: bytes = b"") -> bytes:
    """An instruction packet, stuffed."""
    body = (bytes((instruction,)) + params).replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
    raw = b"\xff\xff\xfd\x00" + bytes((servo_id,)) + (len(body) + 2).to_bytes(2, "little") + body
    return raw + crc(raw).to_bytes(2, "little")


class Client:
    """Talks to one servo and checks every answer byte by byte."""

    def __init__(self, stream: BusStream, servo_id: int = 1) -> None:
        self._stream = stream
        self._id = servo_id
        self._table: dict[str, Register] = {}
        self.last_error = 0

    def _register(self, name: str) -> Register:
        if not self._table:
            number = int.from_bytes(self.read_raw(0, 2), "little")
            self._table = {register.name: register for register in register_table(_NUMBERS[number])}
        return self._table[name]

    def instruct(self, instruction: int, params: bytes = b"") -> tuple[int, bytes]:
        """(error byte, data) of the answer; TimeoutError without one."""
        self._stream.write(packet(self._id, instruction, params))
        raw = b""
        while len(raw) < 7 or len(raw) < 7 + int.from_bytes(raw[5:7], "little"):
            more = self._stream.read(4096, 0.05)
            if not more:
                raise TimeoutError("no answer")
            raw += more
        assert raw[:5] == b"\xff\xff\xfd\x00" + bytes((self._id,))
        assert len(raw) == 7 + int.from_bytes(raw[5:7], "little")
        assert crc(raw[:-2]) == int.from_bytes(raw[-2:], "little")
        body = raw[7:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
        assert body[0] == 0x55
        self.last_error = body[1]
        return body[1], body[2:]

    def broadcast(self, instruction: int, params: bytes = b"") -> None:
        """An instruction to everyone, which nobody answers."""
        self._stream.write(packet(0xFE, instruction, params))

    def read_raw(self, address: int, length: int) -> bytes:
        """Bytes of the control table."""
        _, data = self.instruct(0x02, address.to_bytes(2, "little") + length.to_bytes(2, "little"))
        return data

    def read(self, name: str) -> int:
        """Value of a register."""
        register = self._register(name)
        return int.from_bytes(self.read_raw(register.address, register.size), "little", signed=register.signed)

    def write_raw(self, address: int, data: bytes) -> int:
        """Write bytes; the error byte."""
        return self.instruct(0x03, address.to_bytes(2, "little") + data)[0]

    def write(self, name: str, value: int) -> int:
        """Write a register; the error byte."""
        register = self._register(name)
        mask = (1 << 8 * register.size) - 1
        return self.write_raw(register.address, (value & mask).to_bytes(register.size, "little"))

    def reboot(self) -> None:
        """Reboot the servo."""
        self.instruct(0x08)


def rig(model: str = "XM430-W350", **settings: int) -> tuple[Client, IdealPlant, VirtualBus]:
    """A servo with ID 1 on a world of ideal shafts, with registers as given, and a client to talk to it."""
    plant = IdealPlant([1])
    registers = tuple({"Return_Delay_Time": 0, **settings}.items())
    bus = VirtualBus(plant, [ServoSpec(1, model, registers)])
    stream = BusStream(bus)
    stream.open(1_000_000)
    return Client(stream), plant, bus
