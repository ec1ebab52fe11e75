"""`controller run`: sort, on the real cell, in simulation, or over recorded pictures."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from controller.backends import Level, Mode
from controller.cli.classes import ClassesFolder, with_classes
from controller.cli.config import default_config, taught_file
from controller.cli.interrupts import ends_question, exit_code, on_hangup, on_interrupt
from controller.cli.output import stderr, stdout
from controller.cli.progress import Progress
from controller.config.cell import CellConfig, load_cell
from controller.config.taught import with_taught
from controller.cycle.rehearsal import Rehearsal
from controller.cycle.rig import Observer
from controller.domain import PickPlan
from controller.errors import ConfigError
from controller.insight.film import Film
from controller.insight.report import rows
from controller.service.journal import CycleLog, goes_to_journal, logging_to_its_place
from controller.service.session import RunOptions, Session

_log = logging.getLogger(__name__)


def run(
    config: Annotated[Path | None, typer.Option(metavar="FILE", help="The cell's TOML file.")] = None,
    sim: Annotated[bool, typer.Option("--sim", help="The simulated cell: no hardware is touched.")] = False,
    replay: Annotated[Path | None, typer.Option(metavar="DIR", help="Pictures from DIR, an arm that records.")] = None,
    start: Annotated[bool, typer.Option("--start", help="Real cell: sort at once instead of waiting STOPPED.")] = False,
    parts: Annotated[int | None, typer.Option(min=1, max=200, help="Parts on the simulated table.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the simulated world.")] = 0,
    level: Annotated[Level, typer.Option(help="How imperfect the simulated world is.")] = Level.DYNAMIC,
    arm: Annotated[str | None, typer.Option(metavar="NAME", help="Another arm than the configuration's.")] = None,
    calibration: Annotated[Path | None, typer.Option(metavar="DIR", help="Use this calibration.")] = None,
    speed: Annotated[float | None, typer.Option(metavar="PERCENT", min=5, max=100, help="Arm speed.")] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="One look; say and write down what the arm would do. It has no torque.")
    ] = False,
    air_run: Annotated[
        bool, typer.Option("--air-run", help="One look; the arm passes above the parts at 25 % speed, its jaws still.")
    ] = False,
    bins: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Taught bins (real cell: bins.toml in the state folder)."),
    ] = None,
    classes: ClassesFolder = None,
    step: Annotated[bool, typer.Option("--step", help="Ask before every pick.")] = False,
    real_time: Annotated[
        bool, typer.Option("--real-time", help="Simulation: world in its own process, bus on a pseudo-terminal.")
    ] = False,
    faults: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Simulation: a script of what goes wrong; see configs/faults.")
    ] = None,
    disturb: Annotated[
        str, typer.Option(metavar="KINDS", help="Simulation: slip, knock, remove, add, move, swap, hand, or all.")
    ] = "",
    video: Annotated[Path | None, typer.Option(metavar="FILE", help="Simulation: film the run into FILE.mp4.")] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="New folder for the record and the report.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="The figures as one JSON line on stdout.")] = False,
) -> int:
    """Sort what lies on the table.

    Examples: controller run --sim --parts 8 --seed 7 | controller run --replay photos --config cell.toml |
    controller run --config cell.toml --start | controller run --config cell.toml --dry-run

    --sim without --calibration first calibrates its own cell: 50 s of simulated, 5 s of processor time. It makes no
    certificate, for the touch test would double that, and the report compares the run with the world's truth anyway.
    To sort under one: controller calibrate arm --sim --seed 7 --calibration cal, controller calibrate check with the
    same options, controller run with them.

    Ctrl-C stops the arm along its path, parks it and lets go of the torque.
    """
    mode = _mode(sim, replay, real_time)
    if video is not None and (mode is not Mode.SIM or real_time):
        raise typer.BadParameter("--video belongs to --sim, without --real-time")
    if disturb and mode is not Mode.SIM:
        raise typer.BadParameter("--disturb belongs to --sim")
    if faults is not None and mode is not Mode.SIM:
        raise typer.BadParameter("--faults belongs to --sim")
    rehearsal = _rehearsal(mode, dry_run, air_run)
    taught = taught_file(bins, sim=mode is not Mode.REAL)

    def read() -> CellConfig:
        cell = with_classes(_cell(config, mode, arm, speed), classes)
        return cell if taught is None else with_taught(cell, taught)

    # The journal gets records with fields; a person gets the progress, and log lines only for what is beside it.
    structured = goes_to_journal()
    cycle_log = CycleLog(aloud=structured)
    rehearsed = rehearsal is not Rehearsal.NONE
    progress = Progress(Console(quiet=True) if structured else stderr(), rehearsal=rehearsed)
    say = _log.info if structured else progress.say
    film = Film(video) if video is not None else None
    session = Session(
        RunOptions(
            mode=mode,
            config=read(),
            reread=read,
            out=out,
            replay=replay,
            calibration=calibration,
            parts=parts,
            seed=seed,
            level=level,
            real_time=real_time,
            start=start,
            rehearsal=rehearsal,
            faults=faults,
            disturb=disturb,
            observers=(cycle_log, progress, *([_Intentions(say)] if rehearsed else [])),
            watch=film.watch if film is not None else lambda devices: (),
            confirm=partial(_ask, progress) if step else lambda plan: True,
            say=say,
        )
    )
    stopping = on_interrupt(session.stop, "stopping: the arm parks; once more gives up waiting")
    reloading = on_hangup(session.reload, session.stop) if mode is Mode.REAL else nullcontext()
    with logging_to_its_place(cycle_log), stopping as received, reloading, progress, film or nullcontext():
        try:
            session.run()
        finally:
            # A fault takes nothing from what was sorted before it.
            _tell(session.figures, as_json)
    return exit_code(received)


def _tell(figures: dict[str, Any], as_json: bool) -> None:
    if not figures:
        return
    if as_json:
        print(json.dumps(figures))
    else:
        _table(figures)


def _mode(sim: bool, replay: Path | None, real_time: bool) -> Mode:
    if sim and replay is not None:
        raise typer.BadParameter("--sim and --replay exclude each other")
    if real_time and not sim:
        raise typer.BadParameter("--real-time belongs to --sim")
    return Mode.SIM if sim else Mode.REPLAY if replay is not None else Mode.REAL


def _rehearsal(mode: Mode, dry_run: bool, air_run: bool) -> Rehearsal:
    if dry_run and air_run:
        raise typer.BadParameter("--dry-run and --air-run exclude each other")
    if mode is Mode.REPLAY and (dry_run or air_run):
        raise typer.BadParameter("--replay moves no arm anyway")
    return Rehearsal.DRY if dry_run else Rehearsal.AIR if air_run else Rehearsal.NONE


def _cell(config: Path | None, mode: Mode, arm: str | None, speed: float | None) -> CellConfig:
    if config is None and mode is Mode.REAL:
        raise ConfigError(
            "a real cell needs its configuration", "name it with --config FILE, or try the simulation with --sim"
        )
    cell = load_cell(config or default_config(arm))
    changes: dict[str, Any] = {}
    if arm is not None:
        changes["description"] = arm
    if speed is not None:
        changes["speed_percent"] = speed
    return cell.model_copy(update={"arm": cell.arm.model_copy(update=changes)}) if changes else cell


def _ask(progress: Progress, plan: PickPlan) -> bool:
    with progress.away(), ends_question():
        return typer.confirm(f"pick the {_what(plan)} into {plan.bin.name}?", default=True, err=True)


def _what(plan: PickPlan) -> str:
    target = plan.target
    return f"{target.detection.label or target.shape} at {target.center[0]:.0f}, {target.center[1]:.0f} mm"


class _Intentions(Observer):
    """Says before every pick what is about to be done."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say

    def planned(self, plan: PickPlan) -> None:
        """One line a pick."""
        grasp, seconds = plan.grasp, sum(move.duration for move in plan.trajectories)
        self._say(
            f"would take the {_what(plan)} into {plan.bin.name}: jaws {grasp.opening:.0f} mm along "
            f"{math.degrees(grasp.direction):.0f} deg, {seconds:.1f} s"
        )


def _table(figures: dict[str, Any]) -> None:
    grid = Table(box=None, show_header=False, pad_edge=False)
    for name, value in rows(figures):
        grid.add_row(name, value)
    console = stdout()
    console.print(grid)
    if figures.get("correct") is not None:
        console.print(f"{figures['correct']} of {figures['parts']} parts lie in the right bin.")
    if "rehearsal" in figures:
        console.print("A rehearsal: nothing was picked, the figures say what the cell meant to do.")
    console.print(f"Report, pictures and ledger: {figures['out']}")


def add_to(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command("run")(run)
