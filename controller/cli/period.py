"""Dates on the command line: `2026-11-22`, `2026-11-22T06:00`, or how long ago, such as `8h`."""

from __future__ import annotations

import re
from datetime import datetime, timedelta

import typer

_UNITS = {"min": "minutes", "h": "hours", "d": "days", "w": "weeks"}
_AGO = re.compile(rf"(\d{{1,6}}(?:\.\d{{1,3}})?)\s*({'|'.join(_UNITS)})")

SINCE_HELP = "From then on: 2026-11-22, 2026-11-22T06:00 (local time), or how long ago: 90min, 8h, 2d, 1w."
UNTIL_HELP = "Before then; written like --since."


def moment(text: str | None, now: datetime) -> datetime | None:
    """The moment that a user means; None for none.

    Args:
        text: As it was typed.
        now: The present, with a time zone.

    Raises:
        typer.BadParameter: It cannot be understood.
    """
    if text is None:
        return None
    try:
        ago = _AGO.fullmatch(text.strip())
        if ago is not None:
            return now - timedelta(**{_UNITS[ago.group(2)]: float(ago.group(1))})
        return datetime.fromisoformat(text.strip()).astimezone()
    except (ValueError, OverflowError, OSError) as error:
        raise typer.BadParameter(f"{text!r} is no date: write 2026-11-22, 2026-11-22T06:00 or 8h") from error


def local(wall: object) -> str:
    """A date of the record in local time, to the second; as it is when it is none."""
    try:
        return datetime.fromisoformat(str(wall)).astimezone().strftime("%Y-%m-%d %H:%M:%S")
    except (ValueError, OverflowError, OSError):
        return str(wall)
