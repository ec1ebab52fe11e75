"""`calibrate arm --sim`, then `calibrate check --sim`, over cells and arms: what a touch misses by, beside the limits.

Every cell has a camera, an arm and a sheet of its own: joints mounted up to 1.5 degrees askew, play, links of
another weight, a camera pose and a lens that nobody told the controller. `truth` is what the simulated world says of
the same touches; the limits are those of the certificate, in simulated time those of a person's patience.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from controller.backends import Level
from controller.calibration.certificate import MEAN_LIMIT, P95_LIMIT
from controller.config.cell import load_cell
from controller.config.files import shipped
from controller.service.self_calibration import (
    CalibrationOptions,
    calibrate_arm_in,
    calibrate_camera_and_table,
    check_cell,
    open_cell,
)

ARMS = ("reactorx_150", "pincherx_100", "open_manipulator_x")
SECONDS = 240.0


def certified(arm: str, seed: int, level: Level, folder: Path) -> dict[str, Any]:
    """The certificate of one cell, the times both commands took, and the arm's map and touches."""
    config = load_cell(shipped("sim.toml" if arm == "reactorx_150" else f"cells/{arm}.toml"))
    options = CalibrationOptions(config, True, seed, level, folder)
    times = []
    with open_cell(options) as (devices, _):
        times.append(devices.clock.now())
        calibrate_camera_and_table(devices, config, folder, options.say)
        made = calibrate_arm_in(devices, config, folder, options.say)
        times.append(devices.clock.now())
    # A check is a program of its own, begun on a cell at rest; its places are drawn after the fit.
    with open_cell(replace(options)) as (devices, _):
        began = devices.clock.now()
        found = check_cell(devices, config, folder, seed + 1_000_000, options.say)
        times.append(devices.clock.now() - began)
    kept = made.error_map is not None and made.error_map.map is not None
    return found | {
        "calibrate_s": times[1] - times[0],
        "check_s": times[2],
        "touches": made.touches,
        "map": kept,
        "offset": max(abs(value) for value in made.joint_offsets.values()),
    }


def main() -> None:
    """Print a line a cell, then a verdict an arm."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--arm", choices=ARMS, action="append", help="one or more; all when not given")
    parser.add_argument("--cells", type=int, default=5)
    parser.add_argument("--seed", type=int, default=100, help="of the first cell")
    parser.add_argument("--level", type=Level, default=Level.DYNAMIC)
    chosen = parser.parse_args()
    for arm in chosen.arm or ARMS:
        print(f"{arm}, level {chosen.level}: mean/p95 of 30 held-out places, mm")
        print("  seed  before      touch       truth       unseen  points  map  pushes  calibrate  check  verdict")
        passed, worst = 0, np.zeros(2)
        for seed in range(chosen.seed, chosen.seed + chosen.cells):
            with tempfile.TemporaryDirectory() as folder:
                found = certified(arm, seed, chosen.level, Path(folder) / "cal")
            pairs = [
                f"{found[key]['mean']:.2f}/{found[key]['p95']:.2f}" for key in ("before_mm", "touch_mm", "truth_mm")
            ]
            print(
                f"  {seed:4d}  " + "".join(f"{pair:12s}" for pair in pairs) + f"{found['unseen_mm']:6.2f}  "
                f"{found['points']:6d}  {'yes' if found['map'] else 'no':3s}  {found['touches']:6d}  "
                f"{found['calibrate_s']:7.0f} s  {found['check_s']:3.0f} s  {found['verdict']}",
                flush=True,
            )
            truth = np.array([found["truth_mm"]["mean"], found["truth_mm"]["p95"]])
            worst = np.maximum(worst, truth)
            good = found["verdict"] == "passed" and (truth <= (MEAN_LIMIT, P95_LIMIT)).all()
            passed += bool(good and found["calibrate_s"] < SECONDS and found["check_s"] < SECONDS)
        print(
            f"  {passed} of {chosen.cells} passed; worst truth {worst[0]:.2f}/{worst[1]:.2f} "
            f"(limits {MEAN_LIMIT:g}/{P95_LIMIT:g} mm, {SECONDS:g} s): {'met' if passed == chosen.cells else 'NOT MET'}"
        )


if __name__ == "__main__":
    main()
