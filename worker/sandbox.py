"""Confinement of the solver process: code that reads strangers' files finds nothing to take.

Layers, each where the machine has it (Linux): files by Landlock (the code to read, its own folder
to write, no other file), signals and abstract sockets by Landlock's scopes, no sockets, no
debugging of others and no change of owners or modes by seccomp, limits by setrlimit. None needs
privileges; none can be taken off again, and processes that the solver starts inherit all.

Landlock: kernel documentation, userspace-api/landlock; seccomp: seccomp(2), filters as in
userspace-api/seccomp_filter.
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

PR_SET_PDEATHSIG = 1
PR_SET_DUMPABLE = 4
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
NET_RIGHTS, NET_ABI = 0b11, 4
SCOPES, SCOPE_ABI = 0b11, 6

# Instructions and answers of seccomp's filters
LOAD, JUMP_IF_EQUAL, JUMP_IF_AT_LEAST, JUMP_IF_ANY, RETURN = 0x20, 0x15, 0x35, 0x45, 0x06
ALLOW, REFUSE = 0x7FFF0000, 0x00050000
NUMBER_AT, ARCHITECTURE_AT, FIRST_ARGUMENT_AT = 0, 4, 16
# Numbers from here on are of calls newer than this table, or of the x32 interface
NEWER = 463
# Flags of clone: namespaces of one's own, and children that are the parent's
CLONE_REFUSED = 0x7E020000 | 0x8000

# AUDIT_ARCH_* of the machines that the filter is made for
ARCHITECTURES = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}

# Calls that are allowed for this process (a first argument of 0) and refused for others
OF_OTHERS: Final[dict[str, tuple[int, int]]] = {
    "prlimit64": (302, 261),
    "sched_setaffinity": (203, 122),
}
PRCTL, CLONE, CLONE3 = (157, 167), (56, 220), (435, 435)

# Calls that no job needs, by machine: (x86_64, aarch64); None: the machine has no such call
REFUSED: Final[dict[str, tuple[int | None, int | None]]] = {
    "socket": (41, 198),
    "socketpair": (53, 199),
    "connect": (42, 203),
    "bind": (49, 200),
    "sendto": (44, 206),
    "sendmsg": (46, 211),
    "setpriority": (141, 140),
    "ioprio_set": (251, 30),
    "sched_setscheduler": (144, 119),
    "sched_setparam": (142, 118),
    "sched_setattr": (314, 274),
    "inotify_init": (253, None),
    "inotify_init1": (294, 26),
    "fanotify_init": (300, 262),
    "shmget": (29, 194),
    "shmat": (30, 196),
    "semget": (64, 190),
    "semop": (65, 193),
    "msgget": (68, 186),
    "msgsnd": (69, 189),
    "mq_open": (240, 180),
    "removexattr": (197, 14),
    "lremovexattr": (198, 15),
    "fremovexattr": (199, 16),
    "name_to_handle_at": (303, 264),
    "ptrace": (101, 117),
    "process_vm_readv": (310, 270),
    "process_vm_writev": (311, 271),
    "pidfd_getfd": (438, 438),
    "io_uring_setup": (425, 425),
    "io_uring_enter": (426, 426),
    "io_uring_register": (427, 427),
    "chmod": (90, None),
    "fchmod": (91, 52),
    "fchmodat": (268, 53),
    "fchmodat2": (452, 452),
    "chown": (92, None),
    "fchown": (93, 55),
    "lchown": (94, None),
    "fchownat": (260, 54),
    "utime": (132, None),
    "utimes": (235, None),
    "futimesat": (261, None),
    "utimensat": (280, 88),
    "setxattr": (188, 5),
    "lsetxattr": (189, 6),
    "fsetxattr": (190, 7),
    "setsid": (112, 157),
    "setpgid": (109, 154),
    "mount": (165, 40),
    "umount2": (166, 39),
    "pivot_root": (155, 41),
    "chroot": (161, 51),
    "unshare": (272, 97),
    "setns": (308, 268),
    "bpf": (321, 280),
    "perf_event_open": (298, 241),
    "userfaultfd": (323, 282),
    "add_key": (248, 217),
    "request_key": (249, 218),
    "keyctl": (250, 219),
    "init_module": (175, 105),
    "finit_module": (313, 273),
    "delete_module": (176, 106),
    "kexec_load": (246, 104),
    "open_by_handle_at": (304, 265),
}

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
        If a layer that the machine has cannot be put on.
    """
    if sys.platform != "linux":
        return
    _limit()
    _prctl(PR_SET_NO_NEW_PRIVS, 1)
    if abi := landlock_abi():
        _restrict_files(abi, _folders(packages), reads, writes)
    if platform.machine() in ARCHITECTURES:
        _refuse_calls()


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


def _refuse_calls() -> None:
    """Answer EPERM to the calls that no job needs, ENOSYS to those that glibc can do without."""
    machine = platform.machine()
    program = _filter(ARCHITECTURES[machine], list(ARCHITECTURES).index(machine))
    code = ctypes.create_string_buffer(b"".join(struct.pack("=HBBI", *each) for each in program))
    _prctl(PR_SET_SECCOMP, SECCOMP_MODE_FILTER, _Program(len(program), ctypes.addressof(code)))


def _filter(architecture: int, column: int) -> list[tuple[int, int, int, int]]:
    """Return the filter's instructions: operation, jump if true, jump if false, operand."""
    allow, refuse = (RETURN, 0, 0, ALLOW), (RETURN, 0, 0, REFUSE | errno.EPERM)
    unknown = (RETURN, 0, 0, REFUSE | errno.ENOSYS)
    argument = (LOAD, 0, 0, FIRST_ARGUMENT_AT)
    program = [
        (LOAD, 0, 0, ARCHITECTURE_AT),
        (JUMP_IF_EQUAL, 1, 0, architecture),
        refuse,
        (LOAD, 0, 0, NUMBER_AT),
        (JUMP_IF_AT_LEAST, 0, 1, NEWER),
        unknown,
        (JUMP_IF_EQUAL, 0, 1, CLONE3[column]),
        unknown,
    ]
    for calls in REFUSED.values():
        if (number := calls[column]) is not None:
            program += [(JUMP_IF_EQUAL, 0, 1, number), refuse]
    for number in (calls[column] for calls in OF_OTHERS.values()):
        checks = [argument, (JUMP_IF_EQUAL, 0, 1, 0), allow, refuse]
        program += [(JUMP_IF_EQUAL, 0, len(checks), number), *checks]
    checks = [argument, (JUMP_IF_ANY, 0, 1, CLONE_REFUSED), refuse, allow]
    program += [(JUMP_IF_EQUAL, 0, len(checks), CLONE[column]), *checks]
    checks = [argument]
    for option in (PR_SET_PDEATHSIG, PR_SET_DUMPABLE):
        checks += [(JUMP_IF_EQUAL, 0, 1, option), refuse]
    checks.append(allow)
    program += [(JUMP_IF_EQUAL, 0, len(checks), PRCTL[column]), *checks, allow]
    return program


class _Program(ctypes.Structure):
    """``struct sock_fprog``: a filter's length and place."""

    _fields_ = (("length", ctypes.c_ushort), ("filter", ctypes.c_void_p))


@functools.cache
def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def _prctl(option: int, value: int, more: _Program | None = None) -> None:
    pointer = ctypes.byref(more) if more else ctypes.c_ulong(0)
    _checked(
        _libc().prctl(option, ctypes.c_ulong(value), pointer, ctypes.c_ulong(0), ctypes.c_ulong(0))
    )


def _syscall(number: int, *arguments: object) -> int:
    return _checked(_libc().syscall(number, *arguments))


def _checked(answer: int) -> int:
    if answer < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return answer
