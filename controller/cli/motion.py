"""`controller home` and `controller jog`: motion by hand, at reduced speed, checked by the safety gate."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from controller.backends import Level
from controller.cli.config import default_config, taught_file
from controller.cli.interrupts import exit_code, on_interrupt
from controller.cli.keys import HELP, Client, Keys
from controller.config.cell import load_cell
from controller.config.taught import with_taught
from controller.errors import ConfigError, InputError, PlanError
from controller.service.jogging import DeadMan, HeartbeatLost, Jogger, parse
from controller.service.manual import ManualCell, ManualOptions, manual_cell

ConfigFile = Annotated[Path | None, typer.Option("--config", metavar="FILE", help="The cell's TOML file.")]
Sim = Annotated[bool, typer.Option("--sim", help="The simulated cell: no hardware is touched.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the simulated world.")]
LevelOf = Annotated[Level, typer.Option("--level", help="How imperfect the simulated world is.")]
Calibration = Annotated[Path | None, typer.Option(metavar="DIR", help="Use this calibration.")]
BinsFile = Annotated[
    Path | None,
    typer.Option("--bins", metavar="FILE", help="Taught bins (real cell: bins.toml in the state folder)."),
]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON object a line on stdout.")]


def home(
    config: ConfigFile = None,
    sim: Sim = False,
    park: Annotated[bool, typer.Option("--park", help="Then to the rest pose, and torque off.")] = False,
    seed: Seed = 0,
    level: LevelOf = Level.DYNAMIC,
    calibration: Calibration = None,
    bins: BinsFile = None,
    as_json: AsJson = False,
) -> int:
    """Move the arm to its ready pose, out of the camera's view, at no more than 250 mm/s.

    Examples: controller home --sim | controller home --config cell.toml --park

    Torque stays on unless --park. Ctrl-C stops the arm along its path; it then holds where it is.
    """
    options = manual_options(config, sim, seed, level, calibration, bins)
    with manual_cell(options) as cell, on_interrupt(cell.arm.request_stop, _HOLDS) as received:
        cell.arm.energise()
        arrived = cell.follow(cell.planner.home)
        parked = park and arrived and cell.follow(cell.planner.park)
        if parked:
            cell.arm.relax()
        show(cell, as_json, {"home": arrived, "parked": parked})
    return exit_code(received)


def jog(
    config: ConfigFile = None,
    sim: Sim = False,
    seed: Seed = 0,
    level: LevelOf = Level.DYNAMIC,
    calibration: Calibration = None,
    bins: BinsFile = None,
    as_json: AsJson = False,
) -> int:
    r"""Move the arm by hand: one key, one bounded step, no faster than 250 mm/s, each checked before it moves.

    Examples: controller jog --sim | printf 'x+ 10\nj1- 2\nq\n' | controller jog --sim --json

    The keys are listed when it begins.

    A dead-man watches the terminal: it is asked every 50 ms whether it is there.
    When neither answer nor key comes for 200 ms (a frozen window or connection) the arm
    stops along its path. tmux and screen answer in the terminal's place, and who uses a
    terminal that answers nothing is told so. Lines of a pipe need nobody to be there.

    At the end the arm holds where it is, so that `controller bins set NAME` can take the
    place; `controller home --park` brings it to rest.
    """
    options = manual_options(config, sim, seed, level, calibration, bins)
    keys = Keys(options.say) if sys.stdin.isatty() else None
    with manual_cell(options) as cell:
        return _jog(cell, keys, taught_file(bins, sim), as_json)


def _jog(cell: ManualCell, keys: Keys | None, taught: Path | None, as_json: bool) -> int:
    arm = cell.arm

    def lost() -> None:
        arm.request_stop()
        if keys is not None:
            client.forget()
        else:
            client.quit()

    dead_man = DeadMan(lost)
    client = Client(dead_man.beat, arm.request_stop, keys)

    def end() -> None:
        arm.request_stop()
        client.quit()

    jogger = Jogger(cell, dead_man, taught)
    failed = False
    if keys is not None:
        print(HELP, file=sys.stderr)
    with on_interrupt(end, _HOLDS) as received, client.reading(), dead_man.watching():
        arm.energise()
        said: dict[str, object] = {}
        while True:
            client.ready()
            show(jogger.cell, as_json, said)
            line = client.next()
            note = ""
            try:
                command = parse(line, len(arm.description.joints))
                if command.what == "quit":
                    break
                note = jogger.do(command)
            except (PlanError, ConfigError, InputError, HeartbeatLost) as error:
                failed = True
                note = f"refused: {error}"
            if note:
                print(note, file=sys.stderr)
            said = {"command": line, "note": note}
    return exit_code(received) or int(keys is None and (failed or dead_man.lost))


_HOLDS = "stopping: the arm slows down along its path and holds; once more gives up waiting"


def manual_options(
    config: Path | None, sim: bool, seed: int, level: Level, calibration: Path | None, bins: Path | None
) -> ManualOptions:
    """The cell of a command that moves the arm by hand, its bins where they were taught.

    Raises:
        ConfigError: A real cell without a configuration, or one that makes no sense.
    """
    if config is None and not sim:
        raise ConfigError(
            "a real cell needs its configuration", "name it with --config FILE, or try the simulation with --sim"
        )
    cell = load_cell(config or default_config())
    taught = taught_file(bins, sim)
    if taught is not None:
        cell = with_taught(cell, taught)
    return ManualOptions(cell, sim, seed, level, calibration, say=lambda line: print(line, file=sys.stderr))


def show(cell: ManualCell, as_json: bool, more: dict[str, object]) -> None:
    """Print where the arm stands."""
    found = cell.describe(cell.arm.state())
    if as_json:
        print(json.dumps(found | more), flush=True)
        return
    joints = "  ".join(f"{name} {angle:.1f}" for name, angle in found["joints_deg"].items())
    x, y, z = found["tool_mm"]
    print(f"tool {x:.1f}, {y:.1f}, {z:.1f} mm   joints {joints} deg   jaws {found['opening_mm']:.1f} mm", flush=True)


def add_to(app: typer.Typer) -> None:
    """Add the commands to the program."""
    app.command("home")(home)
    app.command("jog")(jog)
