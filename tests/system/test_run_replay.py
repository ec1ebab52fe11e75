"""Pictures in, recorded moves out."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import cv2
import pytest

from tests.benchmarks.cell_vision import look_at_cell
from tests.system.conftest import Controller


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a picture of three parts in `pictures`, and the calibration that belongs to it."""
    folder = tmp_path_factory.mktemp("cell")
    seen = look_at_cell(7, 3, "static", folder)
    (folder / "pictures").mkdir()
    cv2.imwrite(str(folder / "pictures" / "a.png"), seen.frame.image)
    return folder


def test_a_replay_writes_the_moves_it_would_command(controller: Controller, cell: Path, tmp_path: Path) -> None:
    asked = ("run", "--replay", cell / "pictures", "--calibration", cell / "calibration", "--out", "out", "--json")
    done = controller(*asked)
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout)
    assert figures["mode"] == "replay"
    assert figures["sorted"] == 3
    moves = [json.loads(line) for line in (tmp_path / "out" / "moves.jsonl").read_text().splitlines()]
    names = [move.get("name", move["command"]) for move in moves]
    pick = ["approach", "grip", "carry", "grip"]
    assert [name for name in names if name != "retreat"] == [
        "energise", "home", *pick * 3, "clear_stop", "park", "relax",
    ]  # fmt: skip
    # Recorded moves chain: each begins where the one before ended.
    follows = [move for move in moves if move["command"] == "follow"]
    for before, after in pairwise(follows):
        assert before["to_deg"] == after["from_deg"]


def test_without_a_calibration_the_replay_says_how_rough_it_is(controller: Controller, cell: Path) -> None:
    done = controller("run", "--replay", cell / "pictures", "--out", "out")
    assert done.returncode == 0
    assert "by ruler" in done.stderr
