"""Calibration boards on paper: one page, true to the tenth of a millimetre, with a ruler that proves it.

A board printed at 97 % makes a cell that misses by 3 %, and no residual tells. So every page carries a ruler to
be measured and the SPEC to be typed. The page is a list of black rectangles and discs in mm; PDF (vectors) and
PNG (600 dpi) are two ways to write it down, by a few lines each rather than by a library.
"""

from __future__ import annotations

import math
import os
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.calibration.boards import Board, BoardKind
from controller.calibration.marker import ArmMarker
from controller.errors import InputError
from controller.vision import landmarks

Array = NDArray[np.float64]

#: (short, long) side of the papers that may be used, mm (ISO 216), smallest first.
PAPERS = {"A4": (210.0, 297.0), "A3": (297.0, 420.0)}
#: Common printers leave this much of the paper's edge white: a sixth of an inch, mm.
MARGIN = 4.3
#: The strip with ruler and text along one side of the paper, and its distance from the board, mm.
STRIP, GAP = 6.5, 1.5
#: Length of the ruler, mm.
RULER = 100.0
#: Of a printed PNG: an edge is rounded by at most 0.02 mm.
DPI = 600
_TEXT = 2.3  # height of the letters' em, mm
_DISC = 0.3  # radius of a disc as a share of the pitch
_CHECK = "measure: must be 100.0 mm (print at 100 %, not fitted to the page)"


@dataclass(frozen=True, slots=True)
class Text:
    """One line of text.

    Attributes:
        x, y: Start of its base line, mm from the page's upper left.
        upwards: It runs up the page, to be read from the right.
        text: The line.
    """

    x: float
    y: float
    upwards: bool
    text: str


@dataclass(frozen=True, slots=True, eq=False)
class Sheet:
    """One page. Everything in mm from its upper left, x to the right, y down.

    Attributes:
        paper: Name of the paper.
        size: (width, height) of the page as it is read.
        middle: Middle of the board on the page.
        rectangles: ndarray of shape (N, 4): x, y, width, height.
        discs: ndarray of shape (M, 3): x, y, radius.
        texts: Lines of text.
    """

    paper: str
    size: tuple[float, float]
    middle: tuple[float, float]
    rectangles: Array
    discs: Array
    texts: tuple[Text, ...]


def lay_out(board: Board) -> Sheet:
    """The page of a board: the smallest paper that takes it, its ruler and its name.

    Raises:
        InputError: The board has no size, or fits no paper.
    """
    if board.kind is BoardKind.OVERFILLED:
        raise InputError(f"{board.spec} has no size to print", "name its inner corners, e.g. chessboard:13x9:20")
    if board.kind is BoardKind.STAGGERED:
        raise InputError(f"{board.spec} is read, not printed", "print charuco:10x7:28:21:DICT_5X5_100 instead")
    columns, rows = board.squares
    ink = columns * board.pitch, rows * board.pitch
    best: tuple[float, str, tuple[float, float], bool] | None = None
    for paper, (short, long) in PAPERS.items():
        for size in ((long, short), (short, long)):
            for beside in (False, True):
                need = (STRIP + GAP, 0.0) if beside else (0.0, STRIP + GAP)
                room = min(size[axis] - 2 * MARGIN - ink[axis] - need[axis] for axis in (0, 1))
                if room >= 0.0 and (best is None or room > best[0]):
                    best = room, paper, size, beside
        if best is not None:
            break
    if best is None:
        short, long = PAPERS["A3"]
        most = long - 2 * MARGIN - STRIP - GAP, short - 2 * MARGIN
        raise InputError(
            f"{board.spec} is {ink[0]:g} x {ink[1]:g} mm and does not fit on A3",
            f"choose fewer or smaller squares: {most[0]:.0f} x {most[1]:.0f} mm is the most",
        )
    _, paper, size, beside = best
    free = (size[0] - STRIP - GAP - MARGIN, size[1]) if beside else (size[0], size[1] - STRIP - GAP - MARGIN)
    # The paper beyond the strip is white as well: the board keeps the printer's margin on its other side.
    middle = tuple(max(free[axis] / 2, MARGIN + ink[axis] / 2) for axis in (0, 1))
    pattern, discs = _pattern(board)
    pattern[:, :2] += middle
    discs[:, :2] += middle
    strip, texts = _strip(board.spec, size, beside)
    return Sheet(paper, size, (middle[0], middle[1]), np.vstack([pattern, strip]), discs, texts)


def lay_out_marker(marker: ArmMarker) -> Sheet:
    """The page of the gripper's marker: within the line along which its plate is cut, with a ruler and its place."""
    size = PAPERS["A4"]
    middle = np.array([size[0] / 2, size[1] / 3])
    half = marker.size / 2 + marker.margin
    strip, texts = _strip(f"marker {marker.marker_id} of {marker.dictionary}, {marker.size:g} mm", size, False)
    x, _, z = marker.T_tool_marker[:3, 3]
    words = (
        "Cut along the line and glue it onto something flat and stiff.",
        f"It belongs on the gripper: with the arm stretched level, {-x:g} mm behind the grasp point, {z:g} mm above",
        "it, face to the arm's base, this way up. A few mm and degrees do not matter; that it stays put does.",
    )
    told = _lines(words, float(middle[1] + half + 12.0))
    rectangles = np.vstack([_cut_out(marker, middle), strip])
    return Sheet("A4", size, (float(middle[0]), float(middle[1])), rectangles, np.empty((0, 3)), (*texts, *told))


def lay_out_corners() -> Sheet:
    """The page of the table's four corner markers, each within the line along which it is cut."""
    size = PAPERS["A4"]
    middle = np.array([size[0] / 2, size[1] / 3])
    markers = [ArmMarker(landmarks.DICTIONARY, name, landmarks.SIZE_MM) for name in landmarks.IDS]
    apart = landmarks.SIZE_MM + 2 * markers[0].margin + 12.0
    places = [middle + apart / 2 * np.array([x, y]) for y in (-1, 1) for x in (-1, 1)]
    cut = [_cut_out(marker, place) for marker, place in zip(markers, places, strict=True)]
    strip, texts = _strip(f"corner markers of {landmarks.DICTIONARY}, {landmarks.SIZE_MM:g} mm", size, False)
    words = (
        "Cut along the lines and glue each flat onto the table, whole in the camera's view, away from the parts,",
        "where neither the arm nor a bin hides it for long. Which lies where does not matter. Then calibrate the",
        "table: from then on the cell holds as soon as a marker is seen elsewhere.",
    )
    told = _lines(words, float(middle[1] + apart + 12.0))
    rectangles = np.vstack([*cut, strip])
    return Sheet("A4", size, (float(middle[0]), float(middle[1])), rectangles, np.empty((0, 3)), (*texts, *told))


def _cut_out(marker: ArmMarker, middle: Array) -> Array:
    """Rectangles (N, 4) of a marker around its middle, and of the line along which it is cut."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, marker.dictionary))
    modules = dictionary.markerSize + 2
    step = marker.size / modules
    bits = np.asarray(cv2.aruco.generateImageMarker(dictionary, marker.marker_id, modules)) == 0
    corner = middle - marker.size / 2
    black = [(corner[0] + step * x, corner[1] + step * y, step * n, step) for x, y, n in _runs(bits)]
    half, thin = marker.size / 2 + marker.margin, 0.2
    side = 2 * (half + thin)
    left, top = middle - half - thin
    line = [(left, top, side, thin), (left, top + side - thin, side, thin)]
    line += [(left, top, thin, side), (left + side - thin, top, thin, side)]
    return np.array(black + line)


def _lines(words: Sequence[str], top: float) -> tuple[Text, ...]:
    return tuple(Text(25.0, top + 4.5 * row, False, line) for row, line in enumerate(words))


def _pattern(board: Board) -> tuple[Array, Array]:
    """Rectangles (N, 4) and discs (M, 3) of a board around its middle."""
    columns, rows = board.squares
    corner = -np.array([columns, rows]) * board.pitch / 2
    no_rectangles, no_discs = np.empty((0, 4)), np.empty((0, 3))
    if board.kind is BoardKind.CIRCLES:
        return no_rectangles, np.column_stack([board.corners[:, :2], np.full(columns * rows, _DISC * board.pitch)])
    row, column = np.divmod(np.arange(columns * rows), columns)
    if board.kind is BoardKind.CHESSBOARD:
        black = (row + column) % 2 == 0
        markers: list[tuple[float, float, float, float]] = []
    else:
        # OpenCV's own board decides where its markers are; the squares without one are black.
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
        made = cv2.aruco.CharucoBoard((columns, rows), board.pitch, board.marker, dictionary)
        made.setLegacyPattern(board.legacy)
        modules = dictionary.markerSize + 2
        size = board.marker / modules
        black, markers = np.ones(columns * rows, bool), []
        for name, points in zip(np.ravel(made.getIds()), made.getObjPoints(), strict=True):
            start = np.asarray(points, np.float64)[:, :2].min(axis=0)
            square = np.floor((start + board.marker / 2) / board.pitch).astype(int)
            black[square[1] * columns + square[0]] = False
            bits = np.asarray(cv2.aruco.generateImageMarker(dictionary, int(name), modules)) == 0
            markers += [(*(start + corner + size * np.array([x, y])), size * n, size) for x, y, n in _runs(bits)]
    x, y = corner[0] + column[black] * board.pitch, corner[1] + row[black] * board.pitch
    squares = np.column_stack([x, y, np.full((len(x), 2), board.pitch)])
    return np.vstack([squares, np.array(markers).reshape(-1, 4)]), no_discs


def _runs(bits: NDArray[np.bool_]) -> list[tuple[int, int, int]]:
    """(column, row, length) of every run of set bits in a row."""
    padded = np.pad(bits.astype(np.int8), ((0, 0), (1, 1)))
    steps = np.diff(padded, axis=1)
    starts, ends = np.argwhere(steps == 1), np.argwhere(steps == -1)
    return [(int(s[1]), int(s[0]), int(e[1] - s[1])) for s, e in zip(starts, ends, strict=True)]


def _strip(name: str, size: tuple[float, float], beside: bool) -> tuple[Array, tuple[Text, ...]]:
    """Ruler and text along the lower edge of the page, or along its right one, reading upwards."""
    thin = 0.2
    # In the strip's own coordinates: s along it, t across it away from the board's side.
    bars = [(-thin / 2, STRIP - 1.0 - thin, RULER + thin, thin)]
    for mark in range(0, int(RULER) + 1, 10):
        tall = 4.5 if mark % 50 == 0 else 2.5
        bars.append((mark - thin / 2, STRIP - 1.0 - tall, thin, tall))
    lines = [(RULER + 3.0, 2.6, _CHECK), (RULER + 3.0, 5.6, name), (1.0, 1.9, "0"), (RULER - 5.5, 1.9, "100")]
    if not beside:
        left, top = MARGIN + 1.0, size[1] - MARGIN - STRIP
        rectangles = np.array(bars) + [left, top, 0.0, 0.0]
        return rectangles, tuple(Text(left + s, top + t, False, text) for s, t, text in lines)
    left, bottom = size[0] - MARGIN - STRIP, size[1] - MARGIN - 1.0
    rectangles = np.array([(left + t, bottom - s - long, high, long) for s, t, long, high in bars])
    return rectangles, tuple(Text(left + t, bottom - s, True, text) for s, t, text in lines)


# --- written down -------------------------------------------------------------------------------------


def write_sheet(sheet: Sheet, path: Path) -> None:
    """Write a page as `.pdf` or `.png`, whole or not at all.

    Raises:
        InputError: The file's kind is neither, or it cannot be written.
    """
    kinds = {".pdf": pdf, ".png": png}
    if path.suffix.lower() not in kinds:
        raise InputError(f"{path}: boards are written as .pdf or .png", "end the file's name in one of them")
    content = kinds[path.suffix.lower()](sheet)
    fresh = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        fresh.write_bytes(content)
        fresh.replace(path)
    except OSError as error:
        fresh.unlink(missing_ok=True)
        raise InputError(f"{path}: cannot be written ({error.strerror})", "choose a folder you may write to") from error


def raster(sheet: Sheet, dpi: float = DPI) -> NDArray[np.uint8]:
    """The page as a picture, (H, W), dtype uint8, 0 and 255 only.

    Args:
        sheet: The page.
        dpi: Pixels per inch.
    """
    scale = dpi / 25.4
    width, height = (round(side * scale) for side in sheet.size)
    picture = np.full((height, width), 255, np.uint8)
    starts, sides = np.hsplit(sheet.rectangles, 2)
    for x0, y0, x1, y1 in np.rint(np.hstack([starts, starts + sides]) * scale).astype(int):
        picture[y0 : max(y1, y0 + 1), x0 : max(x1, x0 + 1)] = 0
    for x, y, radius in sheet.discs * scale:
        left, top, end = math.floor(x - radius), math.floor(y - radius), math.ceil(2 * radius) + 2
        rows, columns = np.ogrid[top : top + end, left : left + end]
        inside = (rows + 0.5 - y) ** 2 + (columns + 0.5 - x) ** 2 < radius**2
        picture[top : top + end, left : left + end][inside] = 0
    for text in sheet.texts:
        _letter(picture, text, scale)
    return picture


def _letter(picture: NDArray[np.uint8], text: Text, scale: float) -> None:
    """Draw one line of text in OpenCV's strokes."""
    tall = _TEXT * 0.72 * scale
    size = tall / 22.0  # the plain face is 22 px tall
    pen = max(1, round(0.22 * scale))
    (length, _), below = cv2.getTextSize(text.text, cv2.FONT_HERSHEY_SIMPLEX, size, pen)
    line = np.full((round(tall) + 2 * below, length + 2 * pen), 255, np.uint8)
    base = round(tall) + below // 2
    cv2.putText(line, text.text, (0, base), cv2.FONT_HERSHEY_SIMPLEX, size, 0, pen)
    x, y = round(text.x * scale), round(text.y * scale)
    if text.upwards:
        line = np.rot90(line)
        x, y = x - base, y - line.shape[0]
    else:
        y -= base
    there = picture[max(y, 0) : y + line.shape[0], max(x, 0) : x + line.shape[1]]
    np.minimum(there, line[: there.shape[0], : there.shape[1]], out=there)


def png(sheet: Sheet) -> bytes:
    """The page as a PNG of one bit a pixel that states its resolution.

    Source: PNG specification, 11.3.4.3 pHYs (pixels per metre).
    """
    done, data = cv2.imencode(".png", raster(sheet), [cv2.IMWRITE_PNG_BILEVEL, 1])
    assert done
    content = data.tobytes()
    body = b"pHYs" + struct.pack(">IIB", *(round(DPI / 0.0254),) * 2, 1)
    chunk = struct.pack(">I", 9) + body + struct.pack(">I", zlib.crc32(body))
    end = 8 + 12 + 13  # signature and IHDR, which comes first
    return content[:end] + chunk + content[end:]


def pdf(sheet: Sheet) -> bytes:
    """The page as a PDF of vectors.

    Source: ISO 32000-1, 7.5 (file structure), 8.5 (paths), 9.4 (text); lengths in points of 25.4/72 mm.
    """
    width, height = sheet.size
    # From here on mm from the lower left, as PDF counts.
    parts = [f"{72 / 25.4:.9f} 0 0 {72 / 25.4:.9f} 0 0 cm", "0 g"]
    parts += [f"{x:.4f} {height - y - h:.4f} {w:.4f} {h:.4f} re" for x, y, w, h in sheet.rectangles]
    bend = 4.0 / 3.0 * (math.sqrt(2.0) - 1.0)
    for x, y_down, r in sheet.discs:
        y, b = height - y_down, bend * r
        parts.append(f"{x + r:.4f} {y:.4f} m")
        for (cx, cy), (dx, dy), (ex, ey) in (
            ((r, b), (b, r), (0.0, r)),
            ((-b, r), (-r, b), (-r, 0.0)),
            ((-r, -b), (-b, -r), (0.0, -r)),
            ((b, -r), (r, -b), (r, 0.0)),
        ):
            parts.append(f"{x + cx:.4f} {y + cy:.4f} {x + dx:.4f} {y + dy:.4f} {x + ex:.4f} {y + ey:.4f} c")
    parts.append("f")  # all as one area, so that abutting squares show no seam
    for text in sheet.texts:
        turn = "0 1 -1 0" if text.upwards else "1 0 0 1"
        shown = text.text.replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")
        parts.append(f"BT /F {_TEXT} Tf {turn} {text.x:.4f} {height - text.y:.4f} Tm ({shown}) Tj ET")
    stream = "\n".join(parts).encode("latin-1", "replace")
    box = " ".join(f"{side * 72 / 25.4:.4f}" for side in (width, height))
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {box}] /Contents 4 0 R "
        "/Resources << /Font << /F 5 0 R >> >> >>".encode(),
        b"<< /Length %d >>\nstream\n%s\nendstream" % (len(stream), stream),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
    ]
    out = b"%PDF-1.6\n%\xe2\xe3\xcf\xd3\n"
    places = []
    for number, body in enumerate(objects, 1):
        places.append(len(out))
        out += b"%d 0 obj\n%s\nendobj\n" % (number, body)
    table = len(out)
    out += b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
    out += b"".join(b"%010d 00000 n \n" % place for place in places)
    return out + b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, table)
