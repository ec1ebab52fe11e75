"""The record of an error map: the map where one is kept, and what it is worth either way."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from controller.calibration import files
from controller.domain import ErrorMap, Point
from controller.errors import InputError


@dataclass(frozen=True, slots=True)
class MapRecord:
    """What became of the attempt to map what is left.

    Attributes:
        map: Kept because it helps, or None.
        places: (x, y) of the looks it rests on, `table`, mm.
        without_mm: What these places are missed by in the mean, mm.
        with_mm: The same with the map fitted to all others of them.
    """

    map: ErrorMap | None
    places: tuple[Point, ...]
    without_mm: float
    with_mm: float

    def to_json(self) -> dict[str, Any]:
        """As the arm's file holds it."""
        kept = self.map
        held_out = {"without": self.without_mm, "with": self.with_mm}
        out: dict[str, Any] = {"kept": kept is not None, "held_out_mm": held_out}
        out["places"] = [list(place) for place in self.places]
        if kept is not None:
            out |= {"center": list(kept.center), "scale": kept.scale, "x": list(kept.x), "y": list(kept.y)}
        return out


def record_from_json(content: object, where: str) -> MapRecord | None:
    """A record from its JSON object; None when there is none.

    Raises:
        InputError: It makes no sense.
    """
    if content is None:
        return None
    if not isinstance(content, Mapping) or not isinstance(content.get("held_out_mm"), Mapping):
        raise InputError(f"{where}: error_map is not an object", "calibrate the arm again")
    named = f"{where}: error_map"
    found = None
    if content.get("kept"):
        middle = files.numbers(content, "center", (2,), where=named)
        x, y = (files.numbers(content, axis, (6,), where=named) for axis in ("x", "y"))
        scale = files.number(content, "scale", where=named)
        if scale <= 0.0:
            raise InputError(f"{named}: scale is not positive", "calibrate the arm again")
        found = ErrorMap((float(middle[0]), float(middle[1])), scale, tuple(x.tolist()), tuple(y.tolist()))
    held_out, listed = content["held_out_mm"], content.get("places")
    count = len(listed) if isinstance(listed, list) else 0
    places = files.numbers(content, "places", (count, 2), where=named).tolist() if count else []
    return MapRecord(
        found,
        tuple((x, y) for x, y in places),
        files.number(held_out, "without", where=named),
        files.number(held_out, "with", where=named),
    )
