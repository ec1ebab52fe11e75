"""The program's commands, put together; only the rooms that a command needs are loaded."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Annotated, Any

import typer

from controller import __version__

# Which module of this package holds a command, in the order of the help.
ROOMS = {
    "run": "run",
    "detect": "detect",
    "camera": "camera",
    "board": "board",
    "calibrate": "calibrate",
    "home": "motion",
    "jog": "motion",
    "bins": "bins",
    "identify": "identify",
    "evaluate": "evaluate",
    "config": "config",
    "doctor": "doctor",
    "ledger": "ledger",
    "report": "report",
    "bundle": "bundle",
    "status": "control",
    "start": "control",
    "pause": "control",
    "resume": "control",
    "stop": "control",
    "reset": "control",
    "reload": "control",
    "alarms": "control",
    "service": "service",
    "teach": "teach",
    "classes": "classes",
    "annotate": "annotate",
    "train": "train",
}


def build(arguments: Sequence[str]) -> typer.Typer:
    """The program, with the command that `arguments` name, or with all when they name none (help, a typo)."""
    app = typer.Typer(
        name="controller",
        help="Sorts what lies on a table: a camera looks, a small arm puts every part into the right bin.",
        epilog="Start with: controller run --sim",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode="rich",
    )
    app.callback()(_options)
    named = next((argument for argument in arguments if not argument.startswith("-")), "")
    if named in ROOMS:
        rooms = [ROOMS[named]]
    else:
        rooms = ["control"] if "--version" in arguments else list(dict.fromkeys(ROOMS.values()))
    for room in rooms:
        import_module(f"controller.cli.{room}").add_to(app)
    _explain(app)
    return app


def _explain(app: typer.Typer) -> None:
    """Let every command's help flow to the width of the terminal, its examples a line each."""
    for command in app.registered_commands:
        command.help = _flowing(command.callback)
    for group in app.registered_groups:
        inside = group.typer_instance
        assert inside is not None
        if inside.registered_callback is not None:
            group.help = _flowing(inside.registered_callback.callback)
        _explain(inside)


def _flowing(command: Callable[..., Any] | None) -> str:
    """The docstring of a command: each paragraph in one line, but a line for each of its examples."""
    paragraphs = [" ".join(text.split()) for text in (inspect.getdoc(command) or "").split("\n\n")]
    for index, text in enumerate(paragraphs):
        if text.startswith("Example"):
            paragraphs[index] = text.replace(": ", ":\n$ ", 1).replace(" | controller", "\n$ controller")
    return "\n\n".join(paragraphs)


def _version(wanted: bool) -> None:
    if wanted:
        print(f"controller {__version__}")
        raise typer.Exit


def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass
