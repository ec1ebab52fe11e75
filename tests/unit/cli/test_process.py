"""What the product asks of its process and of whatever it starts: one thread of linear algebra, memory that stays."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

_ASKED = "import controller.cli, os, sys; early = 'numpy' in sys.modules; controller.cli.use_one_thread(); "


def _said(**environment: str) -> str:
    known = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    told = "print(early, os.environ['OPENBLAS_NUM_THREADS'])"
    command = [sys.executable, "-c", _ASKED + told]
    return subprocess.check_output(command, env=known | environment, text=True).strip()


def test_one_thread_is_asked_for_before_numpy_is_imported_and_a_user_may_ask_for_more() -> None:
    assert _said() == "False 1"
    assert _said(OPENBLAS_NUM_THREADS="3") == "False 3"


_LOOKS = """
import controller.cli, ctypes, resource, sys
if not hasattr(ctypes.CDLL(None), "mallopt"): sys.exit("no glibc")
if sys.argv[1] == "kept": controller.cli.keep_memory()
import numpy as np
def look(): return [np.ones((360, 640, 3), np.float32) for _ in range(4)]
def faults(): return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
look()
before = faults()
for _ in range(5): look()
print(faults() - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="memory is asked for in glibc's words")
def test_memory_of_one_picture_serves_the_next() -> None:
    known = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    taken = {}
    for how in ("kept", "given back"):
        done = subprocess.run([sys.executable, "-c", _LOOKS, how], env=known, capture_output=True, text=True)
        if "no glibc" in done.stderr:
            pytest.skip("another C library")
        taken[how] = int(done.stdout)
    # Four arrays of 675 pages are taken anew every time, or only in the first round.
    assert taken["kept"] < 100 < 5 * 4 * 600 < taken["given back"]
