"""The catalogue: every failure has a row, every row says what is noticed, done and to be done."""

from __future__ import annotations

import inspect
from pathlib import Path

import pytest

from controller import errors
from controller.cycle.machine import State
from controller.errors import BusError, CameraLost, PictureUnusable, SafetyStop, ServoFault, SorterError
from controller.service.faults import CATALOGUE, FaultRecord, fault_code, remedy, table
from controller.vision.scenery import Change, trouble
from drivers.arm.control_table import HARDWARE_ERRORS

CONCRETE = [
    error
    for _, error in inspect.getmembers(errors, inspect.isclass)
    if issubclass(error, SorterError) and error not in (BusError, ServoFault, PictureUnusable)
]


def make(kind: type[SorterError]) -> SorterError:
    arguments = inspect.signature(kind).parameters
    return kind(*["x"] * sum(p.default is inspect.Parameter.empty for p in arguments.values()))


@pytest.mark.parametrize("kind", CONCRETE)
def test_every_failure_belongs_to_a_row(kind: type[SorterError]) -> None:
    assert fault_code(make(kind)) in CATALOGUE


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (SafetyStop("look"), "unclean_starts"),
        (BusError("b", "read", "timeout", "no answer"), "bus_timeout"),
        (BusError("b", "read", "lost", "gone"), "bus_lost"),
        (CameraLost("c", "read", "gone"), "camera_lost"),
        (ServoFault("s", "read", "elbow", 0x20, "overload"), "servo_overload"),
        (ServoFault("s", "read", "elbow", 0x24, "overload, hot"), "servo_overload"),
        (ServoFault("s", "check", "elbow", 0, "has restarted"), "servo_rebooted"),
        (PictureUnusable("c", "look", "frozen", "the same"), "picture_frozen"),
    ],
)
def test_failures_have_the_codes_of_their_rows(error: SorterError, code: str) -> None:
    assert fault_code(error) == code
    assert CATALOGUE[code].code == code


@pytest.mark.parametrize(
    "change", [Change(9, 1, 1, 1), Change(0, 0.1, 1, 1), Change(0, 1, 0.2, 1), Change(0, 1, 1, 0.1)]
)
def test_every_trouble_with_the_scenery_has_a_row(change: Change) -> None:
    found = trouble(change)
    assert found is not None
    assert fault_code(PictureUnusable("c", "look", *found)) in CATALOGUE


def test_rows_are_complete_and_remedies_never_missing() -> None:
    for row in CATALOGUE.values():
        assert all((row.name, row.detection, row.remedy))
    assert remedy(CameraLost("c", "read", "gone")) == CATALOGUE["camera_lost"].remedy
    assert remedy(CameraLost("c", "read", "gone", "buy one")) == "buy one"


def test_a_record_tells_when_and_how_long() -> None:
    record = FaultRecord()
    record.entered(State.HOMING, 100.0)
    record.held(CameraLost("c", "read", "gone"), 103.0)
    record.resumed(110.5)
    record.faulted(BusError("b", "read", "timeout", "no answer"), 120.0)
    assert [(f["code"], f["at_s"], f["action"], f.get("lasted_s")) for f in record.faults] == [
        ("camera_lost", 3.0, "held", 7.5),
        ("bus_timeout", 20.0, "stopped", None),
    ]


@pytest.mark.parametrize("bit", HARDWARE_ERRORS)
def test_every_bit_a_servo_can_raise_has_a_row_of_its_own(bit: int) -> None:
    assert fault_code(ServoFault("s", "read", "elbow", 1 << bit, "x")) in set(CATALOGUE) - {"servo_rebooted"}


def test_the_readme_has_the_catalogue() -> None:
    readme = (Path(__file__).resolve().parents[3] / "README.md").read_text(encoding="utf-8")
    assert table() in readme, "stale: replace the table by the output of python -m controller.service.faults"
