"""Sorting by taught classes only: five kinds taught in the simulated cell, then whole tables sorted by them.

    python -m tests.benchmarks.taught_sorting

The kinds of configs/sim_taught.toml differ by shape, colour, size and what is printed on them; each is taught by twelve
views as `controller teach NAME --sim` does. Prints a line a table and the totals. Exit code 1 when a part came into a
wrong bin or was lost without a word, or a run did not come to its end.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from controller.backends import Level
from controller.cli.evaluate_sim import Job
from controller.cli.teach import collected
from controller.cli.teach_sources import from_simulation
from controller.config.cell import CellConfig, load_cell
from controller.config.files import shipped
from controller.vision.classes.store import load_classes, save_class
from controller.vision.classes.taught import admit
from tests.benchmarks.sorting import run_tables

FIRST_SEED = 5000


def teach(config: CellConfig, folder: Path, level: Level, views: int, seed: int) -> None:
    """Teach every kind that lies on the simulated table."""
    for kind in config.simulated_kinds:
        looking, shown = from_simulation(kind.name, config, level, seed, views, "precise", lambda line: None)
        new = collected(kind.name, shown, "mm" if looking.calibrated else "px")
        admission = admit(new, load_classes(folder))
        save_class(folder, admission.new)
        print(f"taught {kind.name!r} by {len(admission.new.views)} views", *admission.warnings, flush=True)


def main() -> int:
    """Teach, sort and judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20, help="tables of 10 parts")
    parser.add_argument("--seed", type=int, default=FIRST_SEED, help="of the first table")
    parser.add_argument("--level", type=Level, default=Level.DYNAMIC)
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--teach-seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    asked = parser.parse_args()
    config = load_cell(shipped("sim_taught.toml"))
    # Bins that do not fill: what is left on the table was not known.
    bins = tuple(bin_.model_copy(update={"capacity": 10}) for bin_ in config.bins)
    config = config.model_copy(update={"bins": bins})
    with tempfile.TemporaryDirectory(prefix="taught-") as name:
        folder = Path(name)
        teach(config, folder, asked.level, asked.views, asked.teach_seed)
        vision = config.vision.model_copy(update={"classes": str(folder)})
        config = config.model_copy(update={"vision": vision})
        seeds = range(asked.seed, asked.seed + asked.runs)
        total = run_tables([Job(config, 10, seed, asked.level) for seed in seeds], asked.jobs)
    lost = total["missorted"] + total["silent"]
    good = lost == 0 and not total["broken"]
    share = total["correct"] / max(total["parts"], 1)
    print(f"{total['parts']} parts, {total['missorted']} missorted (wanted 0), {share:.1%} in their bins: ", end="")
    print("reached" if good else "missed")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
