"""An evaluation that was cut off goes on where it was."""

from __future__ import annotations

from pathlib import Path

from controller.cli.evaluate_sim import Diary, span

HEAD = {"arm": "reactorx_150", "level": "dynamic", "parts_per_table": 10}


def test_tables_that_are_done_are_not_done_again(tmp_path: Path) -> None:
    diary = Diary(tmp_path, HEAD)
    assert diary.done([3, 4, 5]) == []
    diary.add({"seed": 3, "figures": {"parts": 10}})
    diary.add({"seed": 4, "error": "it broke off"})
    with (tmp_path / "runs.jsonl").open("a") as file:
        file.write('{"seed": 5, "fig')
    again = Diary(tmp_path, HEAD)
    assert again.done([3, 4, 5]) == [{"seed": 3, "figures": {"parts": 10}}]
    again.add({"seed": 5, "figures": {}})
    assert [record["seed"] for record in Diary(tmp_path, HEAD).done([3, 4, 5])] == [3, 5]


def test_records_of_something_else_are_thrown_away(tmp_path: Path) -> None:
    diary = Diary(tmp_path, HEAD)
    diary.done([3])
    diary.add({"seed": 3, "figures": {}})
    assert Diary(tmp_path, {**HEAD, "level": "static"}).done([3]) == []
    assert Diary(tmp_path, HEAD).done([3]) == []


def test_seeds_are_told_shortly() -> None:
    assert span([0, 1, 2]) == "0-2"
    assert span([7]) == "7-7"
    assert span([0, 2]) == "0 2"
