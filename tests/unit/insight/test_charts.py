"""Charts are well-formed and show what they are given."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.insight.charts import error_map, gantt, histogram, matrix, ticks

OUTLINE = [(-100.0, -100.0), (100.0, -100.0), (100.0, 100.0), (-100.0, 100.0)]


@given(st.floats(-1e4, 1e4), st.floats(1e-3, 1e4))
def test_ticks_are_round_few_and_inside(low: float, width: float) -> None:
    found = ticks(low, low + width)
    assert 1 <= len(found) <= 13
    slack = 1e-6 * width
    assert all(low - slack <= value <= low + width + slack for value in found)


@pytest.mark.parametrize("values", [[], [1.0], [1.0, 1.0], [0.0, 5.0, 2.0]])
def test_a_histogram_counts_every_value_once(values: list[float]) -> None:
    svg = ElementTree.fromstring(histogram(values, "errors & more", "mm", bins=5))
    heights = [float(bar.attrib["height"]) for bar in svg.iter("rect")]
    if values:
        top = max(heights)
        counts = [round(height / top * max(values.count(v) for v in values)) for height in heights]
        assert sum(counts) == len(values)


def test_bars_are_as_long_as_what_they_show() -> None:
    svg = ElementTree.fromstring(gantt({"arm": [("a", 0.0, 1.0), ("b", 1.0, 4.0)], "camera": []}, "cycle"))
    first, second = (float(bar.attrib["width"]) for bar in svg.iter("rect"))
    # Widths are written with one decimal of a pixel.
    assert second == pytest.approx(3 * first, abs=0.2)


def test_the_square_with_the_largest_error_is_the_darkest() -> None:
    text = error_map([(-50, -50, 0.1, 0.0), (50, 50, 0.0, 0.8), (51, 51, 0.0, 0.6)], OUTLINE, "map")
    ElementTree.fromstring(text)
    shades = dict(re.findall(r'fill-opacity="([\d.]+)"><title>([\d.]+) mm', text))
    assert max(shades, key=float) == next(shade for shade, error in shades.items() if error == "0.700")


def test_what_lies_off_the_diagonal_is_red() -> None:
    text = matrix({"square": {"square": 9, "circle": 1}}, "seen", "true")
    cells = re.findall(r"rgba\((\d+),.*?\)\">(\d*)</td>", text)
    assert cells == [("213", "1"), ("0", "9")]
