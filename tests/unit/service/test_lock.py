"""One instance a folder, and a new folder a run."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from datetime import datetime
from pathlib import Path

import pytest

from controller.errors import InstanceBusy, LedgerError
from controller.service.folders import FolderTaken, new_run_folder, state_folder
from controller.service.lock import InstanceLock

NOW = datetime(2026, 11, 22, 12, 0, 0)


@pytest.mark.safety("SR-03")
def test_a_second_holder_is_refused_and_told_who_holds_it(tmp_path: Path) -> None:
    with InstanceLock(tmp_path), pytest.raises(InstanceBusy, match=str(os.getpid())) as caught:
        InstanceLock(tmp_path).__enter__()
    assert caught.value.exit_code == 75


def test_the_lock_is_free_again_afterwards(tmp_path: Path) -> None:
    for _ in range(2):
        with InstanceLock(tmp_path):
            pass


def test_the_death_of_the_holder_frees_the_lock(tmp_path: Path) -> None:
    code = "import os; from controller.service.lock import InstanceLock as L; from pathlib import Path\n"
    code += f"L(Path({str(tmp_path)!r})).__enter__(); os._exit(9)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 9
    with InstanceLock(tmp_path):
        assert (tmp_path / "lock").read_text() == f"{os.getpid()}\n"


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(LedgerError, match="file"):
        InstanceLock(tmp_path / "file" / "below").__enter__()


def test_a_full_disk_is_named_and_leaves_the_lock_free(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int, data: bytes) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", full)
        with pytest.raises(LedgerError, match="No space left"):
            InstanceLock(tmp_path).__enter__()
    with InstanceLock(tmp_path):
        pass


def test_a_run_s_folder_must_be_new(tmp_path: Path) -> None:
    (tmp_path / "old").write_text("x")
    with pytest.raises(FolderTaken) as caught:
        new_run_folder(tmp_path, NOW)
    assert caught.value.exit_code == 2


def test_a_folder_in_use_is_busy_rather_than_taken(tmp_path: Path) -> None:
    with InstanceLock(tmp_path), pytest.raises(InstanceBusy):
        new_run_folder(tmp_path, NOW)


def test_folders_by_date_never_collide(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert len({new_run_folder(None, NOW) for _ in range(3)}) == 3


def test_the_state_folder_follows_systemd_then_xdg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert state_folder() == tmp_path / "sorting-controller"
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/sorter")
    assert state_folder() == Path("/var/lib/sorter")
