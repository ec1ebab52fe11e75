"""A ledger of its own for each test."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from controller.ledger import SqliteLedger
from tests.unit.ledger.nouns import opened


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "cell" / "ledger.db"


@pytest.fixture
def ledger(path: Path) -> Iterator[SqliteLedger]:
    with opened(path) as ledger:
        yield ledger
