"""The simulated cell as its camera sees it: every part found and named, and no shadow, bin or arm taken for one.

These pictures have what flat scenes lack: side faces, cast shadows with a sharp foot, a tilted and distorted view,
bins, and the arm at its ready pose. `tests/benchmarks/cell_vision.py --save DIR` shows many more.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.benchmarks.cell_vision import look_at_cell


@pytest.mark.parametrize("seed", [1000, 1005, 1011])
def test_parts_are_found_and_named_and_nothing_else_is(seed: int, tmp_path: Path) -> None:
    seen = look_at_cell(seed, 8, "static", tmp_path)
    found = sorted(str(detection.shape) for detection in seen.detected.detections)
    assert found == sorted(str(part.shape) for part in seen.truth)


def test_prints_near_a_rim_neither_hide_a_part_nor_cut_it_in_two(tmp_path: Path) -> None:
    seen = look_at_cell(5, 8, "static", tmp_path, "sim_taught.toml")
    found = sorted(str(detection.shape) for detection in seen.detected.detections)
    assert found == sorted(str(part.shape) for part in seen.truth)
