"""Every safety requirement has a test that runs, every mark names a requirement; and what the source itself shows."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from controller.cli import execute
from tests.safety import ROOT, links, marks, requirements

DOCUMENT = (ROOT / "controller" / "SAFETY.md").read_text(encoding="utf-8")


def test_no_requirement_is_without_a_test_and_no_mark_without_a_requirement() -> None:
    wanted, shown = set(requirements(DOCUMENT)), set(links())
    assert wanted - shown == set(), "requirements that no test shows"
    assert shown - wanted == set(), "marks that name no requirement"
    assert len(wanted) >= 30


def test_an_orphan_would_be_found() -> None:
    text = "- **SR-01** One.\n- **SR-02** Two,\n  on two lines.\n\nMore.\n"
    assert requirements(text) == {"SR-01": "One.", "SR-02": "Two, on two lines."}
    with pytest.raises(ValueError, match="twice"):
        requirements(text + "- **SR-01** Again.\n")
    source = '@pytest.mark.safety("SR-02", "SR-09")\n@given(x)\ndef test_it(): ...\n\n'
    source += '@pytest.mark.safety("SR-01")\ndef no_test(): ...\n'
    assert marks(source, "t.py") == [("SR-02", "t.py::test_it"), ("SR-09", "t.py::test_it")]


def test_a_study_shows_nothing_because_it_does_not_run_by_itself() -> None:
    for path in (ROOT / "tests").rglob("test_*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                decorators = {ast.unparse(decorator).split("(")[0] for decorator in node.decorator_list}
                assert not {"pytest.mark.safety", "pytest.mark.study"} <= decorators, f"{path}::{node.name}"


CONTROL = ("controller/cycle", "controller/motion", "controller/localization", "controller/vision", "drivers")
_CALENDAR = ("time.time", "datetime.now", "datetime.utcnow", "datetime.today", "date.today", "time.localtime")


def _calls(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func)


@pytest.mark.safety("SR-33")
def test_nothing_in_control_asks_for_the_date() -> None:
    """Were there no date, a jump of it could do nothing: control asks only the cell's monotonic clock."""
    asked = {
        f"{path.relative_to(ROOT)}: {call}"
        for room in CONTROL
        for path in (ROOT / room).rglob("*.py")
        for call in _calls(path)
        if call in _CALENDAR
    }
    assert asked == set()


@pytest.mark.parametrize("command", ["stop", "pause"])
def test_no_command_is_called_an_emergency_stop(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert execute([command, "--help"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    if command == "stop":
        assert "no emergency stop" in said
    else:
        assert "emergency" not in said
