"""Parts of 10 to 30 mm height anywhere in view, placed by a lens and a table calibrated here: the short form.

`python -m tests.benchmarks.localization` is the long one, of 500 parts in 50 cells.
"""

from __future__ import annotations

from controller.backends import Level
from tests.benchmarks.localization import figures, study


def test_free_parts_are_placed_to_fractions_of_a_millimetre() -> None:
    cells = [study(seed, 10, Level.DYNAMIC) for seed in (21,)]
    misses = [miss for cell in cells for miss in cell.refined]
    # A part that vision names wrongly is not this room's; all others are placed.
    assert len(misses) + sum(cell.misnamed for cell in cells) >= sum(cell.parts for cell in cells) - 1
    found, rough = figures(misses), figures([miss for cell in cells for miss in cell.rough])
    # The limits of the requirement for 500 parts; measured 0.03 and 0.07 mm, 0.12 degrees, 0.12 mm.
    assert found["position_mm"]["mean"] <= 0.20
    assert found["position_mm"]["p95"] <= 0.50
    assert found["angle_deg"]["p95"] <= 0.3
    assert found["size_mm"]["p95"] <= 0.3
    assert rough["position_mm"]["mean"] > 5 * found["position_mm"]["mean"]
