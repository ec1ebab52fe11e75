"""Where the command line prints: tables keep their columns whole when nobody's terminal limits them."""

from __future__ import annotations

import sys

from rich.console import Console

_WIDE = 200
"""Columns for a file or a pipe."""


def stdout() -> Console:
    """A console on stdout."""
    return Console(width=None if sys.stdout.isatty() else _WIDE, highlight=False)


def stderr() -> Console:
    """A console on stderr."""
    return Console(stderr=True, width=None if sys.stderr.isatty() else _WIDE, highlight=False)
