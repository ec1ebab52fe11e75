"""The report of a run: one HTML file that needs nothing else, with the pictures before and after."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.cycle.rig import Look
from controller.insight.page import head, table, text
from controller.vision.annotate import annotate

FATES = {
    "sorted": "sorted, by the cell's own proof",
    "correct": "in the right bin, by the world's truth",
    "missorted": "in a wrong bin, by the world's truth",
    "silent": "thought placed, but elsewhere",
    "rejected": "put into the reject bin",
    "left": "left on the table",
    "dropped": "dropped on the way",
    "indeterminate": "whereabouts unknown",
}
"""What became of the parts, in words: the counts that every report begins with."""

_NAMES = {
    "level": "level of the simulated world",
    "seed": "its seed",
    "parts": "parts on the table",
    "reachable": "of them within reach",
    **FATES,
    "collisions": "touches of what should not be touched",
    "attempts": "attempts",
    "first_try": "sorted at the first attempt",
    "calibration_s": "calibration, s of the cell's clock",
    "sim_s": "sorting, s of the cell's clock",
    "wall_s": "sorting, s of the wall clock",
    "cycle_s": "cycle time, s",
    "localization_error_mm": "error of the located centre, mm",
    "orientation_error_deg": "error of the orientation modulo the symmetry, degrees",
}


def annotated(look: Look) -> NDArray[np.uint8]:
    """The picture of a look with everything found drawn into it."""
    return annotate(look.frame.image, look.detections, located=look.located)


def side_by_side(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Two pictures beside each other, both as high as the lower one."""
    height = min(left.shape[0], right.shape[0])
    scaled = [
        cv2.resize(picture, (round(picture.shape[1] * height / picture.shape[0]), height), interpolation=cv2.INTER_AREA)
        for picture in (left, right)
    ]
    return np.asarray(np.hstack(scaled), np.uint8)


def rows(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The figures of a run as (name, value), in words a person reads."""
    return [(name, text(report[key])) for key, name in _NAMES.items() if report.get(key) is not None]


def page(report: Mapping[str, Any], pictures: Mapping[str, NDArray[np.uint8]]) -> str:
    """A self-contained HTML page.

    Args:
        report: The figures of the contract of `controller run --json`.
        pictures: BGR pictures by caption.
    """
    title = f"Sorting run: {report.get('mode', '')} {report.get('arm', '')}".strip()
    lines = [head(title), table(rows(report))]
    for fault in report.get("faults", []):
        what = f"{fault['code']} at {fault['at_s']} s: {fault['cause']}"
        lines.append(f'<p class="bad">{html.escape(what)}</p>')
    for caption, picture in pictures.items():
        _, jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 88])
        data = base64.b64encode(jpeg.tobytes()).decode()
        lines.append(
            f'<figure><img alt="{html.escape(caption)}" src="data:image/jpeg;base64,{data}">'
            f"<figcaption>{html.escape(caption)}</figcaption></figure>"
        )
    return "\n".join(lines) + "</html>\n"
