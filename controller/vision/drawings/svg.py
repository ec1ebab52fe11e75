"""Curves of an SVG file in millimetres: paths and basic shapes with their transforms.

Source: W3C, "Scalable Vector Graphics (SVG) 1.1", sections 7 (coordinates), 8 (paths, arc implementation in F.6).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from controller.errors import InputError
from controller.vision.drawings.outline import CHORD

Floats = NDArray[np.float64]

_MM = {"mm": 1.0, "cm": 10.0, "in": 25.4, "pt": 25.4 / 72.0, "pc": 25.4 / 6.0, "px": 25.4 / 96.0, "": 25.4 / 96.0}
_LENGTH = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([a-zA-Z%]*)\s*")
_TOKEN = re.compile(r"[MmLlHhVvCcSsQqTtAaZz]|[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_TRANSFORM = re.compile(r"(matrix|translate|scale|rotate|skewX|skewY)\s*\(([^)]*)\)")
_NUMBERS = {"M": 2, "L": 2, "H": 1, "V": 1, "C": 6, "S": 4, "Q": 4, "T": 2, "A": 7, "Z": 0}
_HIDDEN = frozenset({"defs", "symbol", "clipPath", "mask", "pattern", "marker", "text", "metadata", "style", "title"})


def svg_curves(data: bytes) -> list[Floats]:
    """Curves (N, 2), mm, y up, of all that is drawn.

    Raises:
        InputError: It has no size in known units, or uses what cannot be read as an outline.
        ValueError: It is damaged.
    """
    if b"<!ENTITY" in data or (b"<!DOCTYPE" in data and b"[" in data.split(b"<!DOCTYPE", 1)[1].split(b">", 1)[0]):
        raise InputError("the SVG declares entities", "save it as plain SVG")
    try:
        root = ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        raise ValueError(f"it is no XML ({error})") from error
    if _name(root) != "svg":
        raise ValueError("it is no SVG")
    curves = list(_walk(root, _viewport(root), 0))
    return [np.asarray(curve * (1.0, -1.0)) for curve in curves]


def _name(element: ElementTree.Element) -> str:
    return element.tag.rsplit("}", 1)[-1] if isinstance(element.tag, str) else ""


def _viewport(root: ElementTree.Element) -> Floats:
    """(3, 3) from the drawing's units to mm."""
    box = [float(v) for v in re.split(r"[\s,]+", root.get("viewBox", "").strip()) if v]
    width, height = root.get("width"), root.get("height")
    if len(box) != 4 or box[2] <= 0.0 or box[3] <= 0.0:
        return np.diag([_MM[""], _MM[""], 1.0])
    wide = _mm(width) if width and "%" not in width else box[2] * _MM[""]
    high = _mm(height) if height and "%" not in height else box[3] * wide / box[2]
    # As preserveAspectRatio has it when nothing else is said.
    scale = min(wide / box[2], high / box[3])
    return np.array([[scale, 0.0, -box[0] * scale], [0.0, scale, -box[1] * scale], [0.0, 0.0, 1.0]])


def _mm(text: str) -> float:
    found = _LENGTH.fullmatch(text)
    if not found or found[2] not in _MM:
        raise InputError(f"the length {text!r} is in no known unit", "use mm, cm, in, pt or px")
    return float(found[1]) * _MM[found[2]]


def _units(element: ElementTree.Element, key: str, default: float = 0.0) -> float:
    """A length in user units."""
    text = element.get(key)
    if text is None:
        return default
    found = _LENGTH.fullmatch(text)
    if not found or found[2] not in _MM:
        raise InputError(f"the length {text!r} is in no known unit", "use mm, cm, in, pt or px")
    return float(found[1]) * (1.0 if found[2] == "" else _MM[found[2]] / _MM["px"])


def _walk(element: ElementTree.Element, outer: Floats, depth: int) -> Iterator[Floats]:
    name = _name(element)
    if depth > 50:
        raise ValueError("groups are nested too deep")
    if name in _HIDDEN or element.get("display") == "none":
        return
    if name in ("use", "image"):
        raise InputError(f"it holds <{name}>", "turn copies into paths and leave pictures out")
    matrix = outer @ _transform(element.get("transform", ""))
    scale = math.sqrt(abs(float(np.linalg.det(matrix[:2, :2]))))
    for curve in _shape(name, element, max(scale, 1e-9)):
        yield np.asarray(curve @ matrix[:2, :2].T + matrix[:2, 2])
    for child in element:
        yield from _walk(child, matrix, depth + 1)


def _transform(text: str) -> Floats:
    matrix = np.eye(3)
    for name, inner in _TRANSFORM.findall(text):
        v = [float(x) for x in re.split(r"[\s,]+", inner.strip()) if x]
        one = np.eye(3)
        if name == "matrix":
            one[:2] = np.array(v).reshape(3, 2).T
        elif name == "translate":
            one[:2, 2] = v[0], v[1] if len(v) > 1 else 0.0
        elif name == "scale":
            one[0, 0], one[1, 1] = v[0], v[1] if len(v) > 1 else v[0]
        elif name == "rotate":
            c, s = math.cos(math.radians(v[0])), math.sin(math.radians(v[0]))
            one[:2, :2] = [[c, -s], [s, c]]
            if len(v) > 2:
                about = np.array(v[1:3])
                one[:2, 2] = about - one[:2, :2] @ about
        elif name == "skewX":
            one[0, 1] = math.tan(math.radians(v[0]))
        else:
            one[1, 0] = math.tan(math.radians(v[0]))
        matrix = matrix @ one
    return matrix


def _shape(name: str, element: ElementTree.Element, scale: float) -> Iterator[Floats]:
    """Curves of one element in its own units; `scale` mm a unit."""
    if name == "path":
        yield from _path(element.get("d", ""), scale)
    elif name == "rect":
        x, y, w, h = (_units(element, key) for key in ("x", "y", "width", "height"))
        rx, ry = _units(element, "rx", -1.0), _units(element, "ry", -1.0)
        rx, ry = (ry if rx < 0.0 else rx), (rx if ry < 0.0 else ry)
        rx, ry = min(max(rx, 0.0), w / 2.0), min(max(ry, 0.0), h / 2.0)
        if w > 0.0 and h > 0.0:
            yield _rounded(x, y, w, h, rx, ry)
    elif name in ("circle", "ellipse"):
        rx = _units(element, "r" if name == "circle" else "rx")
        ry = rx if name == "circle" else _units(element, "ry")
        t = np.linspace(0.0, 2.0 * math.pi, 361)
        if rx > 0.0 and ry > 0.0:
            middle = _units(element, "cx"), _units(element, "cy")
            yield np.stack([middle[0] + rx * np.cos(t), middle[1] + ry * np.sin(t)], axis=1)
    elif name in ("polygon", "polyline"):
        values = [float(v) for v in re.split(r"[\s,]+", element.get("points", "").strip()) if v]
        points = np.array(values).reshape(-1, 2)
        if len(points) > 1:
            yield np.concatenate([points, points[:1]]) if name == "polygon" else points
    elif name == "line":
        ends = [[_units(element, "x1"), _units(element, "y1")], [_units(element, "x2"), _units(element, "y2")]]
        yield np.array(ends)


def _rounded(x: float, y: float, w: float, h: float, rx: float, ry: float) -> Floats:
    if rx == 0.0 or ry == 0.0:
        return np.array([[x, y], [x + w, y], [x + w, y + h], [x, y + h], [x, y]])
    quarter = np.linspace(0.0, math.pi / 2.0, 31)
    corners = ((x + w - rx, y + h - ry, 0), (x + rx, y + h - ry, 1), (x + rx, y + ry, 2), (x + w - rx, y + ry, 3))
    parts = []
    for cx, cy, k in corners:
        t = quarter + k * math.pi / 2.0
        parts.append(np.stack([cx + rx * np.cos(t), cy + ry * np.sin(t)], axis=1))
    ring = np.concatenate(parts)
    return np.concatenate([ring, ring[:1]])


def _path(text: str, scale: float) -> Iterator[Floats]:
    """The subpaths of path data."""
    rest = _TOKEN.sub("", text).replace(",", "").strip()
    if rest:
        raise ValueError(f"path data holds {rest[:20]!r}")
    tokens = _TOKEN.findall(text)
    here = start = np.zeros(2)
    control: Floats | None = None
    points: list[Floats] = []
    command, k, before = "", 0, ""
    while k < len(tokens):
        if tokens[k].isalpha():
            command, k = tokens[k], k + 1
        elif not command or command in "Zz":
            raise ValueError("path data has numbers without a command")
        upper = command.upper()
        count = _NUMBERS[upper]
        v = [float(token) for token in tokens[k : k + count]]
        if len(v) < count:
            raise ValueError("path data ends in the middle of a command")
        k += count
        base = here if command.islower() else np.zeros(2)
        if upper == "M":
            if len(points) > 1:
                yield np.array(points)
            here = start = base + v
            points = [here]
            # Further pairs are lines.
            command = "l" if command == "m" else "L"
        elif upper == "Z":
            if len(points) > 1:
                yield np.array([*points, start])
            here, points = start, [start]
        else:
            new, control = _segment(upper, v, here, base, control if before else None, before, scale)
            points += list(new)
            here = points[-1]
        before = upper
    if len(points) > 1:
        yield np.array(points)


def _segment(
    upper: str, v: list[float], here: Floats, base: Floats, control: Floats | None, before: str, scale: float
) -> tuple[Floats, Floats | None]:
    """Points after `here` of one drawing command, and the control point a smooth follower mirrors."""
    if upper == "L":
        return np.array([base + v]), None
    if upper == "H":
        return np.array([[base[0] + v[0], here[1]]]), None
    if upper == "V":
        return np.array([[here[0], base[1] + v[0]]]), None
    if upper == "A":
        return _arc(here, v, base + v[5:7], scale), None
    t = np.linspace(0.0, 1.0, 33)[1:, None]
    ahead = [base + v[j : j + 2] for j in range(0, len(v), 2)]
    if upper in "ST":
        smooth = control is not None and before in ("CS" if upper == "S" else "QT")
        ahead.insert(0, 2.0 * here - control if smooth and control is not None else here)
    if len(ahead) == 3:
        a, b, end = ahead
        new = (1 - t) ** 3 * here + 3 * (1 - t) ** 2 * t * a + 3 * (1 - t) * t**2 * b + t**3 * end
        return np.asarray(new), b
    a, end = ahead
    return np.asarray((1 - t) ** 2 * here + 2 * (1 - t) * t * a + t**2 * end), a


def _arc(here: Floats, v: list[float], end: Floats, scale: float) -> Floats:
    """Points after `here` of an elliptical arc (end points given; SVG 1.1, F.6.5)."""
    rx, ry, phi = abs(v[0]), abs(v[1]), math.radians(v[2])
    if rx == 0.0 or ry == 0.0 or np.array_equal(here, end):
        return np.array([end])
    turn = np.array([[math.cos(phi), math.sin(phi)], [-math.sin(phi), math.cos(phi)]])
    x, y = turn @ (here - end) / 2.0
    grow = math.sqrt(max(1.0, (x / rx) ** 2 + (y / ry) ** 2))
    rx, ry = rx * grow, ry * grow
    under = max(0.0, (rx * ry) ** 2 - (rx * y) ** 2 - (ry * x) ** 2) / ((rx * y) ** 2 + (ry * x) ** 2)
    sign = -1.0 if bool(v[3]) == bool(v[4]) else 1.0
    middle = sign * math.sqrt(under) * np.array([rx * y / ry, -ry * x / rx])
    first = math.atan2((y - middle[1]) / ry, (x - middle[0]) / rx)
    last = math.atan2((-y - middle[1]) / ry, (-x - middle[0]) / rx)
    sweep = (last - first) % (2.0 * math.pi)
    if not v[4]:
        sweep -= 2.0 * math.pi
    steps = max(4, math.ceil(abs(sweep) / math.sqrt(8.0 * CHORD / max(max(rx, ry) * scale, CHORD))))
    t = first + sweep * np.arange(1, min(steps, 2000) + 1) / min(steps, 2000)
    local = np.stack([rx * np.cos(t), ry * np.sin(t)], axis=1) + middle
    out = np.asarray(local @ turn + (here + end) / 2.0)
    out[-1] = end
    return out
