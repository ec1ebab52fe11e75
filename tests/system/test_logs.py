"""Where the log of a run goes: to the journal where stderr ends there anyway, else to a person."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from controller.config.files import shipped


@pytest.mark.parametrize("under_systemd", [False, True])
def test_a_run_logs_records_under_the_service_manager_and_plain_lines_otherwise(
    tmp_path: Path, environment: dict[str, str], under_systemd: bool
) -> None:
    """The cell's warning about itself, before it finds that nothing is plugged in; no journal listens here."""
    spare = '\n[[bins]]\nname = "spare"\ncenter_mm = [-290.0, 100.0]\n'
    (tmp_path / "cell.toml").write_text(shipped("cell.toml").read_text(encoding="utf-8") + spare, encoding="utf-8")
    with (tmp_path / "stderr").open("w") as stream:
        found = os.fstat(stream.fileno())
        stamp = {"JOURNAL_STREAM": f"{found.st_dev}:{found.st_ino}"} if under_systemd else {}
        done = subprocess.run(
            [sys.executable, "-m", "controller.cli", "run", "--config", "cell.toml"],
            cwd=tmp_path,
            env=environment | stamp,
            stderr=stream,
            timeout=100.0,
            check=False,
        )
    lines = (tmp_path / "stderr").read_text(encoding="utf-8").splitlines()
    assert done.returncode == 1
    warning = "warning: bin spare is named by no rule"
    (line,) = [line for line in lines if warning in line]
    assert line.endswith(f"INFO    controller.cli.run: {warning}") if under_systemd else line == warning
    assert lines[-1].startswith("error: ")
