"""The memory of one servo, and the rules of who may write what into it.

It knows registers, access, ranges and indirect addresses; what a value does to the motor is `servo.py`.
"""

from __future__ import annotations

from collections.abc import Callable

from sim_backends.virtual_dynamixel.models import POSITION_MODE, ServoModel
from sim_backends.virtual_dynamixel.protocol import Fail
from sim_backends.virtual_dynamixel.registers import (
    EEPROM,
    POSITION_LIMIT_EXTENDED,
    READ_ONLY,
    Register,
    register_table,
)

Writes = list[tuple[Register, int]]

GOALS = frozenset({"Goal_PWM", "Goal_Current", "Goal_Velocity", "Goal_Position"})
_LIMITED = {"Goal_PWM": "PWM_Limit", "Goal_Current": "Current_Limit", "Goal_Velocity": "Velocity_Limit"}


class ControlTable:
    """Registers as bytes.

    Assumption: a read or write may run over gaps between registers (they read as 0 and swallow what is
    written), but must begin at a register; nothing of a write is stored when one register refuses.

    Args:
        model: Which servo.
    """

    def __init__(self, model: ServoModel) -> None:
        self.model = model
        self.registers = register_table(model)
        self.memory = bytearray(self.registers.size)
        self.registered: Writes = []
        self._mapped = False
        self.reset(lambda register: True)

    def reset(self, which: Callable[[Register], bool]) -> None:
        """Put the registers that `which` selects back to their initial values."""
        for register in self.registers:
            if which(register):
                self.put(register, register.initial)
        self.registered = []
        self._note_mapping()

    def get(self, name: str) -> int:
        """Value of a register."""
        register = self.registers[name]
        return int.from_bytes(self.memory[register.address : register.end], "little", signed=register.signed)

    def put(self, register: Register, value: int) -> None:
        """Store a value, without any rule."""
        mask = (1 << 8 * register.size) - 1
        self.memory[register.address : register.end] = (value & mask).to_bytes(register.size, "little")

    def set(self, name: str, value: int) -> None:
        """Store a value by name, without any rule."""
        self.put(self.registers[name], value)

    # --- reading ---------------------------------------------------------------------------------------

    def check_read(self, address: int, length: int) -> Fail:
        """Whether `length` bytes from `address` may be read."""
        if length == 0:
            return Fail.DATA_LENGTH
        if address + length > self.registers.size or self.registers.at(address) is None:
            return Fail.ACCESS
        return Fail.NONE

    def read(self, address: int, length: int) -> bytes:
        """The bytes, indirect data taken from where they are mapped."""
        if not self._mapped:
            return bytes(self.memory[address : address + length])
        return bytes(self.memory[self.resolve(at)] for at in range(address, address + length))

    def resolve(self, address: int) -> int:
        """Where a byte really lives: an indirect data byte's mapped address, any other byte's own."""
        if self._mapped:
            for block in self.registers.indirect:
                index = address - block.data
                if 0 <= index < block.count:
                    at = block.address + 2 * index
                    return self.memory[at] | self.memory[at + 1] << 8
        return address

    def spans(self, address: int, length: int, low: int, high: int) -> bool:
        """Whether reading these bytes touches an address in [low, high), through indirect addresses too."""
        if address < high and address + length > low:
            return True
        return self._mapped and any(low <= self.resolve(at) < high for at in range(address, address + length))

    def _note_mapping(self) -> None:
        blocks = self.registers.indirect
        memory = self.memory
        self._mapped = any(
            memory[block.address + 2 * n] | memory[block.address + 2 * n + 1] << 8 != block.data + n
            for block in blocks
            for n in range(block.count)
        )

    # --- writing ---------------------------------------------------------------------------------------

    def parse_write(self, address: int, data: bytes) -> tuple[Fail, Writes]:
        """Split a write into registers and check what does not depend on the state: layout and access."""
        size = self.registers.size
        if not data:
            return Fail.DATA_LENGTH, []
        if address + len(data) > size or self.registers.at(address) is None:
            return Fail.ACCESS, []
        writes: Writes = []
        offset = 0
        while offset < len(data):
            place = self.resolve(address + offset)
            register = self.registers.at(place)
            if register is None:
                offset += 1
                continue
            end = offset + register.size
            whole = place == register.address and all(
                self.resolve(address + offset + n) == place + n for n in range(1, register.size)
            )
            if not whole or end > len(data):
                return Fail.DATA_LENGTH, []
            writes.append((register, int.from_bytes(data[offset:end], "little", signed=register.signed)))
            offset = end
        torque = self.memory[64]
        for register, value in writes:
            if register.access == READ_ONLY or (register.access == EEPROM and torque):
                return Fail.ACCESS, []
            if register.low is not None and value < register.low:
                return Fail.DATA_RANGE, []
            if register.high is not None and value > register.high:
                return Fail.DATA_RANGE, []
        return Fail.NONE, writes

    def check_values(self, writes: Writes, tripped: bool, shut_down: bool) -> Fail:
        """Whether values fit the other registers and the servo's state.

        Assumption: values beyond a limit register answer Data Limit (6), values beyond the register's own
        range Data Range (4).

        Args:
            writes: What `parse_write` gave.
            tripped: The bus watchdog has tripped: goals are refused.
            shut_down: A hardware error has taken the torque off until a reboot.
        """
        for register, value in writes:
            name = register.name
            if tripped and name in GOALS:
                return Fail.DATA_RANGE
            if name == "Operating_Mode" and value not in self.model.modes:
                return Fail.DATA_RANGE
            if name == "Torque_Enable" and value and shut_down:
                return Fail.ACCESS
            if name in _LIMITED and abs(value) > self.get(_LIMITED[name]):
                return Fail.DATA_LIMIT
            if name == "Goal_Position" and (fail := self.check_goal_position(value)):
                return fail
        return Fail.NONE

    def check_goal_position(self, value: int) -> Fail:
        """Whether a goal is within the limits: the limit registers count in position mode only."""
        memory = self.memory
        if memory[11] != POSITION_MODE:
            return Fail.NONE if abs(value) <= POSITION_LIMIT_EXTENDED else Fail.DATA_RANGE
        lowest, highest = memory[52] | memory[53] << 8, memory[48] | memory[49] << 8  # 0..4095
        return Fail.NONE if lowest <= value <= highest else Fail.DATA_LIMIT

    def store(self, register: Register, value: int) -> None:
        """Store a value that has been checked."""
        self.put(register, value)
        if register.name.startswith("Indirect_Address"):
            self._note_mapping()
