"""Disturbances: parts that slip or are knocked, and a person who reaches over the table in mid-cycle.

They are seeded: the same seed and wish give the same run again. A wish is a list such as
`slip, swap@PICK:2, add@12.5`: a kind alone strikes at a random moment, `@STATE:N` in the N-th time the cycle comes to
that state, `@SECONDS` after the work began. `all` is one of every kind.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Generator
from dataclasses import dataclass

import numpy as np

from controller.errors import ConfigError
from sim_backends.person import SPEED, Person
from sim_backends.solids import Array
from sim_backends.world import World

KINDS = ("slip", "knock", "remove", "add", "move", "swap", "hand")
"""A part slips out of the jaws, a part is pushed about; a person takes a part away, adds one, moves one, lays two in
each other's place; a hand rests over the table."""

STATES = ("HOMING", "CAPTURE", "PICK", "PLACE", "IDLE")
_WISH = re.compile(r"(?P<kind>[a-z]+)(?:@(?:(?P<state>[A-Z]+)(?::(?P<time>\d+))?|(?P<at>\d+(?:\.\d*)?)))?")
_SECONDS_A_PART = 3.3
_LATEST = 0.8  # share of the expected work after which nothing strikes any more
_SLIPPERY = 0.5  # s
_SHOVE = (150.0, 500.0)  # mm/s
_REST = (1.0, 3.0)  # s that a hand stays which does nothing
_GRASP = 0.25  # s that fingers need to take or to lay a part
_DIFFERENT = 2.0  # mm by which the grips of swapped parts differ at least
_AIMED_AT = 0.6  # how often the part is meant that the arm is about to take
_FRAME = 0.03  # s between two poses of a moving hand


@dataclass(frozen=True, slots=True)
class Disturbance:
    """One thing that happens.

    Attributes:
        kind: One of `KINDS`.
        at: s after the work began; None: by `state`.
        state: At the `occurrence`-th time the cycle enters it, and `delay` s later.
    """

    kind: str
    at: float | None = None
    state: str = ""
    occurrence: int = 1
    delay: float = 0.0


def disturbances(wish: str, seed: int, parts: int) -> tuple[Disturbance, ...]:
    """What a wish means for one seed; moments left open are drawn.

    Args:
        wish: See the module.
        seed: Of the run.
        parts: On its table; how long the work is about to take.

    Raises:
        ConfigError: It is no wish.
    """
    random = np.random.default_rng([seed, 8])
    words = [word.strip() for word in wish.split(",") if word.strip()]
    found = []
    for word in [kind for w in words for kind in (KINDS if w == "all" else (w,))]:
        match = _WISH.fullmatch(word)
        if match is None or match["kind"] not in KINDS:
            known = ", ".join(KINDS)
            raise ConfigError(f"no disturbance {word!r}", f"give KIND, KIND@STATE:N or KIND@SECONDS of {known}")
        kind, delay = match["kind"], float(random.uniform(0.0, 1.2))
        if match["at"]:
            found.append(Disturbance(kind, at=float(match["at"])))
        elif match["state"]:
            if match["state"] not in STATES:
                raise ConfigError(f"{word!r}: no such state", f"states: {', '.join(STATES)}")
            found.append(Disturbance(kind, None, match["state"], int(match["time"] or 1)))
        elif kind == "slip":
            found.append(Disturbance(kind, None, "PLACE", int(random.integers(1, max(parts - 1, 2))), delay))
        elif random.random() < 0.5:
            # Between the look and the grasp, when nobody looks.
            found.append(Disturbance(kind, None, "PICK", int(random.integers(1, max(parts - 1, 2))), delay))
        else:
            found.append(Disturbance(kind, at=float(random.uniform(0.5, _LATEST * _SECONDS_A_PART * parts))))
    return tuple(found)


class Disturber:
    """Lets disturbances happen to a world.

    Args:
        script: What happens when.
        world: The world.
        person: Whose hand does it.
        seed: Of places, speeds and choices.

    Attributes:
        happened: (kind, s after the work began) of all that has begun.
    """

    def __init__(self, script: tuple[Disturbance, ...], world: World, person: Person, seed: int) -> None:
        self._world, self._person = world, person
        self._script = script
        self._random = np.random.default_rng([seed, 9])
        self._began: float | None = None
        self._reached: Counter[str] = Counter()
        self._due: list[tuple[float, str]] = []
        self._aim: Array | None = None
        self._hand: Generator[float, None, None] | None = None
        self._hand_due = 0.0
        self._next = math.inf
        self._at: Array | None = None
        self._deeds: dict[str, Callable[[], Generator[float, None, None]]] = {
            "remove": self._remove, "add": self._add, "move": self._move, "swap": self._swap, "hand": self._rest,
        }  # fmt: skip
        self.happened: list[tuple[str, float]] = []
        world.on_step(self._step)

    def entered(self, state: str) -> None:
        """The cell has come to a state; the first one begins the work."""
        now = self._world.now()
        if self._began is None:
            self._began = now
            self._due += [(now + d.at, d.kind) for d in self._script if d.at is not None]
        self._reached[state] += 1
        self._due += [
            (now + d.delay, d.kind) for d in self._script if d.state == state and d.occurrence == self._reached[state]
        ]
        self._plan()

    def aimed(self, at: Array) -> None:
        """The arm is about to take what is at (x, y) of `base`, mm."""
        self._aim = at

    # --- time ---------------------------------------------------------------------------------------------

    def _plan(self) -> None:
        waiting = [at for at, kind in self._due if self._hand is None or _by_itself(kind)]
        if self._hand is not None:
            waiting.append(self._hand_due)
        self._next = min(waiting, default=math.inf)

    def _step(self, dt: float) -> None:
        now = self._world.now()
        if now + 1e-9 < self._next:
            return
        if self._hand is not None and self._hand_due <= now + 1e-9:
            pause = next(self._hand, None)
            self._hand_due = now + (pause or 0.0)
            if pause is None:
                self._hand = None
        for item in [item for item in self._due if item[0] <= now + 1e-9]:
            if _by_itself(item[1]):
                self._due.remove(item)
                self._let_happen(item[1])
            elif self._hand is None:
                self._due.remove(item)
                self._note(item[1])
                self._hand, self._hand_due = self._deeds[item[1]](), now
        self._plan()

    def _note(self, kind: str) -> None:
        self.happened.append((kind, round(self._world.now() - (self._began or 0.0), 3)))

    # --- what happens by itself -----------------------------------------------------------------------------

    def _let_happen(self, kind: str) -> None:
        world = self._world
        if kind == "slip":
            held = sorted(world.held)
            if not held:
                self._due.append((world.now() + 0.1, kind))
                return
            self._note(kind)
            for index in held:
                world.loose.grease(index, True)
                self._due.append((world.now() + _SLIPPERY, f"dry {index}"))
        elif kind.startswith("dry"):
            world.loose.grease(int(kind.split()[1]), False)
        else:
            chosen = self._choose()
            if chosen is not None:
                self._note(kind)
                speed, way = self._random.uniform(*_SHOVE), self._random.uniform(-math.pi, math.pi)
                spin = float(self._random.uniform(-4.0, 4.0))
                world.loose.shove(chosen, (speed * math.cos(way), speed * math.sin(way)), spin)

    # --- what a person does: every step yields how long it takes, s ----------------------------------------------

    def _remove(self) -> Generator[float, None, None]:
        index = self._choose()
        if index is None:
            return
        yield from self._reach(self._person.place(index))
        yield from self._take(index)
        yield from self._withdraw()

    def _add(self) -> Generator[float, None, None]:
        spare = min(self._world.loose.away, default=None)
        if spare is None:
            return
        yield from self._lay(spare, None)
        yield from self._withdraw()

    def _move(self) -> Generator[float, None, None]:
        index = self._choose()
        if index is None:
            return
        yield from self._reach(self._person.place(index))
        if not (yield from self._take(index)):
            yield from self._withdraw()
            return
        yield from self._lay(index, None)
        yield from self._withdraw()

    def _swap(self) -> Generator[float, None, None]:
        first = self._choose()
        if first is None:
            return
        parts = self._world.parts
        others = [
            i for i in self._person.on_table() if i != first and abs(parts[i].grip - parts[first].grip) > _DIFFERENT
        ]
        if not others:
            return
        second = int(self._random.choice(others))
        places = [(self._person.place(i), self._person.yaw(i)) for i in (first, second)]
        yield from self._reach(places[0][0])
        if not (yield from self._take(first)):
            yield from self._withdraw()
            return
        yield from self._reach(places[1][0])
        if (yield from self._take(second)):
            yield from self._lay(first, places[1])
            yield from self._lay(second, places[0])
        else:
            yield from self._lay(first, places[0])
        yield from self._withdraw()

    def _rest(self) -> Generator[float, None, None]:
        index = self._choose()
        at = self._person.place(index) if index is not None else np.array([210.0, 0.0])
        yield from self._reach(at)
        yield float(self._random.uniform(*_REST))
        yield from self._withdraw()

    def _reach(self, at: Array) -> Generator[float, None, None]:
        """The fingertips go to a place, as soon as the arm is not at work there."""
        if self._at is None:
            self._person.come_from(float(self._random.choice([0.0, 0.9, -0.9])))
            self._at = self._person.outside()
        start = self._at
        steps = max(int(float(np.linalg.norm(at - start)) / SPEED / _FRAME), 1)
        for k in range(1, steps + 1):
            self._at = start + (at - start) * k / steps
            self._person.show(self._at)
            yield _FRAME

    def _withdraw(self) -> Generator[float, None, None]:
        yield from self._reach(self._person.outside())
        self._person.hide()
        self._at = None

    def _take(self, index: int) -> Generator[float, None, bool]:
        """Take a part up; False when the arm has it meanwhile or works there."""
        yield _GRASP
        at = self._person.place(index)
        if index not in self._person.on_table() or self._person.arm_is_in_the_way(at):
            return False
        self._world.loose.take_away(index)
        return True

    def _lay(self, index: int, there: tuple[Array, float] | None) -> Generator[float, None, None]:
        """Lay a part down, where it was asked for when that is still free, else where there is room."""
        while True:
            place = there or self._person.room_for(self._world.parts[index], self._random)
            if place is None:
                return  # a full table: the person keeps it
            yield from self._reach(place[0])
            yield _GRASP
            if self._person.is_free(self._world.parts[index], *place):
                self._world.loose.lay_at(index, float(place[0][0]), float(place[0][1]), place[1])
                return
            there = None

    def _choose(self) -> int | None:
        """A part on the table, more often than not the one that the arm is about to take."""
        there = self._person.on_table()
        if not there:
            return None
        aim = self._aim
        if aim is not None and self._random.random() < _AIMED_AT:
            return min(there, key=lambda i: float(np.linalg.norm(self._person.place(i) - aim)))
        return int(self._random.choice(there))


def _by_itself(kind: str) -> bool:
    """It needs no hand."""
    return kind in ("slip", "knock") or kind.startswith("dry")
