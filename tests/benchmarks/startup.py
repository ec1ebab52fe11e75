"""How long the service takes to be ready, what it costs while it waits, and how soon a stop reaches the arm.

    python -m tests.benchmarks.startup

The service comes up in a process of its own on simulated devices, whose making is not counted: the rest is what a real
cell goes through, from the interpreter's start to READY. Processor time, so that others on the machine do not matter;
the camera's own 1.5 s for its exposure to settle, and its thread of about a hundredth of a core, come on top. Prints
its verdicts; the exit code is 1 when one falls short.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any
from unittest.mock import patch

STOPS = 20
IDLE_S = 10.0
MOST_READY_S, MOST_IDLE = 3.0, 0.05
"""Asked: processor time from the interpreter's start to READY, and its share while the cell waits."""
MOST_STOP_MS = 50.0
"""What SR-20 allows from the order until the goals slow down, of which the way to the arm is the smaller part."""
_PAUSE_S = 0.05
"""Between two requests: their rate is limited."""


def _child(calibration: Path) -> int:
    """The service; prints what it took and the verdicts, and gives the exit code."""
    from controller.backends import DEVICES, BackendOptions, Devices, Level, Mode
    from controller.config.cell import CellConfig, load_cell
    from controller.config.files import shipped
    from controller.domain import ArmDescription
    from controller.errors import SorterError
    from controller.service import session as session_module
    from controller.service.client import ControlClient
    from controller.service.session import RunOptions, Session

    figures: dict[str, Any] = {"imports_cpu_s": time.process_time()}
    made_in = 0.0
    stopped = threading.Event()

    def devices(config: CellConfig, arm: ArmDescription, options: BackendOptions) -> Devices:
        nonlocal made_in
        began = time.process_time()
        made = DEVICES[Mode.SIM](config, arm, BackendOptions(options.out, parts=1, level=Level.DYNAMIC))
        made.presenter = None
        made_in = time.process_time() - began
        request = made.arm.request_stop

        def told() -> None:
            request()
            stopped.set()

        patch.object(made.arm, "request_stop", told).start()
        return made

    patch.object(session_module, "DEVICES", {Mode.REAL: devices}).start()

    def operate() -> None:
        operator = ControlClient(Path(os.environ["STATE_DIRECTORY"]))
        while True:
            try:
                if operator.ask("status")["state"] == "STOPPED":
                    break
            except SorterError:  # not up yet
                time.sleep(0.02)
        figures["ready_cpu_s"] = time.process_time() - made_in
        cpu, wall = time.process_time(), time.perf_counter()
        time.sleep(IDLE_S)
        figures["idle_share"] = (time.process_time() - cpu) / (time.perf_counter() - wall)
        delays = []
        for _ in range(STOPS):
            operator.ask("start")
            stopped.clear()
            time.sleep(_PAUSE_S)
            while operator.ask("status")["state"] == "STOPPED":
                time.sleep(_PAUSE_S)
            time.sleep(_PAUSE_S)
            began = time.perf_counter()
            operator.ask("stop")
            assert stopped.wait(5.0)
            delays.append(1e3 * (time.perf_counter() - began))
            operator.wait_for_rest(30.0)
        figures["stop_ms"] = {"median": sorted(delays)[len(delays) // 2], "max": max(delays), "stops": STOPS}

    def measure() -> None:
        try:
            operate()
        finally:
            session.stop()

    session = Session(RunOptions(Mode.REAL, load_cell(shipped("sim.toml")), calibration=calibration))
    operator = threading.Thread(target=measure, daemon=True)
    operator.start()
    session.run()
    operator.join()
    print(json.dumps(figures))
    return _judge(figures)


def _judge(figures: dict[str, Any]) -> int:
    """Print each figure beside what is asked; 1 when one falls short or was not reached."""
    verdicts = [
        ("ready, s of processor time", figures.get("ready_cpu_s", math.inf), MOST_READY_S),
        ("share of a core while waiting", figures.get("idle_share", math.inf), MOST_IDLE),
        ("stop at the socket to the arm, ms, median", figures.get("stop_ms", {}).get("median", math.inf), MOST_STOP_MS),
    ]
    for what, found, most in verdicts:
        print(f"{what}: {found:.3g}, asked {most:g} at most: {'holds' if found <= most else 'falls short'}")
    return 0 if all(found <= most for _, found, most in verdicts) else 1


def main() -> int:
    """Measure."""
    if len(sys.argv) > 1:
        return _child(Path(sys.argv[1]))
    from tests.benchmarks.cell_vision import look_at_cell
    from tests.unit.calibration.certified import certify

    with tempfile.TemporaryDirectory() as name:
        look_at_cell(0, 1, "dynamic", Path(name))
        certify(Path(name) / "calibration")
        environment = os.environ | {"STATE_DIRECTORY": f"{name}/state"}
        command = [sys.executable, "-m", "tests.benchmarks.startup", f"{name}/calibration"]
        return subprocess.run(command, env=environment, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
