"""The control table of the X series and what distinguishes its models, as data.

The driver asks for registers by the e-Manual's names; nothing else in this package knows an address. The
layout is the same for every model listed, but for what address 126 measures.

Source: ROBOTIS e-Manual, pages `dxl/x/<model>`, sections "Control Table" and "Control Table Description".
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum


class Access(Enum):
    """Who may write a register, and when."""

    READ = "read only"
    RAM = "writable, lost with power"
    EEPROM = "writable with torque off, kept without power"


@dataclass(frozen=True, slots=True)
class Register:
    """One entry of the control table, little-endian.

    Attributes:
        name: The e-Manual's name, e.g. `Goal_Position`.
        address: First byte.
        size: Bytes: 1, 2 or 4.
        access: Who may write it.
        signed: Two's complement.
    """

    name: str
    address: int
    size: int
    access: Access
    signed: bool = False

    def encode(self, value: int) -> bytes:
        """Bytes of a value.

        Raises:
            OverflowError: The value does not fit the register.
        """
        return value.to_bytes(self.size, "little", signed=self.signed)

    def decode(self, data: bytes) -> int:
        """Value of exactly `size` bytes.

        Raises:
            ValueError: Another number of bytes.
        """
        if len(data) != self.size:
            raise ValueError(f"{self.name} has {self.size} bytes, not {len(data)}")
        return int.from_bytes(data, "little", signed=self.signed)


def _table(*rows: tuple[str, int, int, Access] | tuple[str, int, int, Access, bool]) -> dict[str, Register]:
    return {row[0]: Register(*row) for row in rows}


_READ, _RAM, _EEPROM = Access.READ, Access.RAM, Access.EEPROM

REGISTERS: Mapping[str, Register] = _table(
    ("Model_Number", 0, 2, _READ),
    ("Firmware_Version", 6, 1, _READ),
    ("ID", 7, 1, _EEPROM),
    ("Baud_Rate", 8, 1, _EEPROM),
    ("Return_Delay_Time", 9, 1, _EEPROM),
    ("Drive_Mode", 10, 1, _EEPROM),
    ("Operating_Mode", 11, 1, _EEPROM),
    ("Secondary_ID", 12, 1, _EEPROM),
    ("Protocol_Type", 13, 1, _EEPROM),
    ("Homing_Offset", 20, 4, _EEPROM, True),
    ("Moving_Threshold", 24, 4, _EEPROM),
    ("Temperature_Limit", 31, 1, _EEPROM),
    ("Max_Voltage_Limit", 32, 2, _EEPROM),
    ("Min_Voltage_Limit", 34, 2, _EEPROM),
    ("PWM_Limit", 36, 2, _EEPROM),
    ("Current_Limit", 38, 2, _EEPROM),  # not on XL430 and XC430
    ("Velocity_Limit", 44, 4, _EEPROM),
    ("Max_Position_Limit", 48, 4, _EEPROM),
    ("Min_Position_Limit", 52, 4, _EEPROM),
    ("Shutdown", 63, 1, _EEPROM),
    ("Torque_Enable", 64, 1, _RAM),
    ("LED", 65, 1, _RAM),
    ("Status_Return_Level", 68, 1, _RAM),
    ("Registered_Instruction", 69, 1, _READ),
    ("Hardware_Error_Status", 70, 1, _READ),
    ("Velocity_I_Gain", 76, 2, _RAM),
    ("Velocity_P_Gain", 78, 2, _RAM),
    ("Position_D_Gain", 80, 2, _RAM),
    ("Position_I_Gain", 82, 2, _RAM),
    ("Position_P_Gain", 84, 2, _RAM),
    ("Feedforward_2nd_Gain", 88, 2, _RAM),
    ("Feedforward_1st_Gain", 90, 2, _RAM),
    ("Bus_Watchdog", 98, 1, _RAM, True),
    ("Goal_PWM", 100, 2, _RAM, True),
    ("Goal_Current", 102, 2, _RAM, True),  # not on XL430 and XC430
    ("Goal_Velocity", 104, 4, _RAM, True),
    ("Profile_Acceleration", 108, 4, _RAM),
    ("Profile_Velocity", 112, 4, _RAM),
    ("Goal_Position", 116, 4, _RAM, True),
    ("Realtime_Tick", 120, 2, _READ),
    ("Moving", 122, 1, _READ),
    ("Moving_Status", 123, 1, _READ),
    ("Present_PWM", 124, 2, _READ, True),
    ("Present_Load", 126, 2, _READ, True),  # Present_Current where the model measures it
    ("Present_Velocity", 128, 4, _READ, True),
    ("Present_Position", 132, 4, _READ, True),
    ("Velocity_Trajectory", 136, 4, _READ, True),
    ("Position_Trajectory", 140, 4, _READ, True),
    ("Present_Input_Voltage", 144, 2, _READ),
    ("Present_Temperature", 146, 1, _READ),
)

POSITION_MODE = 3
"""Operating_Mode: position control within one turn."""

REVERSE = 0b1
"""Drive_Mode bit 0: the servo counts the other way."""

PWM_FULL = 885
"""Goal_PWM and PWM_Limit of 100 %."""

NO_SECONDARY_ID = 255
"""Secondary_ID values of 253 and above mean none."""

HOMING_LIMIT = 1024
"""Largest Homing_Offset that position mode honours, ticks."""

WATCHDOG_UNIT = 0.020
"""Unit of Bus_Watchdog, s."""

WATCHDOG_TRIPPED = -1
"""Bus_Watchdog after it has stopped the servo; goals are refused until 0 is written."""

_RESTART = "restart the servo: controller reset, or switch the servos' supply off and on"

HARDWARE_ERRORS: Mapping[int, tuple[str, str]] = {
    0: ("input voltage out of range", "check the power supply and its cable, then switch it off and on"),
    2: ("overheated", "let it cool for 20 minutes, then " + _RESTART),
    3: ("motor encoder does not work", "switch the servos' supply off and on; if it returns, replace the servo"),
    4: ("electrical shock or too little power to drive", "check the power supply, then " + _RESTART),
    5: ("overloaded for too long", "free the joint, lighten the load, then " + _RESTART),
}
"""Hardware_Error_Status by bit: what it means and what to do."""


@dataclass(frozen=True, slots=True)
class Model:
    """What the driver must know about one model of servo.

    Attributes:
        name: e.g. `XM430-W350`.
        number: Model_Number.
        position_gains: (P, I, D) from the factory.
        shutdown: Factory Shutdown: the hardware errors that cut the torque.
        load_full: Value at address 126 that is 100 %: Current_Limit, or 1000 for a load in 0.1 %.
        firmware: Firmware_Version that brought the Bus Watchdog; 0 where every one has it.
    """

    name: str
    number: int
    position_gains: tuple[int, int, int]
    shutdown: int
    load_full: int
    firmware: int = 38


_MODELS = (
    Model("XL330-M077", 1190, (400, 400, 0), 53, 1750, 0),
    Model("XL330-M288", 1200, (400, 0, 0), 53, 1750, 0),
    Model("XL430-W250", 1060, (640, 0, 4000), 52, 1000),
    Model("XC430-W150", 1070, (700, 0, 0), 52, 1000),
    Model("XC430-W240", 1080, (700, 0, 0), 52, 1000),
    Model("XM430-W350", 1020, (800, 0, 0), 52, 1193),
    Model("XM540-W270", 1120, (800, 0, 0), 52, 2047),
    Model("XH430-W350", 1000, (900, 0, 0), 52, 648),
)

MODELS: Mapping[str, Model] = {model.name: model for model in _MODELS}


def model_name(number: int) -> str:
    """Name of a model number, or a description of an unknown one."""
    return next((model.name for model in _MODELS if model.number == number), f"unknown model {number}")


def hardware_error_text(bits: int) -> tuple[str, str]:
    """(cause, remedy) of Hardware_Error_Status; several causes are joined, the remedy is the first one's."""
    found = [HARDWARE_ERRORS[bit] for bit in HARDWARE_ERRORS if bits >> bit & 1]
    if not found:
        return f"hardware error {bits:#04x}", "switch the servos' supply off and on"
    return ", ".join(cause for cause, _ in found), found[0][1]
