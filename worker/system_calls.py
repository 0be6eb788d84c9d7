"""The system calls that jobs make, and the filter that refuses a confined process all others.

An allow-list: what a kernel learns tomorrow is refused today. The calls are those that the jobs of
every kind were seen to make, and those that the same libraries make on other machines: another
glibc, another allocator, several memories. Numbers are (x86_64, aarch64), from the kernel's
``asm/unistd_64.h`` and ``asm-generic/unistd.h``; None: the machine has no such call.

Filters: seccomp(2), userspace-api/seccomp_filter of the kernel's documentation.
"""

from __future__ import annotations

import errno
from typing import Final, NamedTuple

Numbers = tuple[int | None, int | None]
Instruction = tuple[int, int, int, int]

# AUDIT_ARCH_* of the machines that the filter is made for, in the order of the numbers
ARCHITECTURES: Final[dict[str, int]] = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}

ALLOWED: Final[dict[str, Numbers]] = {
    # Memory: arrays, allocators, code that numba and ctypes make, and where it is on machines with
    # several memories (TBB, BLAS)
    "brk": (12, 214),
    "mmap": (9, 222),
    "munmap": (11, 215),
    "mremap": (25, 216),
    "mprotect": (10, 226),
    "madvise": (28, 233),
    "msync": (26, 227),
    "membarrier": (324, 283),
    "mbind": (237, 235),
    "get_mempolicy": (239, 236),
    "set_mempolicy": (238, 237),
    # Threads of OpenMP, TBB, BLAS and numba: their locks, their processors, their ends
    "futex": (202, 98),
    "set_robust_list": (273, 99),
    "get_robust_list": (274, 100),
    "rseq": (334, 293),
    "set_tid_address": (218, 96),
    "arch_prctl": (158, None),
    "gettid": (186, 178),
    "getcpu": (309, 168),
    "sched_yield": (24, 124),
    "sched_getaffinity": (204, 123),
    "sched_getparam": (143, 121),
    "sched_getscheduler": (145, 120),
    "sched_get_priority_max": (146, 125),
    "sched_get_priority_min": (147, 126),
    "exit": (60, 93),
    "exit_group": (231, 94),
    # Children: the mesher's process (Landlock says which programs, and whom signals may reach)
    "fork": (57, None),
    "vfork": (58, None),
    "execve": (59, 221),
    "wait4": (61, 260),
    "waitid": (247, 95),
    "kill": (62, 129),
    "tkill": (200, 130),
    "tgkill": (234, 131),
    "getpid": (39, 172),
    "getppid": (110, 173),
    "getpgid": (121, 155),
    "getpgrp": (111, None),
    "getsid": (124, 156),
    "getpriority": (140, 141),
    # Signals: Python's handlers, stacks for them, calls that one interrupted
    "rt_sigaction": (13, 134),
    "rt_sigprocmask": (14, 135),
    "rt_sigreturn": (15, 139),
    "rt_sigpending": (127, 136),
    "rt_sigsuspend": (130, 133),
    "rt_sigtimedwait": (128, 137),
    "sigaltstack": (131, 132),
    "restart_syscall": (219, 128),
    # Time: clocks where the kernel lends no page for them, pauses, the mesher's limit
    "clock_gettime": (228, 113),
    "clock_getres": (229, 114),
    "clock_nanosleep": (230, 115),
    "nanosleep": (35, 101),
    "gettimeofday": (96, 169),
    "time": (201, None),
    "times": (100, 153),
    "getrusage": (98, 165),
    "getitimer": (36, 102),
    "setitimer": (38, 103),
    # Files: what is in them (Landlock says which)
    "open": (2, None),
    "openat": (257, 56),
    "close": (3, 57),
    "close_range": (436, 436),
    "read": (0, 63),
    "readv": (19, 65),
    "pread64": (17, 67),
    "preadv": (295, 69),
    "preadv2": (327, 286),
    "write": (1, 64),
    "writev": (20, 66),
    "pwrite64": (18, 68),
    "pwritev": (296, 70),
    "pwritev2": (328, 287),
    "lseek": (8, 62),
    "truncate": (76, 45),
    "ftruncate": (77, 46),
    "fallocate": (285, 47),
    "fsync": (74, 82),
    "fdatasync": (75, 83),
    "fadvise64": (221, 223),
    "sendfile": (40, 71),
    "copy_file_range": (326, 285),
    # Files: their names and folders, without links, owners, modes, dates and attributes
    "stat": (4, None),
    "fstat": (5, 80),
    "lstat": (6, None),
    "newfstatat": (262, 79),
    "statx": (332, 291),
    "access": (21, None),
    "faccessat": (269, 48),
    "faccessat2": (439, 439),
    "statfs": (137, 43),
    "fstatfs": (138, 44),
    "readlink": (89, None),
    "readlinkat": (267, 78),
    "getdents64": (217, 61),
    "getcwd": (79, 17),
    "chdir": (80, 49),
    "fchdir": (81, 50),
    "mkdir": (83, None),
    "mkdirat": (258, 34),
    "rmdir": (84, None),
    "unlink": (87, None),
    "unlinkat": (263, 35),
    "rename": (82, None),
    "renameat": (264, 38),
    "renameat2": (316, 276),
    "umask": (95, 166),
    # Descriptors: pipes to children and to the worker, and waiting for them
    "dup": (32, 23),
    "dup2": (33, None),
    "dup3": (292, 24),
    "flock": (73, 32),
    "pipe": (22, None),
    "pipe2": (293, 59),
    "poll": (7, None),
    "ppoll": (271, 73),
    "select": (23, None),
    "pselect6": (270, 72),
    # What the process and the machine are
    "getuid": (102, 174),
    "geteuid": (107, 175),
    "getgid": (104, 176),
    "getegid": (108, 177),
    "getresuid": (118, 148),
    "getresgid": (120, 150),
    "getgroups": (115, 158),
    "getrlimit": (97, 163),
    "uname": (63, 160),
    "sysinfo": (99, 179),
    "getrandom": (318, 278),
}


class ArgumentRule(NamedTuple):
    """A call of which only some values of one argument are allowed."""

    numbers: Numbers
    place: int
    values: tuple[int, ...]


BY_ARGUMENT: Final[dict[str, ArgumentRule]] = {
    # Limits and processors of this process (0), not of others
    "prlimit64": ArgumentRule((302, 261), 0, (0,)),
    "sched_setaffinity": ArgumentRule((203, 122), 0, (0,)),
    # Less of the processor for this process itself: a live session's full solves stand back
    "setpriority": ArgumentRule((141, 140), 1, (0,)),
    # Names of threads and of memory, and no_new_privs, which takes away; not the signal at the
    # worker's end, nor dumps
    "prctl": ArgumentRule((157, 167), 0, (15, 16, 23, 38, 39, 0x53564D41)),
    # Whether a descriptor is a terminal, how wide it is, what it has to read, whether children get
    # it; not what types into a terminal
    "ioctl": ArgumentRule(
        (16, 29), 1, (0x5401, 0x802C542A, 0x5413, 0x541B, 0x5421, 0x5450, 0x5451)
    ),
    # Copies and flags of descriptors, locks, sizes of pipes; not signals to others, nor watching
    "fcntl": ArgumentRule((72, 25), 1, (*range(8), 36, 37, 38, 1030, 1031, 1032)),
}

CLONE: Final[Numbers] = (56, 220)
# Flags of clone: namespaces of one's own, and children that are the parent's
CLONE_REFUSED = 0x7E020000 | 0x8000

# From this number on all machines count alike, and every program has an answer to ENOSYS: glibc
# goes back to clone where there is no clone3, whose flags no filter can read. Older ones get EPERM.
RECENT = 424

# Instructions and answers of filters, and where `struct seccomp_data` has what they look at
LOAD = 0x20
JUMP_IF_EQUAL = 0x15
JUMP_IF_AT_LEAST = 0x35
JUMP_IF_ANY = 0x45
RETURN = 0x06
ALLOW: Final[Instruction] = (RETURN, 0, 0, 0x7FFF0000)
REFUSE: Final[Instruction] = (RETURN, 0, 0, 0x00050000 | errno.EPERM)
UNKNOWN: Final[Instruction] = (RETURN, 0, 0, 0x00050000 | errno.ENOSYS)
NUMBER_AT = 0
ARCHITECTURE_AT = 4


def call_filter(machine: str) -> list[Instruction]:
    """Return the filter's instructions: operation, jump if true, jump if false, operand."""
    column = list(ARCHITECTURES).index(machine)
    program = [
        (LOAD, 0, 0, ARCHITECTURE_AT),
        (JUMP_IF_EQUAL, 1, 0, ARCHITECTURES[machine]),
        REFUSE,
        (LOAD, 0, 0, NUMBER_AT),
    ]
    for numbers in ALLOWED.values():
        program += _if_called(numbers[column], [ALLOW])
    for rule in BY_ARGUMENT.values():
        checks = [_argument(rule.place)]
        for value in rule.values:
            checks += [(JUMP_IF_EQUAL, 0, 1, value), ALLOW]
        program += _if_called(rule.numbers[column], [*checks, REFUSE])
    flags = [_argument(0), (JUMP_IF_ANY, 0, 1, CLONE_REFUSED), REFUSE, ALLOW]
    program += _if_called(CLONE[column], flags)
    return [*program, (JUMP_IF_AT_LEAST, 0, 1, RECENT), UNKNOWN, REFUSE]


def _if_called(number: int | None, instructions: list[Instruction]) -> list[Instruction]:
    """Return instructions that are passed over unless the call is this one."""
    if number is None:
        return []
    return [(JUMP_IF_EQUAL, 0, len(instructions), number), *instructions]


def _argument(place: int) -> Instruction:
    """Return the instruction that loads the lower half of an argument."""
    return (LOAD, 0, 0, 16 + 8 * place)
