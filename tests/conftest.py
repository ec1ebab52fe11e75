"""What every test is held to: no thread and no file descriptor outlives it; shared data is found or the test skips."""

from __future__ import annotations

import gc
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import cv2
import pytest
from hypothesis import settings

# One thread: the suite shares its processors with others, and results must not depend on their number.
cv2.setNumThreads(1)

# For the tests in tests/hostile, which try many more things with it: pytest tests/hostile --hypothesis-profile=study
settings.register_profile("study", settings.get_profile("default"))

SHARED = Path(__file__).resolve().parents[2] / "shared"
_DESCRIPTORS = Path("/proc/self/fd")
# pytest-timeout's guard on systems without SIGALRM.
_OTHERS_THREADS = ("pytest_timeout",)
# Devices that libraries open once and keep: random numbers, event loops' wake-ups, memory maps of a GPU-less Mesa.
_OTHERS_FILES = ("/dev/urandom", "/dev/random", "/dev/null", "anon_inode:")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the longer studies unless they are asked for: `-m study`, or a test by its name.

    With `--hypothesis-profile=study` a test may take as long as its thousands of examples need.
    """
    if settings.get_current_profile_name() == "study":
        for item in items:
            item.add_marker(pytest.mark.timeout(0))
    if config.option.markexpr or any("::" in argument for argument in config.args):
        return
    studies = [item for item in items if item.get_closest_marker("study")]
    if studies:
        config.hook.pytest_deselected(items=studies)
        items[:] = [item for item in items if item not in studies]


@pytest.fixture(scope="session", autouse=True)
def _nobodys_state(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep the user's own cell out of it: his ledger, calibration, classes, service manager and journal."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("STATE_DIRECTORY", "RUNTIME_DIRECTORY", "NOTIFY_SOCKET", "WATCHDOG_USEC", "JOURNAL_STREAM"):
            patch.delenv(name, raising=False)
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of shared pictures and facts beside the checkout; the test skips where there is none."""
    if not SHARED.is_dir():
        pytest.skip("the folder of shared data is not beside this checkout")
    return SHARED


@pytest.fixture(autouse=True)
def _no_leaks() -> Iterator[None]:
    """Fail a test that leaves a thread running or a file descriptor open."""
    threads_before = set(threading.enumerate())
    files_before = _open_files()
    yield
    threads = [t for t in threading.enumerate() if t not in threads_before and _is_ours(t)]
    for thread in threads:
        # A thread that has been told to end may need a moment; one that has not will still be there.
        thread.join(timeout=2.0)
    alive = [t.name for t in threads if t.is_alive()]
    leaked = _new_files(files_before)
    if leaked:
        # What only a reference cycle keeps open (a traceback, say) is closed by the collector.
        gc.collect()
        leaked = _new_files(files_before)
    assert not alive, f"threads left running: {alive}"
    assert not leaked, f"file descriptors left open: {leaked}"


def _is_ours(thread: threading.Thread) -> bool:
    return not thread.name.startswith(_OTHERS_THREADS)


def _open_files() -> dict[int, str]:
    """Target of every open descriptor; empty where the system does not tell."""
    found: dict[int, str] = {}
    if _DESCRIPTORS.is_dir():
        for name in os.listdir(_DESCRIPTORS):
            try:
                found[int(name)] = os.readlink(_DESCRIPTORS / name)
            except OSError:
                continue  # the descriptor that listed the folder
    return found


def _new_files(before: dict[int, str]) -> list[str]:
    return [
        f"{number}: {target}"
        for number, target in _open_files().items()
        if before.get(number) != target and not target.startswith(_OTHERS_FILES)
    ]
