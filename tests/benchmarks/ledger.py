"""What the ledger costs: `python -m tests.benchmarks.ledger [TARGETS]`.

Prints the time of an intent and of an outcome until it is on the disk, and how long a ledger of that many
targets takes to open (with its check) and to verify. A pick takes seconds: anything below some ms is free.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median, quantiles
from time import perf_counter

from controller.ledger import LedgerView, SqliteLedger
from sim_backends.virtual_clock import VirtualClock
from tests.unit.ledger.nouns import outcome, plan


def timed(action: Callable[[], object]) -> float:
    """Milliseconds an action takes."""
    began = perf_counter()
    action()
    return (perf_counter() - began) * 1e3


def main() -> None:
    targets = int(sys.argv[1]) if len(sys.argv) > 1 else 2000
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "ledger.db"
        intents, outcomes = [], []
        with SqliteLedger(path, clock=VirtualClock()) as ledger:
            for number in range(targets):
                planned, final = plan(f"t{number}"), outcome(f"t{number}")
                intents.append(timed(partial(ledger.intend, f"t{number}", planned, 1, 0.0)))
                outcomes.append(timed(partial(ledger.conclude, final)))
        for name, times in (("intent", intents), ("outcome", outcomes)):
            print(f"{name:8} median {median(times):.2f} ms, p95 {quantiles(times, n=20)[-1]:.2f} ms on the disk")
        size = path.stat().st_size / 1e6
        opening = timed(lambda: SqliteLedger(path, clock=VirtualClock()).close())
        with LedgerView(path) as view:
            verifying = timed(view.verify)
        print(f"{targets} targets, {size:.1f} MB: open {opening:.0f} ms, verify {verifying:.0f} ms")


if __name__ == "__main__":
    main()
