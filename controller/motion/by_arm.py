"""What is worked out of an arm's description once, and then asked for thousands of times a second."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from controller.domain import ArmDescription

KEPT = 8
"""Arms remembered at a time: a process sees one or two, one that sorts in many cells after each other ever new ones."""

_Built = TypeVar("_Built")


def once_per_arm(build: Callable[[ArmDescription], _Built]) -> Callable[[ArmDescription], _Built]:
    """The same function, which remembers what it gave for the last few arms.

    Arms are told apart by identity: hashing a whole description takes longer than the kinematics.
    """
    known: dict[int, tuple[ArmDescription, _Built]] = {}

    def find(arm: ArmDescription) -> _Built:
        found = known.get(id(arm))
        if found is None:
            if len(known) >= KEPT:
                known.clear()
            found = known[id(arm)] = (arm, build(arm))
        return found[1]

    find.__doc__ = build.__doc__
    return find
