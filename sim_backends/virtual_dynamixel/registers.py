"""The control table of the X series as the simulated servos have it.

Typed in from the manuals, apart from the driver's own table, so that one wrong address cannot pass on both
sides. Values are raw register values unless a suffix says otherwise.

Source: ROBOTIS e-Manual, pages `dxl/x/<model>`, section "Control Table".
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

from sim_backends.virtual_dynamixel.models import ServoModel

READ_ONLY, RAM, EEPROM = "R", "W", "E"

HOMING_LIMIT = 1_044_479
POSITION_LIMIT_EXTENDED = 1_048_575
"""Largest goal in the modes that count turns (256 revolutions), ticks."""


@dataclass(frozen=True, slots=True)
class Register:
    """One entry of a control table.

    Attributes:
        name: The manual's name, e.g. `Goal_Position`.
        address: First byte.
        size: Number of bytes: 1, 2 or 4, little-endian.
        access: `R` read only, `W` RAM, `E` EEPROM (not writable while torque is on).
        signed: Two's complement.
        low, high: Range of values a write may carry; None where the manual states none.
        initial: Value after a factory reset (EEPROM) or a power-up (RAM).
    """

    name: str
    address: int
    size: int
    access: str
    signed: bool = False
    low: int | None = None
    high: int | None = None
    initial: int = 0

    @property
    def end(self) -> int:
        """Address after the last byte."""
        return self.address + self.size


@dataclass(frozen=True, slots=True)
class IndirectBlock:
    """`count` indirect addresses (2 bytes each, from `address`) that map the data bytes from `data` on."""

    address: int
    data: int
    count: int


class RegisterTable:
    """The registers of one model, found by name or by address.

    Attributes:
        size: Number of bytes of the whole table.
        indirect: Blocks of indirect addresses.
    """

    def __init__(self, registers: tuple[Register, ...], indirect: tuple[IndirectBlock, ...]) -> None:
        self._registers = registers
        self.indirect = indirect
        self._by_name = {register.name: register for register in registers}
        self.size = max(register.end for register in registers)
        self._at: list[Register | None] = [None] * self.size
        for register in registers:
            self._at[register.address : register.end] = [register] * register.size

    def __iter__(self) -> Iterator[Register]:
        return iter(self._registers)

    def __getitem__(self, name: str) -> Register:
        return self._by_name[name]

    def __contains__(self, name: str) -> bool:
        return name in self._by_name

    def at(self, address: int) -> Register | None:
        """The register that owns a byte, or None in a gap."""
        return self._at[address] if 0 <= address < self.size else None


@cache
def register_table(model: ServoModel) -> RegisterTable:
    """The control table of a model."""
    volt_low, volt_high = model.voltage_range
    volt_min, volt_max = model.voltage_limits
    velocity_p, velocity_i = model.velocity_gains
    position_p, position_i, position_d = model.position_gains
    small = model.family == "XL330"
    rows = [
        Register("Model_Number", 0, 2, READ_ONLY, initial=model.number),
        Register("Model_Information", 2, 4, READ_ONLY),
        Register("Firmware_Version", 6, 1, READ_ONLY, initial=model.firmware),
        Register("ID", 7, 1, EEPROM, low=0, high=252, initial=1),
        Register("Baud_Rate", 8, 1, EEPROM, low=0, high=6 if small else 7, initial=1),
        Register("Return_Delay_Time", 9, 1, EEPROM, low=0, high=254, initial=250),
        Register("Drive_Mode", 10, 1, EEPROM, low=0, high=13),
        Register("Operating_Mode", 11, 1, EEPROM, initial=3),
        Register("Secondary_ID", 12, 1, EEPROM, initial=255),
        Register("Protocol_Type", 13, 1, EEPROM, low=1, high=22 if small else 2, initial=2),
        Register("Homing_Offset", 20, 4, EEPROM, signed=True, low=-HOMING_LIMIT, high=HOMING_LIMIT),
        Register("Moving_Threshold", 24, 4, EEPROM, low=0, high=1023, initial=10),
        Register("Temperature_Limit", 31, 1, EEPROM, low=0, high=100, initial=model.temperature_limit),
        Register("Max_Voltage_Limit", 32, 2, EEPROM, low=volt_low, high=volt_high, initial=volt_max),
        Register("Min_Voltage_Limit", 34, 2, EEPROM, low=volt_low, high=volt_high, initial=volt_min),
        Register("PWM_Limit", 36, 2, EEPROM, low=0, high=885, initial=885),
        Register("Velocity_Limit", 44, 4, EEPROM, low=0, high=2047 if small else 1023, initial=model.velocity_limit),
        Register("Max_Position_Limit", 48, 4, EEPROM, low=0, high=4095, initial=4095),
        Register("Min_Position_Limit", 52, 4, EEPROM, low=0, high=4095),
        Register("Startup_Configuration", 60, 1, EEPROM, low=0, high=3),
        Register("Shutdown", 63, 1, EEPROM, initial=model.shutdown),
        Register("Torque_Enable", 64, 1, RAM, low=0, high=1),
        Register("LED", 65, 1, RAM, low=0, high=1),
        Register("Status_Return_Level", 68, 1, RAM, low=0, high=2, initial=2),
        Register("Registered_Instruction", 69, 1, READ_ONLY),
        Register("Hardware_Error_Status", 70, 1, READ_ONLY),
        Register("Velocity_I_Gain", 76, 2, RAM, low=0, high=16383, initial=velocity_i),
        Register("Velocity_P_Gain", 78, 2, RAM, low=0, high=16383, initial=velocity_p),
        Register("Position_D_Gain", 80, 2, RAM, low=0, high=16383, initial=position_d),
        Register("Position_I_Gain", 82, 2, RAM, low=0, high=16383, initial=position_i),
        Register("Position_P_Gain", 84, 2, RAM, low=0, high=16383, initial=position_p),
        Register("Feedforward_2nd_Gain", 88, 2, RAM, low=0, high=16383),
        Register("Feedforward_1st_Gain", 90, 2, RAM, low=0, high=16383),
        Register("Bus_Watchdog", 98, 1, RAM, signed=True, low=0, high=127),
        Register("Goal_PWM", 100, 2, RAM, signed=True),
        Register("Goal_Velocity", 104, 4, RAM, signed=True),
        Register("Profile_Acceleration", 108, 4, RAM, low=0, high=32767),
        Register("Profile_Velocity", 112, 4, RAM, low=0, high=32767),
        Register("Goal_Position", 116, 4, RAM, signed=True),
        Register("Realtime_Tick", 120, 2, READ_ONLY),
        Register("Moving", 122, 1, READ_ONLY),
        Register("Moving_Status", 123, 1, READ_ONLY),
        Register("Present_PWM", 124, 2, READ_ONLY, signed=True),
        Register("Present_Current" if model.current_unit else "Present_Load", 126, 2, READ_ONLY, signed=True),
        Register("Present_Velocity", 128, 4, READ_ONLY, signed=True),
        Register("Present_Position", 132, 4, READ_ONLY, signed=True),
        Register("Velocity_Trajectory", 136, 4, READ_ONLY, signed=True),
        Register("Position_Trajectory", 140, 4, READ_ONLY, signed=True),
        Register("Present_Input_Voltage", 144, 2, READ_ONLY),
        Register("Present_Temperature", 146, 1, READ_ONLY),
        Register("Backup_Ready", 147, 1, READ_ONLY),
    ]
    if model.current_limit:
        top = model.current_limit
        rows.append(Register("Current_Limit", 38, 2, EEPROM, low=0, high=top, initial=top))
        rows.append(Register("Goal_Current", 102, 2, RAM, signed=True))
    if small:
        rows.append(Register("PWM_Slope", 62, 1, EEPROM, low=1, high=255, initial=140))
    if model.external_ports:
        rows += [Register(f"External_Port_Mode_{n}", 55 + n, 1, EEPROM, low=0, high=3, initial=3) for n in (1, 2, 3)]
        rows += [Register(f"External_Port_Data_{n}", 150 + 2 * n, 2, RAM) for n in (1, 2, 3)]
    indirect = (IndirectBlock(168, 208, 20),) if small else (IndirectBlock(168, 224, 28), IndirectBlock(578, 634, 28))
    last = indirect[-1].data + indirect[-1].count - 1
    number = 0
    for block in indirect:
        for index in range(block.count):
            number += 1
            mapped = block.data + index
            address = block.address + 2 * index
            rows.append(Register(f"Indirect_Address_{number}", address, 2, RAM, low=64, high=last, initial=mapped))
            rows.append(Register(f"Indirect_Data_{number}", mapped, 1, RAM))
    return RegisterTable(tuple(sorted(rows, key=lambda row: row.address)), indirect)
