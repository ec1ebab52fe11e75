"""Installing the controller as a systemd service: what is written where, what is run, and how to undo it.

A plan is made first and is all there is: `--dry-run` prints it, installing carries it out.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from controller.config.files import shipped
from controller.errors import SorterError

UNIT = "controller.service"
CONFIG = Path("/etc/sorter/cell.toml")
STATE = Path("/var/lib/sorter")
RUNTIME = Path("/run/sorter")
"""The unit's StateDirectory, and its RuntimeDirectory, which is there while the service runs."""
_SYSUSERS = Path("/etc/sysusers.d/sorter.conf")
_PLACES = {
    "systemd/controller.service": Path("/etc/systemd/system") / UNIT,
    "systemd/sorter.sysusers.conf": _SYSUSERS,
    "systemd/sorter.modules-load.conf": Path("/etc/modules-load.d/sorter.conf"),
    "udev/70-sorter.rules": Path("/etc/udev/rules.d/70-sorter.rules"),
}
# ROBOTIS U2D2: an FT232H with FTDI's own numbers. Source: U2D2 e-manual, lsusb.
_U2D2 = 'ATTRS{idVendor}=="0403", ATTRS{idProduct}=="6014"'
_ANY_USB = 'ATTRS{idVendor}=="?*"'
# What the unit's ProtectHome and PrivateTmp hide from the service.
_HIDDEN = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")
_MOVE_PROGRAM = "install the program below /opt, or with pipx install --global"
_PATIENCE = 90.0
"""s for a command of the system; one that stops the service waits for the unit's TimeoutStopSec."""
_MARK = re.compile("@[A-Z_]+@")
_PLAIN_PATH = re.compile(r"/[A-Za-z0-9_./+@:,=-]*")
_SERIAL = re.compile(r"[A-Za-z0-9_.:-]{1,64}")

Run = Callable[[Sequence[str]], str]


@dataclass(frozen=True, slots=True)
class InstalledFile:
    """A file of the service.

    Attributes:
        path: Where it belongs.
        content: Its text.
    """

    path: Path
    content: str


@dataclass(frozen=True, slots=True)
class Plan:
    """Everything an installation does.

    Attributes:
        files: Written in this order, readable by all.
        commands: Run after that, in this order.
        warnings: What would keep the service from running; installing refuses, a dry run only says so.
        next_steps: For people, afterwards.
    """

    files: tuple[InstalledFile, ...]
    commands: tuple[tuple[str, ...], ...]
    warnings: tuple[SorterError, ...]
    next_steps: tuple[str, ...]


_COMMANDS: tuple[tuple[str, ...], ...] = (
    ("systemd-sysusers", str(_SYSUSERS)),
    ("systemctl", "restart", "systemd-modules-load.service"),
    ("udevadm", "control", "--reload"),
    ("udevadm", "trigger", "--action=add", "--subsystem-match=usb-serial"),
    ("udevadm", "trigger", "--action=change", "--subsystem-match=tty", "--subsystem-match=video4linux"),
    ("systemctl", "daemon-reload"),
    ("systemctl", "enable", UNIT),
)
UNINSTALL_BEFORE: tuple[tuple[str, ...], ...] = (("systemctl", "disable", "--now", UNIT),)
"""Run before the files are taken away: the arm parks."""
UNINSTALL_AFTER: tuple[tuple[str, ...], ...] = (("systemctl", "daemon-reload"), ("udevadm", "control", "--reload"))


def program() -> Path:
    """The `controller` of the interpreter that runs now, as an absolute path that an upgrade keeps.

    Raises:
        SorterError: The program was not installed, only its sources are there.
    """
    for folder in (Path(sys.executable).parent, Path(sysconfig.get_path("scripts"))):
        if (folder / "controller").is_file():
            return folder / "controller"
    raise SorterError(
        f"there is no program `controller` beside {sys.executable}",
        "install it, e.g. python3 -m venv /opt/sorter && /opt/sorter/bin/pip install sorting-controller",
    )


def plan(
    controller: Path,
    config: Path = CONFIG,
    *,
    arm_serial: str | None = None,
    camera_serial: str | None = None,
    interpreter: Path | None = None,
) -> Plan:
    """What installing the service means.

    Args:
        controller: Absolute path of the program.
        config: Absolute path of the cell's configuration; it need not exist yet.
        arm_serial: USB serial number of the servo adapter; any U2D2 when left out.
        camera_serial: USB serial number of the camera; any USB camera when left out.
        interpreter: What runs the program, for the check that the service can reach it.

    Raises:
        SorterError: A path or serial number cannot be written into a unit or a rule.
    """
    fill = {
        "@CONTROLLER@": _path(controller),
        "@CONFIG@": _path(config),
        "@ARM_MATCH@": _U2D2 if arm_serial is None else _serial(arm_serial),
        "@CAMERA_MATCH@": _ANY_USB if camera_serial is None else _serial(camera_serial),
    }
    files = []
    for template, path in _PLACES.items():
        head, text = _without_note(shipped(template).read_text(encoding="utf-8"))
        for mark, value in fill.items():
            text = text.replace(mark, value)
        files.append(InstalledFile(path, head + text))
    needed = {controller: _MOVE_PROGRAM, config: f"put it into {CONFIG.parent}"}
    if interpreter is not None:
        needed[interpreter] = _MOVE_PROGRAM
    warnings = [
        SorterError(f"{path} lies where the service cannot see it", remedy)
        for path, remedy in needed.items()
        if any(path.is_relative_to(hidden) for hidden in _HIDDEN)
    ]
    return Plan(tuple(files), _COMMANDS, tuple(warnings), _next_steps(config))


def _next_steps(config: Path) -> tuple[str, ...]:
    return (
        "write the cell's configuration: controller config new cell.toml; check it: controller config check --config"
        f" cell.toml; put it in place: sudo install -D -m 644 cell.toml {config}",
        "look at the machine: controller doctor --config " + str(config),
        f"start the service, which moves nothing yet: systemctl start {UNIT}",
        "let others operate the cell: usermod -aG sorter NAME",
    )


def install(what: Plan, *, root: Path = Path("/"), run: Run | None = None, uid: int | None = None) -> None:
    """Carry a plan out; files that are there already are replaced.

    Args:
        what: The plan.
        root: Folder that stands for the root of the file system.
        run: Runs one command and returns its output.
        uid: Who is asking.

    Raises:
        SorterError: Not root, no systemd, a warning of the plan stands, a file cannot be written, a command fails.
    """
    run = run or run_command
    _check_may(os.geteuid() if uid is None else uid, root, "install")
    if what.warnings:
        raise what.warnings[0]
    for file in what.files:
        path = root / file.path.relative_to("/")
        fresh = path.with_name(f".{path.name}.new")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            fresh.write_text(file.content, encoding="utf-8")
            fresh.chmod(0o644)
            fresh.replace(path)
        except OSError as error:
            raise SorterError(f"{path}: {error.strerror or error}", "check the file system") from error
    for command in what.commands:
        run(command)


def uninstall(*, root: Path = Path("/"), run: Run | None = None, uid: int | None = None) -> tuple[Path, ...]:
    """Stop the service (the arm parks) and take its files away; state, configuration and user stay.

    Returns:
        The files that were there.

    Raises:
        SorterError: Not root, no systemd, a command fails, a file cannot be removed.
    """
    run = run or run_command
    _check_may(os.geteuid() if uid is None else uid, root, "uninstall")
    present = installed_files(root)
    if root / _PLACES["systemd/controller.service"].relative_to("/") in present:
        for command in UNINSTALL_BEFORE:
            run(command)
    for path in present:
        try:
            path.unlink()
        except OSError as error:
            raise SorterError(f"{path}: {error.strerror or error}", "check the file system") from error
    for command in UNINSTALL_AFTER:
        run(command)
    return present


def installed_files(root: Path = Path("/")) -> tuple[Path, ...]:
    """Files of the service that are there."""
    paths = (root / path.relative_to("/") for path in _PLACES.values())
    return tuple(path for path in paths if path.exists())


@dataclass(frozen=True, slots=True)
class ServiceStatus:
    """How the service stands.

    Attributes:
        installed: Its unit is there.
        differing: Files that are missing, or not as this version would write them.
        properties: What the service manager says; empty without one.
    """

    installed: bool
    differing: tuple[Path, ...]
    properties: dict[str, str]

    @property
    def active(self) -> bool:
        """It is running."""
        return self.properties.get("ActiveState") == "active"


PROPERTIES = ("ActiveState", "SubState", "UnitFileState", "MainPID", "NRestarts", "Result", "StatusText")


def status(*, root: Path = Path("/"), run: Run | None = None) -> ServiceStatus:
    """How the service stands; needs no rights and no systemd. What was filled in at installing may be anything."""
    differing = []
    for template, place in _PLACES.items():
        path = root / place.relative_to("/")
        wanted = "".join(_without_note(shipped(template).read_text(encoding="utf-8")))
        try:
            same = re.fullmatch(_MARK.sub(".+", re.escape(wanted)), path.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError):
            same = None
        if same is None:
            differing.append(path)
    properties: dict[str, str] = {}
    if booted_with_systemd(root):
        text = (run or run_command)(("systemctl", "show", UNIT, "--property=" + ",".join(PROPERTIES)))
        properties = dict(line.split("=", 1) for line in text.splitlines() if "=" in line)
    unit = root / _PLACES["systemd/controller.service"].relative_to("/")
    return ServiceStatus(unit.exists(), tuple(differing), properties)


def booted_with_systemd(root: Path = Path("/")) -> bool:
    """Whether systemd is the service manager of this machine. Source: sd_booted(3)."""
    return (root / "run/systemd/system").is_dir()


def run_command(command: Sequence[str]) -> str:
    """Run a command of the system and return its output.

    Raises:
        SorterError: There is no such command, or it fails.
    """
    path = shutil.which(command[0])
    if path is None:
        raise SorterError(f"{command[0]}: no such command", "install systemd and udev")
    try:
        done = subprocess.run([path, *command[1:]], capture_output=True, text=True, timeout=_PATIENCE, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise SorterError(f"{' '.join(command)}: {error}") from error
    if done.returncode != 0:
        said = (done.stderr or done.stdout).strip().splitlines()
        raise SorterError(f"{' '.join(command)} failed" + (f": {said[-1]}" if said else ""), "see journalctl -xe")
    return done.stdout


def _check_may(uid: int, root: Path, verb: str) -> None:
    if uid != 0:
        remedy = f"sudo {program_or_name()} service {verb}; --dry-run shows what it does"
        raise SorterError(f"only root can {verb} a service", remedy)
    if not booted_with_systemd(root):
        raise SorterError("this machine was not started by systemd", "run `controller run` under your service manager")


def program_or_name() -> str:
    """The program as one types it under sudo, which has another search path."""
    try:
        return str(program())
    except SorterError:
        return "controller"


def _without_note(text: str) -> tuple[str, str]:
    """Replace a template's note about its marks, two lines, by where the file comes from."""
    lines = text.splitlines(keepends=True)
    if not lines[0].startswith("# Written by"):
        return "", text
    return "# Written by `controller service install`; changes are lost when it is run again.\n", "".join(lines[2:])


def _path(path: Path) -> str:
    if not _PLAIN_PATH.fullmatch(str(path)):
        remedy = "letters, digits and _./+@:,=- need no quoting in a unit"
        raise SorterError(f"{path}: not an absolute path of plain characters", remedy)
    return str(path)


def _serial(serial: str) -> str:
    if not _SERIAL.fullmatch(serial):
        raise SorterError(f"{serial!r}: not a USB serial number", "see udevadm info --attribute-walk /dev/ttyUSB0")
    return f'ATTRS{{serial}}=="{serial}"'
