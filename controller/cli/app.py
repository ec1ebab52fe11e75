"""The program's commands, put together."""

from __future__ import annotations

from typing import Annotated

import typer

from controller import __version__
from controller.cli import calibrate, config, detect, run

app = typer.Typer(
    name="controller",
    help="Sorts what lies on a table: a camera looks, a small arm puts every part into the right bin.",
    epilog="Start with: controller run --sim",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)


def _version(wanted: bool) -> None:
    if wanted:
        print(f"controller {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


app.command("run")(run.run)
app.command("detect")(detect.detect)
app.add_typer(calibrate.app, name="calibrate")
app.add_typer(config.app, name="config")
