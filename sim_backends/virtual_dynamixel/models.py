"""What distinguishes the servo models: motor data and factory settings.

Source: ROBOTIS e-Manual, pages `dxl/x/<model>`, sections "Specifications" and "Control Table". Where a page
gives no figure, the value is marked.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

TICKS_PER_RAD = 4096 / (2 * math.pi)
VELOCITY_UNIT = 0.229 * 2 * math.pi / 60
"""rad/s per unit of the velocity registers (0.229 rpm)."""
PWM_FULL = 885
"""Raw PWM value of 100 %."""

CURRENT_MODE, VELOCITY_MODE, POSITION_MODE, EXTENDED_MODE, CURRENT_POSITION_MODE, PWM_MODE = 0, 1, 3, 4, 5, 16

_MODES = (1, 3, 4, 16)
_MODES_WITH_CURRENT = (0, 1, 3, 4, 5, 16)
_RPM = 2 * math.pi / 60


@dataclass(frozen=True, slots=True)
class ServoModel:
    """One model of servo.

    Attributes:
        name: e.g. `XM430-W350`.
        number: Model_Number.
        modes: Values that Operating_Mode accepts.
        stall_torque: Nm at `voltage`.
        no_load_speed: rad/s at `voltage`.
        stall_current: A at `voltage`.
        voltage: Nominal supply, V.
        velocity_limit: Factory Velocity_Limit.
        voltage_range: Smallest and largest value of the voltage limits, 0.1 V.
        voltage_limits: Factory Min_ and Max_Voltage_Limit, 0.1 V.
        temperature_limit: Factory Temperature_Limit, degC.
        shutdown: Factory Shutdown bits.
        position_gains: Factory Position P, I and D gain.
        velocity_gains: Factory Velocity P and I gain.
        current_unit: A per unit of Present_Current; 0 where the servo measures no current.
        current_limit: Factory (and largest) Current_Limit; 0 where there is none.
        external_ports: It has external ports.
        firmware: Firmware_Version. Assumption: recent enough for every feature simulated here.
    """

    name: str
    number: int
    modes: tuple[int, ...]
    stall_torque: float
    no_load_speed: float
    stall_current: float
    voltage: float
    velocity_limit: int
    voltage_range: tuple[int, int]
    voltage_limits: tuple[int, int]
    temperature_limit: int
    shutdown: int
    position_gains: tuple[int, int, int]
    velocity_gains: tuple[int, int]
    current_unit: float = 0.0
    current_limit: int = 0
    external_ports: bool = False
    firmware: int = 50

    @property
    def family(self) -> str:
        """`XL330`, `XM430`, ..."""
        return self.name.partition("-")[0]

    @property
    def back_emf(self) -> float:
        """Braking torque per speed that makes the torque-speed line meet zero at `no_load_speed`, Nm s/rad."""
        return self.stall_torque / self.no_load_speed

    @property
    def torque_constant(self) -> float:
        """Output torque per ampere, Nm/A: stall torque over stall current."""
        return self.stall_torque / self.stall_current


_FIVE_VOLT = ((31, 70), (35, 70))
_SIX_TO_SIXTEEN = ((60, 160), (60, 160))
_TEN_TO_SIXTEEN = ((95, 160), (95, 160))

_ALL = (
    ServoModel(
        "XL330-M077", 1190, _MODES_WITH_CURRENT, 0.215, 383 * _RPM, 1.47, 5.0, 1620, *_FIVE_VOLT, 70, 53,
        (400, 400, 0), (40, 400), 0.001, 1750,
    ),
    ServoModel(
        "XL330-M288", 1200, _MODES_WITH_CURRENT, 0.52, 103 * _RPM, 1.47, 5.0, 445, *_FIVE_VOLT, 70, 53,
        (400, 0, 0), (180, 1600), 0.001, 1750,
    ),
    ServoModel(
        "XL430-W250", 1060, _MODES, 1.5, 61 * _RPM, 1.4, 12.0, 265, (60, 140), (60, 140), 72, 52,
        (640, 0, 4000), (100, 1000),
    ),
    # Assumption: Velocity_Limit, voltages, temperature and gains of the W150 follow its sibling W240.
    ServoModel(
        "XC430-W150", 1070, _MODES, 1.6, 106 * _RPM, 1.4, 12.0, 460, *_SIX_TO_SIXTEEN, 80, 52,
        (700, 0, 0), (100, 1920),
    ),
    ServoModel(
        "XC430-W240", 1080, _MODES, 1.9, 70 * _RPM, 1.4, 12.0, 306, *_SIX_TO_SIXTEEN, 80, 52,
        (700, 0, 0), (100, 1920),
    ),
    ServoModel(
        "XM430-W350", 1020, _MODES_WITH_CURRENT, 4.1, 46 * _RPM, 2.3, 12.0, 200, *_TEN_TO_SIXTEEN, 80, 52,
        (800, 0, 0), (100, 1920), 0.00269, 1193,
    ),
    ServoModel(
        "XM540-W270", 1120, _MODES_WITH_CURRENT, 10.6, 30 * _RPM, 4.4, 12.0, 128, *_TEN_TO_SIXTEEN, 80, 52,
        (800, 0, 0), (100, 1920), 0.00269, 2047, external_ports=True,
    ),
    ServoModel(
        "XH430-W350", 1000, _MODES_WITH_CURRENT, 3.4, 30 * _RPM, 1.3, 12.0, 130, *_TEN_TO_SIXTEEN, 80, 52,
        (900, 0, 0), (100, 1920), 0.00269, 648,
    ),
)  # fmt: skip

MODELS = {model.name: model for model in _ALL}
"""The simulated models by name."""
