"""Linear algebra uses one thread in the product, and in whatever it starts."""

from __future__ import annotations

import os
import subprocess
import sys

_ASKED = "import controller.cli, os, sys; early = 'numpy' in sys.modules; controller.cli.use_one_thread(); "


def _said(**environment: str) -> str:
    known = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    told = "print(early, os.environ['OPENBLAS_NUM_THREADS'])"
    command = [sys.executable, "-c", _ASKED + told]
    return subprocess.check_output(command, env=known | environment, text=True).strip()


def test_one_thread_is_asked_for_before_numpy_is_imported_and_a_user_may_ask_for_more() -> None:
    assert _said() == "False 1"
    assert _said(OPENBLAS_NUM_THREADS="3") == "False 3"
