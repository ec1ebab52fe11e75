"""Runs the matrix; see the package."""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import cv2

from tests.benchmarks.fault_matrix.cases import CASES, Found
from tests.benchmarks.fault_matrix.cycle import run_case
from tests.benchmarks.fault_matrix.processes import PROCESSES, run_process
from tests.benchmarks.fault_matrix.standing import run_standing
from tests.benchmarks.fault_matrix.starting import STARTS, run_start
from tests.benchmarks.open_cell import OpenCell, apart

Field = Callable[[OpenCell, Path], Found]


def fields() -> dict[tuple[str, str], Field]:
    """Every field of the matrix, by fault and state."""
    found: dict[tuple[str, str], Field] = {}
    for fault, case in CASES.items():
        found |= {(fault, state): partial(run_case, case, state) for state in case.states}
        found |= {(fault, state): partial(run_standing, case, state) for state in case.standing}
    found |= {(fault, f"START, {variant}"): partial(run_start, fault, variant) for fault, variant in STARTS}
    found |= {(fault, when): partial(run_process, fault, when) for fault, when in PROCESSES}
    return found


def main() -> int:
    """Run the matrix."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.fault_matrix", description=__doc__)
    parser.add_argument("--faults", nargs="*", metavar="CODE", help="only these")
    parser.add_argument("--states", nargs="*", metavar="STATE", help="only in these: PICK, HELD, STOPPED, START, ...")
    parser.add_argument("--jobs", type=int, default=1, help="fields worked on at a time")
    parser.add_argument("--record", type=Path, metavar="FILE", help="a line a field; those in it are not run again")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    wanted = {
        key: field
        for key, field in fields().items()
        if (not arguments.faults or key[0] in arguments.faults)
        and (not arguments.states or key[1].split(",")[0] in arguments.states)
    }
    began, lines = perf_counter(), list[dict[str, Any]]()
    if arguments.record is not None and arguments.record.exists():
        known = [json.loads(line) for line in arguments.record.read_text(encoding="utf-8").splitlines()]
        lines = [line for line in known if (line["fault"], line["state"]) in wanted]
        for line in lines:
            del wanted[line["fault"], line["state"]]
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        cell = OpenCell.make(root)
        keys = list(wanted)
        jobs = [partial(wanted[key], cell, root / f"field{number}") for number, key in enumerate(keys)]
        for number, found in apart(jobs, arguments.jobs):
            line = _line(*keys[number], found)
            lines.append(line)
            print(json.dumps(line), flush=True)
            if arguments.record is not None:
                with arguments.record.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(line) + "\n")
        cell.devices.close()
    bad = [line for line in lines if line["complaints"]]
    cpu = sum(os.times()[:4])
    print(json.dumps({
        "fields": len(lines),
        "bad": [f"{line['fault']} in {line['state']}" for line in bad],
        "ends": dict(Counter(line["end"] for line in lines)),
        "wall_s": round(perf_counter() - began, 1),
        "cpu_s": round(cpu, 1),
        "verdict": "failed" if bad else "passed",
    }))  # fmt: skip
    return 1 if bad else 0


def _line(fault: str, state: str, found: Found | None) -> dict[str, Any]:
    if found is None:
        return {"fault": fault, "state": state, "end": "?", "complaints": ["its process has died"]}
    figures = {key: found.figures.get(key) for key in ("sorted", "left", "dropped", "indeterminate")}
    line = {"fault": fault, "state": state, "end": found.end or "goes on", **figures}
    return line | {"noticed": found.noticed, "complaints": found.complaints}


if __name__ == "__main__":
    sys.exit(main())
