"""Runs the program as its user does: as a subprocess, from a folder of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

Controller = Callable[..., "subprocess.CompletedProcess[str]"]
ROOT = Path(__file__).parents[2]


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """An environment whose home and state folders are the test's own."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("XDG_", "STATE_"))}
    paths = os.pathsep.join(filter(None, [str(ROOT), kept.get("PYTHONPATH")]))
    own = {"HOME": str(tmp_path), "XDG_STATE_HOME": str(tmp_path / "state"), "PYTHONPATH": paths, "COLUMNS": "160"}
    return kept | own


@pytest.fixture
def controller(tmp_path: Path, environment: dict[str, str]) -> Controller:
    """Call `controller` with arguments; returns the completed process."""

    def call(*arguments: object, timeout: float = 100.0) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "controller.cli", *map(str, arguments)],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
        )

    return call
