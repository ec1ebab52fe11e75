"""Pictures in, recorded moves out."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import cv2

from tests.benchmarks.cell_vision import look_at_cell
from tests.system.conftest import Controller


def test_a_replay_writes_the_moves_it_would_command(controller: Controller, tmp_path: Path) -> None:
    seen = look_at_cell(7, 3, "static", tmp_path)
    (tmp_path / "pictures").mkdir()
    cv2.imwrite(str(tmp_path / "pictures" / "a.png"), seen.frame.image)
    done = controller(
        "run", "--replay", "pictures", "--calibration", tmp_path / "calibration", "--out", "out", "--json"
    )
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


def test_without_a_calibration_the_replay_says_how_rough_it_is(controller: Controller, tmp_path: Path) -> None:
    seen = look_at_cell(7, 1, "ideal", tmp_path)
    (tmp_path / "pictures").mkdir()
    cv2.imwrite(str(tmp_path / "pictures" / "a.png"), seen.frame.image)
    done = controller("run", "--replay", "pictures", "--out", "out")
    assert done.returncode == 0
    assert "by ruler" in done.stderr
