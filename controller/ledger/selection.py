"""Which records somebody asks for: a period, a class, a bin, a result, a run."""

from __future__ import annotations

from dataclasses import dataclass, fields
from datetime import UTC, datetime
from typing import Literal

Table = Literal["runs", "intents", "outcomes", "events", "days"]
TABLES: tuple[Table, ...] = ("runs", "intents", "outcomes", "events", "days")

# The column that a question is about, table by table; a question that is not here makes no sense there.
_COLUMNS: dict[Table, dict[str, str]] = {
    "runs": {"since": "coalesce(ended_wall, '9999')", "until": "started_wall", "run_id": "run_id"},
    "intents": {
        "since": "wall", "until": "wall", "run_id": "run_id", "label": "label", "bin": "bin",
        "from_s": "at_s", "to_s": "at_s",
    },
    "outcomes": {
        "since": "wall", "until": "wall", "run_id": "run_id", "label": "label", "bin": "bin", "result": "result",
        "from_s": "finished_at_s", "to_s": "finished_at_s",
    },
    "events": {
        "since": "wall", "until": "wall", "run_id": "run_id", "kind": "kind", "from_s": "at_s", "to_s": "at_s",
    },
    "days": {"since": "day", "until": "day", "label": "label", "bin": "bin", "result": "result"},
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Selection:
    """What is asked for; None asks for all.

    Attributes:
        since, until: From and before this date, with a time zone; a run is within a period that it touches.
        run_id: Of this run.
        label: Of this class.
        bin: For this bin.
        result: With this result.
        kind: Events of this kind.
        from_s, to_s: From and before this time of the cell's clock, s; makes sense within one run.
    """

    since: datetime | None = None
    until: datetime | None = None
    run_id: int | None = None
    label: str | None = None
    bin: str | None = None
    result: str | None = None
    kind: str | None = None
    from_s: float | None = None
    to_s: float | None = None

    def asked(self) -> tuple[str, ...]:
        """Names of what is asked for."""
        return tuple(field.name for field in fields(self) if getattr(self, field.name) is not None)

    def where(self, table: Table) -> tuple[str, tuple[object, ...]]:
        """A WHERE clause and its values, both empty when all is asked for.

        Raises:
            ValueError: The table has nothing of the kind.
        """
        columns = _COLUMNS[table]
        terms, values = [], []
        for name in self.asked():
            if name not in columns:
                raise ValueError(f"{table} have no {_WORDS.get(name, name)}")
            terms.append(f"{columns[name]} {_SIGNS.get(name, '=')} ?")
            values.append(self._value(table, name))
        return (f"WHERE {' AND '.join(terms)}", tuple(values)) if terms else ("", ())

    def _value(self, table: Table, name: str) -> object:
        value = getattr(self, name)
        if isinstance(value, datetime):
            moment = value.astimezone(UTC)
            return moment.date().isoformat() if table == "days" else moment.isoformat(timespec="milliseconds")
        return value


_WORDS = {"run_id": "run", "label": "class", "result": "outcome"}
_SIGNS = {"since": ">=", "until": "<", "from_s": ">=", "to_s": "<"}

EVERYTHING = Selection()
