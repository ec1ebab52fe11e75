"""What is not in order and no reason to hold yet: told once when it begins and once when it is over."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from controller.cycle.rig import Rig
from controller.cycle.stock import Stock
from controller.domain import LocatedObject
from controller.motion.planner import Planner

LOW_SUPPLY = 10.8
"""V at the servos below which the cell moves slowly: a tenth less than the 12 V that all of them want."""

GOOD_SUPPLY = 11.1
"""V from which it moves at full speed again: an arm that moves slowly draws less, which must not look like a cure."""

SLOW = 0.5
"""Share of its speed at which an arm with a weak supply moves: a quarter of the acceleration's current."""


class Concerns:
    """Tells the observers of a rig what has changed since the last look.

    Args:
        rig: Whose observers.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._known: frozenset[str] = frozenset()
        self._full: frozenset[str] = frozenset()

    def __contains__(self, code: str) -> bool:
        return code in self._known

    def review(self, seen: Sequence[LocatedObject], stock: Stock) -> Planner:
        """Warn of what is not in order after a look; the planner to go on with, a slow one while the supply is weak."""
        found = dict(self._rig.concerns())
        waiting = stock.waited_for(seen)
        if waiting:
            found["bin_full"] = "; ".join(f"{name} is full, {_waits(count)}" for name, count in waiting.items())
        if waiting.keys() - self._full:
            # Another bin is full now: that is news.
            self._known -= {"bin_full"}
        self._full = frozenset(waiting)
        voltage, weak = self._rig.arm.state().voltage, "supply_low" in self._known
        if voltage is not None and voltage < (GOOD_SUPPLY if weak else LOW_SUPPLY):
            found["supply_low"] = f"{voltage:.1f} V at the servos"
        self.update(found)
        return self._rig.planner.slowed(SLOW) if "supply_low" in found else self._rig.planner

    def update(self, found: Mapping[str, str]) -> None:
        """Take in everything that is of concern now, by code of the fault catalogue: its cause in words."""
        now = self._rig.clock.now()
        for code, cause in found.items():
            if code not in self._known:
                for observer in self._rig.observers:
                    observer.warned(code, cause, now)
        for code in self._known - found.keys():
            for observer in self._rig.observers:
                observer.eased(code, now)
        self._known = frozenset(found)


def _waits(count: int) -> str:
    return "1 part waits" if count == 1 else f"{count} parts wait"
