"""The shift report: every figure counted right, every second of the period accounted for, a page that stands alone."""

from __future__ import annotations

import html
import itertools
import json
import re
import shlex
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from controller.cli import execute
from controller.cycle.machine import State
from controller.domain import Result
from controller.insight.shift import figures
from controller.insight.shift_page import page
from controller.ledger import LedgerView, SqliteLedger
from sim_backends.virtual_clock import VirtualClock
from tests.unit.insight.shift_ledger import BEGIN, Day, busy_day
from tests.unit.ledger.nouns import outcome, plan

NAMES = {"camera_lost": "camera unplugged", "motion_timeout": "joint blocked"}
LATER = BEGIN + timedelta(days=3)


def counted(path: Path, since: datetime | None = None, until: datetime | None = None) -> dict[str, Any]:
    with LedgerView(path) as view:
        return figures(view, NAMES, LATER, since, until)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "ledger.db"


def test_a_small_day_to_the_second(path: Path) -> None:
    day = Day(path)
    day.clock.sleep(100.0)
    day.start()
    for _ in range(3):
        day.part(10.0)
    day.part(20.0, Result.GRASP_MISSED)
    day.wait(50.0)
    day.part(10.0, Result.REJECTED, bin_="rest")
    day.hold(40.0)
    day.pause(60.0)
    day.part(10.0)
    day.fault(200.0)
    day.end()
    found = counted(path)
    assert found["time_s"] == {
        "sorting": 70.0, "waiting": 50.0, "held": 40.0, "paused": 60.0, "fault": 200.0, "stopped": 100.0, "off": 0.0,
    }  # fmt: skip
    assert found["hours"] == pytest.approx(520 / 3600, abs=1e-4)
    assert found["availability"] == pytest.approx(120 / 360, abs=1e-5)  # told to five places
    assert (found["targets"], found["attempts"]) == (6, 3 * 1 + 3 + 3 + 1)
    assert {name: n for name, n in found["results"].items() if n} == {"placed": 4, "rejected": 1, "grasp_missed": 1}
    assert found["success"]["value"] == pytest.approx(5 / 6, abs=1e-5)
    assert found["first_try"]["value"] == pytest.approx(4 / 6, abs=1e-5)
    assert found["parts_per_hour"] == {"period": 34.6, "while_sorting": pytest.approx(257.1)}
    # From the first to the second and to the third part; what is interrupted is no cycle.
    assert found["cycles"] == [10.0, 10.0]
    assert [(line["name"], line["seconds"], line["unplanned"]) for line in found["downtime"]] == [
        ("joint blocked", 200.0, True),
        ("stopped, waiting for start", 100.0, False),
        ("paused", 60.0, False),
        ("camera unplugged", 40.0, True),
    ]
    assert [(alarm["code"], alarm["lasted_s"], alarm["remedy"]) for alarm in found["alarms"]] == [
        ("camera_lost", 40.0, "plug it in"),
        ("motion_timeout", 200.0, "clear the way"),
    ]
    assert found["bins"] == {"left": {"nut": 4}, "rest": {"nut": 1}}
    assert [line["command"] for line in found["operators"]] == ["start", "reset"]


@pytest.fixture(scope="module")
def busy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("busy") / "ledger.db"
    busy_day(path, seed=1, scale=0.04)
    return path


def test_every_second_and_every_part_is_accounted_for_once(busy: Path) -> None:
    found = counted(busy)
    spans = found["spans"]
    assert spans[0]["begin_s"] == 0.0
    assert [span["end_s"] for span in spans[:-1]] == [span["begin_s"] for span in spans[1:]]
    assert sum(found["time_s"].values()) == pytest.approx(found["hours"] * 3600, abs=1.0)
    columns = found["columns"]
    assert sum(columns["covered_s"]) == pytest.approx(found["hours"] * 3600, abs=1.0)
    assert all(0.0 < seconds <= columns["step_s"] for seconds in columns["covered_s"])
    assert sum(columns["placed"]) == found["results"]["placed"]
    assert sum(columns["rejected"]) == found["results"]["rejected"]
    assert sum(map(sum, (columns[kind] for kind in ("placed", "rejected", "other")))) == found["targets"]
    assert sum(sum(counts.values()) for counts in found["bins"].values()) == sum(
        found["results"][name] for name in ("placed", "rejected")
    )
    lost = sum(line["seconds"] for line in found["downtime"])
    assert lost == pytest.approx(sum(found["time_s"][name] for name in ("held", "paused", "fault", "stopped", "off")))
    with LedgerView(busy) as view:
        assert view.counts()["targets"] == found["targets"]


def test_periods_that_meet_add_up(busy: Path) -> None:
    whole = counted(busy)
    since, until = (datetime.fromisoformat(whole[key]) for key in ("since", "until"))
    edges = [since + (until + timedelta(seconds=1) - since) * k / 5 for k in range(6)]
    parts = [counted(busy, *pair) for pair in itertools.pairwise(edges)]
    assert sum(part["targets"] for part in parts) == whole["targets"]
    for name, seconds in whole["time_s"].items():
        # Every part is told to a tenth of a second, and the last edge is a second late.
        assert sum(part["time_s"][name] for part in parts) == pytest.approx(seconds, abs=1.6)


def test_time_between_runs_is_downtime_and_changes_are_told(busy: Path) -> None:
    found = counted(busy)
    assert found["time_s"]["off"] > 3 * 3600
    assert [change["what"] for change in found["changes"]] == [
        "run 1 began; software 1, configuration abc, calibration cal-1, arm rx",
        "run 2 began; configuration abd",
    ]


def test_a_run_that_was_cut_off_ends_when_it_was_last_heard_of(path: Path) -> None:
    day = Day(path)
    day.start()
    day.part(10.0)
    day.ledger.intend("open", plan("open"), 1, day.clock.now())
    day.clock.sleep(500.0)
    day.ledger._connection.close()
    day = Day(path, begin=BEGIN + timedelta(seconds=100.0))
    day.start()
    day.part(10.0)
    day.end()
    found = counted(path)
    assert (found["time_s"]["sorting"], found["time_s"]["off"]) == (20.0, 90.0)
    assert found["results"]["indeterminate"] == 1
    assert found["changes"][1]["what"] == "run 2 began; nothing had changed; the run before was cut off"


def test_a_real_run_goes_on_until_now_and_a_hold_before_the_period_still_holds(path: Path) -> None:
    day = Day(path)
    day.start()
    day.chronicle.faulted(_stuck(), day.clock.now())
    found = counted(path, BEGIN + timedelta(hours=1), BEGIN + timedelta(hours=2))
    assert found["time_s"]["fault"] == 3600.0
    assert found["alarms"][0]["code"] == "motion_timeout"
    day.ledger.close()


def test_a_fault_that_is_the_last_record_of_its_run_is_among_the_alarms(path: Path) -> None:
    day = Day(path)
    day.start()
    day.part(10.0)
    day.chronicle.faulted(_stuck(), day.clock.now())
    day.ledger.close()
    found = counted(path)
    assert [(alarm["code"], alarm["lasted_s"]) for alarm in found["alarms"]] == [("motion_timeout", 0.0)]
    assert [(line["code"], line["times"]) for line in found["downtime"]] == [("motion_timeout", 1)]
    check_page(page(found))


def _stuck() -> Any:
    from controller.errors import MotionTimeout

    return MotionTimeout("arm", "follow", "stuck")


def test_a_warning_lasts_until_it_is_over_or_the_run_is(path: Path) -> None:
    day = Day(path)
    day.start()
    day.chronicle.warned("supply_low", "10.6 V at the servos", day.clock.now())
    day.part(30.0)
    day.chronicle.warned("bin_full", "left is full, 2 parts wait", day.clock.now())
    day.chronicle.eased("supply_low", day.clock.now())
    day.part(20.0)
    day.end()
    found = counted(path)
    assert [(a["code"], a["doing"], a["lasted_s"]) for a in found["alarms"]] == [
        ("supply_low", "warning", 30.0),
        ("bin_full", "warning", 20.0),
    ]
    assert found["availability"] == 1.0
    assert "10.6 V at the servos" in page(found)


def test_simulated_time_counts_where_time_is_simulated(path: Path) -> None:
    clock = VirtualClock()
    with SqliteLedger(path, clock=clock, wall=lambda: BEGIN) as ledger:
        ledger.begin_run(software_version="1", config_hash="abc", mode="sim", arm="rx")
        ledger.note("state", clock.now(), doing="sorting")
        for number in range(4):
            clock.sleep(900.0)
            final = outcome(f"t{number}")
            ledger.conclude(type(final)(final.target, final.plan, final.result, "", 1, 0.0, clock.now()))
    found = counted(path)
    assert found["hours"] == 1.0
    assert found["parts_per_hour"]["period"] == 4.0
    assert "simulated time" in page(found)


@pytest.mark.parametrize("kind", ["empty", "only started", "only days"])
def test_next_to_nothing_is_a_report_too(path: Path, kind: str) -> None:
    now = BEGIN
    with SqliteLedger(path, clock=VirtualClock(), wall=lambda: now) as ledger:
        if kind != "empty":
            ledger.begin_run(software_version="1", config_hash="abc", mode="real")
        if kind == "only days":
            ledger.conclude(outcome("t1"))
            now += timedelta(days=2)
            ledger.prune(keep=timedelta(days=1))
    found = counted(path, BEGIN - timedelta(days=1), BEGIN + timedelta(days=1))
    assert found["targets"] == 0
    assert found["counted_by_day"] == ({"placed": 1} if kind == "only days" else {})
    check_page(page(found))


def check_page(text: str) -> None:
    """It asks nobody for anything, and its drawings are well-formed."""
    assert not re.search(r"https?:|src=|href=|url\(|@import|<script", text)
    for drawing in re.findall(r"<svg.*?</svg>", text, re.DOTALL):
        ElementTree.fromstring(drawing)


def test_the_page_stands_alone_and_shows_what_was_counted(busy: Path) -> None:
    found = counted(busy)
    text = page(found)
    check_page(text)
    done = found["results"]["placed"] + found["results"]["rejected"]
    assert f"<b>{done}</b><span>of {found['targets']} parts in a bin" in text
    for word in ("Parts per hour", "Parts in each bin", "Time from part to part", "Downtime", "camera unplugged"):
        assert word in text


def test_what_people_wrote_cannot_break_the_page(path: Path) -> None:
    evil = '<script>alert("1")</script>'
    day = Day(path, config=evil)
    day.start()
    day.part(5.0, label=evil, bin_=evil)
    day.ledger.note("operator", day.clock.now(), command=evil, uid=evil)
    day.enter(State.STOPPED)
    day.end()
    text = page(counted(path))
    assert "<script" not in text
    check_page(text)


def test_the_command_writes_a_page_or_figures(
    busy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert execute(["report", str(busy.parent)]) == 0
    (made,) = tmp_path.glob("shift-*.html")
    assert str(made.name) in capsys.readouterr().out
    # The records it was counted from come with the command at its foot.
    (said,) = re.findall(r"<code>controller (.*?)</code>", made.read_text(encoding="utf-8"))
    assert execute(["report", str(busy), "--json"]) == 0
    targets = json.loads(capsys.readouterr().out)["targets"]
    assert execute([*shlex.split(html.unescape(said)), "--json"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == targets > 0
    assert execute(["report", str(busy), "--json", "--since", "2026-03-10T06:00Z", "--until", "2026-03-10T06:10Z"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["time_s"]["stopped"] == 300.0
    assert list(tmp_path.iterdir()) == [made]
    assert execute(["report", str(busy), "--since", "2h", "--until", "3h"]) == 2
    assert execute(["report", str(tmp_path / "none.db")]) == 1
    assert execute(["report", str(busy), "--out", str(tmp_path / "none" / "x.html")]) == 1


def test_dates_are_told_in_local_time(busy: Path) -> None:
    with LedgerView(busy) as view:
        found = figures(view, NAMES, LATER.astimezone(UTC))
    assert found["since"] == "2026-03-10T06:00:00+00:00"
    assert found["columns"]["starts"][0] == "2026-03-10T06:00+00:00"
