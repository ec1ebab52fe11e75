"""A few fields of the fault matrix, a few kills, half a minute of soaking, scripts of faults, and a full disk.

The whole matrix is `tests.benchmarks.fault_matrix`, the kills `tests.benchmarks.kills`.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from controller.config.files import shipped
from controller.cycle.machine import State
from controller.errors import ConfigError, LedgerError
from controller.ledger.sqlite import SqliteLedger
from controller.service.faults import CATALOGUE
from sim_backends.fault_script import FAULTS, load_script
from sim_backends.virtual_clock import VirtualClock
from tests.benchmarks.fault_matrix.__main__ import fields
from tests.benchmarks.fault_matrix.cases import CASES
from tests.benchmarks.kills import run as run_kills
from tests.benchmarks.open_cell import SEED, OpenCell, apart
from tests.benchmarks.soak.__main__ import run as soak


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[OpenCell]:
    """The matrix's cell."""
    made = OpenCell.make(tmp_path_factory.mktemp("cell"))
    yield made
    made.devices.close()


@pytest.mark.safety("SR-23", "SR-41")
def test_faults_end_as_the_catalogue_says(cell: OpenCell, tmp_path: Path) -> None:
    some = (
        ("camera_lost", "CAPTURE"),
        ("ledger_unwritable", "PLACE"),
        ("bus_timeout", "PLACE"),
        ("servo_overload", "PICK"),
        ("internal_error", "PLACE"),
        ("camera_lost", "FAULT"),
        ("bus_refused", "START, missing"),
        ("config_invalid", "START, five ways"),
        ("power_lost", "after_intend"),
    )
    jobs = [partial(fields()[field], cell, tmp_path / str(number)) for number, field in enumerate(some)]
    ends = {some[number]: found and found.complaints for number, found in apart(jobs)}
    assert ends == {field: [] for field in some}


@pytest.mark.safety("SR-41")
def test_kills_lose_nothing_and_double_nothing(cell: OpenCell, tmp_path: Path) -> None:
    verdicts = list(run_kills(2, 3, tmp_path, calibration=cell.calibration))
    assert [complaint for verdict in verdicts for complaint in verdict.complaints] == []


def test_a_minute_with_faults_and_disturbances_leaves_every_part_accounted_for(
    cell: OpenCell, tmp_path: Path
) -> None:
    # Hours of it are `python -m tests.benchmarks.soak`. Two parts: a table is laid anew between faults and hands.
    found = soak(
        0.022, SEED, 2, faults_an_hour=300.0, disturbances_an_hour=300.0, folder=tmp_path, calibration=cell.calibration
    )
    assert found.complaints == []
    assert found.supplies > 0
    assert found.results["placed"] > 0
    assert found.faults


def test_every_fault_is_in_the_matrix_in_every_state_in_which_it_can_strike() -> None:
    assert set(CATALOGUE) >= FAULTS
    covered: dict[str, set[str]] = {}
    for fault, state in fields():
        covered.setdefault(fault, set()).add(state.split(", ")[0])
    assert set(covered) == set(CATALOGUE)
    working = {state.value for state in State} - {"STOPPED", "FAULT"}
    for fault in FAULTS:
        missing = working | {"STOPPED", "FAULT"}
        if fault == "power_lost":  # a process that dies at rest leaves nothing open
            missing -= {"STOPPED", "FAULT"}
        elif CASES[fault].compares:  # what is noticed beside an earlier picture needs one
            missing -= {"HOMING", "STOPPED"}
        assert missing <= covered[fault], fault


@pytest.mark.parametrize("path", sorted(shipped("sim.toml").parent.glob("faults/*.toml")), ids=lambda path: path.stem)
def test_the_shipped_scripts_can_be_read(path: Path) -> None:
    assert load_script(path)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('[[fault]]\nfault = "camera_lots"\nat_s = 1', "camera_lots"),
        ('[[fault]]\nfault = "camera_lost"', "when is not clear"),
        ('[[fault]]\nfault = "camera_lost"\nat_s = 1\non = { state = "PICK" }', "when is not clear"),
        ('[[fault]]\nfault = "camera_lost"\non = { state = "PIKC" }', "PIKC"),
        ('[[fault]]\nfault = "camera_lost"\nat_s = -1', "at_s is -1"),
        ('[[fault]]\nfault = "camera_lost"\nat = 1', "unknown key 'at'"),
        ("[fault]", "something else"),
        ("[[fault", "Expected"),
    ],
)
@pytest.mark.safety("SR-43")
def test_a_wrong_script_is_refused_with_its_place(text: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "faults.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=says):
        load_script(path)


def test_a_ledger_goes_on_when_the_disk_has_space_again(tmp_path: Path) -> None:
    with SqliteLedger(tmp_path / "ledger.db", clock=VirtualClock()) as ledger:
        ledger.begin_run(software_version="x", config_hash="x")
        pages = ledger._connection.execute("PRAGMA page_count").fetchone()[0]
        ledger._connection.execute(f"PRAGMA max_page_count = {pages}")
        written = 0

        def fill() -> None:
            nonlocal written
            while written < 10_000:
                ledger.note("filler", 0.0, text="x" * 400)
                written += 1

        with pytest.raises(LedgerError, match=r"full.*free some space"):
            fill()
        ledger._connection.execute("PRAGMA max_page_count = 1000000")
        ledger.note("after", 1.0)
        assert ledger.verify() == ()
    with sqlite3.connect(tmp_path / "ledger.db") as connection:
        kinds = [kind for (kind,) in connection.execute("SELECT kind FROM events ORDER BY rowid")]
    assert kinds == ["filler"] * written + ["after"]
