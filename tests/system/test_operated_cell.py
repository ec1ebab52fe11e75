"""A cell that operators start, pause and stop through its socket; the devices are simulated, the rest is real."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from controller.backends import DEVICES, BackendOptions, Devices, Level, Mode
from controller.config.cell import CellConfig, load_cell
from controller.config.files import shipped
from controller.domain import ArmDescription
from controller.errors import InstanceBusy, MotionTimeout, SorterError
from controller.ledger.view import LedgerView
from controller.service import session as session_module
from controller.service.client import ControlClient, NotRunning
from controller.service.lock import InstanceLock
from controller.service.session import RunOptions, Session
from tests.benchmarks.cell_vision import look_at_cell

PARTS = 2


class RunningCell:
    """A session in a thread of its own, and an operator at its socket."""

    def __init__(self, state: Path, calibration: Path) -> None:
        self.error: SorterError | None = None
        self.figures: dict[str, object] = {}
        options = RunOptions(Mode.REAL, load_cell(shipped("sim.toml")), calibration=calibration)
        self.session = Session(options)
        self.operator = ControlClient(state)
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._run, name="cell")

    def __enter__(self) -> RunningCell:
        self._thread.start()
        self.wait_for("state", "STOPPED")
        return self

    def __exit__(self, *unused: object) -> None:
        self.session.stop()
        self._thread.join(60.0)
        assert not self._thread.is_alive()

    def wait_for(self, key: str, wanted: object) -> None:
        """Ask until the status says so."""
        tick = threading.Event()
        for _ in range(1200):
            with contextlib.suppress(NotRunning):
                if self.operator.ask("status")[key] == wanted:
                    return
            assert self._thread.is_alive(), self.error
            tick.wait(0.05)
        raise AssertionError(f"{key} never became {wanted}: {self.operator.ask('status')}")

    def _run(self) -> None:
        try:
            self.figures = self.session.run()
        except SorterError as error:
            self.error = error


@pytest.fixture
def devices(monkeypatch: pytest.MonkeyPatch) -> list[Devices]:
    """The simulated devices that stand in for the real ones, once they are made."""
    made: list[Devices] = []

    def simulated(config: CellConfig, arm: ArmDescription, options: BackendOptions) -> Devices:
        options = BackendOptions(options.out, parts=PARTS, seed=7, level=Level.STATIC)
        made.append(DEVICES[Mode.SIM](config, arm, options))
        made[-1].presenter = None
        return made[-1]

    monkeypatch.setattr(session_module, "DEVICES", {Mode.REAL: simulated})
    return made


@pytest.fixture
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The state folder."""
    folder = tmp_path / "state"
    monkeypatch.setenv("STATE_DIRECTORY", str(folder))
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    return folder


@pytest.fixture
def cell(tmp_path: Path, state: Path, devices: list[Devices]) -> Iterator[RunningCell]:
    """A cell that is ready, STOPPED."""
    look_at_cell(7, PARTS, "static", tmp_path)
    with RunningCell(state, tmp_path / "calibration") as running:
        yield running


@pytest.mark.safety("SR-01")
def test_a_cell_comes_up_stopped_and_moves_only_when_it_is_started(
    cell: RunningCell, devices: list[Devices], state: Path
) -> None:
    with pytest.raises(InstanceBusy), InstanceLock(state):
        pass
    before = devices[0].arm.state().positions.copy()
    assert (devices[0].arm.state().positions == before).all()
    cell.operator.ask("start")
    cell.wait_for("counts", {"placed": PARTS})
    cell.operator.ask("pause")
    cell.wait_for("state", "HELD")
    cell.operator.ask("resume")
    cell.wait_for("state", "SUSPENDED")
    cell.operator.ask("stop")
    cell.wait_for("state", "STOPPED")
    cell.operator.ask("start")
    cell.wait_for("state", "SUSPENDED")
    cell.session.stop()
    cell._thread.join(60.0)
    assert cell.error is None
    assert cell.figures["sorted"] == PARTS
    with LedgerView(state / "ledger.db") as ledger:
        assert ledger.verify() == ()
        assert [run["end_reason"] for run in ledger.rows("runs")] == ["stopped"]


@pytest.mark.safety("SR-22")
def test_a_fault_latches_until_it_is_reset(
    cell: RunningCell, devices: list[Devices], monkeypatch: pytest.MonkeyPatch
) -> None:
    arm = devices[0].arm
    follow, left = arm.follow, [1]

    def stuck(trajectory, *more):  # type: ignore[no-untyped-def]
        if trajectory.name == "approach" and left:
            left.pop()
            raise MotionTimeout("arm", "follow", "the elbow does not move")
        return follow(trajectory, *more)

    monkeypatch.setattr(arm, "follow", stuck)
    cell.operator.ask("start")
    cell.wait_for("state", "ABORTED")
    with pytest.raises(SorterError, match="latched"):
        cell.operator.ask("start")
    cell.operator.ask("reset")
    cell.wait_for("state", "STOPPED")
    cell.operator.ask("start")
    cell.wait_for("counts", {"indeterminate": 1, "placed": PARTS})
