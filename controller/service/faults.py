"""The fault catalogue: what can go wrong, how it is noticed, what the cell does, and what a person can do about it.

Alarms, logs, reports, documentation and tests take their codes and words from here and from nowhere else.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from controller.cycle.machine import State
from controller.cycle.rig import Observer
from controller.errors import (
    ArmError,
    BusError,
    CalibrationError,
    CalibrationMissing,
    CalibrationStale,
    CameraError,
    CameraLost,
    ConfigError,
    FrameStale,
    InstanceBusy,
    Intruder,
    LedgerError,
    MotionTimeout,
    PartHeld,
    PictureUnusable,
    PlanError,
    SafetyStop,
    ServoFault,
    SorterError,
)


class Action(StrEnum):
    """What the cell does about a fault."""

    GOES_ON = "goes on"
    """What failed is tried again within the step, or left out; nothing else changes."""
    WARNED = "warned"
    """An alarm says so; the cell goes on, more slowly where that helps."""
    RETRIED = "retried"
    """The part is looked for and tried again, and left alone or counted as lost after the last attempt."""
    SUSPENDED = "suspended"
    """Parts of that kind are left; the others are sorted."""
    HELD = "held"
    """Nothing moves, torque stays on; it goes on when the cause is over."""
    STOPPED = "stopped"
    """Latched: only an operator's reset and start move the cell again. The arm was brought to rest, or holds still
    where one of its own faults forbids to move it."""
    REFUSED = "refused"
    """The cell does not start."""
    RESTARTED = "restarted"
    """The process ends or is ended, and comes up STOPPED."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One row of the catalogue.

    Attributes:
        code: For alarms, logs and scripts.
        name: For people.
        detection: How it is noticed.
        action: What the cell does.
        remedy: What a person can do about it.
    """

    code: str
    name: str
    detection: str
    action: Action
    remedy: str


_A = Action
_LIGHT = "check the light, the lens cap and the camera's settings"
_REDO = "look why, then controller reset and start"

_ROWS: tuple[Fault, ...] = (
    # --- camera ---
    Fault("camera_lost", "camera unplugged", "the device gives no more frames or is gone", _A.HELD, "plug it in again"),
    Fault(
        "camera_stalled", "camera stalled", "no frame begun after the last motion before the deadline", _A.HELD,
        "check cable and USB hub",
    ),
    Fault("camera_failed", "camera failed", "it gives frames of another size or cannot be set up", _A.HELD,
          "see controller doctor"),
    Fault("picture_frozen", "frozen picture", "two looks equal to the bit", _A.HELD, "unplug it and plug it in again"),
    Fault("picture_torn", "truncated pictures", "every picture until the deadline lacks its lower part", _A.HELD,
          "check cable and USB hub"),
    Fault("picture_black", "black picture", "not a hundredth of the picture is lit", _A.HELD, _LIGHT),
    Fault("picture_overexposed", "overexposed picture", "most of the picture is clipped", _A.HELD, _LIGHT),
    Fault("picture_light", "light has changed", "brightness of the still scenery against the reference", _A.HELD,
          "restore the light, or calibrate again"),
    Fault("picture_soft", "blurred picture", "strength of the still scenery's edges", _A.HELD,
          "clean and focus the lens"),
    Fault("picture_moved", "camera was moved", "the still scenery has shifted by more than 2 px", _A.HELD,
          "put it back, or calibrate again"),
    Fault("picture_covered", "view covered", "little of the still scenery is to be seen", _A.HELD, "clear the view"),
    Fault("light_drifting", "light is changing", "brightness of the still scenery, halfway to where it is held for",
          _A.WARNED, "see what has changed; shade the cell or light it better"),
    Fault("pictures_damaged", "damaged pictures", "more than 5 % of the latest hundred lack their lower part, or "
          "cannot be decoded; each is passed over", _A.WARNED, "check cable and USB hub"),
    # --- parts ---
    Fault("part_unknown", "unknown or doubtful part", "low confidence, no rule, refused by localisation", _A.GOES_ON,
          "sort it by hand, or teach it"),
    Fault("grasp_missed", "missed pick", "the jaws settle at another width than was seen", _A.RETRIED,
          "look what lies there"),
    Fault("part_lost", "part lost on the way", "the jaws close further while it is carried", _A.RETRIED,
          "look for it on the table and the floor"),
    Fault("part_held", "part still held after placing", "the jaws, opened three times, stay at its width", _A.HELD,
          "take it out of the jaws, then controller resume"),
    Fault("bin_full", "bin full", "as many parts as it takes were put in, and more of its kind lie there",
          _A.SUSPENDED, "empty the bin, then controller bins emptied NAME"),
    Fault("intruder", "hand over the table", "something reaches into the view or is larger than any part", _A.HELD,
          "clear the table, then controller resume"),
    # --- arm ---
    Fault("bus_timeout", "servo does not answer", "five cycles in a row, or every retry of a read", _A.STOPPED,
          "check its cable and the 12 V supply; " + _REDO),
    Fault("bus_corrupt", "garbage on the bus", "CRC, length or ID of answers; never acted on, read again", _A.GOES_ON,
          "check cables and plugs when it is frequent"),
    Fault("bus_noisy", "many lost or damaged answers", "more than 1 % of the servos' latest answers", _A.WARNED,
          "check cables and plugs"),
    Fault("bus_lost", "bus adapter unplugged", "the port fails; the servos' watchdog has stopped them", _A.STOPPED,
          "plug it in; " + _REDO),
    Fault("bus_busy", "bus is used by another process", "exclusive access is refused", _A.REFUSED,
          "end the other program"),
    Fault("bus_refused", "servo missing, double or of another model", "inventory at start; refused writes", _A.REFUSED,
          "correct the IDs, or choose the right arm"),
    Fault("servo_overload", "servo overloaded", "Hardware_Error_Status bit 5", _A.STOPPED,
          "free the joint, let it cool for 20 minutes; " + _REDO),
    Fault("servo_shock", "electrical shock or weak supply of a motor", "Hardware_Error_Status bit 4", _A.STOPPED,
          "check the supply and its wiring; " + _REDO),
    Fault("servo_encoder", "servo lost its encoder", "Hardware_Error_Status bit 3", _A.STOPPED, "replace the servo"),
    Fault("servo_overheat", "servo too hot", "Hardware_Error_Status bit 2", _A.STOPPED,
          "let it cool for 20 minutes; " + _REDO),
    Fault("servo_undervoltage", "supply voltage out of range", "Hardware_Error_Status bit 0", _A.STOPPED,
          "check the 12 V supply, switch it off and on; " + _REDO),
    Fault("supply_low", "supply voltage low", "below 10.8 V at the servos; the arm moves at half its speed", _A.WARNED,
          "check the 12 V supply and its wiring"),
    Fault("servo_rebooted", "servo has restarted", "its RAM differs from what was written before every move",
          _A.STOPPED, "check the supply for interruptions; " + _REDO),
    Fault("motion_timeout", "joint blocked", "it strays from its path, or neither arrives nor stops", _A.STOPPED,
          "clear the way; " + _REDO),
    Fault("arm_failed", "arm failed", "the driver refuses", _A.STOPPED, _REDO),
    Fault("plan_refused", "no safe move", "limits, workspace or measured pose forbid it", _A.STOPPED, _REDO),
    # --- the machine it runs on ---
    Fault("ledger_unwritable", "record cannot be written", "a commit fails: disk full, read-only, failing", _A.HELD,
          "free some space, make the folder writable"),
    Fault("ledger_damaged", "record damaged", "quick_check when it is opened; set aside, a new one is begun",
          _A.GOES_ON, "keep the file set aside for whoever needs the counts"),
    Fault("power_lost", "power lost or process killed in a pick", "an intent without outcome when the record is opened",
          _A.RESTARTED, "look what the gripper holds; the part is on record as indeterminate"),
    Fault("loop_hung", "loop hung, computer too slow", "no sign of life for the supervisor; late cycles", _A.RESTARTED,
          "relieve the computer; controller bundle keeps the stacks"),
    Fault("clock_jumped", "date jumped", "compared with the clock that nobody sets, which is all that control uses; "
          "put on record", _A.GOES_ON, "none needed"),
    Fault("unclean_starts", "cut off three times in a row", "runs without end in the record", _A.STOPPED, _REDO),
    # --- what it is told ---
    Fault("config_invalid", "configuration wrong", "schema, ranges, unreachable bins; exit code 78", _A.REFUSED,
          "correct the line named"),
    Fault("calibration_missing", "not calibrated", "no calibration in the state folder", _A.REFUSED,
          "run controller calibrate"),
    Fault("calibration_stale", "foreign or old calibration", "it names other devices", _A.REFUSED,
          "run controller calibrate"),
    Fault("calibration_poor", "calibration not good enough", "residuals above the limits", _A.REFUSED,
          "run controller calibrate again"),
    Fault("cell_busy", "second instance", "the lock is held; exit code 75 and the holder's process", _A.REFUSED,
          "stop the other one"),
    Fault("internal_error", "failure in the program", "anything else; the arm is brought to rest first", _A.RESTARTED,
          "send a controller bundle"),
)  # fmt: skip

CATALOGUE: Mapping[str, Fault] = {row.code: row for row in _ROWS}


def table() -> str:
    """The catalogue as a Markdown table, for the README."""
    rows = [(f"`{row.code}`", row.name, row.detection, str(row.action), row.remedy) for row in _ROWS]
    cells = [("code", "fault", "noticed by", "the cell", "remedy"), ("---",) * 5, *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in cells)


_SERVO_BITS: tuple[tuple[int, str], ...] = (
    (0x20, "servo_overload"),
    (0x10, "servo_shock"),
    (0x08, "servo_encoder"),
    (0x04, "servo_overheat"),
    (0x01, "servo_undervoltage"),
)

# The first that fits: children before their parents.
_CODES: tuple[tuple[type[SorterError], str], ...] = (
    (CameraLost, "camera_lost"),
    (FrameStale, "camera_stalled"),
    (CameraError, "camera_failed"),
    (PartHeld, "part_held"),
    (Intruder, "intruder"),
    (MotionTimeout, "motion_timeout"),
    (ArmError, "arm_failed"),
    (LedgerError, "ledger_unwritable"),
    (CalibrationMissing, "calibration_missing"),
    (CalibrationStale, "calibration_stale"),
    (CalibrationError, "calibration_poor"),
    (ConfigError, "config_invalid"),
    (InstanceBusy, "cell_busy"),
    (PlanError, "plan_refused"),
    (SafetyStop, "unclean_starts"),
)


def fault_code(error: SorterError) -> str:
    """The code of the catalogue's row that a failure belongs to."""
    if isinstance(error, ServoFault):
        return next((code for bit, code in _SERVO_BITS if error.bits & bit), "servo_rebooted")
    if isinstance(error, BusError):
        if error.operation == "inventory" and error.code != "lost":
            return "bus_refused"  # somebody is not there, there twice, or another one
        return f"bus_{error.code}" if f"bus_{error.code}" in CATALOGUE else "arm_failed"
    if isinstance(error, PictureUnusable):
        return f"picture_{error.code}"
    return next((code for kind, code in _CODES if isinstance(error, kind)), "internal_error")


def remedy(error: SorterError) -> str:
    """What to do about a failure: its own words, or the catalogue's."""
    return error.remedy or CATALOGUE[fault_code(error)].remedy


_MOST_FAULTS = 1000
"""A report lists the latest; the ledger has all."""


class FaultRecord(Observer):
    """What was warned of, held or stopped a run, as its report lists it.

    Attributes:
        faults: `code`, `at_s` (since the work began), `action`, `cause`, and `lasted_s` once it is over.
    """

    def __init__(self) -> None:
        self.faults: list[dict[str, Any]] = []
        self._began: float | None = None

    def entered(self, state: State, at: float) -> None:
        """Remember when the work began."""
        self._began = at if self._began is None else self._began

    def held(self, cause: SorterError, at: float) -> None:
        """Note the hold."""
        self._add(cause, at, Action.HELD)

    def resumed(self, at: float) -> None:
        """Note how long it took."""
        for fault in self.faults:
            if fault["action"] == Action.HELD and "lasted_s" not in fault:
                fault["lasted_s"] = round(at - (self._began or 0.0) - fault["at_s"], 3)

    def faulted(self, error: SorterError, at: float) -> None:
        """Note the fault that latched."""
        self._add(error, at, Action.STOPPED)

    def warned(self, code: str, cause: str, at: float) -> None:
        """Note what was warned of."""
        at_s = round(at - (self._began or 0.0), 3)
        self._keep({"code": code, "at_s": at_s, "action": str(CATALOGUE[code].action), "cause": cause})

    def eased(self, code: str, at: float) -> None:
        """Note how long it lasted."""
        for fault in self.faults:
            if fault["code"] == code and "lasted_s" not in fault:
                fault["lasted_s"] = round(at - (self._began or 0.0) - fault["at_s"], 3)

    def _add(self, error: SorterError, at: float, action: Action) -> None:
        at_s = round(at - (self._began or 0.0), 3)
        self._keep({"code": fault_code(error), "at_s": at_s, "action": str(action), "cause": str(error)})

    def _keep(self, fault: dict[str, Any]) -> None:
        self.faults.append(fault)
        del self.faults[:-_MOST_FAULTS]


if __name__ == "__main__":
    print(table())
