"""A cell operated from outside: only a start from STOPPED begins anything, and a stop is never lost."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.cycle.machine import State
from controller.cycle.sorter import Sorter
from controller.errors import CameraLost, LedgerError, SafetyStop, SorterError
from controller.service.alarms import Alarm, AlarmLog
from controller.service.controls import Controls, Refused
from controller.service.operation import CellFacts, Operation, Work
from controller.service.packml import PackML
from controller.service.requests import CHANGING, READING

FACTS = CellFacts("real", "cell.toml", "c0ffee", "cell-1")


class PretendedWork:
    """Sorts nothing, until it is stopped.

    Attributes:
        running: Set while it sorts.
        told: What it was asked for.
    """

    def __init__(self, operation: Operation) -> None:
        self.fault: SorterError | None = None
        self.running = threading.Event()
        self.told: list[str] = []
        self.stands = False
        self._operation = operation
        self._over = threading.Event()

    def run(self) -> None:
        self._operation.entered(State.CAPTURE, 1.0)
        self.running.set()
        assert self._over.wait(20.0)
        self._operation.entered(State.STOPPED if self.fault is None else State.FAULT, 2.0)

    def request_stop(self) -> None:
        self.told.append("stop")
        self._over.set()

    def request_pause(self) -> None:
        self.told.append("pause")

    def resume(self) -> None:
        self.told.append("resume")

    @property
    def holds(self) -> bool:
        return self.stands

    def fail(self, error: SorterError) -> None:
        """Latch a fault, as the cycle does, and go on bringing the arm to rest."""
        self.fault = error
        self._operation.faulted(error, 2.0)

    def rest(self) -> None:
        self._over.set()


class Cell:
    """An operation and the main thread that serves it."""

    def __init__(self) -> None:
        self.said: list[str] = []
        self.beats = 0
        self.operation = Operation(FACTS, lambda: ("camera.width",), say=self.said.append)
        self.works: list[PretendedWork] = []
        self._begun = threading.Semaphore(0)
        self._rested = threading.Semaphore(0)
        self.thread = threading.Thread(target=self._serve)

    def _serve(self) -> None:
        while self.operation.wait_for_start(self._beat):
            work = PretendedWork(self.operation)
            self.works.append(work)
            self._begun.release()
            self.operation.sort(work)
            self._rested.release()

    def _beat(self) -> None:
        self.beats += 1

    def start(self) -> PretendedWork:
        self.operation.start()
        assert self._begun.acquire(timeout=20.0)
        work = self.works[-1]
        assert work.running.wait(20.0)
        return work

    def rested(self) -> None:
        assert self._rested.acquire(timeout=20.0)

    def shows(self) -> str:
        return str(self.operation.status().packml)


@contextmanager
def _served(prepare: Callable[[Cell], None]) -> Iterator[Cell]:
    cell = Cell()
    prepare(cell)
    cell.thread.start()
    try:
        yield cell
    finally:
        cell.operation.end()
        cell.thread.join(20.0)


@pytest.fixture
def cell() -> Iterator[Cell]:
    with _served(lambda cell: cell.operation.ready()) as serving:
        yield serving


def test_the_cycle_is_what_it_runs_and_the_control_socket_what_it_serves() -> None:
    # The type checker compares the signatures.
    works: list[type[Work]] = [Sorter, PretendedWork]
    served: type[Controls] = Operation
    for work in works:
        assert all(callable(getattr(work, name)) for name in ("run", "request_stop", "request_pause", "resume"))
    assert all(callable(getattr(served, name)) for name in (*CHANGING, *READING, "stop"))


@pytest.mark.safety("SR-01")
def test_nothing_starts_before_everything_is_ready() -> None:
    operation = Operation(FACTS, lambda: ())
    assert str(operation.status().packml) == "RESETTING"
    with pytest.raises(Refused, match="RESETTING"):
        operation.start()


def test_what_reaches_over_the_table_is_forgotten_only_by_a_start_that_is_granted() -> None:
    told: list[str] = []
    operation = Operation(FACTS, lambda: (), view_clear=lambda: told.append("clear"))
    with pytest.raises(Refused):
        operation.start(view_clear=True)
    operation.ready()
    assert told == []
    operation.start(view_clear=True)
    assert told == ["clear"]


def test_what_the_cell_holds_for_is_an_alarm_until_it_is_over(cell: Cell) -> None:
    cell.start()
    operation = cell.operation
    with pytest.raises(Refused):
        operation.resume()
    operation.entered(State.HELD, 2.0)
    operation.held(CameraLost("/dev/video0", "capture", "unplugged"), 2.0)
    (alarm,) = operation.alarms()
    assert (alarm.code, alarm.active) == ("camera_lost", True)
    assert alarm.remedy == "plug it in again"  # the catalogue's, where the failure has no words of its own
    assert "unplugged" in operation.status().reason
    operation.held(LedgerError("disk full"), 3.0)
    assert [(alarm.code, alarm.active) for alarm in operation.alarms()] == [
        ("camera_lost", False),
        ("ledger_unwritable", True),
    ]
    operation.resume()
    operation.resumed(4.0)
    assert not any(alarm.active for alarm in operation.alarms())
    operation.stop()
    cell.rested()


def test_a_start_a_pause_a_resume_and_a_stop(cell: Cell) -> None:
    assert cell.shows() == "STOPPED"
    work = cell.start()
    assert cell.shows() == "EXECUTE"
    cell.operation.pause()
    assert cell.shows() == "HOLDING"
    assert cell.said[-1] == "HOLDING: 0 placed"
    work.stands = True  # in the middle of a move
    assert cell.shows() == "HELD"
    assert cell.operation.status().reason == "somebody has paused"
    work.stands = False
    cell.operation.entered(State.HELD, 3.0)
    assert cell.shows() == "HELD"
    cell.operation.resume()
    assert cell.said[-1].startswith("HELD")  # until the cycle goes on
    cell.operation.stop()
    assert work.told == ["pause", "resume", "stop"]
    cell.rested()
    assert cell.shows() == "STOPPED"
    assert cell.said[0] == "STOPPED: 0 placed"
    assert cell.said[-1] == "STOPPED: 0 placed"


def test_it_can_be_started_again_and_only_once_at_a_time(cell: Cell) -> None:
    for _ in range(3):
        cell.start()
        with pytest.raises(Refused, match="EXECUTE"):
            cell.operation.start()
        cell.operation.stop()
        cell.rested()
    assert len(cell.works) == 3


@pytest.mark.parametrize("command", ["pause", "resume", "reset"])
def test_what_the_state_does_not_allow_is_refused(cell: Cell, command: str) -> None:
    with pytest.raises(Refused):
        getattr(cell.operation, command)()
    cell.operation.stop()
    assert cell.shows() == "STOPPED"


def test_the_state_is_said_when_it_changes_and_not_again(cell: Cell) -> None:
    work = cell.start()
    for state in (State.DETECT, State.LOCALIZE, State.PICK, State.IDLE, State.CAPTURE):
        cell.operation.entered(state, 1.0)
    assert cell.said[-3:] == [f"{state}: 0 placed" for state in ("EXECUTE", "SUSPENDED", "EXECUTE")]
    work.rest()


def test_a_stop_waits_for_nobody_who_reads_the_alarms() -> None:
    class SlowLog(AlarmLog):
        def open(self) -> tuple[Alarm, ...]:
            other = threading.Thread(target=operation.stop, daemon=True)
            other.start()
            other.join(10.0)
            stopped.append(not other.is_alive())
            return ()

    stopped: list[bool] = []
    operation = Operation(FACTS, lambda: (), alarms=SlowLog())
    operation.status()
    assert stopped == [True]


@pytest.mark.safety("SR-20")
def test_a_stop_between_a_start_and_its_work_is_not_lost() -> None:
    operation = Operation(FACTS, lambda: ())
    operation.ready()
    operation.start()
    operation.stop()
    assert operation.wait_for_start(lambda: None)
    work = PretendedWork(operation)
    operation.sort(work)
    assert not work.running.is_set()
    assert str(operation.status().packml) == "STOPPED"


@pytest.mark.safety("SR-01", "SR-22")
def test_a_fault_latches_until_it_is_reset_and_a_reset_starts_nothing(cell: Cell) -> None:
    work = cell.start()
    work.fail(SafetyStop("the elbow does not follow", "clear the way"))
    assert cell.shows() == "ABORTING"
    with pytest.raises(Refused, match="not at rest"):
        cell.operation.reset()
    work.rest()
    cell.rested()
    assert cell.shows() == "ABORTED"
    assert "elbow" in cell.operation.status().reason
    cell.operation.acknowledge(None)
    with pytest.raises(Refused, match="a fault is latched: the elbow does not follow"):
        cell.operation.start()
    cell.operation.reset()
    assert cell.shows() == "STOPPED"
    assert not cell.operation.alarms()[0].active
    assert len(cell.works) == 1
    cell.start()


@pytest.mark.safety("SR-22")
def test_the_first_fault_is_the_one_that_is_shown(cell: Cell) -> None:
    work = cell.start()
    work.fail(SafetyStop("first"))
    cell.operation.faulted(SorterError("second"), 3.0)
    assert cell.operation.status().reason == "first"
    assert [alarm.first_out for alarm in cell.operation.alarms()] == [True, False]
    work.rest()
    cell.rested()


@pytest.mark.safety("SR-07")
def test_a_cell_that_must_be_looked_at_comes_up_aborted() -> None:
    fault = SafetyStop("three unclean starts", "look at the cell")
    with _served(lambda cell: cell.operation.ready(fault=fault, may_hold_part=True)) as cell:
        assert cell.shows() == "ABORTED"
        assert cell.operation.status().may_hold_part
        with pytest.raises(Refused, match="three unclean starts"):
            cell.operation.start()
        cell.operation.reset()
        assert not cell.operation.status().may_hold_part
        cell.start()


def test_the_end_stops_the_work_and_the_waiting(cell: Cell) -> None:
    work = cell.start()
    cell.operation.end()
    cell.thread.join(20.0)
    assert not cell.thread.is_alive()
    assert work.told == ["stop"]
    with pytest.raises(Refused):
        cell.operation.start()


def test_the_end_may_come_from_a_signal_in_the_waiting_thread() -> None:
    operation = Operation(FACTS, lambda: ())
    operation.ready()
    # As a signal's handler would: in the thread that waits, while it holds the lock.
    assert operation.wait_for_start(operation.end) is False


COMMANDS = ("start", "pause", "resume", "stop", "reset", "fault", "rest", "turn", "acknowledge")


@given(st.lists(st.sampled_from(COMMANDS), max_size=40))
@pytest.mark.safety("SR-01")
def test_whatever_is_asked_nothing_moves_without_a_start_that_was_granted(commands: list[str]) -> None:
    """Commands come while the cell waits and while it works; a model keeps what must be true."""
    operation = Operation(FACTS, lambda: ())
    operation.ready()
    queue = iter(commands)
    granted = [0]
    latched = [False]

    def obey(command: str) -> None:
        try:
            if command == "fault":
                operation.faulted(SafetyStop("stuck"), 0.0)
                latched[0] = True
            elif command == "acknowledge":
                operation.acknowledge(None)
            else:
                getattr(operation, command)()
        except Refused:
            return
        if command == "start":
            assert not latched[0]
            granted[0] += 1
        elif command == "reset":
            latched[0] = False

    class Inline(PretendedWork):
        """Works through the commands that come while it is at work."""

        def run(self) -> None:
            # This is where metal would begin to move.
            assert granted[0] == 1
            assert not latched[0]
            operation.entered(State.PICK, 0.0)
            for command in queue:
                if command == "rest":
                    break
                if command == "fault":
                    self.fault = SafetyStop("stuck")
                if command != "turn":
                    obey(command)
                if self.told[-1:] == ["stop"] or self.fault is not None:
                    break
                assert operation.status().packml in (PackML.EXECUTE, PackML.HOLDING)

    for command in queue:
        if command not in ("turn", "rest"):
            obey(command)
        elif granted[0]:
            assert operation.wait_for_start(lambda: None)
            operation.sort(Inline(operation))
            granted[0] = 0
        expected = PackML.ABORTED if latched[0] else PackML.STOPPED
        shown = operation.status().packml
        assert shown is expected or granted[0]
