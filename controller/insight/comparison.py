"""Two evaluations beside each other: what was set otherwise, and which figures differ by more than chance.

The parts of a table share its light, its arm and its gaps: tables are the independent trials, not parts. So chance is
judged by exchanging whole tables between the two evaluations, which needs no model of how any figure is distributed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from controller.domain import Array
from controller.insight.evaluation import cycle_durations
from controller.insight.page import text
from controller.insight.trial import Record

BEYOND_CHANCE = 0.01
"""A difference that so few exchanges reach is no chance; 5 % would find one in twenty figures that are all alike."""

SETTINGS_HEADING = ("set otherwise", "before", "now")
DIFFERENCES_HEADING = ("figure", "before", "now", "difference", "beyond chance")
HOW_JUDGED = (
    "p is the share of exchanges of whole tables between the two evaluations after which a figure differs as much or "
    f"more; below {BEYOND_CHANCE:g} the difference is taken for more than chance. Fewer than eight tables of the same "
    "seeds cannot show that."
)

_EXCHANGES = 4096
"""Exchanges tried; all there are, where twelve pairs or fewer have no more."""

_SETTINGS = ("arm", "level", "parts_per_table", "seeds", "disturb", "pick_proof", "config")
"""Of the figures of an evaluation: what was run, apart from the configuration's keys."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """What `evaluation.json` holds.

    Attributes:
        figures: Of `evaluation.summary`.
        configuration: The cell's, as JSON.
        records: The runs.
    """

    figures: Mapping[str, Any]
    configuration: Mapping[str, Any]
    records: Sequence[Record]


@dataclass(frozen=True, slots=True)
class Difference:
    """One figure of two evaluations.

    Attributes:
        name: In words.
        unit: Of the values; a share is in %.
        before, now: The values; None where there is nothing to take them from.
        chance: Share of exchanges of tables by which it differs as much or more; None where it does not differ.
    """

    name: str
    unit: str
    before: float | None
    now: float | None
    chance: float | None

    def row(self) -> tuple[str, str, str, str, str]:
        """Name, before, now, difference, and whether that is beyond chance, for people."""
        apart = None if self.before is None or self.now is None else self.now - self.before
        return (self.name, self._text(self.before), self._text(self.now), self._text(apart, "+"), self._verdict())

    def _text(self, value: float | None, sign: str = "") -> str:
        return "-" if value is None else f"{value:{sign}.4g} {self.unit}" if value else f"0 {self.unit}"

    def _verdict(self) -> str:
        if self.chance is None:
            return "-"
        return f"{'yes' if self.chance < BEYOND_CHANCE else 'no'} (p = {self.chance:.2g})"


def _counted(key: str, of: str = "parts") -> Callable[[Record], tuple[float, float]]:
    return lambda run: (float(run["figures"].get(key) or 0), float(run["figures"].get(of) or 0))


def _mean(values: Sequence[float]) -> tuple[float, float]:
    return math.fsum(values), float(len(values))


def _speed(run: Record) -> tuple[float, float]:
    figures = run["figures"]
    return float(figures.get("sim_s") or 0) + float(figures.get("calibration_s") or 0), float(run.get("cpu_s", 0.0))


def _alike(run: Record) -> list[Record]:
    return [item for item in run["seen"] if item["true"] == item["seen"]]


def _missed(run: Record) -> tuple[float, float]:
    missed = len(run["missed"])
    return missed, missed + len(run["seen"])


_MEASURES: tuple[tuple[str, str, Callable[[Record], tuple[float, float]]], ...] = (
    ("in the right bin, of reachable", "%", _counted("correct", "reachable")),
    ("sorted at the first try, of tried", "%", lambda run: (run["figures"]["first_try"], len(run["outcomes"]))),
    ("in a wrong bin, of all parts", "%", _counted("missorted")),
    ("thought placed, but elsewhere", "%", _counted("silent")),
    ("put into the reject bin", "%", _counted("rejected")),
    ("left on the table", "%", _counted("left")),
    ("dropped on the way", "%", _counted("dropped")),
    ("whereabouts unknown", "%", _counted("indeterminate")),
    ("attempts at what was no part", "a part", _counted("phantoms")),
    ("touches of what should not be touched", "a part", _counted("collisions")),
    ("attempts", "a part", _counted("attempts")),
    ("pushes to make room for the jaws", "a part", _counted("nudges")),
    ("named rightly, of located", "%", lambda run: (len(_alike(run)), len(run["seen"]))),
    ("missed by a look, of what lay there", "%", _missed),
    ("made up by a look, beside what it located", "%", lambda run: (run["false"], len(run["seen"]))),
    ("error of the located centre", "mm", lambda run: _mean([math.hypot(i["dx"], i["dy"]) for i in run["seen"]])),
    ("error of the orientation", "deg", lambda run: _mean(
        [abs(i["angle_deg"]) for i in run["seen"] if i["angle_deg"] is not None]
    )),
    ("error of the sides", "mm", lambda run: _mean([item["size_mm"] for item in _alike(run)])),
    ("cycle time", "s", lambda run: _mean(cycle_durations(run["spans"]))),
    ("simulated for one of processor time", "s", _speed),
)  # fmt: skip
"""Name, unit, and for a run the two sums whose quotient over all runs is the figure: shares and means alike."""


def settings(now: Evaluation, before: Evaluation) -> list[tuple[str, str, str]]:
    """(name, before, now) of all that was set otherwise, the keys of the configuration one by one."""
    kept = bool(now.configuration and before.configuration)
    keys = _SETTINGS if kept else (*_SETTINGS, "config_digest")
    sides = [
        {key: side.figures.get(key) for key in keys} | (_flat(side.configuration, "") if kept else {})
        for side in (before, now)
    ]
    names = dict.fromkeys([*sides[0], *sides[1]])
    rows = [(name, *(text(side.get(name)) or "-" for side in sides)) for name in names]
    return [(name, was, is_) for name, was, is_ in rows if was != is_]


def differences(now: Evaluation, before: Evaluation) -> list[Difference]:
    """Every figure of both, in the order of their worth."""
    runs_before, runs_now = (
        sorted((r for r in side.records if "figures" in r), key=lambda r: int(r["seed"])) for side in (before, now)
    )
    paired = [run["seed"] for run in runs_before] == [run["seed"] for run in runs_now]
    exchanges = _exchanges(len(runs_before), len(runs_now), paired)
    found = []
    for name, unit, of in _MEASURES:
        sums = np.array([of(run) for run in (*runs_before, *runs_now)], float).reshape(-1, 2)
        if unit == "%":
            sums[:, 0] *= 100.0
        later = exchanges @ sums
        values = _quotient(sums.sum(axis=0) - later), _quotient(later)
        apart = np.abs(values[1] - values[0])
        first = [None if math.isnan(value[0]) else float(value[0]) for value in values]
        # An exchange that leaves one side nothing to take the figure from says nothing.
        known = apart[~np.isnan(apart)]
        differs = not math.isnan(apart[0]) and apart[0] > 1e-9
        chance = float(np.mean(known >= apart[0] * (1.0 - 1e-9))) if differs else None
        found.append(Difference(name, unit, first[0], first[1], chance))
    return found


def _exchanges(before: int, now: int, paired: bool) -> Array:
    """Which tables count as the later ones, 0 or 1, a row each; the first row is how it was.

    The same seed before and now is the same table: then the two are exchanged with one another only.
    """
    random = np.random.default_rng(0)
    if not paired:
        labels = np.tile(np.repeat([0.0, 1.0], [before, now]), (_EXCHANGES, 1))
        labels[1:] = random.permuted(labels[1:], axis=1)
        return labels
    if 2**now <= _EXCHANGES:
        swapped = (np.arange(2**now)[:, None] >> np.arange(now) & 1).astype(float)
    else:
        swapped = random.integers(0, 2, (_EXCHANGES, now)).astype(float)
        swapped[0] = 0.0
    return np.hstack([swapped, 1.0 - swapped])


def _quotient(sums: Array) -> Array:
    quotient: Array = np.divide(sums[:, 0], sums[:, 1], out=np.full(len(sums), np.nan), where=sums[:, 1] > 0)
    return quotient


def _flat(value: object, name: str) -> dict[str, object]:
    if isinstance(value, Mapping):
        parts = [(f"{name}.{key}" if name else str(key), part) for key, part in value.items()]
    elif isinstance(value, list) and any(isinstance(part, dict) for part in value):
        parts = [(f"{name}[{number}]", part) for number, part in enumerate(value)]
    else:
        return {name: value}
    found: dict[str, object] = {}
    for path, part in parts:
        found |= _flat(part, path)
    return found
