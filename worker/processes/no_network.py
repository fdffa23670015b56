"""Deny network access to this process: a seccomp filter that blocks opening sockets and starting programs (Linux)."""

from __future__ import annotations

import ctypes
import errno
import platform
import sys

_NO_NEW_PRIVILEGES, _SET_SECCOMP, _FILTER = 38, 22, 2
"""Constants of prctl(2): PR_SET_NO_NEW_PRIVS, PR_SET_SECCOMP, SECCOMP_MODE_FILTER."""

_ALLOW, _DENY, _KILL = 0x7FFF0000, 0x00050000 | errno.EACCES, 0x80000000
"""Return values of a filter: SECCOMP_RET_ALLOW, SECCOMP_RET_ERRNO with EACCES, SECCOMP_RET_KILL_PROCESS."""

_LOAD, _EQUAL, _AT_LEAST, _RETURN = 0x20, 0x15, 0x35, 0x06
"""Instructions of the filter: load a word of `seccomp_data`, compare it, return."""

_X32 = 0x40000000
"""Lowest number of a system call of the x32 ABI on x86-64."""

DENIED = {
    # socket, execve, ptrace, process_vm_readv, process_vm_writev, execveat, io_uring_setup
    "x86_64": (0xC000003E, (41, 59, 101, 310, 311, 322, 425)),
    # socket, execve, ptrace, process_vm_readv, process_vm_writev, execveat, io_uring_setup
    "aarch64": (0xC00000B7, (198, 221, 117, 270, 271, 281, 425)),
}
"""Audit number of each architecture, and the system calls that fail with EACCES."""


class _Instruction(ctypes.Structure):
    _fields_ = [("code", ctypes.c_uint16), ("jt", ctypes.c_uint8), ("jf", ctypes.c_uint8), ("k", ctypes.c_uint32)]


class _Program(ctypes.Structure):
    _fields_ = [("length", ctypes.c_uint16), ("filter", ctypes.POINTER(_Instruction))]


def restrict_process() -> bool:
    """Deny new sockets and new programs to this process for the rest of its life.

    Call it before starting threads: it applies to the calling thread and its descendants.

    Returns
    -------
    bool
        False if the system or the architecture does not support the filter.
    """
    if sys.platform != "linux" or platform.machine() not in DENIED:
        return False
    machine, denied = DENIED[platform.machine()]
    count = len(denied)
    steps = [
        (_LOAD, 0, 0, 4),  # the architecture of the call
        (_EQUAL, 1, 0, machine),
        (_RETURN, 0, 0, _KILL),
        (_LOAD, 0, 0, 0),  # the number of the call
        (_AT_LEAST, count + 1, 0, _X32),
        *((_EQUAL, count - place, 0, number) for place, number in enumerate(denied)),
        (_RETURN, 0, 0, _ALLOW),
        (_RETURN, 0, 0, _DENY),
    ]
    listed = (_Instruction * len(steps))(*(_Instruction(*step) for step in steps))
    program = _Program(len(steps), listed)
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0) != 0:
        return False
    return bool(libc.prctl(_SET_SECCOMP, _FILTER, ctypes.byref(program), 0, 0) == 0)
