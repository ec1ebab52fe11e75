"""The command line: one file a command group; tables for people, JSON for machines, one line for an error."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import click

from controller.errors import SorterError


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the program and exit with the contract's code."""
    sys.exit(execute(arguments))


def execute(arguments: Sequence[str] | None = None) -> int:
    """Run the program and return its exit code: 0, 1 failed, 2 usage, 75 busy, 78 configuration, 130 Ctrl-C."""
    from controller.cli.app import app

    try:
        result = app(args=arguments, prog_name="controller", standalone_mode=False)
    except click.exceptions.Exit as stop:
        return stop.exit_code
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        print("interrupted", file=sys.stderr)
        return 130
    except SorterError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    except BrokenPipeError:
        sys.stderr.close()
        return 1
    return result if isinstance(result, int) else 0
