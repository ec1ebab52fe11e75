"""The error tree: every failure a caller can meet, named by what he has to do about it.

Vendor exceptions are wrapped once, at the driver, `from` the original. A message says the cause; the
remedy stands beside it, so that the command line can print both in one line.
"""

from __future__ import annotations


class SorterError(Exception):
    """Root of every failure this project raises on purpose.

    Args:
        cause: What happened, one line, naming the device, file or key.
        remedy: What the user can do about it, one line; may be empty.
    """

    exit_code = 1

    def __init__(self, cause: str, remedy: str = "") -> None:
        super().__init__(cause)
        self.cause = cause
        self.remedy = remedy

    def __str__(self) -> str:
        """Cause and remedy in one line; what a file or a bus made its way into it cannot command a terminal."""
        text = f"{self.cause}: {self.remedy}" if self.remedy else self.cause
        return text if text.isprintable() else "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


class ConfigError(SorterError, ValueError):
    """A configuration that must not be run: bad file, key, type, range or an unreachable bin."""

    exit_code = 78


class InstanceBusy(SorterError):
    """Another instance holds the cell; the message names its process."""

    exit_code = 75


class InputError(SorterError):
    """A file, folder or picture the user named cannot be read or makes no sense."""


class LedgerError(SorterError):
    """The durable record cannot be read or written (disk full, read-only, damaged, too new): nothing may move."""


class CalibrationError(SorterError):
    """A calibration is missing, out of date or too poor to be trusted with motion."""


class CalibrationMissing(CalibrationError):
    """No calibration where one is needed."""


class CalibrationStale(CalibrationError):
    """The calibration belongs to another camera, arm, or time."""


class CalibrationPoorFit(CalibrationError):
    """The measurements do not fit the model well enough to be used."""


class DeviceError(SorterError):
    """A device did not do what was asked: reads may be retried, moves never.

    Args:
        device: Name of the device, e.g. `/dev/video0` or `servo 3 (elbow)`.
        operation: What was being done, e.g. `read Present_Position`.
        cause: What happened.
        remedy: What the user can do about it.
    """

    def __init__(self, device: str, operation: str, cause: str, remedy: str = "") -> None:
        super().__init__(f"{device}: {operation}: {cause}", remedy)
        self.device = device
        self.operation = operation


class CameraError(DeviceError):
    """The camera failed."""


class FrameStale(CameraError):
    """No frame young enough arrived before the deadline."""


class CameraLost(CameraError):
    """The camera is gone: unplugged, or it cannot be opened."""


class PictureUnusable(CameraError):
    """Frames come, but what they show cannot be trusted.

    `code` says why: `black`, `overexposed`, `frozen`, `torn`, `light`, `covered`, `moved` or `soft`.
    """

    def __init__(self, device: str, operation: str, code: str, cause: str, remedy: str = "") -> None:
        super().__init__(device, operation, cause, remedy)
        self.code = code


class CameraEnded(CameraLost):
    """A replayed camera has shown its last picture: the end of the run, not a failure of a device."""


class ArmError(DeviceError):
    """The arm failed."""


class BusError(ArmError):
    """A transaction on the servo bus failed; `code` says how (`timeout`, `corrupt`, `lost`, `refused`, ...)."""

    def __init__(self, device: str, operation: str, code: str, cause: str, remedy: str = "") -> None:
        super().__init__(device, operation, cause, remedy)
        self.code = code


class ServoFault(ArmError):
    """A servo reports a hardware error: `joint` names it, `bits` is Hardware_Error_Status."""

    def __init__(self, device: str, operation: str, joint: str, bits: int, cause: str, remedy: str = "") -> None:
        super().__init__(device, operation, cause, remedy)
        self.joint = joint
        self.bits = bits


class MotionTimeout(ArmError):
    """A move did not end, or a joint did not follow, before its deadline."""


class PartHeld(ArmError):
    """The jaws were opened and still hold a part: somebody must take it out."""


class Intruder(SorterError):
    """A hand or something else that is large and unknown is over the table: nothing moves until it is gone."""


class PlanError(SorterError, ValueError):
    """No safe plan for this target: skip it or clear the way; nothing has moved."""


class Unreachable(PlanError):
    """The pose lies outside what the joints can reach."""


class LimitViolation(PlanError):
    """A plan breaks a limit of joint, speed, acceleration, workspace or clearance."""


class NoClearGrasp(PlanError):
    """Every closing direction would touch a neighbour, a bin or the table."""


class SafetyStop(SorterError):
    """A latched stop: a human must look and reset."""
