"""`controller ledger` on every kind of file: sound, empty, damaged, newer, half written, none."""

from __future__ import annotations

import csv
import errno
import io
import json
import os
import shutil
import sqlite3
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from controller.cli import execute
from controller.domain import Result
from controller.ledger import LedgerView, SqliteLedger
from controller.ledger.schema import SCHEMA
from sim_backends.virtual_clock import VirtualClock
from tests.unit.ledger.nouns import outcome, plan

NOON = datetime(2026, 3, 10, 12, tzinfo=UTC)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Two days: placed and dropped on the first, missed on the second; the second run is still going on."""
    now = NOON
    file = tmp_path / "ledger.db"
    with SqliteLedger(file, clock=VirtualClock(), wall=lambda: now) as ledger:
        ledger.begin_run(software_version="1", config_hash="abc", calibration_id="cal-1", mode="real", arm="rx")
        ledger.intend("t1", plan("t1"), 1, 4.0)
        ledger.conclude(outcome("t1"))
        ledger.intend("t2", plan("t2"), 1, 4.0)
        ledger.conclude(outcome("t2", Result.DROPPED))
        ledger.note("state", 5.0, doing="held", code="camera_lost")
        now += timedelta(days=1)
        ledger.begin_run(software_version="2", config_hash="abd")
        ledger.intend("t1", plan("t1"), 1, 4.0)
        ledger.conclude(outcome("t1", Result.GRASP_MISSED))
        ledger.note("operator", 6.0, command="stop", uid=1000)
    return file


def lines(capsys: pytest.CaptureFixture[str], *arguments: object) -> list[Any]:
    assert execute(["ledger", *map(str, arguments), "--json"]) == 0
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


@pytest.mark.parametrize(
    ("options", "wanted"),
    [
        ((), ["placed", "dropped", "grasp_missed"]),
        (("--last", 1), ["grasp_missed"]),
        (("--outcome", "dropped"), ["dropped"]),
        (("--class", "nut"), ["placed", "dropped", "grasp_missed"]),
        (("--class", "bolt"), []),
        (("--bin", "left", "--run", 1), ["placed", "dropped"]),
        (("--since", "2026-03-11T00:00+00:00"), ["grasp_missed"]),
        (("--until", "2026-03-11T00:00+00:00"), ["placed", "dropped"]),
        (("--since", "1h"), []),
    ],
)
def test_show_filters(
    path: Path, capsys: pytest.CaptureFixture[str], options: tuple[object, ...], wanted: list[str]
) -> None:
    assert [row["result"] for row in lines(capsys, "show", path, *options)] == wanted


@pytest.mark.parametrize(
    ("of", "options", "key", "wanted"),
    [
        ("runs", (), "config_hash", ["abc", "abd"]),
        ("runs", ("--until", "2026-03-10T18:00Z"), "run_id", [1]),
        ("runs", ("--since", "2026-03-10T18:00Z"), "run_id", [1, 2]),  # the first one ended on the second day
        ("intents", (), "target_id", ["t1", "t2", "t1"]),
        ("events", (), "kind", ["state", "operator"]),
        ("events", ("--kind", "operator"), "details", [{"command": "stop", "uid": 1000}]),
        ("days", (), "day", []),
    ],
)
def test_every_kind_of_record_is_shown_and_exported(
    path: Path, capsys: pytest.CaptureFixture[str], of: str, options: tuple[object, ...], key: str, wanted: list[Any]
) -> None:
    for command in ("show", "export"):
        assert [row[key] for row in lines(capsys, command, path, "--of", of, *options)] == wanted
    assert execute(["ledger", "show", str(path), "--of", of]) == 0


def test_a_table_says_when_what_where_and_why(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert execute(["ledger", "show", str(path.parent), "--outcome", "dropped"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0].split()[:4] == ["when", "run", "target", "class"]
    for piece in ("t2", "nut", "12.5, -40.2", "dropped", "left", "seen in the bin"):
        assert piece in said[1]
    assert said[-1] == "in all 3 targets: 1 placed, 1 grasp_missed, 1 dropped"


def test_an_export_goes_to_stdout_or_a_file(path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert execute(["ledger", "export", str(path)]) == 0
    said = capsys.readouterr().out
    assert [row["result"] for row in csv.DictReader(io.StringIO(said))] == ["placed", "dropped", "grasp_missed"]
    assert execute(["ledger", "export", str(path), "--out", str(tmp_path / "out.csv")]) == 0
    assert (tmp_path / "out.csv").read_text(encoding="utf-8") == said
    assert execute(["ledger", "export", str(path), "--out", str(tmp_path / "out.jsonl")]) == 0
    lines = (tmp_path / "out.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["result"] for line in lines] == ["placed", "dropped", "grasp_missed"]
    assert execute(["ledger", "export", str(path), "--out", str(tmp_path / "none" / "out.csv")]) == 1


def test_infinite_figures_are_no_json_numbers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with SqliteLedger(tmp_path / "ledger.db", clock=VirtualClock()) as ledger:
        ledger.conclude(outcome("t1"))
        ledger.note("odd", 1.0, value=float("inf"))
    with sqlite3.connect(tmp_path / "ledger.db") as connection:
        connection.execute("DROP TRIGGER outcomes_never_updated")
        connection.execute("UPDATE outcomes SET grasp_clearance_mm = 9e999")
    connection.close()
    for of in ("outcomes", "events"):
        assert execute(["ledger", "show", str(tmp_path), "--json", "--of", of]) == 0
        found = capsys.readouterr().out
        assert '": null' in found
        assert "Infinity" not in found


@pytest.mark.parametrize(
    "arguments",
    [
        ("show", "--of", "runs", "--class", "nut"),
        ("export", "--of", "days", "--run", "1"),
        ("show", "--since", "yesterday"),
        ("show", "--since", "2026-13-01"),
        ("show", "--last", "0"),
        ("show", "--outcome", "lost"),
        ("export", "--since", "999999w"),
    ],
)
def test_what_makes_no_sense_is_a_usage_error(path: Path, arguments: tuple[str, ...]) -> None:
    assert execute(["ledger", arguments[0], str(path), *arguments[1:]]) == 2


def test_verify(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (found,) = lines(capsys, "verify", path)
    assert (found["sound"], found["problems"], found["schema"], found["counts"]["targets"]) == (True, [], SCHEMA, 3)
    with sqlite3.connect(path) as connection:
        connection.execute("INSERT INTO events (run_id, at_s, wall, kind, details) VALUES (9, 0, '', 'x', '{}')")
    connection.close()
    assert execute(["ledger", "verify", str(path)]) == 1
    said = capsys.readouterr().out
    assert "names an unknown run" in said
    assert "NOT SOUND" in said
    assert execute(["ledger", "verify", str(path), "--json"]) == 1
    assert not json.loads(capsys.readouterr().out)["sound"]


COMMANDS = ("show", "export", "verify")


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("killed", [False, True], ids=["empty", "killed before its first commit"])
def test_an_empty_ledger_is_sound(tmp_path: Path, command: str, killed: bool) -> None:
    if killed:
        (tmp_path / "ledger.db").touch()
    else:
        SqliteLedger(tmp_path / "ledger.db", clock=VirtualClock()).close()
    assert execute(["ledger", command, str(tmp_path)]) == 0
    assert execute(["ledger", command, str(tmp_path), "--json"]) == 0


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("none", "no such ledger"),
        ("text", "not a database"),
        ("page", "malformed"),
        ("newer", "newer version"),
        ("foreign", "not a ledger"),
    ],
)
def test_what_cannot_be_read_is_said_and_left_alone(
    path: Path, command: str, kind: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    _spoil(path, kind)
    before = path.read_bytes() if path.exists() else None
    assert execute(["ledger", command, str(path)]) == 1
    assert said in capsys.readouterr().err
    assert (path.read_bytes() if path.exists() else None) == before


def _spoil(path: Path, kind: str) -> None:
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA journal_mode = DELETE")
        if kind == "newer":
            connection.execute(f"PRAGMA user_version = {SCHEMA + 1}")
        elif kind == "foreign":
            connection.execute("PRAGMA application_id = 7")
    connection.close()
    if kind == "none":
        path.unlink()
    elif kind == "text":
        path.write_text("not a database at all, but a text\n" * 100, encoding="ascii")
    elif kind == "page":
        data = bytearray(path.read_bytes())
        data[4096:] = b"\xa5" * (len(data) - 4096)
        path.write_bytes(bytes(data))


@pytest.mark.parametrize("command", COMMANDS)
def test_a_half_written_ledger_shows_what_was_acknowledged(
    tmp_path: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """What a killed process leaves: a database, a log that ends in the middle of a frame, and no index of it."""
    with SqliteLedger(tmp_path / "ledger.db", clock=VirtualClock()) as ledger:
        ledger.intend("t1", plan("t1"), 1, 1.0)
        ledger.conclude(outcome("t1"))
        ledger.intend("t2", plan("t2"), 1, 2.0)
        copy = tmp_path / "copy"
        copy.mkdir()
        for name in ("ledger.db", "ledger.db-wal"):
            shutil.copyfile(tmp_path / name, copy / name)
    with (copy / "ledger.db-wal").open("ab") as log:
        log.write(os.urandom(24 + 2000))
    assert execute(["ledger", command, str(copy), "--json"]) == 0
    found = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    if command == "verify":
        assert (found[0]["counts"]["placed"], found[0]["counts"]["open"]) == (1, 1)
    else:
        assert [row["target_id"] for row in found] == ["t1"]
    with LedgerView(copy / "ledger.db") as view:
        assert view.counts()["open"] == 1  # looking settles nothing


def test_a_folder_of_the_service_that_a_stranger_may_not_read_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def denied(path: Path) -> bool:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    with monkeypatch.context() as patch:
        patch.setattr(Path, "is_file", denied)
        code = execute(["ledger", "verify", str(tmp_path / "ledger.db")])
    shown = capsys.readouterr()
    assert (code, shown.out) == (1, "")
    assert shown.err.startswith(f"error: {tmp_path / 'ledger.db'}: Permission denied: ")
    assert "usermod -aG sorter" in shown.err
