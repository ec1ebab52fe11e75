"""A run that ends in FAULT still tells what it sorted before."""

from __future__ import annotations

import json
from typing import Any

import pytest

from controller.cli import run as command
from controller.errors import ArmError, SorterError


class Faulted:
    """A session that sorts three parts, then faults."""

    def __init__(self, options: object) -> None:
        self.figures: dict[str, Any] = {}

    def run(self) -> None:
        self.figures = {"parts": 4, "correct": 3, "out": "run"}
        raise ArmError("servo 2 (shoulder)", "carry", "overloaded", "free the joint")

    def stop(self) -> None:
        """Nobody asks for it here."""


@pytest.mark.parametrize("as_json", [True, False])
def test_figures_are_printed_before_the_fault_ends_the_command(
    as_json: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command, "Session", Faulted)
    with pytest.raises(SorterError, match="overloaded"):
        command.run(sim=True, as_json=as_json)
    said = capsys.readouterr().out
    if as_json:
        assert json.loads(said) == {"parts": 4, "correct": 3, "out": "run"}
    else:
        assert "3" in said
