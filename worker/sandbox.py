"""Confinement of the solver process: code that reads strangers' files finds nothing to take.

Layers, each where the machine has it (Linux): files by Landlock (the code to read, its own folder
to write, no other file), signals and abstract sockets by Landlock's scopes, no system calls but
those that jobs make by seccomp (`worker.system_calls`), limits by setrlimit. None needs privileges;
none can be taken off again, and processes that the solver starts inherit all.

Landlock: kernel documentation, userspace-api/landlock.
"""

from __future__ import annotations

import ctypes
import errno
import functools
import importlib.util
import os
import platform
import resource
import struct
import sys
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Final

from worker.system_calls import ARCHITECTURES, call_filter

PR_SET_SECCOMP = 22
PR_SET_NO_NEW_PRIVS = 38
SECCOMP_MODE_FILTER = 2

# System calls that have the same number on all architectures
LANDLOCK_CREATE_RULESET = 444
LANDLOCK_ADD_RULE = 445
LANDLOCK_RESTRICT_SELF = 446
LANDLOCK_CREATE_RULESET_VERSION = 1
LANDLOCK_RULE_PATH_BENEATH = 1

# Rights of Landlock to files; a version of its interface knows the first so many
EXECUTE, WRITE_FILE, READ_FILE, READ_DIR = (1 << bit for bit in range(4))
RIGHTS_OF_ABI = {1: 13, 2: 14, 3: 15, 4: 15, 5: 16}
# To make what is neither a file nor a folder: devices, sockets, pipes, links that somebody follows
MAKE_OTHERS = 1 << 6 | 1 << 9 | 1 << 10 | 1 << 11 | 1 << 12
RIGHTS_TO_A_FILE = EXECUTE | WRITE_FILE | READ_FILE | 1 << 14 | 1 << 15
# Rights to bind and connect TCP (version 4), scopes of abstract sockets and signals (version 6)
NET_RIGHTS = 0b11
NET_ABI = 4
SCOPES = 0b11
SCOPE_ABI = 6

# Places of the system that Python and the libraries use; of /etc, /proc and /dev no more than these
PLACES: Final[dict[str, int]] = {
    **dict.fromkeys(("/usr", "/lib", "/lib64", "/bin", "/sbin"), READ_FILE | READ_DIR | EXECUTE),
    **dict.fromkeys(("/etc/ld.so.cache", "/etc/localtime", "/etc/mime.types"), READ_FILE),
    **dict.fromkeys(("/etc/fonts", "/sys/devices/system", "/sys/fs/cgroup"), READ_FILE | READ_DIR),
    **dict.fromkeys(("/proc/cpuinfo", "/proc/meminfo", "/proc/stat"), READ_FILE),
    **dict.fromkeys(("/proc/self", "/proc/sys/vm"), READ_FILE | READ_DIR),
    **dict.fromkeys(("/dev/urandom", "/dev/random", "/dev/zero"), READ_FILE),
    **dict.fromkeys(("/dev/null", "/dev/full"), READ_FILE | WRITE_FILE),
}

# Limits: of a file's size in bytes, of open files, of the user's processes and threads
LARGEST_FILE = 16 * 1024**3
MOST_FILES = 1024
MOST_PROCESSES = 4096
# Where memory runs out, this process goes before the service's
OOM_SCORE = 800

# Variables of the environment that the solver process may see, beside LC_*
ENVIRONMENT = frozenset(
    {
        *("PATH", "LANG", "LANGUAGE", "TZ", "PYTHONPATH", "PYTHONHASHSEED", "LD_LIBRARY_PATH"),
        *("PYTHONUNBUFFERED", "PYTHONDONTWRITEBYTECODE", "VIRTUAL_ENV", "NUMBA_CACHE_DIR"),
        *("MYOFACE_CACHE", "MYOFACE_FACE_LANDMARKER", "SOURCE_DATE_EPOCH"),
    }
)


def allowed_environment(more: Iterable[str] = ()) -> dict[str, str]:
    """Return the variables that a solver process may see: no settings, keys or addresses."""
    return {
        name: value
        for name, value in os.environ.items()
        if name in ENVIRONMENT or name in more or name.startswith("LC_")
    }


def landlock_abi() -> int:
    """Return the version of the kernel's Landlock; 0: there is none."""
    if sys.platform != "linux":
        return 0
    version = LANDLOCK_CREATE_RULESET_VERSION
    found: int = _libc().syscall(LANDLOCK_CREATE_RULESET, None, ctypes.c_size_t(0), version)
    return max(found, 0)


def missing_layers() -> list[str]:
    """Return what of the confinement this machine does not have, in words."""
    if sys.platform != "linux":
        return ["files, network and signals: only Linux confines a process here"]
    abi = landlock_abi()
    missing = []
    if abi == 0:
        missing.append("files: this kernel has no Landlock (Linux 5.13)")
    if abi < SCOPE_ABI:
        missing.append("signals to other processes of the user: Landlock 6 (Linux 6.12)")
    if platform.machine() not in ARCHITECTURES:
        missing.append(f"network: no filter of system calls for {platform.machine()}")
    return missing


def count_threads() -> int:
    """Return how many threads this process has (Linux)."""
    return len(os.listdir("/proc/self/task"))


def confine(packages: Iterable[str], reads: Iterable[Path], writes: Iterable[Path]) -> None:
    """Confine this process and all that it starts, for good; call it before any thread starts.

    Parameters
    ----------
    packages
        Python packages whose code may be read; the installation's others are.
    reads
        Further files and folders that may be read.
    writes
        The only folders that may be written; nothing in them can be run.

    Raises
    ------
    OSError
        If a layer that the machine has cannot be put on, or other threads run already: they would
        not have it.
    """
    if sys.platform != "linux":
        return
    if count_threads() > 1:
        raise OSError(errno.EBUSY, "threads that run already cannot be confined")
    _limit()
    _prctl(PR_SET_NO_NEW_PRIVS, 1)
    if abi := landlock_abi():
        _restrict_files(abi, _folders(packages), reads, writes)
    if platform.machine() in ARCHITECTURES:
        _filter_calls()


def _limit() -> None:
    for what, most in (
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_FSIZE, LARGEST_FILE),
        (resource.RLIMIT_NOFILE, MOST_FILES),
        (resource.RLIMIT_NPROC, MOST_PROCESSES),
    ):
        hard = resource.getrlimit(what)[1]
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(what, (most, most))
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(OOM_SCORE))


def _folders(packages: Iterable[str]) -> list[Path]:
    """Return the folders of Python packages."""
    specs = map(importlib.util.find_spec, packages)
    return [
        Path(place) for spec in specs if spec for place in spec.submodule_search_locations or ()
    ]


def _restrict_files(
    abi: int, code: Iterable[Path], reads: Iterable[Path], writes: Iterable[Path]
) -> None:
    everything = (1 << RIGHTS_OF_ABI[min(abi, 5)]) - 1
    attributes = [
        everything,
        NET_RIGHTS if abi >= NET_ABI else 0,
        SCOPES if abi >= SCOPE_ABI else 0,
    ]
    # An older kernel takes more bytes than it knows if they are zero.
    packed = struct.pack("=QQQ", *attributes)
    ruleset = _syscall(LANDLOCK_CREATE_RULESET, packed, ctypes.c_size_t(len(packed)), 0)
    try:
        for path in code:
            _allow(ruleset, path.parent, READ_DIR)  # for the names of packages: Python looks there
            _allow(ruleset, path, READ_FILE | READ_DIR)
        for python in (sys.prefix, sys.base_prefix, str(Path(sys.executable).resolve().parent)):
            _allow(ruleset, Path(python), READ_FILE | READ_DIR | EXECUTE)
        for name, rights in PLACES.items():
            _allow(ruleset, Path(name), rights)
        for path in reads:
            _allow(ruleset, path, READ_FILE | READ_DIR)
        for path in writes:
            _allow(ruleset, path, everything & ~(EXECUTE | MAKE_OTHERS))
        _syscall(LANDLOCK_RESTRICT_SELF, ruleset, 0)
    finally:
        os.close(ruleset)


def _allow(ruleset: int, path: Path, rights: int) -> None:
    """Let a place be used with ``rights``; one that is not there needs no rule."""
    try:
        place = os.open(path, os.O_PATH | os.O_CLOEXEC)
    except FileNotFoundError:
        return
    try:
        if not path.is_dir():
            rights &= RIGHTS_TO_A_FILE
        rule = struct.pack("=Qi", rights, place)
        _syscall(LANDLOCK_ADD_RULE, ruleset, LANDLOCK_RULE_PATH_BENEATH, rule, 0)
    finally:
        os.close(place)


def _filter_calls() -> None:
    """Allow only the calls that jobs make, to this process and its children, for good."""
    program = call_filter(platform.machine())
    code = ctypes.create_string_buffer(b"".join(struct.pack("=HBBI", *each) for each in program))
    _prctl(PR_SET_SECCOMP, SECCOMP_MODE_FILTER, _Program(len(program), ctypes.addressof(code)))


class _Program(ctypes.Structure):
    """``struct sock_fprog``: a filter's length and place."""

    _fields_ = (("length", ctypes.c_ushort), ("filter", ctypes.c_void_p))


@functools.cache
def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def _prctl(option: int, value: int, more: _Program | None = None) -> None:
    pointer = ctypes.byref(more) if more else ctypes.c_ulong(0)
    _check(
        _libc().prctl(option, ctypes.c_ulong(value), pointer, ctypes.c_ulong(0), ctypes.c_ulong(0))
    )


def _syscall(number: int, *arguments: object) -> int:
    return _check(_libc().syscall(number, *arguments))


def _check(answer: int) -> int:
    if answer < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return answer
