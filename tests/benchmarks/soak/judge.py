"""The verdict of a soak: everything on record, nothing grown."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from pathlib import Path

from controller.ledger.view import LedgerView
from tests.benchmarks.soak.shift import Found, Window

MOST_GROWTH_MB = 3.0
"""Memory that may be gained a simulated hour: what the allocator does not give back, and the counts of a run."""
MOST_SLOWER = 1.25
"""Times of the last third of the windows against the first: the mix of faults alone makes them differ by a tenth."""


def judge(found: Found, path: Path) -> None:
    """Add what is wrong with the ledger at `path`, or has grown from the first third of the windows to the last."""
    say = found.complaints.append
    with LedgerView(path) as ledger:
        for problem in ledger.verify():
            say(f"ledger: {problem}")
        counts = {name: number for name, number in ledger.counts().items() if number and name != "targets"}
    if counts != {name: number for name, number in found.results.items() if number}:
        say(f"on record are {counts}, seen were {dict(found.results)}")
    later = found.windows[1:]
    third = len(later) // 3
    if third == 0:
        return
    first, last = later[:third], later[-third:]
    apart = (last[-1].sim_s - first[0].sim_s) / 3600.0
    growth = statistics.median(w.rss_mb for w in last) - statistics.median(w.rss_mb for w in first)
    if growth > MOST_GROWTH_MB * max(apart, 1.0):
        say(f"memory has grown by {growth:.1f} MB in {apart:.1f} h")
    if max(w.files for w in last) > max(w.files for w in first) + 2:
        say("file descriptors have grown")
    if max(w.threads for w in last) > max(w.threads for w in first):
        say("threads have grown")
    times: dict[str, Callable[[Window], float]] = {
        "cycle_s": lambda window: window.cycle_s,
        "cpu_s in yardsticks": lambda window: window.cpu_s / window.yardstick_s,
    }
    for name, of in times.items():
        before, after = (statistics.median(map(of, part)) for part in (first, last))
        if after > MOST_SLOWER * before:
            say(f"{name} has grown from {before:.3f} to {after:.3f}")
