"""Curves of a DXF file (ASCII, R12 and later) in millimetres.

Source: Autodesk, "DXF Reference": group codes of LINE, ARC, CIRCLE, ELLIPSE, LWPOLYLINE, POLYLINE, SPLINE; $INSUNITS.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from controller.errors import InputError
from controller.vision.drawings.outline import MOST_POINTS, arc

Floats = NDArray[np.float64]
Pair = tuple[int, str]

_MM = {0: 1.0, 1: 25.4, 2: 304.8, 4: 1.0, 5: 10.0, 6: 1000.0, 13: 0.001, 14: 100.0}
"""Millimetres of a unit of $INSUNITS; 0 is none, taken for mm."""
_SILENT = frozenset({"TEXT", "MTEXT", "DIMENSION", "LEADER", "POINT", "HATCH", "VIEWPORT", "ATTDEF", "ATTRIB"})
"""Entities that draw no outline."""


def dxf_curves(data: bytes) -> list[Floats]:
    """Curves (N, 2), mm, of a file's model space.

    Raises:
        InputError: It is binary or compressed, or holds what cannot be read as an outline.
        ValueError: It is damaged.
    """
    if data.startswith(b"AutoCAD Binary DXF"):
        raise InputError("the DXF is binary", "save it as ASCII DXF")
    pairs = list(_pairs(data.decode("utf-8", "replace")))
    if not any(pair == (0, "SECTION") for pair in pairs):
        raise ValueError("it has no sections")
    scale = _unit(pairs)
    curves = []
    for kind, codes in _entities(pairs):
        curve = _curve(kind, codes, scale)
        if curve is not None:
            curves.append(curve * scale)
    return curves


def _pairs(text: str) -> Iterator[Pair]:
    lines = text.splitlines()
    for k in range(0, len(lines) - 1, 2):
        try:
            code = int(lines[k])
        except ValueError as error:
            raise ValueError(f"line {k + 1} is no group code") from error
        yield code, lines[k + 1].strip()


def _unit(pairs: Sequence[Pair]) -> float:
    for k, pair in enumerate(pairs[:-1]):
        if pair == (9, "$INSUNITS"):
            unit = int(pairs[k + 1][1])
            if unit not in _MM:
                raise InputError(f"its unit ($INSUNITS {unit}) is not known", "save it in millimetres or inches")
            return _MM[unit]
    return 1.0


def _entities(pairs: Sequence[Pair]) -> Iterator[tuple[str, list[Pair]]]:
    """(kind, its codes) of everything in the section ENTITIES; vertices go with their polyline."""
    inside, kind, codes = False, "", list[Pair]()
    ended = False
    for k, (code, value) in enumerate(pairs):
        if code == 2 and value == "ENTITIES" and k and pairs[k - 1] == (0, "SECTION"):
            inside = True
            continue
        if not inside:
            continue
        if code == 0:
            if kind == "POLYLINE" and value == "VERTEX":
                codes.append((0, value))
                continue
            if kind:
                yield kind, codes
            kind, codes = value, []
            if value == "ENDSEC":
                ended = True
                break
        else:
            codes.append((code, value))
    if inside and not ended:
        raise ValueError("it ends in the middle of its entities")


def _curve(kind: str, codes: list[Pair], scale: float) -> Floats | None:
    """Points (N, 2) of one entity in the file's unit; None for one that draws nothing."""
    if kind in _SILENT or kind == "SEQEND":
        return None
    # The vertices of an old polyline follow it with codes of their own.
    own = codes[: codes.index((0, "VERTEX"))] if (0, "VERTEX") in codes else codes
    one = dict(own)
    if float(one.get(230, "1")) < 0.0:
        raise InputError(f"a {kind} is seen from behind", "flatten the drawing to its top view")

    def number(code: int, default: float | None = None) -> float:
        if code not in one:
            if default is None:
                raise ValueError(f"a {kind} lacks its group code {code}")
            return default
        return float(one[code])

    if kind == "LINE":
        return np.array([[number(10), number(20)], [number(11), number(21)]])
    if kind in ("CIRCLE", "ARC"):
        center, radius = (number(10), number(20)), number(40)
        if radius <= 0.0:
            raise ValueError(f"a {kind} has no radius")
        start = math.radians(number(50, 0.0))
        sweep = 2.0 * math.pi
        if kind == "ARC":
            sweep = (math.radians(number(51)) - start) % (2.0 * math.pi) or 2.0 * math.pi
        return _unscaled(center, radius, start, sweep, scale)
    if kind == "ELLIPSE":
        u = np.array([number(11), number(21)])
        v = np.array([-u[1], u[0]]) * number(40)
        t = np.linspace(number(41, 0.0), number(42, 2.0 * math.pi), 181)
        return np.asarray((number(10), number(20)) + np.outer(np.cos(t), u) + np.outer(np.sin(t), v))
    if kind in ("LWPOLYLINE", "POLYLINE"):
        return _polyline(kind, codes, bool(int(one.get(70, "0")) & 1), scale)
    if kind == "SPLINE":
        return _spline(codes, int(number(71)))
    if kind in ("INSERT", "SOLID", "3DFACE", "REGION", "3DSOLID", "BODY", "MESH"):
        raise InputError(f"it holds a {kind}", "explode blocks and solids into lines and arcs")
    return None


def _unscaled(center: tuple[float, float], radius: float, start: float, sweep: float, scale: float) -> Floats:
    """An arc in the file's unit, as fine as it has to be in mm."""
    ring = arc((0.0, 0.0), radius * scale, start, sweep)
    return np.asarray(ring / scale + center)


def _polyline(kind: str, codes: list[Pair], closed: bool, scale: float) -> Floats:
    points: list[list[float]] = []
    started = kind == "LWPOLYLINE"
    for code, value in codes:
        if code == 0:
            started = True
        elif started and code == 10:
            points.append([float(value), math.nan, 0.0])
        elif started and code == 20 and points:
            points[-1][1] = float(value)
        elif started and code == 42 and points:
            points[-1][2] = float(value)
    if len(points) < 2:
        raise ValueError(f"a {kind} has {len(points)} points")
    pieces = []
    ahead = [*points[1:], points[0]] if closed else points[1:]
    for a, b in zip(points, ahead, strict=False):
        pieces.append(_bulged(a, b, scale)[:-1])
    last = points[0] if closed else points[-1]
    return np.concatenate([*pieces, np.array([last[:2]])])


def _bulged(a: Sequence[float], b: Sequence[float], scale: float) -> Floats:
    """From one point of a polyline to the next: straight, or an arc whose bulge is the tangent of a quarter of it."""
    p, q, bulge = np.array(a[:2]), np.array(b[:2]), a[2]
    if bulge == 0.0 or np.array_equal(p, q):
        return np.stack([p, q])
    sweep = 4.0 * math.atan(bulge)
    chord = q - p
    half = float(np.linalg.norm(chord)) / 2.0
    to_center = np.array([-chord[1], chord[0]]) / (2.0 * half) * half / math.tan(sweep / 2.0)
    center = (p + q) / 2.0 + to_center
    radius = abs(half / math.sin(sweep / 2.0))
    start = math.atan2(p[1] - center[1], p[0] - center[0])
    return _unscaled((float(center[0]), float(center[1])), radius, start, sweep, scale)


def _spline(codes: list[Pair], degree: int) -> Floats:
    knots = np.array([float(v) for c, v in codes if c == 40])
    control = np.array([[float(v) for c, v in codes if c == axis] for axis in (10, 20)]).T
    weights = np.array([float(v) for c, v in codes if c == 41]) if any(c == 41 for c, _ in codes) else None
    if not len(control) and any(c == 11 for c, _ in codes):
        raise InputError("a SPLINE has fit points only", "turn splines into polylines")
    if not 1 <= degree <= 10 or len(control) <= degree or len(knots) != len(control) + degree + 1:
        raise ValueError("a SPLINE has not the knots its points need")
    if len(control) > MOST_POINTS:
        raise ValueError("a SPLINE has too many points")
    # A rational spline is a plain one in a dimension more.
    w = np.ones(len(control)) if weights is None else weights
    curve = BSpline(knots, np.column_stack([control * w[:, None], w]), degree)
    t = np.linspace(knots[degree], knots[-degree - 1], min(40 * len(control), 4000))
    values = np.asarray(curve(t), np.float64)
    return np.asarray(values[:, :2] / values[:, 2:])
