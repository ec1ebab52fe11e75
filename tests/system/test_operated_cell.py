"""A cell that operators start, pause and stop through its socket; the devices are simulated, the rest is real."""

from __future__ import annotations

import contextlib
import re
import shutil
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from controller.backends import DEVICES, BackendOptions, Devices, Level, Mode
from controller.config.cell import CellConfig, load_cell
from controller.config.files import shipped
from controller.cycle.rig import Observer
from controller.domain import ArmDescription, PickPlan
from controller.errors import BusError, InstanceBusy, MotionTimeout, SorterError
from controller.ledger.sqlite import SqliteLedger
from controller.ledger.view import LedgerView
from controller.service import session as session_module
from controller.service.client import ControlClient, NotRunning
from controller.service.lock import InstanceLock
from controller.service.session import RunOptions, Session
from drivers.arm.dynamixel import DynamixelArm
from sim_backends.virtual_clock import VirtualClock

PARTS = 2


class Meanwhile(Observer):
    """Lets something happen when the first part is about to be picked."""

    def __init__(self) -> None:
        self.at_first_attempt: Callable[[], object] = lambda: None

    def attempted(self, plan: PickPlan, attempt: int) -> None:
        act, self.at_first_attempt = self.at_first_attempt, lambda: None
        act()


class RunningCell:
    """A session in a thread of its own, and an operator at its socket."""

    def __init__(self, state: Path, calibration: Path, config: Path, *, start: bool = False) -> None:
        self.error: SorterError | None = None
        self.figures: dict[str, object] = {}
        self.config = config
        self.meanwhile = Meanwhile()
        options = RunOptions(
            Mode.REAL,
            load_cell(config),
            reread=lambda: load_cell(self.config),
            calibration=calibration,
            start=start,
            observers=(self.meanwhile,),
        )
        self.session = Session(options)
        self.operator = ControlClient(state)
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._run, name="cell")

    def __enter__(self) -> RunningCell:
        self._thread.start()
        self.wait_for("state", "STOPPED", "ABORTED")
        return self

    def __exit__(self, *unused: object) -> None:
        self.session.stop()
        self._thread.join(60.0)
        assert not self._thread.is_alive()

    def wait_for(self, key: str, *wanted: object) -> None:
        """Ask until the status says one of these."""
        tick = threading.Event()
        for _ in range(1200):
            with contextlib.suppress(NotRunning):
                if self.operator.ask("status")[key] in wanted:
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
def config(tmp_path: Path) -> Path:
    """The cell's configuration, to be changed."""
    return Path(shutil.copy(shipped("sim.toml"), tmp_path / "cell.toml"))


@pytest.fixture
def cell(config: Path, state: Path, calibration: Path, devices: list[Devices]) -> Iterator[RunningCell]:
    """A cell that is ready, STOPPED."""
    with RunningCell(state, calibration, config) as running:
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


def test_a_pause_in_mid_move_holds_there_and_resume_goes_on(
    cell: RunningCell, devices: list[Devices], monkeypatch: pytest.MonkeyPatch
) -> None:
    arm, truth, on_step = devices[0].arm, devices[0].truth, devices[0].on_step
    assert truth is not None
    assert on_step is not None
    follow, paused, left = arm.follow, threading.Event(), [0.0]

    def watched(trajectory, *more):  # type: ignore[no-untyped-def]
        if trajectory.name == "carry" and not paused.is_set():
            left[0] = 0.5 * trajectory.duration
        report = follow(trajectory, *more)
        left[0] = 0.0
        return report

    def halfway(step: float) -> None:
        if 0.0 < left[0] <= step and not paused.is_set():
            assert cell.operator.ask("pause")["state"] == "HOLDING"
            paused.set()
        left[0] -= step

    monkeypatch.setattr(arm, "follow", watched)
    on_step(halfway)
    cell.operator.ask("start")
    assert paused.wait(60.0)
    cell.wait_for("state", "HELD")
    status = cell.operator.ask("status")
    assert (status["cycle_state"], status["reason"]) == ("PLACE", "somebody has paused")
    stood = truth.tool()
    threading.Event().wait(0.05)
    # Held by its servos, a part in its jaws: no more than what is left of a swing.
    assert truth.tool() == pytest.approx(stood, abs=0.5)
    assert stood[2] > 30.0
    cell.operator.ask("resume")
    cell.wait_for("counts", {"placed": PARTS})


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


def test_after_the_adapter_was_unplugged_a_reset_opens_the_arm_again(
    cell: RunningCell, devices: list[Devices], monkeypatch: pytest.MonkeyPatch
) -> None:
    driver = devices[0].arm
    assert isinstance(driver, DynamixelArm)
    plugged_in = driver.bus.open

    def unplugged() -> None:
        raise BusError("adapter", "open", "lost", "there is no such port")

    follow = driver.follow

    def cut(trajectory, *more):  # type: ignore[no-untyped-def]
        if trajectory.name == "carry":
            monkeypatch.setattr(driver, "follow", follow)
            monkeypatch.setattr(driver.bus, "open", unplugged)
            driver.bus.close()
        return follow(trajectory, *more)

    monkeypatch.setattr(driver, "follow", cut)
    cell.operator.ask("start")
    cell.wait_for("state", "ABORTED")
    assert [alarm["code"] for alarm in cell.operator.ask("status")["alarms"]] == ["bus_lost"]
    # As long as it is not there again, a reset ends in the same fault.
    assert cell.operator.ask("reset")["state"] in ("RESETTING", "ABORTED")
    cell.wait_for("state", "ABORTED")
    monkeypatch.setattr(driver.bus, "open", plugged_in)
    before = devices[0].truth.tool() if devices[0].truth is not None else None
    cell.operator.ask("reset")
    cell.wait_for("state", "STOPPED")
    assert devices[0].truth is not None
    # Nothing has moved but what gravity does to an arm whose goals stand as they were.
    assert devices[0].truth.tool() == pytest.approx(before, abs=2.0)
    cell.operator.ask("start")
    cell.wait_for("state", "SUSPENDED")
    counts = cell.operator.ask("status")["counts"]
    assert counts.get("indeterminate") == 1
    assert counts["placed"] in (PARTS - 1, PARTS)  # the part that was in the jaws may have been let go where it is seen


@pytest.mark.safety("SR-04")
def test_a_running_cell_takes_a_new_configuration_over_between_two_parts(cell: RunningCell, state: Path) -> None:
    text = cell.config.read_text(encoding="utf-8")
    before = cell.operator.ask("status")["config_digest"]
    for wrong, says in (
        (text.replace('bin = "squares"', 'bin = "squarse"'), "did you mean squares"),
        (text.replace("width = 1280", "width = 640"), "camera.width cannot change while the cell runs"),
        (re.sub(r"center_mm = .*", "center_mm = [-190.0, 926.0]", text, count=1), "cannot be reached"),
        ("[", "not TOML"),
    ):
        cell.config.write_text(wrong, encoding="utf-8")
        with pytest.raises(SorterError, match=says):
            cell.operator.ask("reload")
        assert cell.operator.ask("status")["config_digest"] == before
    # Changed while it is at work on a part: that one still goes where it was meant to, the next to the other bin.
    new = text
    for bin_ in ("squares", "rectangles", "circles", "hexagons", "triangles"):
        new = new.replace(f'bin = "{bin_}"', 'bin = "rejects"')
    cell.config.write_text(new, encoding="utf-8")
    changes: list[str] = []
    cell.meanwhile.at_first_attempt = lambda: changes.extend(cell.operator.ask("reload"))
    cell.operator.ask("start")
    cell.wait_for("counts", {"placed": 1, "rejected": PARTS - 1})
    assert "sorting.rules[0].bin: squares -> rejects" in changes
    after = cell.operator.ask("status")["config_digest"]
    assert after != before
    # A hangup does the same, by itself.
    cell.config.write_text(text, encoding="utf-8")
    cell.session.reload()
    cell.wait_for("config_digest", before)
    cell.operator.ask("stop")
    cell.wait_for("state", "STOPPED")
    with LedgerView(state / "ledger.db") as ledger:
        noted = [event["details"] for event in ledger.rows("events") if event["kind"] == "configuration"]
    assert [note["config_hash"] for note in noted if isinstance(note, dict)] == [after, before]


def test_a_full_bin_suspends_its_parts_until_it_is_emptied_also_over_a_restart(
    config: Path, state: Path, calibration: Path, devices: list[Devices]
) -> None:
    config.write_text(config.read_text(encoding="utf-8").replace("capacity = 6", "capacity = 1"), encoding="utf-8")
    with RunningCell(state, calibration, config) as cell:
        cell.operator.ask("start")
        cell.wait_for("state", "SUSPENDED")
        assert cell.operator.ask("status")["counts"] == {"placed": PARTS}
        with pytest.raises(SorterError, match="there is no bin 'sqares'"):
            cell.operator.ask("emptied", bin="sqares")
    # Another program finds the bins as they were left: the same parts lie there again, and wait.
    with RunningCell(state, calibration, config) as cell:
        cell.operator.ask("start")
        cell.wait_for("state", "SUSPENDED")
        status = cell.operator.ask("status")
        assert (status["counts"], [alarm["code"] for alarm in status["alarms"]]) == ({}, ["bin_full"])
        cell.operator.ask("emptied")
        cell.wait_for("counts", {"placed": PARTS})
    with LedgerView(state / "ledger.db") as ledger:
        told = [event["details"] for event in ledger.rows("events") if event["kind"] == "operator"]
    commands = [one["command"] for one in told if isinstance(one, dict)]
    assert commands == ["start", "start", "emptied"]


@pytest.mark.safety("SR-07", "SR-22")
def test_three_runs_cut_off_in_a_row_end_in_safe_mode(
    config: Path, state: Path, calibration: Path, devices: list[Devices]
) -> None:
    for _ in range(3):
        with SqliteLedger(state / "ledger.db", clock=VirtualClock()) as ledger:
            ledger.begin_run(software_version="0", config_hash="0")
            ledger._run_id = None  # killed: nobody ends it
    # Neither is a start that is asked for together with the program a reset, nor is the program's end.
    with RunningCell(state, calibration, config, start=True) as cell:
        assert cell.operator.ask("status")["state"] == "ABORTED"
    with RunningCell(state, calibration, config) as cell:
        status = cell.operator.ask("status")
        assert (status["state"], status["alarms"][0]["code"]) == ("ABORTED", "unclean_starts")
        with pytest.raises(SorterError, match="the last 3 runs were cut off"):
            cell.operator.ask("start")
        assert cell.operator.ask("acknowledge") == 1
        assert cell.operator.ask("status")["state"] == "ABORTED"  # to acknowledge is not to reset
        assert cell.operator.ask("reset")["state"] == "STOPPED"
    assert cell.error is None
    (state / "report.json").unlink()
    (state / "report.json").mkdir()
    with RunningCell(state, calibration, config) as cell:
        assert cell.operator.ask("status")["state"] == "STOPPED"
    # A report that cannot be written takes nothing from what is known.
    assert "no report: Is a directory" in str(cell.error)
    assert cell.session.figures["sorted"] == 0


def test_an_end_that_is_asked_for_before_the_start_is_no_error(
    config: Path, state: Path, calibration: Path, devices: list[Devices]
) -> None:
    cell = RunningCell(state, calibration, config, start=True)
    cell.session.stop()
    cell._run()
    assert cell.error is None
    assert cell.figures["sorted"] == 0


def test_under_a_service_manager_a_missing_arm_is_an_alarm(
    config: Path,
    state: Path,
    calibration: Path,
    devices: list[Devices],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "nobody"))
    missing = BusError("/dev/sorter-arm", "open", "lost", "there is no such port", "plug the adapter in")
    opened = DynamixelArm.open

    def absent(arm: DynamixelArm, *, restart: bool = False) -> None:
        raise missing

    monkeypatch.setattr(DynamixelArm, "open", absent)
    with RunningCell(state, calibration, config) as cell:
        status = cell.operator.ask("status")
        assert (status["state"], status["alarms"][0]["code"]) == ("ABORTED", "bus_lost")
        cell.operator.ask("reset")  # too early: it is still unplugged
        cell.wait_for("state", "ABORTED")
        monkeypatch.setattr(DynamixelArm, "open", opened)
        cell.operator.ask("reset")
        cell.wait_for("state", "STOPPED")
        cell.operator.ask("start")
        cell.wait_for("counts", {"placed": PARTS})
    with LedgerView(state / "ledger.db") as ledger:
        doings = [event["details"]["doing"] for event in ledger.rows("events") if event["kind"] == "state"]
    assert doings[:5] == ["fault", "stopped", "fault", "stopped", "sorting"]
