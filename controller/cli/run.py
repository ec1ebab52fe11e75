"""`controller run`: sort, on the real cell, in simulation, or over recorded pictures."""

from __future__ import annotations

import json
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import typer
from rich.table import Table

from controller.backends import Level, Mode
from controller.cli.config import default_config
from controller.cli.output import stderr, stdout
from controller.cli.progress import Progress
from controller.config.cell import CellConfig, load_cell
from controller.domain import PickPlan
from controller.errors import ConfigError
from controller.insight.report import rows
from controller.service.session import RunOptions, Session


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
    step: Annotated[bool, typer.Option("--step", help="Ask before every pick.")] = False,
    real_time: Annotated[
        bool, typer.Option("--real-time", help="Simulation: world in its own process, bus on a pseudo-terminal.")
    ] = False,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="New folder for the record and the report.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="The figures as one JSON line on stdout.")] = False,
) -> int:
    """Sort what lies on the table.

    Examples: controller run --sim --parts 8 --seed 7 | controller run --replay photos --config cell.toml |
    controller run --config cell.toml --start

    Ctrl-C stops the arm along its path, parks it and lets go of the torque.
    """
    mode = _mode(sim, replay, real_time)
    cell = _cell(config, mode, arm, speed)
    progress = Progress(stderr())
    session = Session(
        RunOptions(
            mode=mode,
            config=cell,
            out=out,
            replay=replay,
            calibration=calibration,
            parts=parts,
            seed=seed,
            level=level,
            real_time=real_time,
            start=start,
            observers=(progress,),
            confirm=_ask if step else lambda plan: True,
            say=progress.say,
        )
    )
    with _signals(session) as interrupted, progress:
        figures = session.run()
    if figures:
        if as_json:
            print(json.dumps(figures))
        else:
            _table(figures)
    return 130 if signal.SIGINT in interrupted else 0


def _mode(sim: bool, replay: Path | None, real_time: bool) -> Mode:
    if sim and replay is not None:
        raise typer.BadParameter("--sim and --replay exclude each other")
    if real_time and not sim:
        raise typer.BadParameter("--real-time belongs to --sim")
    return Mode.SIM if sim else Mode.REPLAY if replay is not None else Mode.REAL


def _cell(config: Path | None, mode: Mode, arm: str | None, speed: float | None) -> CellConfig:
    if config is None and mode is Mode.REAL:
        raise ConfigError(
            "a real cell needs its configuration", "name it with --config FILE, or try the simulation with --sim"
        )
    cell = load_cell(config or default_config())
    changes: dict[str, Any] = {}
    if arm is not None:
        changes["description"] = arm
    if speed is not None:
        changes["speed_percent"] = speed
    return cell.model_copy(update={"arm": cell.arm.model_copy(update=changes)}) if changes else cell


def _ask(plan: PickPlan) -> bool:
    target = plan.target
    what = f"{target.detection.label or target.shape} at {target.center[0]:.0f}, {target.center[1]:.0f} mm"
    return typer.confirm(f"pick the {what} into {plan.bin.name}?", default=True, err=True)


@contextmanager
def _signals(session: Session) -> Iterator[list[int]]:
    """Ctrl-C and SIGTERM stop the session; a second Ctrl-C gives up waiting for the arm to park."""
    received: list[int] = []

    def handle(number: int, frame: FrameType | None) -> None:
        received.append(number)
        if len(received) > 1:
            raise KeyboardInterrupt
        print("\nstopping: the arm parks; once more gives up waiting", file=sys.stderr)
        session.stop()

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _table(figures: dict[str, Any]) -> None:
    grid = Table(box=None, show_header=False, pad_edge=False)
    for name, value in rows(figures):
        grid.add_row(name, value)
    console = stdout()
    console.print(grid)
    if figures.get("correct") is not None:
        console.print(f"{figures['correct']} of {figures['parts']} parts lie in the right bin.")
    console.print(f"Report, pictures and ledger: {figures['out']}")


def add_to(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command("run")(run)
