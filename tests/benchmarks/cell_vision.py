"""What vision and localisation make of painted cells, beside the truth: found, named, false, and the errors in mm.

    python -m tests.benchmarks.cell_vision --cells 20 --level static

The lens and the table are calibrated once a cell from painted boards, by the code a user runs; the parts are
scattered anew for every cell. Prints one line a cell, a summary, and the time of a frame beside what the simulated
cycle charges for it: processor time of this thread, the best of several looks at the same frame, on one core.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import thread_time

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.backends import DEVICES, BackendOptions, Level, Mode
from controller.config.arm import load_arm
from controller.config.cell import load_cell
from controller.config.files import shipped
from controller.cycle.view import Backdrop, region_mask
from controller.domain import CellCalibration, Frame, TruePart
from controller.geometry import angle_difference
from controller.localization.locate import Located, locate
from controller.motion.planner import Planner
from controller.service.self_calibration import calibrate_cell
from controller.vision.annotate import annotate
from controller.vision.detect import Detected, detect
from controller.vision.recipe import load_recipe

SAME_PART_MM = 15.0
"""Half of the narrowest part: nearer than this, a located object can only be that part."""
_LOOKS = 3
"""How often each frame is looked at: the least time counts."""


@dataclass(frozen=True, slots=True)
class Seen:
    """One painted cell, and what was made of it.

    Attributes:
        frame: The picture, taken with the arm at its ready pose.
        truth: Every part.
        detected: By vision.
        located: By localisation.
        calibration: Of the cell, with which it was seen.
        region: ndarray of shape (H, W), dtype uint8: where parts are looked for.
        hidden: ndarray of shape (H, W), dtype uint8: where nothing is to be looked for.
        vision_ms: What vision took, ms of processor time, the least of some looks.
        locate_ms: What localisation took.
    """

    frame: Frame
    truth: Sequence[TruePart]
    detected: Detected
    located: Located
    calibration: CellCalibration
    region: NDArray[np.uint8]
    hidden: NDArray[np.uint8]
    vision_ms: float
    locate_ms: float


def look_at_cell(
    seed: int, parts: int, level: str, folder: Path, cell: str = "sim.toml", *, looks: int = 1
) -> Seen:
    """Build a shipped cell, calibrate its camera with boards, move the arm out of view, take a picture, look at it."""
    config = load_cell(shipped(cell))
    arm = load_arm(config.arm.description)
    devices = DEVICES[Mode.SIM](config, arm, BackendOptions(folder, parts=parts, seed=seed, level=Level(level)))
    devices.open()
    try:
        devices.clear_table()
        calibration = calibrate_cell(devices, config, folder / "calibration", lambda line: None, thorough=False)
        devices.lay_parts()
        planner = Planner(arm, calibration, config.bin_values())
        devices.arm.follow(planner.home(devices.arm.energise().positions))
        frame = devices.camera.capture(devices.clock.now())
        joints = devices.arm.state().positions
        assert devices.truth is not None
        truth = list(devices.truth.at(frame.captured_at))
    finally:
        devices.close()
    recipe = load_recipe(config.vision.recipe)
    region = region_mask(config, calibration, frame.size)
    hidden = Backdrop(config, calibration, frame.size).mask(planner.hidden(joints))
    plane = calibration.plane(config.shape_plane_mm)
    vision_ms = locate_ms = math.inf
    for _ in range(looks):
        began = thread_time()
        detected = detect(frame, recipe, plane=plane, region=region, hidden=hidden)
        between = thread_time()
        located = locate(detected.detections, calibration, config.part_height)
        vision_ms = min(vision_ms, 1e3 * (between - began))
        locate_ms = min(locate_ms, 1e3 * (thread_time() - between))
    return Seen(frame, truth, detected, located, calibration, region, hidden, vision_ms, locate_ms)


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=1000)
    parser.add_argument("--parts", type=int, default=8)
    parser.add_argument("--level", type=str, default="static")
    parser.add_argument("--save", type=Path, help="write annotated pictures of cells with an error into this folder")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    totals = {"parts": 0, "found": 0, "right": 0, "false": 0, "refused": 0}
    errors: list[float] = []
    angles: list[float] = []
    sizes: list[float] = []
    times: list[float] = []
    more: list[float] = []
    for seed in range(arguments.first_seed, arguments.first_seed + arguments.cells):
        with tempfile.TemporaryDirectory() as folder:
            seen = look_at_cell(seed, arguments.parts, arguments.level, Path(folder), looks=_LOOKS)
        times.append(seen.vision_ms)
        more.append(seen.locate_ms)
        refused = len(seen.located.refused)
        line = {"seed": seed, "parts": len(seen.truth), "found": 0, "right": 0, "false": 0, "refused": refused}
        free = list(seen.truth)
        for thing in seen.located.objects:
            near = sorted((math.dist(part.center, thing.center), part.part_id, part) for part in free)
            if not near or near[0][0] > SAME_PART_MM:
                line["false"] += 1
                continue
            distance, _, part = near[0]
            free.remove(part)
            line["found"] += 1
            if thing.shape is part.shape:
                line["right"] += 1
                errors.append(distance)
                sizes.append(max(abs(a - b) for a, b in zip(part.size, thing.size, strict=True)))
                angles += _angle(part, thing.yaw)
        for key in totals:
            totals[key] += line[key]
        print(json.dumps(line), flush=True)
        if arguments.save and (line["right"] < line["parts"] or line["false"]):
            arguments.save.mkdir(parents=True, exist_ok=True)
            picture = annotate(seen.frame.image, seen.detected.detections, located=seen.located.objects)
            cv2.imwrite(str(arguments.save / f"{seed}.png"), picture)
    spreads = {"position_mm": errors, "angle_deg": angles, "size_mm": sizes, "vision_ms": times, "locate_ms": more}
    print(json.dumps(totals | {name: _spread(values) for name, values in spreads.items()}))
    charged = 1e3 * load_cell(shipped("sim.toml")).cycle.vision_budget_s
    slow, typical, most = sum(time > charged for time in times), float(np.median(times)), max(times)
    verdict = "holds" if not slow else f"{slow} of {len(times)} frames take longer"
    print(f"vision takes {typical:.1f} ms a frame in the median, {most:.1f} at most; {charged:.0f} charged: {verdict}")
    print(f"localisation takes {float(np.median(more)):.1f} ms more in the median, {max(more):.1f} at most")


def _angle(part: TruePart, yaw: float | None) -> list[float]:
    period = part.shape.period
    if period is None or part.yaw is None or yaw is None:
        return []
    return [abs(math.degrees(angle_difference(yaw, part.yaw, period)))]


def _spread(values: list[float]) -> dict[str, float]:
    if not values:
        return {}
    array = np.array(values)
    figures = {"mean": array.mean(), "median": np.median(array), "p95": np.percentile(array, 95), "max": array.max()}
    return {name: round(float(value), 3) for name, value in figures.items()}


if __name__ == "__main__":
    main()
