"""A board comes off the printer in its size, with its name and a ruler on it."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from controller.calibration.board_search import find_board
from controller.calibration.board_spec import parse_board
from controller.calibration.marker import ArmMarker
from controller.calibration.printing import (
    DPI,
    MARGIN,
    RULER,
    Sheet,
    lay_out,
    lay_out_marker,
    pdf,
    png,
    raster,
    write_sheet,
)
from controller.errors import InputError

SPECS = (
    "charuco:10x7:28:21:DICT_5X5_100",
    "charuco:8x6:25:18:DICT_4X4_50:legacy",
    "chessboard:9x6:25",
    "circles:7x5:30",
)
_MM = 72.0 / 25.4


def drawn_pdf(content: bytes, dpi: float) -> NDArray[np.uint8]:
    """The filled shapes of a PDF of ours, drawn by a reader of its operators written for this test."""
    text = content.decode("latin-1")
    box = re.search(r"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", text)
    assert box is not None
    scale = dpi / 72.0
    width, height = (round(float(side) * scale) for side in box.groups())
    picture = np.full((height, width), 255, np.uint8)
    stream = text.split("stream\n", 1)[1].split("\nendstream", 1)[0]
    unit = float(stream.split()[0])
    for line in stream.splitlines():
        words = line.split()
        if words[-1] == "re":
            x, y, w, h = (float(word) * unit * scale for word in words[:4])
            picture[round(height - y - h) : round(height - y), round(x) : round(x + w)] = 0
        elif words[-1] == "m":
            start = np.array([float(words[0]), float(words[1])])
            path: list[NDArray[np.float64]] = []
        elif words[-1] == "c":
            a, b, end = np.array([float(word) for word in words[:6]]).reshape(3, 2)
            t = np.linspace(0.0, 1.0, 40)[:, None]
            path.append((1 - t) ** 3 * start + 3 * t * (1 - t) ** 2 * a + 3 * t**2 * (1 - t) * b + t**3 * end)
            start = end
            if len(path) == 4:
                points = np.vstack(path) * unit * scale
                points[:, 1] = height - points[:, 1]
                cv2.fillPoly(picture, [np.rint(16 * (points - 0.5)).astype(np.int32)], (0.0,), shift=4)
    return picture


@pytest.mark.parametrize("spec", SPECS)
@pytest.mark.parametrize("kind", ["png", "pdf"])
def test_a_print_is_found_in_its_true_size(spec: str, kind: str) -> None:
    board, dpi = parse_board(spec), 150.0
    sheet = lay_out(board)
    page = raster(sheet, dpi) if kind == "png" else drawn_pdf(pdf(sheet), dpi)
    view = find_board(board, page)
    assert len(view.ids) == len(board.corners)
    # Pixel centres are half a pixel beyond the edges that the millimetres count from.
    on_page = (view.image_points + 0.5) * 25.4 / dpi - sheet.middle
    # At 150 dpi an edge is rounded by up to 0.085 mm; a scale error of 1 in 1000 would be 0.13 mm at the rim.
    assert np.abs(on_page - view.object_points[:, :2]).max() < 0.12
    scale = np.sum(on_page * view.object_points[:, :2]) / np.sum(view.object_points[:, :2] ** 2)
    assert abs(scale - 1.0) < 4e-4


@pytest.mark.parametrize("spec", SPECS)
def test_nothing_lies_where_printers_do_not_print_nor_the_ruler_on_the_board(spec: str) -> None:
    sheet = lay_out(parse_board(spec))
    page = np.asarray(raster(sheet, 150.0) < 128)
    edge = int((MARGIN - 0.2) * 150.0 / 25.4)
    assert not page[:edge].any()
    assert not page[-edge:].any()
    assert not page[:, :edge].any()
    assert not page[:, -edge:].any()
    # A white line parts board and strip.
    inked = np.asarray(page.any(axis=0 if _beside(sheet) else 1))
    printed = inked[edge + 2 : -edge - 2]
    assert not printed.all()


def _beside(sheet: Sheet) -> bool:
    return sheet.texts[0].upwards


def test_the_ruler_is_100_mm_and_the_page_says_so_and_names_the_board() -> None:
    sheet = lay_out(parse_board(SPECS[0]))
    ruler = sheet.rectangles[-12:]  # the line and eleven marks
    along = 1 if _beside(sheet) else 0
    marks = np.sort(ruler[1:, along] + ruler[1:, 2 + along] / 2)
    assert np.allclose(np.diff(marks), RULER / 10)
    assert {SPECS[0]} < {text.text for text in sheet.texts}
    assert any("must be 100.0 mm" in text.text for text in sheet.texts)
    assert f"({SPECS[0]}) Tj".encode() in pdf(sheet)


def test_the_paper_is_the_smallest_that_takes_it() -> None:
    assert lay_out(parse_board("charuco:10x7:28:21:DICT_5X5_100")).size == (297.0, 210.0)
    assert lay_out(parse_board("chessboard:5x8:28")).size == (210.0, 297.0)
    assert lay_out(parse_board("chessboard:12x8:30")).paper == "A3"
    with pytest.raises(InputError, match="does not fit on A3"):
        lay_out(parse_board("chessboard:20x20:28"))
    with pytest.raises(InputError, match="no size to print"):
        lay_out(parse_board("chessboard:any:20"))


def test_a_png_states_its_resolution(tmp_path: Path) -> None:
    sheet = lay_out(parse_board("chessboard:5x4:20"))
    write_sheet(sheet, tmp_path / "board.png")
    content = (tmp_path / "board.png").read_bytes()
    place = content.index(b"pHYs")
    per_metre = struct.unpack(">II", content[place + 4 : place + 12])
    picture = cv2.imread(str(tmp_path / "board.png"), cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    # The page's side is rounded to whole pixels.
    for side, pixels, density in zip(sheet.size, picture.shape[::-1], per_metre, strict=True):
        assert abs(pixels / density * 1000.0 - side) < 25.4 / DPI
    assert png(sheet) == content


def test_a_pdf_is_well_formed() -> None:
    content = pdf(lay_out(parse_board("circles:7x5:30")))
    table = int(content.split(b"startxref\n")[1].split()[0])
    assert content[table:].startswith(b"xref")
    places = re.findall(rb"(\d{10}) 00000 n", content[table:])
    for number, place in enumerate(places, 1):
        assert content[int(place) :].startswith(b"%d 0 obj" % number)
    length = re.search(rb"/Length (\d+) >>\nstream\n", content)
    assert length is not None
    assert content[length.end() + int(length[1]) :].startswith(b"\nendstream")


def test_other_kinds_of_file_and_unwritable_folders_are_refused(tmp_path: Path) -> None:
    board = lay_out(parse_board("chessboard:5x4:20"))
    with pytest.raises(InputError, match=r"\.pdf or \.png"):
        write_sheet(board, tmp_path / "board.svg")
    with pytest.raises(InputError, match="cannot be written"):
        write_sheet(board, tmp_path / "missing" / "board.pdf")
    assert list(tmp_path.iterdir()) == []


def test_the_grippers_marker_is_found_in_its_size_upright_with_its_white_border() -> None:
    marker, dpi = ArmMarker(), 150.0
    sheet = lay_out_marker(marker)
    picture = raster(sheet, dpi)
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, marker.dictionary)))
    corners, ids, _ = detector.detectMarkers(picture)
    assert ids is not None
    assert ids.ravel().tolist() == [marker.marker_id]
    half = marker.size / 2
    wanted = np.array(sheet.middle) + [[-half, -half], [half, -half], [half, half], [-half, half]]
    # Corners are given to about a pixel, 0.17 mm here, before refinement.
    assert np.abs(np.asarray(corners[0])[0] * 25.4 / dpi - wanted).max() < 0.4
    border = np.abs(sheet.rectangles[:, :2] - sheet.middle).max(axis=1)
    outline = sheet.rectangles[(border > half + marker.margin) & (border < half + marker.margin + 1)]
    assert len(outline) == 4  # the line to cut along, all of the white border inside it
