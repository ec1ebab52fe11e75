"""The devices of a real cell: webcam, servo bus, the machine's own clock."""

from __future__ import annotations

from typing import TYPE_CHECKING

from controller.backends.concerns import Concerns
from controller.backends.devices import BackendOptions, Devices
from controller.config.cell import CellConfig
from controller.domain import ArmDescription
from controller.ports import Camera, Clock
from controller.vision.watch import WatchedCamera

if TYPE_CHECKING:
    from drivers.camera.listing import CameraListing


def real_devices(config: CellConfig, arm: ArmDescription, options: BackendOptions) -> Devices:
    """Webcam, servo bus and the machine's own clock."""
    from drivers.arm.dynamixel import DynamixelArm
    from drivers.arm.serial_stream import SerialStream
    from drivers.camera.v4l2 import V4l2Camera
    from drivers.clock import MonotonicClock

    clock = options.watch_clock(MonotonicClock())
    camera = V4l2Camera(
        config.camera.device,
        clock,
        size=(config.camera.width, config.camera.height),
        fps=config.camera.frames_per_second,
        settings=config.camera.settings,
    )
    watched, driver = WatchedCamera(camera, clock), DynamixelArm(arm, SerialStream(config.arm.port), clock)
    return Devices(watched, driver, clock, concerns=Concerns(watched, driver.bus.statistics, camera))


def plugged_in() -> tuple[CameraListing, ...]:
    """Cameras that the system knows; opens none."""
    from drivers.camera.listing import list_cameras

    return list_cameras()


def lone_camera(config: CellConfig, device: str) -> tuple[Camera, Clock]:
    """A camera without its cell, to aim and to focus it; not open."""
    from drivers.camera.v4l2 import V4l2Camera
    from drivers.clock import MonotonicClock

    clock, section = MonotonicClock(), config.camera
    size = section.width, section.height
    return V4l2Camera(device, clock, size=size, fps=section.frames_per_second, settings=section.settings), clock
