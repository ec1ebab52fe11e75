"""A process that records targets until it is killed: `python -m tests.unit.ledger.writer LEDGER [LARGEST_FILE]`.

It says on stdout what has been acknowledged, one line each, and `failed: ...` when the ledger refuses.
"""

from __future__ import annotations

import itertools
import sys
from pathlib import Path

from controller.errors import LedgerError
from controller.ledger import SqliteLedger
from sim_backends.virtual_clock import VirtualClock
from tests.unit.ledger.nouns import outcome, plan


def say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> None:
    if len(sys.argv) > 2:
        import resource
        import signal

        # Writes beyond it fail, as on a full disk, instead of killing the process.
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), int(sys.argv[2])))
    clock = VirtualClock()
    ledger = SqliteLedger(Path(sys.argv[1]), clock=clock)
    run = ledger.begin_run(software_version="1.0", config_hash="abc")
    try:
        for number in itertools.count():
            name = f"{run}-{number}"
            ledger.intend(name, plan(name), 1, clock.now())
            say(f"intent {name}")
            attempts = 1 + (number % 3 == 1)
            if attempts == 2:
                ledger.intend(name, plan(name), 2, clock.now())
            ledger.conclude(outcome(name, attempts=attempts))
            say(f"outcome {name}")
    except LedgerError as error:
        say(f"failed: {error}")


if __name__ == "__main__":
    main()
