"""The durable record: what was meant to be picked, before it moves, and what became of it, exactly once.

`SqliteLedger` is the one writer of a running cell; `LedgerView` reads any ledger without changing it.
"""

from controller.ledger.selection import Selection
from controller.ledger.sqlite import OpenTarget, SqliteLedger
from controller.ledger.view import LedgerView

__all__ = ["LedgerView", "OpenTarget", "Selection", "SqliteLedger"]
