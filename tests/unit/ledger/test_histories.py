"""Any history of picks, crashes and restarts, against a model in plain Python."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from controller.domain import Result
from controller.ledger import SqliteLedger
from sim_backends.virtual_clock import VirtualClock
from tests.unit.ledger.nouns import outcome, plan

NAMES = st.sampled_from(["a", "b", "c"])
FINAL = st.sampled_from([result for result in Result if result is not Result.INDETERMINATE])


class Histories(RuleBasedStateMachine):
    """The model: for every (run, target) how often it was tried, and its outcome."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = tempfile.TemporaryDirectory()
        self.path = Path(self.folder.name) / "ledger.db"
        self.run = 0
        self.tried: dict[tuple[int, str], int] = {}
        self.concluded: dict[tuple[int, str], Result] = {}
        self.open()

    def open(self) -> None:
        self.ledger = SqliteLedger(self.path, clock=VirtualClock())

    def begin(self) -> None:
        self.run = self.ledger.begin_run(software_version="1", config_hash="x")

    def teardown(self) -> None:
        self.ledger.close()
        self.folder.cleanup()

    @rule()
    def begin_a_run(self) -> None:
        self.begin()

    @precondition(lambda self: self.ledger.run_id is not None)
    @rule(name=NAMES)
    def intend(self, name: str) -> None:
        key = (self.run, name)
        attempt = self.tried.get(key, 0) + 1
        if key in self.concluded:
            with pytest.raises(ValueError, match="already has an outcome"):
                self.ledger.intend(name, plan(name), attempt, 1.0)
        else:
            self.ledger.intend(name, plan(name), attempt, 1.0)
            self.tried[key] = attempt

    @precondition(lambda self: self.ledger.run_id is not None)
    @rule(name=NAMES, result=FINAL)
    def conclude(self, name: str, result: Result) -> None:
        key = (self.run, name)
        final = outcome(name, result, attempts=self.tried.get(key, 0))
        if key in self.concluded:
            with pytest.raises(ValueError, match="UNIQUE"):
                self.ledger.conclude(final)
        else:
            self.ledger.conclude(final)
            self.concluded[key] = result

    @rule()
    def crash_and_open_again(self) -> None:
        cut_off = self.ledger.run_id is not None
        self.ledger._connection.close()
        self.open()
        self.settle()
        assert self.ledger.unclean_runs == cut_off

    @rule()
    def close_and_open_again(self) -> None:
        self.ledger.close()
        self.open()
        self.settle()
        assert self.ledger.unclean_runs == 0

    def settle(self) -> None:
        left_open = sorted(key for key in self.tried if key not in self.concluded)
        assert sorted((o.run_id, o.target_id) for o in self.ledger.indeterminate) == left_open
        self.concluded |= dict.fromkeys(left_open, Result.INDETERMINATE)

    @invariant()
    def the_ledger_agrees_with_the_model(self) -> None:
        counts = self.ledger.counts()
        for result in Result:
            assert counts[result] == sum(1 for r in self.concluded.values() if r is result)
        assert counts["open"] == sum(1 for key in self.tried if key not in self.concluded)
        assert counts["targets"] == len(self.tried.keys() | self.concluded.keys())
        assert self.ledger.verify() == ()


Histories.TestCase.settings = settings(max_examples=15, stateful_step_count=20, deadline=None)
TestHistories = Histories.TestCase
