"""Taught classes at work on detections, and the checks a class must pass before it is let in."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from controller.domain import Detection
from controller.errors import InputError
from controller.geometry import PlaneMap
from controller.vision.appearance.look import Surfaces
from controller.vision.classes.classifier import Classifier, Verdict, scaled_by_noise
from controller.vision.classes.features import features
from controller.vision.classes.markings import Marking, best_likeness, marking, tiles_of
from controller.vision.classes.store import MOST_VIEWS, TaughtClass, digest_of

LEAST_VIEWS = 3
GOOD_VIEWS = 5
_JUMP = 5.0
"""A gap this wide, in units of noise, between two groups of views ..."""
_JUMP_RATIO = 3.0
"""... and this many times wider than usual within, makes two faces of them ..."""
_WIDE = 10.0
"""... and one this wide always does: views of one face lie 1 to 4 apart, kinds of fasteners 7 to 20."""
_EXTRAS = 0.25
"""Share of the views that may be other things lying beside the part."""
_SAME = 0.7
"""Prints laid over one another are the same from this likeness on: the same ones reach 0.85, others 0.75 at most
when their outlines agree by chance, 0.1 usually."""
_CLEARLY = 0.08
"""The second must be less alike by this."""
_MOSTLY = 0.75
"""Share of a class's views that must show its print."""
_COMPARED = 8
"""Views of a class whose prints are looked at."""
_RIGHT = 0.8
"""Share of its own views that a class must recognise when each is left out in turn."""


class Taught:
    """The classes of a folder, ready to name what is seen.

    Args:
        classes: All in the same units.

    Attributes:
        heights: Of the classes that say it, mm.

    Raises:
        InputError: Some were taught in mm and some in px.
    """

    def __init__(self, classes: tuple[TaughtClass, ...]) -> None:
        if len({item.units for item in classes}) > 1:
            raise InputError(
                "some classes were taught in mm, others in px", "teach them all with, or all without, a calibration"
            )
        self.classes = classes
        self.units = classes[0].units if classes else "px"
        self.digest = digest_of(classes)
        self.classifier = Classifier({item.name: item.views for item in classes})
        self.heights = {item.name: item.height_mm for item in classes if item.height_mm is not None}
        self._prints = {item.name: item.prints for item in classes}
        self._twins = self.classifier.twins() if len(classes) > 1 else {}
        self._known: dict[str, tuple[Marking, ...]] = {}
        self._marked: dict[str, bool] = {}

    def markings(self, name: str) -> tuple[Marking, ...]:
        """What is printed on the views of a class."""
        if name not in self._known:
            self._known[name] = tuple(marking(tile) for tile in self._prints[name])
        return self._known[name]

    def is_marked(self, name: str) -> bool:
        """Whether its views carry one and the same print."""
        if name not in self._marked:
            own = self.markings(name)[:_COMPARED]
            alike = [best_likeness(one, [other for other in own if other is not one]) >= _SAME for one in own]
            self._marked[name] = bool(alike) and sum(alike) >= _MOSTLY * len(alike)
        return self._marked[name]

    def names(
        self, detections: Sequence[Detection], surfaces: Surfaces, plane: PlaneMap | None
    ) -> list[str | None]:
        """What class each surface of the detections is of; None where it is unknown.

        Raises:
            InputError: The classes were taught in mm and there is no calibrated plane.
        """
        if self.units == "mm" and plane is None and self.classes:
            raise InputError("the classes were taught in mm", "give the calibration: --camera and --table")
        values = features(detections, surfaces, plane if self.units == "mm" else None)
        out: list[str | None] = []
        for k, verdict in zip(surfaces.which, self.classifier.verdicts(values), strict=True):
            name = None if verdict is None else verdict.name
            if verdict is not None and verdict.distance <= 1.0 and self._twins.get(verdict.nearest):
                (tile,) = tiles_of(surfaces.image, [detections[k]])
                name = self._by_print(marking(tile), verdict)
            out.append(name)
        return out

    def _by_print(self, seen: Marking, verdict: Verdict) -> str | None:
        """Which of the classes that differ by their surface only it is, or None."""
        candidates = {verdict.nearest, *self._twins[verdict.nearest]}
        marked = [name for name in candidates if self.is_marked(name)]
        scores = {
            name: best_likeness(seen, [one for one in self.markings(name)[:_COMPARED] if one is not seen])
            for name in marked
        }
        first, second = sorted([*scores.values(), 0.0, 0.0], reverse=True)[:2]
        if first < _SAME:
            # None of the prints: it may be one of those that have none, or whose texture tells.
            return verdict.name if verdict.name not in marked else None
        return max(scores, key=lambda name: scores[name]) if first >= second + _CLEARLY else None

    def confusion(self) -> dict[str, Counter[str]]:
        """For each class what its views are taken for when each is left out in turn; `unknown` where nothing."""
        table: dict[str, Counter[str]] = {name: Counter() for name in self.classifier.names}
        seen: Counter[str] = Counter()
        for true, verdict in self.classifier.left_out():
            own = seen[true]
            seen[true] += 1
            said = verdict.name
            if verdict.distance <= 1.0 and self._twins.get(verdict.nearest):
                said = self._by_print(self.markings(true)[own], verdict)
            table[true][said or "unknown"] += 1
        return table


@dataclass(frozen=True, slots=True)
class Admission:
    """What was found when a class was checked.

    Attributes:
        new: The class as it was let in.
        taught: All classes with the new one.
        confusion: By leaving one view out, see `Taught.confusion`.
        warnings: What may be better.
    """

    new: TaughtClass
    taught: Taught
    confusion: dict[str, Counter[str]]
    warnings: tuple[str, ...]


def admit(new: TaughtClass, others: Sequence[TaughtClass], faces: int = 1) -> Admission:
    """Check a class against its own views and the other classes.

    Args:
        new: The class; one of the same name among the others is replaced by it.
        others: The classes known so far.
        faces: How many different sides of the part the views show.

    Raises:
        InputError: Too few or too many views, views of different things, or views of a class known already.
    """
    if len(new.views) < LEAST_VIEWS:
        raise InputError(
            f"{len(new.views)} views of {new.name!r}, {LEAST_VIEWS} are the least", f"show it {GOOD_VIEWS} to 30 times"
        )
    if len(new.views) > MOST_VIEWS:
        raise InputError(f"{len(new.views)} views are more than {MOST_VIEWS}", "choose some of them")
    kept = tuple(item for item in others if item.name != new.name)
    new, warnings = _without_extras(new)
    groups = _groups(scaled_by_noise(new.views))
    if groups.max() + 1 > faces:
        odd = int(np.argmin(np.bincount(groups)))
        names = sorted({new.pictures[k] for k in np.flatnonzero(groups == odd)})
        raise InputError(
            f"the views of {new.name!r} show {groups.max() + 1} different things; "
            f"what stands in {', '.join(names[:3])} is unlike the rest",
            f"leave those out, or say --faces {groups.max() + 1} when they are sides of one part",
        )
    _refuse_known(new, kept)
    taught = Taught(tuple(sorted((*kept, new), key=lambda item: item.name)))
    confusion = taught.confusion()
    right = confusion[new.name][new.name] / len(new.views)
    if right < _RIGHT:
        raise InputError(
            f"{new.name!r} is recognised in {right:.0%} of its own views when each is left out: "
            + ", ".join(f"{said} {count}" for said, count in confusion[new.name].most_common()),
            "show it more often, or remove the class it looks like",
        )
    if len(new.views) < GOOD_VIEWS:
        warnings.append(f"{len(new.views)} views are few: show {new.name!r} {GOOD_VIEWS} times or more")
    return Admission(new, taught, confusion, tuple(warnings))


def _without_extras(new: TaughtClass) -> tuple[TaughtClass, list[str]]:
    """The class without odd things that lay beside it in pictures that show it as well, and a warning for each."""
    groups = _groups(scaled_by_noise(new.views))
    main = groups == np.argmax(np.bincount(groups))
    shown = {picture for picture, own in zip(new.pictures, main, strict=True) if own}
    extra = np.array([not own and picture in shown for picture, own in zip(new.pictures, main, strict=True)])
    if not extra.any() or extra.mean() > _EXTRAS:
        return new, []
    warnings = [f"left out something unlike {new.name!r} in {new.pictures[k]}" for k in np.flatnonzero(extra)]
    kept = tuple(picture for picture, out in zip(new.pictures, extra, strict=True) if not out)
    return replace(new, views=new.views[~extra], pictures=kept, prints=new.prints[~extra]), warnings


def _refuse_known(new: TaughtClass, kept: tuple[TaughtClass, ...]) -> None:
    """Raise when most of the new views are taken for a class that is known already."""
    if not kept:
        return
    known_by_now, own = Taught(kept), Taught((new,))
    said: Counter[str] = Counter()
    for verdict, print_ in zip(known_by_now.classifier.verdicts(new.views), own.markings(new.name), strict=True):
        if verdict is None or verdict.name is None:
            continue
        if own.is_marked(new.name) or known_by_now.is_marked(verdict.name):
            to_known = best_likeness(print_, known_by_now.markings(verdict.name)[:_COMPARED])
            others = [one for one in own.markings(new.name)[: _COMPARED + 1] if one is not print_]
            if to_known < _SAME or best_likeness(print_, others) >= to_known + _CLEARLY:
                continue
        said[verdict.name] += 1
    if said and said.most_common(1)[0][1] > 0.5 * len(new.views):
        known, count = said.most_common(1)[0]
        raise InputError(
            f"{count} of {len(new.views)} views of {new.name!r} look like {known!r}",
            f"choose other pictures, or remove {known!r} first",
        )


def _groups(views: NDArray[np.float32]) -> NDArray[np.intp]:
    """Which group each view (n, D) belongs to: groups are joined by single steps that are not unusually wide."""
    apart = np.linalg.norm(views[:, None] - views[None], axis=2)
    nearest = (apart + np.where(np.eye(len(views)) > 0, np.inf, 0.0)).min(axis=1)
    limit = min(max(_JUMP, _JUMP_RATIO * float(np.median(nearest))), _WIDE)
    group = np.full(len(views), -1, np.intp)
    count = 0
    for start in range(len(views)):
        if group[start] >= 0:
            continue
        group[start], todo = count, [start]
        while todo:
            near = np.flatnonzero((apart[todo.pop()] <= limit) & (group < 0))
            group[near] = count
            todo += [int(k) for k in near]
        count += 1
    return group
