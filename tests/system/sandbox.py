"""Runs a program under the shipped unit's system call filter and its ban on executable memory, without systemd.

    python -m tests.system.sandbox PROGRAM ARGUMENTS...

The filter is read from the unit and spelt out by `systemd-analyze syscall-filter`. Linux on x86-64 only.
"""

from __future__ import annotations

import ctypes
import os
import re
import struct
import subprocess
import sys
from functools import cache
from pathlib import Path

from controller.config.files import shipped

NUMBERS = Path("/usr/include/x86_64-linux-gnu/asm/unistd_64.h")
# Source: linux/prctl.h, linux/seccomp.h, linux/bpf_common.h.
_PR_SET_NO_NEW_PRIVS, _PR_SET_SECCOMP, _PR_SET_MDWE = 38, 22, 65
_MDWE_REFUSE_EXEC_GAIN = 1
_SECCOMP_MODE_FILTER = 2
_LOAD_WORD, _JUMP_IF_EQUAL, _RETURN = 0x20, 0x15, 0x06
_ALLOW, _EPERM = 0x7FFF0000, 0x00050001


@cache
def _calls(group: str) -> frozenset[str]:
    """Names of the system calls in one of systemd's groups."""
    listed = subprocess.run(["systemd-analyze", "syscall-filter", group], capture_output=True, text=True, check=True)
    found: set[str] = set()
    for line in listed.stdout.splitlines()[1:]:
        name = line.strip().split(" ")[0]
        if name.startswith("@"):
            found |= _calls(name)
        elif name and not name.startswith("#"):
            found.add(name)
    return frozenset(found)


def allowed_calls() -> set[str]:
    """What the unit's SystemCallFilter lines leave, read as systemd.exec(5) says."""
    allowed = set(_calls("@default"))
    for line in shipped("systemd/controller.service").read_text(encoding="utf-8").splitlines():
        key, _, value = line.partition("=")
        if key == "SystemCallFilter":
            groups = {call for group in value.removeprefix("~").split() for call in _calls(group)}
            allowed = allowed - groups if value.startswith("~") else allowed | groups
    return allowed


def enter() -> None:
    """Put this process, and what it executes, under the unit's restrictions.

    Raises:
        OSError: The kernel refuses.
    """
    numbers = dict(re.findall(r"#define __NR_(\w+) (\d+)", NUMBERS.read_text(encoding="ascii")))
    program = [(_LOAD_WORD, 0, 0, 0)]
    for name in sorted(allowed_calls() & numbers.keys()):
        program += [(_JUMP_IF_EQUAL, 0, 1, int(numbers[name])), (_RETURN, 0, 0, _ALLOW)]
    program.append((_RETURN, 0, 0, _EPERM))
    code = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *step) for step in program))
    filter_ = ctypes.create_string_buffer(struct.pack("H6xQ", len(program), ctypes.addressof(code)))
    _prctl(_PR_SET_NO_NEW_PRIVS, 1)
    _prctl(_PR_SET_MDWE, _MDWE_REFUSE_EXEC_GAIN)
    _prctl(_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER, ctypes.addressof(filter_))


def _prctl(option: int, *arguments: int) -> None:
    call = ctypes.CDLL(None, use_errno=True).prctl
    call.argtypes = [ctypes.c_int] + [ctypes.c_ulong] * 4
    if call(option, *arguments, *[0] * (4 - len(arguments))) != 0:
        error = ctypes.get_errno()
        raise OSError(error, f"prctl({option}): {os.strerror(error)}")


if __name__ == "__main__":
    enter()
    os.execv(sys.argv[1], sys.argv[1:])
