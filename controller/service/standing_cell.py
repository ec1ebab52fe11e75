"""A real cell between start and end of its program: it sorts when an operator says so, as often as he says so.

What of the configuration can change while the cell runs is changed at a cycle boundary, whole or not at all.
"""

from __future__ import annotations

import itertools
import logging
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import timedelta
from typing import Any

from pydantic import BaseModel

from controller import __version__
from controller.backends import Devices
from controller.config.cell import CellConfig
from controller.cycle.preflight import check
from controller.cycle.rig import Rig
from controller.cycle.sorter import Sorter
from controller.domain import CellCalibration
from controller.errors import InputError, LedgerError, SafetyStop, SorterError
from controller.ledger.sqlite import NOT_RESET, SqliteLedger
from controller.motion.planner import Planner
from controller.service.chronicle import Calendar, Chronicle, Housekeeper, tell_what_was_found
from controller.service.controls import Refused
from controller.service.standing_service import Service
from controller.service.taught_classes import taught_classes
from controller.service.worker import Worker
from controller.vision.recipe import load_recipe

_log = logging.getLogger(__name__)

_UNCLEAN_RUNS = 3
"""Runs cut off in a row (killed, or without power) after which somebody must look before the next start."""

_WITH_A_RESTART = ("arm.description", "arm.port", "camera", "table.origin_in_base_mm", "table.yaw_deg", "table.board",
                   "ledger")  # fmt: skip
"""Keys that devices, calibration and record were opened with."""

PlannerFor = Callable[[CellConfig, CellCalibration], Planner]


@dataclass(frozen=True, slots=True)
class Standing:
    """What a standing cell needs besides its rig.

    Attributes:
        service: Service manager, supervisor and socket.
        devices: To be opened again after a fault of theirs.
        ledger: The record.
        chronicle: Told what operators ask for.
        reread: Reads the configuration again.
        planner_for: A planner by a configuration and a calibration.
        by_ruler: What is known without a calibration, for the check of a new configuration.
        say: Takes lines for people.
    """

    service: Service
    devices: Devices
    ledger: SqliteLedger
    chronicle: Chronicle
    reread: Callable[[], CellConfig]
    planner_for: PlannerFor
    by_ruler: Callable[[], CellCalibration]
    say: Callable[[str], None]


class StandingCell:
    """Sorts whenever an operator starts it, until it is to end.

    Args:
        rig: Devices, knowledge and rules.
        standing: What else it needs.
        missing: Why a device could not be opened: it comes up ABORTED, and a reset opens it again.

    Attributes:
        operation: What operators talk to.
    """

    def __init__(self, rig: Rig, standing: Standing, missing: SorterError | None = None) -> None:
        self._standing = standing
        self._missing = missing
        self._cut_off = _safe_mode(standing.ledger)
        self._lock = threading.Lock()
        self._sorter: Sorter | None = None
        self._filled: Counter[str] = Counter(standing.ledger.in_bins())
        self._reloader = Worker("reload", waiting=1)
        self.operation = standing.service.operation(
            rig.config,
            rig.calibration.calibration_id,
            reload=self._reload,
            emptied=self._emptied,
            view_clear=rig.clear_view.forget,
            cleared=self._cleared,
            recover=self._open_again,
        )
        section = rig.config.ledger
        keep = timedelta(days=section.keep_days)
        housekeeper = Housekeeper(standing.ledger, rig.clock, keep, section.most_mb << 20)
        self._rig = replace(rig, observers=(*rig.observers, self.operation, housekeeper, Calendar(standing.ledger)))

    def run(self, *, start: bool, most_parts: int | None) -> Sorter | None:
        """Serve operators until the end; the last sorter, if there was one. Moves metal when it is started.

        Args:
            start: Start at once, unless there is a fault to be reset first.
            most_parts: Stop after so many parts were dealt with; None for no limit.
        """
        service, operation, ledger = self._standing.service, self.operation, self._standing.ledger
        starts = itertools.count(1)
        try:
            with service.open_to_operators(operation, self._standing.chronicle.commanded):
                tell_what_was_found(ledger, operation.alarm_log)
                fault = self._missing or self._cut_off
                if fault is not None:
                    self._standing.chronicle.faulted(fault, self._rig.clock.now())
                operation.ready(fault=fault, may_hold_part=ledger.may_hold_part)
                service.notifier.ready(operation.line)
                if fault is not None:
                    self._standing.say(f"{operation.line}; nothing moves before a reset and a start")
                elif start:
                    with suppress(Refused):  # by an end that was asked for meanwhile
                        operation.start()
                else:
                    self._standing.say(f"{operation.line}; nothing moves: controller start begins to sort")
                while operation.wait_for_start(service.cycle.progress):
                    with self._lock:
                        sorter = self._sorter = Sorter(
                            self._rig,
                            most_parts=most_parts,
                            filled=self._filled,
                            target_prefix=f"start{next(starts)}-t",
                        )
                    operation.sort(sorter)
                    if most_parts is not None or (start and sorter.fault is not None):
                        break
                service.notifier.stopping("parked")
        finally:
            self._reloader.close(1.0)
            if self._cut_off is not None:
                with suppress(LedgerError):  # then it is one more that was cut off
                    ledger.end_run(NOT_RESET)
        return self._sorter

    def reload_soon(self) -> None:
        """Read the configuration again in a thread of its own; from any thread or a signal's handler."""
        self._reloader.offer(self._reload_for_manager, lambda: None)

    # --- what operators ask for -----------------------------------------------------------------------

    def _cleared(self) -> None:
        """Somebody has looked, and reset what was latched."""
        self._cut_off = None
        self._standing.chronicle.cleared()

    def _open_again(self) -> None:
        """Open the devices again after a reset; what is still wrong goes on record as a fault of its own.

        Raises:
            SorterError: A device cannot be opened.
        """
        try:
            self._standing.devices.reopen()
        except SorterError as error:
            self._standing.chronicle.faulted(error, self._rig.clock.now())
            raise

    def _reload_for_manager(self) -> None:
        notifier = self._standing.service.notifier
        notifier.reloading()
        try:
            changes = self._reload()
            _log.info("configuration read again: %s", "; ".join(changes) or "nothing has changed")
        except SorterError as error:
            _log.error("the old configuration stays: %s", error)
        finally:
            notifier.ready(self.operation.line)

    def _reload(self) -> tuple[str, ...]:
        """Read the configuration again; it holds from the next cycle on, and the old one stays if anything is wrong.

        Raises:
            SorterError: It is wrong, or cannot change without a restart.
        """
        new, old = self._standing.reread(), self._rig.config
        changes = differences(old, new)
        for change in changes:
            key = change.split(":")[0]
            if key.startswith(_WITH_A_RESTART):
                raise Refused(f"{key} cannot change while the cell runs", "stop it and start the program again")
        arm = self._standing.devices.arm.description
        for warning in check(new, arm, self._standing.planner_for(new, self._standing.by_ruler())):
            self._standing.say(f"warning: {warning}")
        recipe = load_recipe(new.vision.recipe)
        taught = taught_classes(new, recipe)
        rig = replace(
            self._rig,
            config=new,
            recipe=recipe,
            planner=self._standing.planner_for(new, self._rig.calibration),
            classes=taught,
        )
        self._standing.ledger.note(
            "configuration",
            rig.clock.now(),
            config_hash=new.digest,
            calibration_id=rig.calibration.calibration_id,
            software_version=__version__,
            classes=taught.digest if taught is not None else "",
            changes=list(changes),
        )
        with self._lock:
            self._rig = rig
            if self._sorter is not None:
                self._sorter.change(rig)
        self.operation.facts = replace(self.operation.facts, config=new.name, config_digest=new.digest)
        return changes

    def _emptied(self, name: str | None) -> None:
        known = [bin_.name for bin_ in self._rig.config.bins]
        if name is not None and name not in known:
            raise InputError(f"there is no bin {name!r}", f"bins: {', '.join(known)}")
        self._standing.ledger.note("emptied", self._rig.clock.now(), **({} if name is None else {"bin": name}))
        for emptied in known if name is None else [name]:
            self._filled[emptied] = 0


def differences(old: BaseModel, new: BaseModel) -> tuple[str, ...]:
    """What has changed from one configuration to another, one line a key: `arm.speed_percent: 100.0 -> 50.0`."""
    before, after = _flat(old.model_dump(mode="json")), _flat(new.model_dump(mode="json"))
    return tuple(
        f"{key}: {before.get(key, 'nothing')} -> {after.get(key, 'nothing')}"
        for key in sorted(before.keys() | after.keys())
        if before.get(key, "") != after.get(key, "")
    )


def _flat(value: Any, prefix: str = "") -> dict[str, Any]:
    """Tables and lists of tables as one level of dotted keys."""
    if isinstance(value, dict):
        items = [(f"{prefix}.{key}" if prefix else key, inner) for key, inner in value.items()]
    elif isinstance(value, list) and any(isinstance(inner, dict) for inner in value):
        items = [(f"{prefix}[{index}]", inner) for index, inner in enumerate(value)]
    else:
        return {prefix: value}
    return {key: inner for name, item in items for key, inner in _flat(item, name).items()}


def _safe_mode(ledger: SqliteLedger) -> SafetyStop | None:
    """Why the cell must be looked at before it may start, after it was cut off too often; or None."""
    if ledger.unclean_in_a_row < _UNCLEAN_RUNS:
        return None
    return SafetyStop(
        f"the last {ledger.unclean_in_a_row} runs were cut off", "find out why, then controller reset and start"
    )
