"""What lies in the bins: which of them has room for a part, where in it to let go, and how high it may be filled."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from controller.config.cell import CellConfig
from controller.domain import Bin, LocatedObject, Point

DROP_SPREAD = 0.18
"""Parts are let go at four places of a bin, this share of its size from the middle, so that none lands on the last."""

ASKEW_MM = 45.0
"""A part that fell into a bin may lean on a wall or stand on an edge, as high as its longest side: this much at least,
where nobody knows what lies there."""

LAYER_MM = 8.0
"""What every further part adds to that, on average: 20 cm^3 over the floor of a usual bin, with gaps."""


def drop_points(bin_: Bin) -> tuple[Point, Point, Point, Point]:
    """Where in a bin parts are let go, one place after the other, (x, y) in `table`, mm."""
    (x, y), dx, dy = bin_.center, DROP_SPREAD * bin_.size[0], DROP_SPREAD * bin_.size[1]
    return (x - dx, y - dy), (x + dx, y + dy), (x + dx, y - dy), (x - dx, y + dy)


def pile_of(bin_: Bin, count: int, longest: float = 0.0) -> float:
    """Height over the table that so many parts in a bin may reach, mm.

    Never less than the walls: what leans on one stands up to its diagonal, and jaws that open among parts push them.

    Args:
        bin_: The bin.
        count: Parts in it.
        longest: Longest side of any of them, mm.
    """
    return 0.0 if count == 0 else max(bin_.height, max(longest, ASKEW_MM) + LAYER_MM * (count - 1))


class Stock:
    """Counts the parts in the bins.

    Args:
        config: Bins and rules.
        filled: Parts in each bin already, by name; counted up as they are placed.
    """

    def __init__(self, config: CellConfig, filled: Counter[str]) -> None:
        self._config = config
        self._filled = filled
        self._longest: dict[str, float] = {}

    def bin_for(self, thing: LocatedObject) -> Bin | None:
        """The bin an object belongs in, or None when it is to lie or its bin is full."""
        bin_ = self._wanted(thing)
        return self._open(bin_.name) if bin_ is not None else None

    def _open(self, name: str) -> Bin | None:
        """The bin of this name, unless it is full."""
        bin_ = next((bin_ for bin_ in self._config.bin_values() if bin_.name == name), None)
        return bin_ if bin_ is not None and self._filled[name] < bin_.capacity else None

    def rejects(self) -> Bin | None:
        """The bin for what no rule names, or None when that is to lie or the bin is full."""
        return self._open(self._config.sorting.otherwise)

    def waited_for(self, things: Iterable[LocatedObject]) -> dict[str, int]:
        """Full bins by name, and how many of these objects wait for each."""
        wanted = [bin_ for bin_ in map(self._wanted, things) if bin_ is not None]
        return dict(Counter(bin_.name for bin_ in wanted if self._filled[bin_.name] >= bin_.capacity))

    def _wanted(self, thing: LocatedObject) -> Bin | None:
        name = self._config.bin_for(thing.shape, thing.detection.label, thing.size[0], thing.detection.colour)
        return next((bin_ for bin_ in self._config.bin_values() if bin_.name == name), None)

    def drop_point(self, bin_: Bin) -> Point:
        """Where in a bin the next part is let go, (x, y) in `table`, mm."""
        return drop_points(bin_)[self._filled[bin_.name] % 4]

    def pile(self, bin_: Bin) -> float:
        """Height over the table that what lies in a bin already may reach, mm."""
        return pile_of(bin_, self._filled[bin_.name], self._longest.get(bin_.name, 0.0))

    def piles(self) -> dict[str, float]:
        """`pile` of every bin, by its name."""
        return {bin_.name: self.pile(bin_) for bin_ in self._config.bin_values()}

    def placed(self, bin_: Bin, thing: LocatedObject) -> None:
        """One more part lies in a bin."""
        self._filled[bin_.name] += 1
        self._longest[bin_.name] = max(self._longest.get(bin_.name, 0.0), thing.size[0])
