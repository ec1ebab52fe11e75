"""The service's files: complete, strict enough, well-formed, and installed as a whole or not at all."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

from controller.errors import SorterError
from controller.service import unit

PROGRAM = Path("/opt/sorter/bin/controller")


def _plan(**given: str) -> unit.Plan:
    return unit.plan(PROGRAM, **given)  # type: ignore[arg-type]  # only texts are passed on here


def _file(plan: unit.Plan, name: str) -> unit.InstalledFile:
    (found,) = (file for file in plan.files if str(file.path).endswith(name))
    return found


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A machine that systemd has started."""
    (tmp_path / "run/systemd/system").mkdir(parents=True)
    return tmp_path


class Shell:
    """Remembers commands instead of running them."""

    def __init__(self, answer: str = "") -> None:
        self.ran: list[tuple[str, ...]] = []
        self.answer = answer

    def __call__(self, command: Sequence[str]) -> str:
        self.ran.append(tuple(command))
        return self.answer


def test_every_mark_is_filled_in() -> None:
    for file in _plan().files:
        assert not re.search(r"@[A-Z_]+@", file.content), file.path


def test_the_unit_runs_this_program_with_that_configuration() -> None:
    text = _file(unit.plan(PROGRAM, Path("/etc/sorter/line-2.toml")), "controller.service").content
    assert "ExecStart=/opt/sorter/bin/controller run --config /etc/sorter/line-2.toml\n" in text


@pytest.mark.parametrize(
    "line",
    [
        "Type=notify",
        "WatchdogSec=10s",
        "Restart=on-failure",
        "RestartPreventExitStatus=75 78",
        "StartLimitBurst=5",
        "KillMode=mixed",
        "TimeoutStopSec=60s",
        "User=sorter",
        "DevicePolicy=closed",
        "RuntimeDirectory=sorter",
        "StateDirectory=sorter",
    ],
)
def test_the_unit_keeps_what_the_service_relies_on(line: str) -> None:
    assert line in _file(_plan(), "controller.service").content.splitlines()


@pytest.mark.safety("SR-01")
def test_the_unit_starts_nothing_that_moves() -> None:
    assert "--start" not in _file(_plan(), "controller.service").content


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not on this machine")
def test_the_unit_is_as_hard_as_promised(tmp_path: Path) -> None:
    path = tmp_path / "controller.service"
    path.write_text(_file(unit.plan(Path("/usr/bin/env")), "controller.service").content)
    # --threshold counts tenths: 15 is the promised 1.5.
    command = ["systemd-analyze", "security", "--offline=true", "--no-pager", "--threshold=15", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout.splitlines()[-1:] + done.stderr.splitlines()
    checked = subprocess.run(["systemd-analyze", "verify", str(path)], capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stderr
    # A misspelt key is only a warning to systemd.
    assert str(path) not in checked.stderr


@pytest.mark.skipif(shutil.which("systemd-sysusers") is None, reason="systemd is not on this machine")
def test_the_user_is_made_as_described(tmp_path: Path) -> None:
    path = tmp_path / "sorter.conf"
    path.write_text(_file(_plan(), "sysusers.d/sorter.conf").content)
    (tmp_path / "root/etc").mkdir(parents=True)
    command = ["systemd-sysusers", "--dry-run", f"--root={tmp_path / 'root'}", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_rules_are_lines_of_matches_and_assignments() -> None:
    text = _file(_plan(), "70-sorter.rules").content
    term = r'[A-Z_]+(\{[^}]+\})?(==|!=|\+=|:=|=)"[^"]*"'
    for line in text.splitlines():
        assert not line or line.startswith("#") or re.fullmatch(f"{term}(, {term})*", line), line
    assert 'SYMLINK+="sorter-arm"' in text
    assert 'SYMLINK+="sorter-cam"' in text
    assert 'ATTR{latency_timer}="1"' in text
    assert 'ENV{ID_MM_DEVICE_IGNORE}="1"' in text


def test_serial_numbers_tell_one_device_from_its_likes() -> None:
    text = _file(_plan(arm_serial="FT4U2D2A", camera_serial="CAM-01"), "70-sorter.rules").content
    assert text.count('ATTRS{serial}=="FT4U2D2A"') == 4
    assert text.count('ATTRS{serial}=="CAM-01"') == 1
    assert "0403" not in text


@pytest.mark.parametrize("serial", ['x", RUN+="/bin/sh', "two words", "", "line\nbreak"])
def test_a_serial_number_cannot_smuggle_in_a_rule(serial: str) -> None:
    with pytest.raises(SorterError, match="serial number"):
        _plan(arm_serial=serial)


@pytest.mark.parametrize("path", ["relative", "/opt/my cell/cell.toml", "/opt/%h/cell.toml", "/opt/x\nUser=root"])
def test_a_path_cannot_smuggle_in_a_setting(path: str) -> None:
    with pytest.raises(SorterError, match="plain characters"):
        unit.plan(PROGRAM, Path(path))


def test_installing_writes_every_file_and_runs_every_command(root: Path) -> None:
    plan, shell = _plan(), Shell()
    unit.install(plan, root=root, run=shell, uid=0)
    assert len(unit.installed_files(root)) == len(plan.files) == 4
    for file in plan.files:
        path = root / file.path.relative_to("/")
        assert path.read_text() == file.content
        assert path.stat().st_mode & 0o777 == 0o644
    assert shell.ran == list(plan.commands)
    # The user must be there before the service that runs as him, and the unit known before it is enabled.
    assert [command[0] for command in shell.ran].index("systemd-sysusers") == 0
    assert shell.ran[-2:] == [("systemctl", "daemon-reload"), ("systemctl", "enable", unit.UNIT)]


def test_uninstalling_stops_first_and_leaves_what_is_the_users(root: Path) -> None:
    unit.install(_plan(), root=root, run=Shell(), uid=0)
    (root / "etc/sorter").mkdir()
    (root / "etc/sorter/cell.toml").write_text("")
    shell = Shell()
    assert len(unit.uninstall(root=root, run=shell, uid=0)) == 4
    assert unit.installed_files(root) == ()
    assert (root / "etc/sorter/cell.toml").exists()
    assert shell.ran[0] == ("systemctl", "disable", "--now", unit.UNIT)
    assert unit.uninstall(root=root, run=Shell(), uid=0) == ()


def test_only_root_may_and_only_where_systemd_is(root: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    shell = Shell()
    with pytest.raises(SorterError, match="only root can install a service: sudo"):
        unit.install(_plan(), root=root, run=shell, uid=1000)
    with pytest.raises(SorterError, match="not started by systemd"):
        unit.install(_plan(), root=tmp_path_factory.mktemp("other"), run=shell, uid=0)
    assert shell.ran == []
    assert unit.installed_files(root) == ()


@pytest.mark.parametrize("hidden", ["/home/pi/.venv/bin/controller", "/root/x/controller", "/tmp/controller"])
def test_a_program_the_service_could_not_see_is_refused(root: Path, hidden: str) -> None:
    plan = unit.plan(Path(hidden))
    assert plan.warnings
    with pytest.raises(SorterError, match="cannot see it"):
        unit.install(plan, root=root, run=Shell(), uid=0)
    assert unit.installed_files(root) == ()


def test_an_interpreter_the_service_could_not_see_is_refused_too() -> None:
    assert unit.plan(PROGRAM, interpreter=Path("/root/.pyenv/bin/python3")).warnings
    assert not unit.plan(PROGRAM, interpreter=Path("/usr/bin/python3")).warnings


def test_the_status_tells_what_is_missing_and_what_was_changed(root: Path) -> None:
    found = unit.status(root=root, run=Shell("ActiveState=inactive\nStatusText=a=b\n"))
    assert (found.installed, found.active, len(found.differing)) == (False, False, 4)
    unit.install(_plan(), root=root, run=Shell(), uid=0)
    (root / "etc/udev/rules.d/70-sorter.rules").write_text("# mine")
    found = unit.status(root=root, run=Shell("ActiveState=active\nStatusText=EXECUTE: a=b\n"))
    assert (found.installed, found.active) == (True, True)
    assert [path.name for path in found.differing] == ["70-sorter.rules"]
    assert found.properties["StatusText"] == "EXECUTE: a=b"


def test_what_was_chosen_at_installing_is_no_difference(root: Path) -> None:
    plan = unit.plan(Path("/srv/bin/controller"), Path("/etc/sorter/line-2.toml"), arm_serial="A1", camera_serial="C2")
    unit.install(plan, root=root, run=Shell(), uid=0)
    assert unit.status(root=root, run=Shell()).differing == ()
    path = root / "etc/systemd/system/controller.service"
    path.write_text(path.read_text().replace("WatchdogSec=10s", "WatchdogSec=0"))
    assert unit.status(root=root, run=Shell()).differing == (path,)


def test_a_command_that_fails_is_named_with_what_it_said() -> None:
    with pytest.raises(SorterError, match="sh -c echo no >&2; exit 3 failed: no"):
        unit.run_command(("sh", "-c", "echo no >&2; exit 3"))
    with pytest.raises(SorterError, match="no such command"):
        unit.run_command(("sorter-no-such-command",))
