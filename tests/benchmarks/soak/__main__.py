"""Hours of sorting with faults and disturbances: does anything grow, slow down, get stuck or go missing?

    python -m tests.benchmarks.soak --hours 8

The service itself sorts a simulated table, in simulated time. Whenever the table is empty somebody takes the parts out
of the bins and lays them on the table anew; faults of the catalogue and disturbances strike at random moments; an
operator at the control socket puts right what is wrong, resets, resumes and starts. Prints one line for every ten
simulated minutes and a summary; the exit code is 1 when a part is not accounted for, something moves where nothing
may, the cell gets stuck, or memory, file descriptors or times are not flat.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import threading
import time
from pathlib import Path
from unittest.mock import patch

import cv2

from controller.backends import DEVICES, BackendOptions, Devices, Level, Mode
from controller.cli import keep_memory
from controller.config.cell import CellConfig, load_cell
from controller.config.files import shipped
from controller.domain import ArmDescription
from controller.errors import SorterError
from controller.service import session as session_module
from controller.service.session import RunOptions, Session
from tests.benchmarks.cell_vision import look_at_cell
from tests.benchmarks.soak.judge import judge
from tests.benchmarks.soak.operator import operate
from tests.benchmarks.soak.shift import Found, Soak
from tests.benchmarks.soak.trouble import script, wish
from tests.unit.calibration.certified import certify


def run(
    hours: float,
    seed: int,
    parts: int,
    *,
    faults_an_hour: float,
    disturbances_an_hour: float,
    folder: Path,
    calibration: Path | None = None,
) -> Found:
    """Sort for so long; the environment's state folder is the soak's for as long as it lasts.

    The cell is calibrated into the folder, unless its calibration is given.
    """
    seconds = 3600.0 * hours
    if calibration is None:
        look_at_cell(seed, parts, "dynamic", folder)
        calibration = folder / "calibration"
        certify(calibration)
    faults = folder / "faults.toml"
    faults.write_text(script(seconds, seed, faults_an_hour), encoding="utf-8")
    found = Found()
    soak = Soak(seconds, seed, found)

    def devices(config: CellConfig, arm: ArmDescription, options: BackendOptions) -> Devices:
        options = BackendOptions(
            folder,
            parts=parts,
            seed=seed,
            level=Level.DYNAMIC,
            faults=faults,
            disturb=wish(seconds, seed, disturbances_an_hour),
            watch_clock=options.watch_clock,
        )
        made = DEVICES[Mode.SIM](config, arm, options)
        made.presenter = None
        return made

    config = load_cell(shipped("sim.toml"))
    session = Session(RunOptions(Mode.REAL, config, calibration=calibration, watch=soak.watch))
    operator = threading.Thread(target=operate, args=(soak.over, soak.repair, session), name="operator")
    state = {"STATE_DIRECTORY": str(folder / "state")}
    with patch.object(session_module, "DEVICES", {Mode.REAL: devices}), patch.dict(os.environ, state):
        operator.start()
        try:
            session.run()
        except SorterError as error:
            # A fault may have latched just as it was stopped.
            if not soak.over.is_set():
                found.complaints.append(f"the service has ended: {error}")
        finally:
            if not soak.over.is_set():
                found.complaints.append(f"it ended before its time, at {soak.lasted:.0f} s")
            soak.over.set()
            operator.join()
    judge(found, folder / "state" / "ledger.db")
    return found


def main() -> int:
    """Run the soak."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=8.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--parts", type=int, default=8)
    parser.add_argument("--faults-per-hour", type=float, default=60.0)
    parser.add_argument("--disturbances-per-hour", type=float, default=60.0)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    keep_memory()
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as name:
        found = run(
            arguments.hours,
            arguments.seed,
            arguments.parts,
            faults_an_hour=arguments.faults_per_hour,
            disturbances_an_hour=arguments.disturbances_per_hour,
            folder=Path(name),
        )
    figures = {
        "hours": arguments.hours,
        "supplies": found.supplies,
        "results": dict(found.results),
        "faults": dict(found.faults),
        "complaints": found.complaints,
        "cpu_s": round(time.process_time(), 1),
        "wall_s": round(time.perf_counter() - began, 1),
    }
    print(json.dumps(figures))
    return 1 if found.complaints else 0


if __name__ == "__main__":
    sys.exit(main())
