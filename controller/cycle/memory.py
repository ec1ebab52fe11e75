"""What an earlier look showed and this one does not, though the picture has not changed there, is still in the way.

Vision overlooks a part now and then: two that touch, one at the rim of a shadow. Nothing is picked on the word of an
earlier look, but no jaw comes down there either.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from controller.cycle.source import still_shows
from controller.domain import Frame, LocatedObject

_SAME = 0.2
"""Share of the smaller footprint that two things may have in common at most: parts lie beside each other, and outlines
of touching ones overlap by a millimetre."""


class Memory:
    """Remembers the things of earlier looks for as long as the picture shows them.

    Attributes:
        overlooked: Those that the last look did not find.
    """

    def __init__(self) -> None:
        self._known: tuple[LocatedObject, ...] = ()
        self.overlooked: tuple[LocatedObject, ...] = ()

    def look(self, seen: Sequence[LocatedObject], frame: Frame) -> tuple[LocatedObject, ...]:
        """Take in a look; what it has overlooked.

        Args:
            seen: Everything found in it, whether it could be located or roughly only.
            frame: Its frame, with the arm out of the view.
        """
        self.overlooked = tuple(
            old
            for old in self._known
            if not any(_overlap(old, thing) for thing in seen) and still_shows(old.detection, frame)
        )
        self._known = (*seen, *self.overlooked)
        return self.overlooked

    def forget(self) -> None:
        """Believe the looks to come."""
        self._known = self.overlooked = ()


def _overlap(a: LocatedObject, b: LocatedObject) -> bool:
    """Whether two footprints have so much in common that they cannot be two parts."""
    first, second = (cv2.convexHull(thing.footprint.astype(np.float32)) for thing in (a, b))
    common, _ = cv2.intersectConvexConvex(first, second)
    return bool(common > _SAME * min(cv2.contourArea(first), cv2.contourArea(second)))
