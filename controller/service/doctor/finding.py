"""What a check has found."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Level(StrEnum):
    """How bad it is."""

    OK = "ok"
    WARNING = "warning"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of one check.

    Attributes:
        name: Of the check.
        level: How bad it is.
        finding: One line for people: what is.
        remedy: What to do; empty when all is well.
    """

    name: str
    level: Level
    finding: str
    remedy: str = ""

    def to_json(self) -> dict[str, str]:
        """The finding for machines."""
        return {"name": self.name, "level": str(self.level), "finding": self.finding, "remedy": self.remedy}


def ok(name: str, finding: str) -> Finding:
    """All is well."""
    return Finding(name, Level.OK, finding)


def warning(name: str, finding: str, remedy: str) -> Finding:
    """It works, but somebody should look after it."""
    return Finding(name, Level.WARNING, finding, remedy)


def failed(name: str, finding: str, remedy: str) -> Finding:
    """The cell cannot work like this."""
    return Finding(name, Level.FAILED, finding, remedy)


def counted(number: int, noun: str) -> str:
    """A number of things in words: `1 rule`, `2 rules`."""
    return f"{number} {noun}{'' if number == 1 else 's'}"
