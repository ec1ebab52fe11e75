"""The command line: one file a command group; tables for people, JSON for machines, one line for an error."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Sequence

import typer

from controller.errors import SorterError


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the program and exit with the contract's code."""
    use_one_thread()
    keep_memory()
    sys.exit(execute(arguments))


def use_one_thread() -> None:
    """Linear algebra in this process and those it starts uses one thread, unless the environment says otherwise.

    To be called before numpy is imported, which is when the variables are read. Helper threads gain nothing on matrices
    as small as ours: they spin between two products, and what they take is missed by the other processes of a cell.
    """
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")


_KEPT, _FROM_HEAP = 64 << 20, 32 << 20
"""Free memory, bytes, that stays with the process: twice what one picture takes; and the largest block to be found in
it, glibc's limit."""


def keep_memory() -> None:
    """What this process and those it starts free stays theirs for the next picture; only glibc can be told so.

    Otherwise memory goes back to the system at once, and each look at a picture takes thousands of pages anew, every
    one of which is to be cleared first: on a virtual machine a tenth of the look's time.

    Source: mallopt(3).
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        for name, number, value in (("TRIM", -1, _KEPT), ("MMAP", -3, _FROM_HEAP)):
            os.environ.setdefault(f"MALLOC_{name}_THRESHOLD_", str(value))
            mallopt(number, value)


def execute(arguments: Sequence[str] | None = None) -> int:
    """Run the program and return its exit code: 0, 1 failed, 2 usage, 75 busy, 78 configuration, 130 Ctrl-C."""
    from controller.cli.app import build

    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        result = build(given)(args=given, prog_name="controller", standalone_mode=False)
    except typer.Exit as stop:
        return stop.exit_code
    except (typer.Abort, KeyboardInterrupt):
        print("interrupted", file=sys.stderr)
        return 130
    except SorterError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    except PermissionError as error:
        from controller.service.folders import not_permitted

        print(f"error: {not_permitted(error)}", file=sys.stderr)
        return 1
    except BrokenPipeError:
        sys.stderr.close()
        return 1
    except Exception as error:
        # Typer carries a copy of click of its own, whose usage errors have no public name.
        show, code = getattr(error, "show", None), getattr(error, "exit_code", None)
        if show is None or not isinstance(code, int):
            raise
        show()
        return code
    return result if isinstance(result, int) else 0
