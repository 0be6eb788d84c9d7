"""Tries what a process could take, do or leave behind; the job's figures say what it got."""

import ctypes
import fcntl
import json
import os
import resource
import shutil
import socket
import subprocess
import sys
import termios
from collections.abc import Callable
from pathlib import Path
from typing import Any

import solver
from solver.jobs import Task

SECRETS = ("SECRET", "KEY", "PASSWORD", "TOKEN", "URL", "DATA_DIR")
PTRACE_ATTACH = 16
LIBC = ctypes.CDLL(None, use_errno=True)


def run(task: Task) -> None:
    attempt = task.out.parent
    got = {name: _got(try_it) for name, try_it in _tries(task, attempt).items()}
    (task.out / "check.json").write_text(
        json.dumps({"verdict": "good", "findings": [], "figures": {"got": got}})
    )
    (task.out / "check.png").write_bytes(b"PNG")


def _got(try_it: Callable[[], Any]) -> str:
    """Return what a try brought, nothing if it was refused."""
    try:
        found = try_it()
    except (OSError, subprocess.SubprocessError, RuntimeError, StopIteration):
        return ""
    return repr(found)[:100] if found or found == 0 else ""


def _tries(task: Task, attempt: Path) -> dict[str, Callable[[], Any]]:
    data = attempt.parents[2]
    parent = os.getppid()
    code = Path(solver.__file__).parent
    return {
        "list the data folder": lambda: os.listdir(data / "files"),
        "read the database": lambda: (data / "myoface.db").read_bytes()[:16],
        "read the secret": lambda: (data / "secret").read_bytes(),
        "read the admin key": lambda: (data / "admin.key").read_bytes(),
        "read another attempt's file": lambda: (attempt.parent / "other" / "scan").read_bytes(),
        "read a user's file": lambda: (Path("/etc/passwd")).read_bytes()[:9],
        "environment of the parent": lambda: Path(f"/proc/{parent}/environ").read_bytes()[:9],
        "memory of the parent": lambda: Path(f"/proc/{parent}/maps").read_bytes()[:9],
        "attach to the parent": lambda: LIBC.ptrace(PTRACE_ATTACH, parent, 0, 0) == 0 or None,
        "signal the parent": lambda: os.kill(parent, 0) or "may",
        "secrets of its own environment": _secrets,
        "write beside its folder": lambda: (attempt.parent / "left").write_text("x"),
        "write for the next job": lambda: (Path("/tmp") / "left").write_text("x"),
        "change the code": lambda: (code / "left.py").write_text("x"),
        "change the kernels": lambda: (code / "__pycache__" / "left.nbi").write_text("x"),
        "change a kernel that it reads": lambda: next(
            each.write_bytes(b"x") for each in (attempt / "kernels").rglob("*.nb[ic]")
        ),
        "write for the tenant's next job": lambda: (
            attempt.parent / "caches" / "default" / "meshed-4-x-9mm.npz"
        ).write_text("x"),
        "change the cache that it reads": lambda: (
            attempt / "cache" / "meshed-4-there.npz"
        ).write_text("x"),
        "say whose its processes are": lambda: attempt.with_name(
            f"{attempt.name}.session"
        ).write_text("{}"),
        "show that its worker lives": lambda: (attempt.parent / "alive.ingest").write_text("x"),
        "remove the database": lambda: (data / "myoface.db").rename(data / "gone"),
        "lock others out": lambda: os.chmod(data / "files", 0o700) or "may",
        "limit the parent": lambda: (
            LIBC.prlimit(parent, resource.RLIMIT_NOFILE, None, None) == 0 or None
        ),
        "slow the parent down": lambda: os.setpriority(os.PRIO_PROCESS, parent, 19) or "may",
        "open the secret by its attributes": lambda: (
            LIBC.syscall(463, -100, b"/", 0, b"a", 0, 0) == 0 or None
        ),
        "watch the data folder": lambda: LIBC.inotify_init1(0) >= 0 or None,
        "memory that outlives it": lambda: LIBC.shmget(0, 4096, 0o1600) >= 0 or None,
        "a namespace of its own": lambda: LIBC.syscall(56, 0x10000011, 0, 0, 0, 0) >= 0 or None,
        "to outlive its worker": lambda: LIBC.prctl(1, 0) == 0 or None,
        "a pair of sockets": lambda: socket.socketpair(),
        "a TCP socket": lambda: socket.socket(),
        "a UDP socket": lambda: socket.socket(type=socket.SOCK_DGRAM),
        "a Unix socket": lambda: socket.socket(socket.AF_UNIX),
        "a name resolved": lambda: socket.getaddrinfo("localhost.example", 80),
        "a program of its own": lambda: _own_program(attempt),
        "a link to the secret": lambda: (
            (task.out / "link.json").symlink_to(data / "secret") or "may"
        ),
        "a pipe in its results": lambda: os.mkfifo(task.out / "pipe.json") or "may",
        "a program in memory": lambda: os.memfd_create("program") >= 0 or None,
        "to type into a terminal": lambda: fcntl.ioctl(0, termios.TIOCSTI, b"x") == 0 or None,
        "signals to others by a pipe": lambda: fcntl.fcntl(1, fcntl.F_SETOWN, parent) == 0 or None,
        "memory of its own faults": lambda: LIBC.syscall(323, 0) >= 0 or None,
        "keys of the kernel": lambda: LIBC.syscall(250, 0, -3, 0) >= 0 or None,
        "another personality": lambda: LIBC.personality(0x0040000) >= 0 or None,
        "a ring of calls": lambda: LIBC.syscall(425, 8, bytes(120)) >= 0 or None,
        "a filter of its own": lambda: LIBC.prctl(22, 2, 0) == 0 or None,
        "to be dumped": lambda: LIBC.prctl(4, 1) == 0 or None,
        "to count what others do": lambda: LIBC.syscall(298, bytes(128), 0, -1, -1, 0) >= 0 or None,
        "a second name of the database": lambda: (
            os.link(data / "myoface.db", attempt / "tmp" / "db") or "may"
        ),
        "a session of its own": lambda: (
            subprocess.run(
                [sys.executable, "-c", "import os; os.setsid()"], check=True, capture_output=True
            ).returncode
        ),
        "another user": lambda: (
            subprocess.run(["su", "nobody", "-c", "id"], check=True, capture_output=True).stdout
        ),
        "a thread that is not confined": lambda: [
            number
            for number in os.listdir("/proc/self/task")
            if "Seccomp:\t2" not in Path(f"/proc/self/task/{number}/status").read_text()
        ],
        "a file that was left open": _open_files,
        "the order of another job": lambda: os.read(0, 100),
        "a core dump": lambda: resource.getrlimit(resource.RLIMIT_CORE)[1] != 0 or None,
        "a file of 64 GB": lambda: _large_file(attempt / "tmp" / "large"),
        "more files than it needs": lambda: (
            resource.getrlimit(resource.RLIMIT_NOFILE)[1] > 4096 or None
        ),
    }


def _secrets() -> list[str]:
    return [
        name
        for name in os.environ
        if any(word in name for word in SECRETS) and name != "MYOFACE_ATTEMPT"
    ]


def _open_files() -> list[str]:
    """Return what is open but pipes, nothing, and the list of what is open."""
    links = [Path(f"/proc/self/fd/{number}") for number in os.listdir("/proc/self/fd")]
    places = [os.readlink(link) for link in links if link.is_symlink()]
    return [place for place in places if not place.startswith(("pipe:", "/dev/null"))]


def _own_program(attempt: Path) -> int:
    program = attempt / "tmp" / "program"
    shutil.copyfile("/bin/true", program)
    with open(program, "rb") as file:
        os.fchmod(file.fileno(), 0o700)
    return subprocess.run([str(program)], check=True).returncode


def _large_file(path: Path) -> int:
    with path.open("wb") as file:
        file.truncate(64 * 1024**3)
    return path.stat().st_size
