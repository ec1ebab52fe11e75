"""All checks, in the order in which one would mend things."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from controller.config.arm import load_arm
from controller.config.cell import load_cell
from controller.errors import SorterError
from controller.service.doctor import cell, devices, host, software
from controller.service.doctor.case import Case
from controller.service.doctor.finding import Finding, Level, counted, failed, ok, warning
from controller.service.folders import not_permitted
from controller.vision.recipe import load_recipe

Check = Callable[[Case], Finding | list[Finding] | None]

_ALWAYS: dict[str, Check] = {
    "python": software.python,
    "libraries": software.libraries,
    "sqlite": software.sqlite,
    "unit": software.exposure,
    "service": software.service,
    "disk": host.disk,
    "clock": host.clock,
    "supply": host.supply,
    "instance": cell.instance,
    "ledger": cell.ledger,
}
_OF_A_CELL: dict[str, Check] = {"bins": cell.bins, "devices": devices.opened}
_OF_A_REAL_CELL: dict[str, Check] = {
    "calibration": cell.calibration,
    "device files": devices.nodes,
    "latency timer": devices.latency,
}


def examine(case: Case) -> list[Finding]:
    """Make every check that the case allows; blocks for some seconds when devices are opened."""
    findings = _made(_ALWAYS, case)
    verdict, case = _configuration(case)
    findings.append(verdict)
    if case.cell is not None and case.arm is not None:
        findings += _made(_OF_A_CELL if case.simulated else _OF_A_REAL_CELL | _OF_A_CELL, case)
    return findings


def worst(findings: list[Finding]) -> Level:
    """The level of the worst finding."""
    order = list(Level)
    return max((finding.level for finding in findings), key=order.index, default=Level.OK)


def _configuration(case: Case) -> tuple[Finding, Case]:
    """The configuration can be read; and the case with what it says."""
    name = "configuration"
    if case.config is None:
        remedy = "name it: controller doctor --config FILE"
        return warning(name, "none was named: calibration and devices were not looked at", remedy), case
    try:
        found = load_cell(case.config)
        arm = load_arm(found.arm.description)
        load_recipe(found.vision.recipe)
    except SorterError as error:
        return failed(name, error.cause, error.remedy), case
    size = f"{counted(len(found.bins), 'bin')}, {counted(len(found.sorting.rules), 'rule')}"
    text = f"{case.config}: {arm.title}, {size}"
    return ok(name, text), dataclasses.replace(case, cell=found, arm=arm)


def _made(checks: dict[str, Check], case: Case) -> list[Finding]:
    findings: list[Finding] = []
    for name, check in checks.items():
        try:
            found = check(case)
        except SorterError as error:
            found = failed(name, error.cause, error.remedy)
        except PermissionError as error:
            denied = not_permitted(error)
            found = failed(name, denied.cause, denied.remedy)
        except Exception as error:  # one check that goes wrong must not keep the others from being made
            found = failed(name, f"could not be examined: {type(error).__name__}: {error}", "please report this")
        findings += found if isinstance(found, list) else [] if found is None else [found]
    return findings
