"""Real servers for tests and shows: each a context manager that starts one and gives its URL."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import pytest

from myoface.stack import free_port

REQUIRED = "MYOFACE_REQUIRE_SERVERS"
"""Set it where a server that cannot be started is a failure, not a reason to skip."""

START_TIMEOUT = 20.0


DYING_WITH_US = ["setpriv", "--pdeathsig", "TERM", "--"] if shutil.which("setpriv") else []
"""Words before a command, so that a test that is killed leaves no server (Linux)."""


class UnavailableError(RuntimeError):
    """This machine cannot run the server; the message says what is missing."""


@contextmanager
def listening(
    command: Sequence[str | Path],
    log: Path,
    host: str,
    port: int | None,
    end: signal.Signals = signal.SIGTERM,
    **more: Any,
) -> Iterator[subprocess.Popen[bytes]]:
    """Run a server until the end of the block, and tell it so by ``end``.

    The block begins when its port, if it has one, answers.
    """
    with log.open("ab") as output:
        process = subprocess.Popen(
            [*DYING_WITH_US, *map(str, command)],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            start_new_session=True,
            **more,
        )
    try:
        if port is not None:
            _wait(lambda: _answers(host, port), process, log)
        yield process
    finally:
        process.send_signal(end)
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _wait(condition: Callable[[], bool], process: subprocess.Popen[bytes], log: Path) -> None:
    deadline = time.monotonic() + START_TIMEOUT
    while not condition():
        if process.poll() is not None or time.monotonic() > deadline:
            raise RuntimeError(f"a server does not start: {log.read_text()[-2000:]}")
        time.sleep(0.05)


def _answers(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port), timeout=1).close()
    except OSError:
        return False
    return True


def required() -> bool:
    """Tell whether a missing server is a failure."""
    return bool(os.environ.get(REQUIRED))


def unavailable(reason: str) -> NoReturn:
    """End the calling test: it fails where a missing server is a failure, else it is skipped."""
    if required():
        pytest.fail(reason)
    pytest.skip(reason)


__all__ = ["REQUIRED", "UnavailableError", "free_port", "listening", "required", "unavailable"]
