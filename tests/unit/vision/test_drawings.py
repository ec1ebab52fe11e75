"""Outlines from drawings: what is drawn comes out in millimetres, what is no part is refused with its reason."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from controller.errors import InputError
from controller.vision.classes.drawn import drawn_class
from controller.vision.classes.features import LENGTH, block
from controller.vision.classes.store import load_class, save_class
from controller.vision.classes.taught import Taught, admit
from controller.vision.drawings import outline as outline_module
from controller.vision.drawings.outline import read_drawing

# 40 x 30 mm with a half disc at its right end and a hole of 6 mm radius.
AREA = 40.0 * 30.0 + math.pi * 15.0**2 / 2.0


def _dxf(*entities: str, unit: int = 4) -> str:
    head = f"0\nSECTION\n2\nHEADER\n9\n$INSUNITS\n70\n{unit}\n0\nENDSEC\n0\nSECTION\n2\nENTITIES\n"
    return head + "".join(entities) + "0\nENDSEC\n0\nEOF\n"


LINE = "0\nLINE\n8\n0\n10\n{}\n20\n{}\n11\n{}\n21\n{}\n"
CIRCLE = "0\nCIRCLE\n8\n0\n10\n{}\n20\n{}\n40\n{}\n"
ARC = "0\nARC\n8\n0\n10\n{}\n20\n{}\n40\n{}\n50\n{}\n51\n{}\n"
POLYLINE = (
    "0\nLWPOLYLINE\n8\n0\n90\n4\n70\n1\n10\n0\n20\n0\n10\n40\n20\n0\n42\n1\n10\n40\n20\n30\n10\n0\n20\n30\n"
)
OLD = (
    "0\nPOLYLINE\n8\n0\n66\n1\n70\n1\n10\n0\n20\n0\n0\nVERTEX\n10\n0\n20\n0\n70\n0\n0\nVERTEX\n10\n40\n20\n0\n42\n1\n"
    "0\nVERTEX\n10\n40\n20\n30\n0\nVERTEX\n10\n0\n20\n30\n0\nSEQEND\n"
)
PIECES = (
    LINE.format(0, 0, 40, 0) + LINE.format(0, 30, 40, 30) + LINE.format(0, 0, 0, 30) + ARC.format(40, 15, 15, 270, 90)
)


@pytest.mark.parametrize("entities", [POLYLINE, OLD, PIECES])
def test_a_dxf_outline_comes_out_in_mm(tmp_path: Path, entities: str) -> None:
    path = tmp_path / "part.dxf"
    path.write_text(_dxf(entities, CIRCLE.format(15, 15, 6), "0\nTEXT\n1\nnot drawn\n"))
    drawn = read_drawing(path)
    # Chords stray from arcs by 0.02 mm: 0.7 mm^2 on 47 mm of arc.
    assert drawn.area == pytest.approx(AREA, abs=0.8)
    assert np.allclose(drawn.size, (55.0, 30.0), atol=0.05)
    assert len(drawn.holes) == 1
    assert outline_module.area(drawn.holes[0]) == pytest.approx(math.pi * 36.0, abs=0.6)


def test_units_and_splines_are_read(tmp_path: Path) -> None:
    path = tmp_path / "part.dxf"
    path.write_text(_dxf(CIRCLE.format(0, 0, 0.5), unit=1))
    assert read_drawing(path).size[0] == pytest.approx(25.4, abs=0.05)
    # A quarter of a circle as a rational spline of degree 2, closed by two lines.
    w = math.sqrt(0.5)
    spline = "0\nSPLINE\n70\n4\n71\n2\n" + "".join(f"40\n{k}\n" for k in (0, 0, 0, 1, 1, 1))
    spline += "".join(f"41\n{v}\n" for v in (1, w, 1)) + "".join(
        f"10\n{x}\n20\n{y}\n" for x, y in ((20, 0), (20, 20), (0, 20))
    )
    path.write_text(_dxf(spline, LINE.format(0, 20, 0, 0), LINE.format(0, 0, 20, 0)))
    assert read_drawing(path).area == pytest.approx(math.pi * 100.0, abs=0.2)


def test_an_svg_outline_comes_out_in_mm(tmp_path: Path) -> None:
    path = tmp_path / "part.svg"
    path.write_text(
        '<svg xmlns="http://www.w3.org/2000/svg" width="6cm" height="4cm" viewBox="0 0 120 80">'
        '<g transform="translate(10 10) scale(2)"><path d="M0,0h40a15 15 0 0 1 0,30H0z"/>'
        '<circle cx="15" cy="15" r="6"/></g><text x="1" y="1">no</text></svg>'
    )
    drawn = read_drawing(path)
    assert drawn.area == pytest.approx(AREA, abs=0.8)
    assert len(drawn.holes) == 1


@pytest.mark.parametrize(
    ("name", "text", "reason"),
    [
        ("a.dxf", "no drawing at all", "damaged"),
        ("a.dxf", _dxf(POLYLINE)[:-40], "damaged"),
        ("a.dxf", _dxf(LINE.format(0, 0, 40, 0), LINE.format(40, 0, 40, 30)), "is open at"),
        ("a.dxf", _dxf(LINE.format(0, "inf", 40, 0), PIECES), "no number"),
        ("a.dxf", _dxf(), "no outline"),
        ("a.dxf", _dxf(CIRCLE.format(0, 0, 10), CIRCLE.format(100, 0, 10)), "more than one outline"),
        ("a.dxf", _dxf(CIRCLE.format(0, 0, 10), unit=6), "mm long"),
        ("a.dxf", _dxf(CIRCLE.format(0, 0, "nan")), "damaged"),
        ("a.dxf", _dxf("0\nINSERT\n2\nblock\n10\n0\n20\n0\n"), "explode"),
        ("a.svg", "<svg", "no XML"),
        ("a.svg", '<!DOCTYPE x [<!ENTITY a "b">]><svg/>', "entities"),
        ("a.svg", '<svg width="9furlong" viewBox="0 0 1 1"/>', "no known unit"),
        ("a.svg", '<svg><path d="M0 0 L 5"/></svg>', "middle of a command"),
        ("a.step", "x", "neither DXF nor SVG"),
    ],
)
def test_what_is_no_outline_is_refused_with_its_reason(tmp_path: Path, name: str, text: str, reason: str) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(InputError) as refused:
        read_drawing(path)
    assert reason in f"{refused.value.cause} {refused.value.remedy}"


def test_a_huge_drawing_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.dxf"
    path.write_text(_dxf(POLYLINE))
    monkeypatch.setattr(outline_module, "MOST_BYTES", 10)
    with pytest.raises(InputError, match="larger than"):
        read_drawing(path)


def test_a_drawn_class_knows_its_form_and_size_in_any_colour(tmp_path: Path) -> None:
    path = tmp_path / "part.dxf"
    path.write_text(_dxf(POLYLINE, CIRCLE.format(15, 15, 6)))
    drawn = drawn_class("bracket", read_drawing(path), 12.0, path.name)
    taught = admit(drawn, ()).taught
    assert taught.heights == {"bracket": 12.0}
    again = load_class(save_class(tmp_path, drawn))
    assert np.array_equal(again.views, drawn.views, equal_nan=True)
    views = np.nan_to_num(drawn.views, nan=0.3)
    larger = views.copy()
    larger[:, block("size")] += math.log(1.25)
    verdicts = Taught((again,)).classifier.verdicts(np.concatenate([views, larger]).reshape(-1, LENGTH))
    said = [verdict.name if verdict else None for verdict in verdicts]
    assert said[: len(views)] == ["bracket"] * len(views)
    assert said[len(views) :] == [None] * len(views)
