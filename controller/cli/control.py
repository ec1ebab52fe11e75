"""`controller status|start|pause|resume|stop|reset|alarms`: talk to the cell that is running."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Column, Table

from controller.cli.output import stdout
from controller.errors import SorterError
from controller.service.client import ControlClient, folder_of_running_cell

STOP_TIMEOUT = 60.0
"""s that parking may take: as long as the unit's TimeoutStopSec."""

At = Annotated[
    Path | None,
    typer.Option("--at", metavar="DIR", help="Folder of the running cell's control socket (default: the service's)."),
]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")]


def status(at: At = None, as_json: AsJson = False) -> None:
    """Say what the running cell is doing.

    Example: controller status --json
    """
    _show(_client(at).ask("status"), as_json)


def start(
    view_clear: Annotated[
        bool,
        typer.Option(
            "--view-clear", help="You have looked: what reaches over the table now, a cable say, is to stay there."
        ),
    ] = False,
    at: At = None,
    as_json: AsJson = False,
) -> None:
    """Start sorting, from STOPPED. The arm moves.

    Who may: root, the user the cell runs as, and with the installed service the members of the group `sorter`; so with
    every command that talks to a running cell.

    Example: controller start
    """
    _show(_client(at).ask("start", **({"view_clear": True} if view_clear else {})), as_json)


def pause(at: At = None, as_json: AsJson = False) -> None:
    """Hold: the arm slows down along its path and stands, even in the middle of a move; torque stays on.

    Example: controller pause

    `controller status` says HOLDING, then HELD. A jaw movement under way ends first. What the arm holds stays held.
    It is no protective stop: cut the power before reaching in.
    """
    _show(_client(at).ask("pause"), as_json)


def resume(at: At = None, as_json: AsJson = False) -> None:
    """Go on after a pause: the arm moves on at once from where it stands.

    Example: controller resume
    """
    _show(_client(at).ask("resume"), as_json)


def stop(at: At = None, as_json: AsJson = False) -> None:
    """Stop the arm along its path, park it, let go of the torque; says so when that is done.

    This is no emergency stop: that is a switch in the servos' supply.

    Example: controller stop
    """
    client = _client(at)
    client.ask("stop")
    found = client.wait_for_rest(STOP_TIMEOUT)
    if found is not None:
        _show(found, as_json)
    elif as_json:
        print(json.dumps({"state": "STOPPED", "reason": "the program has ended"}))
    else:
        print("STOPPED: the program has ended")


def reset(at: At = None, as_json: AsJson = False) -> None:
    """Clear a latched fault, after you have looked at the cell. Nothing moves until `controller start`.

    Example: controller reset
    """
    _show(_client(at).ask("reset"), as_json)


def reload(at: At = None, as_json: AsJson = False) -> None:
    """Read the configuration again; it holds from the next cycle on, and the old one stays if the new is wrong.

    Example: controller reload
    """
    changes: list[str] = _client(at).ask("reload")
    if as_json:
        print(json.dumps({"changes": changes}))
    else:
        print("\n".join(changes) or "nothing has changed")


def alarms(
    acknowledge: Annotated[
        bool, typer.Option("--acknowledge", help="Note that all were seen. This clears nothing and resets nothing.")
    ] = False,
    at: At = None,
    as_json: AsJson = False,
) -> None:
    """List the alarms of the running cell, present and past.

    Example: controller alarms --acknowledge
    """
    client = _client(at)
    if acknowledge:
        client.ask("acknowledge")
    found: list[dict[str, Any]] = client.ask("alarms")
    if as_json:
        for alarm in found:
            print(json.dumps(alarm))
    elif found:
        _alarm_table(found)
    else:
        print("no alarms")


def add_to(app: typer.Typer) -> None:
    """Add the commands to the program."""
    for command in (status, start, pause, resume, stop, reset, reload, alarms):
        app.command(command.__name__)(command)


def control_folder(at: Path | None) -> Path:
    """Folder of the running cell's control socket: the one named, or the service's."""
    if at is not None and not at.is_dir():
        raise SorterError(f"{at}: no such folder", "name the folder of a running cell with --at")
    return at or folder_of_running_cell()


def _client(at: Path | None) -> ControlClient:
    return ControlClient(control_folder(at))


def _show(found: Mapping[str, Any], as_json: bool) -> None:
    if as_json:
        print(json.dumps(found))
        return
    grid = Table(box=None, show_header=False, pad_edge=False)
    grid.add_row("state", f"{found['state']} ({found['cycle_state'] or 'not ready'}), {found['since_s']:.0f} s")
    grid.add_row("", str(found["reason"]))
    grid.add_row("mode", f"{found['mode']}, up {found['uptime_s'] / 3600:.1f} h, process {found['pid']}")
    grid.add_row("configuration", f"{found['config']} ({found['config_digest']})")
    grid.add_row("calibration", found["calibration_id"] or "none")
    counts = {name: number for name, number in found["counts"].items() if number}
    grid.add_row("targets", ", ".join(f"{number} {name}" for name, number in counts.items()) or "none yet")
    if found["may_hold_part"]:
        grid.add_row("gripper", "may hold a part")
    stdout().print(grid)
    if found["alarms"]:
        _alarm_table(found["alarms"])


def _alarm_table(alarms: list[dict[str, Any]]) -> None:
    table = Table("no.", "raised", "alarm", Column("cause and remedy", overflow="fold"), "", box=None, pad_edge=False)
    for alarm in alarms:
        marks = ["active" if alarm["active"] else "over"]
        marks += ["seen"] if alarm["acknowledged_at"] else []
        marks += ["came first"] if alarm["first_out"] else []
        text = f"{alarm['cause']}: {alarm['remedy']}" if alarm["remedy"] else alarm["cause"]
        table.add_row(str(alarm["number"]), alarm["raised_at"][:19], alarm["code"], text, ", ".join(marks))
    stdout().print(table)
