"""Everything about a configuration that only arm and rules together can tell, before anything is opened."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from controller.config.cell import CellConfig, RuleSection
from controller.cycle.stock import drop_points, pile_of
from controller.domain import ArmDescription, Bin, Gripper, Shape
from controller.errors import ConfigError
from controller.motion.grasps import OPENING_MARGINS
from controller.motion.planner import Planner

_ACROSS: Mapping[Shape | None, float] = {
    Shape.SQUARE: 1.0,
    Shape.CIRCLE: 1.0,
    Shape.HEXAGON: math.sqrt(3.0) / 2.0,
    Shape.TRIANGLE: math.sqrt(3.0) / 2.0,
}
"""Extent between the jaws over the long side that rules speak of, for shapes whose one side tells the other."""

_SPOT_MM = 60.0
"""Side of the floor that a part of 45 mm takes up, with the gap beside it."""


def check(config: CellConfig, arm: ArmDescription, planner: Planner) -> list[str]:
    """Refuse what cannot work, and say what is odd.

    Args:
        config: The cell.
        arm: Its arm.
        planner: A planner for that arm with the best calibration known, the ruler's if need be.

    Returns:
        Warnings, one line each.

    Raises:
        ConfigError: A bin cannot be reached.
    """
    for index, bin_ in enumerate(config.bin_values()):
        error = planner.bin_error(bin_)
        if error is not None:
            raise ConfigError(
                f"bins[{index}] ({bin_.name}) at {bin_.center[0]:.0f}, {bin_.center[1]:.0f} mm cannot be reached by "
                f"{arm.title}: {error}",
                "move it, or lower its walls",
            )
    warnings: list[str] = []
    for section, bin_ in zip(config.bins, config.bin_values(), strict=True):
        warnings += _overfilled(bin_, _tallest(config, section.name), planner)
    used = {rule.bin for rule in config.sorting.rules} | {config.sorting.otherwise}
    warnings += [f"bin {bin_.name} is named by no rule" for bin_ in config.bins if bin_.name not in used]
    for index, rule in enumerate(config.sorting.rules):
        warnings += [f"sorting.rules[{index}] {what}" for what in _oddities(index, rule, config.sorting.rules)]
        misfit = _misfit(rule, arm.gripper)
        warnings += [f"sorting.rules[{index}] {misfit}"] if misfit else []
    return warnings


def _tallest(config: CellConfig, name: str) -> float:
    """Height of the tallest part that may come into a bin, mm; 0 when no heights are stated."""
    rules = [rule for rule in config.sorting.rules if rule.bin == name]
    anything = name == config.sorting.otherwise or any(rule.shape is None for rule in rules)
    shapes = {rule.shape for rule in rules}
    return max((part.height_mm for part in config.parts if anything or part.shape in shapes), default=0.0)


def _overfilled(bin_: Bin, tall: float, planner: Planner) -> list[str]:
    """What keeps a bin from taking as many parts as it is said to: low walls, or the reach over what lies in it."""
    found = []
    layer = tall * _SPOT_MM**2 / (bin_.size[0] * bin_.size[1])
    # The topmost part stays while half of it lies behind the walls.
    if layer * bin_.capacity - tall / 2.0 > bin_.height:
        fits = int((bin_.height + tall / 2.0) / layer)
        found.append(
            f"bin {bin_.name}: {bin_.capacity} parts of {tall:g} mm may lie {layer * bin_.capacity:.0f} mm high and "
            f"slide over its walls of {bin_.height:g} mm, which hold {fits}"
        )
    for count in range(1, bin_.capacity):
        if any(planner.bin_error(bin_, point, pile_of(bin_, count)) for point in drop_points(bin_)):
            found.append(
                f"bin {bin_.name}: over {count} parts the arm can let go no further one, the capacity is "
                f"{bin_.capacity}"
            )
            break
    return found


def _oddities(index: int, rule: RuleSection, rules: Sequence[RuleSection]) -> list[str]:
    """What is odd about a rule beside those before it, which decide first."""
    if rule.shape is not None and rule.label in set(Shape) - {rule.shape}:
        return [f"never matches: nothing is a {rule.shape} and a {rule.label}"]
    before = list(enumerate(rules[:index]))
    hiding = [(i, other) for i, other in before if _speaks_of_all(other, rule)]
    if _covers([_sizes(other) for _, other in hiding], _sizes(rule)):
        names = " and ".join(f"sorting.rules[{i}]" for i, other in hiding if _meet(_sizes(other), _sizes(rule)))
        return [f"never matches: {names} {'decides' if ' and ' not in names else 'decide'} first"]
    found = []
    for i, other in before:
        common = _meet(_sizes(other), _sizes(rule))
        if common and other.bin != rule.bin and rule.size_mm and other.size_mm and _speak_of_the_same(other, rule):
            low, high = common
            found.append(f"overlaps sorting.rules[{i}] from {low:g} to {high:g} mm: those parts go to {other.bin}")
    return found


def _speaks_of_all(wide: RuleSection, narrow: RuleSection) -> bool:
    """Whether a rule, sizes apart, matches all that another one matches."""
    return all(
        asked is None or asked == given
        for asked, given in ((wide.shape, narrow.shape), (wide.label, narrow.label), (wide.colour, narrow.colour))
    )


def _speak_of_the_same(a: RuleSection, b: RuleSection) -> bool:
    """Whether some part, sizes apart, matches both rules."""
    pairs = ((a.shape, b.shape), (a.label, b.label), (a.colour, b.colour))
    return all(x is None or y is None or x == y for x, y in pairs)


def _sizes(rule: RuleSection) -> tuple[float, float]:
    return rule.size_mm if rule.size_mm is not None else (0.0, math.inf)


def _meet(a: tuple[float, float], b: tuple[float, float]) -> tuple[float, float] | None:
    low, high = max(a[0], b[0]), min(a[1], b[1])
    return (low, high) if low < high else None


def _covers(ranges: Sequence[tuple[float, float]], wanted: tuple[float, float]) -> bool:
    """Whether ranges [from, to) together leave nothing of another one."""
    reached = wanted[0]
    for low, high in sorted(ranges):
        if low <= reached:
            reached = max(reached, high)
    return reached >= wanted[1]


def _misfit(rule: RuleSection, gripper: Gripper) -> str | None:
    """Why the jaws cannot take what a rule asks for, as far as its sizes tell, or None."""
    if rule.size_mm is None:
        return None
    narrowest, widest = gripper.opening[0], gripper.opening[1] - 2.0 * OPENING_MARGINS[-1]
    low, high = (side * _ACROSS.get(rule.shape, 1.0) for side in rule.size_mm)
    if high <= narrowest:
        return f"asks for parts of at most {high:.0f} mm between the jaws, which close to {narrowest:.0f} mm only"
    if rule.shape in _ACROSS:
        if low > widest:
            return f"asks for parts of {low:.0f} mm between the jaws and more, which take {widest:.0f} mm at most"
        if high > widest + 1e-9:
            return f"asks for parts of up to {high:.0f} mm between the jaws: those over {widest:.0f} mm are left"
        if low < narrowest - 1e-9:
            return f"asks for parts from {low:.0f} mm between the jaws: those under {narrowest:.0f} mm are left"
    return None
