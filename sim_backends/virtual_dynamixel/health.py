"""What wears a servo down: load, heat and supply, and the hardware errors they raise.

Source: ROBOTIS e-Manual, `dxl/x/xm430-w350`, "Hardware Error Status", "Shutdown".
"""

from __future__ import annotations

from sim_backends.virtual_dynamixel.control_table import ControlTable
from sim_backends.virtual_dynamixel.models import ServoModel

ERROR_VOLTAGE, ERROR_OVERHEAT, ERROR_ENCODER, ERROR_SHOCK, ERROR_OVERLOAD = 0x01, 0x04, 0x08, 0x10, 0x20

OVERLOAD_TIME = 1.5
"""s of sustained load until the overload error. Assumption."""
OVERLOAD_SHARE = 0.8
"""Share of the stall torque from which a load counts as overload. Assumption."""
AMBIENT = 30.0
"""degC at rest. Assumption."""
THERMAL_RESISTANCE = 4.0
"""K per W of winding loss, case to air. Assumption: stalled at full voltage a servo would reach its limit."""
THERMAL_TIME = 300.0
"""s, first-order warming of the case. Assumption."""


class Health:
    """Supply, temperature and latched errors of one servo.

    Args:
        model: Which servo.
        table: Its registers; Hardware_Error_Status is kept up to date.

    Attributes:
        supply: Voltage it is fed with, V.
        temperature: degC.
        bits: Hardware_Error_Status. Assumption: stays until a reboot, whatever becomes of the cause.
        shut_down: An error that Shutdown selects has taken the torque off for good.
    """

    def __init__(self, model: ServoModel, table: ControlTable) -> None:
        self._model = model
        self._table = table
        self._overload_since: float | None = None
        self.supply = model.voltage
        self.temperature = AMBIENT
        self.bits = 0
        self.shut_down = False

    def reboot(self) -> None:
        """Forget the errors; heat and supply stay as they are."""
        self.bits = 0
        self.shut_down = False
        self._overload_since = None

    def fail(self, bits: int) -> None:
        """Latch errors."""
        self.bits |= bits
        self._table.set("Hardware_Error_Status", self.bits)
        self.shut_down = self.shut_down or bool(self.bits & self._table.get("Shutdown"))

    def look(self, dt: float, now: float, torque: float) -> int:
        """Warm, cool and judge; the errors that should be raised.

        Args:
            dt: s since the last look.
            now: s.
            torque: Of the motor, Nm, absolute; 0 with torque off.
        """
        model, memory = self._model, self._table.memory
        current = torque / model.torque_constant
        loss = current * current * model.voltage / model.stall_current
        self.temperature += dt / THERMAL_TIME * (AMBIENT + THERMAL_RESISTANCE * loss - self.temperature)
        bits = 0
        if torque < OVERLOAD_SHARE * model.stall_torque * self.supply / model.voltage:
            self._overload_since = None
        elif self._overload_since is None:
            self._overload_since = now
        elif now - self._overload_since >= OVERLOAD_TIME:
            bits |= ERROR_OVERLOAD
        if self.temperature > memory[31]:  # Temperature_Limit
            bits |= ERROR_OVERHEAT
        highest, lowest = memory[32] | memory[33] << 8, memory[34] | memory[35] << 8  # Max_, Min_Voltage_Limit
        if not lowest <= round(self.supply * 10) <= highest:
            bits |= ERROR_VOLTAGE
        return bits & ~self.bits
