"""The composition root: the only room that knows which drivers and which simulated backends exist.

Camera, arm and clock come as a set. A simulated set is asked for by name; nothing falls back to one.
"""

from collections.abc import Mapping

from controller.backends.devices import BackendOptions, Devices, Factory, Level, Mode, Touch
from controller.backends.nominal import nominal_camera
from controller.backends.painted_table import PaintedTable
from controller.backends.real import lone_camera, plugged_in, real_devices
from controller.backends.recorded import rehearsed, replay_devices
from controller.backends.simulated import sim_devices
from controller.backends.simulated_spec import simulated_cell

__all__ = [
    "DEVICES",
    "BackendOptions",
    "Devices",
    "Factory",
    "Level",
    "Mode",
    "PaintedTable",
    "Touch",
    "lone_camera",
    "nominal_camera",
    "plugged_in",
    "rehearsed",
    "simulated_cell",
]

DEVICES: Mapping[Mode, Factory] = {Mode.REAL: real_devices, Mode.SIM: sim_devices, Mode.REPLAY: replay_devices}
