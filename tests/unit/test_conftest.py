"""The guard over all tests must itself be able to fail."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

CONFTEST = Path(__file__).resolve().parents[1] / "conftest.py"
LEAKS = '''
import os, threading

kept = []
release = threading.Event()

def test_clean(tmp_path):
    with open(tmp_path / "a", "w"):
        pass

def test_thread():
    threading.Thread(target=release.wait, name="forgotten", daemon=True).start()

def test_descriptor(tmp_path):
    kept.append(os.open(tmp_path / "forgotten.txt", os.O_CREAT))

def test_after():
    release.set()

@__import__("pytest").mark.study
def test_study():
    raise AssertionError("a study ran without being asked for")
'''


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="the system does not list open files")
def test_a_forgotten_thread_and_a_forgotten_file_fail_their_test(tmp_path: Path) -> None:
    (tmp_path / "conftest.py").write_text(CONFTEST.read_text(encoding="utf-8"), encoding="utf-8")
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = study: x\n", encoding="ascii")
    (tmp_path / "test_leaks.py").write_text(LEAKS, encoding="ascii")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(tmp_path)]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "4 passed, 1 deselected, 2 errors" in run.stdout, run.stdout
    assert "threads left running: ['forgotten']" in run.stdout
    assert "forgotten.txt" in run.stdout
