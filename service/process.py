"""Set up a process: who reads its files, its log, its end with the process that started it."""

from __future__ import annotations

import ctypes
import logging
import os
import sys

import structlog

PR_SET_PDEATHSIG = 1
PR_SET_DUMPABLE = 4


def keep_private() -> None:
    """Let only this user read what this process and its children write: it is faces."""
    os.umask(0o077)


def configure_logs(json: bool) -> None:
    """Send the logs of this process to standard error."""
    renderer: structlog.typing.Processor = (
        structlog.processors.JSONRenderer() if json else structlog.dev.ConsoleRenderer(colors=False)
    )
    shared: list[structlog.typing.Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.stdlib.add_log_level,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
    ]
    structlog.configure(
        processors=[*shared, structlog.stdlib.ProcessorFormatter.wrap_for_formatter],
        logger_factory=structlog.stdlib.LoggerFactory(),
        wrapper_class=structlog.make_filtering_bound_logger(logging.INFO),
        cache_logger_on_first_use=True,
    )
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=shared,
            processors=[
                structlog.stdlib.ProcessorFormatter.remove_processors_meta,
                structlog.processors.format_exc_info,
                _escape_controls,
                renderer,
            ],
        )
    )
    root = logging.getLogger()
    root.handlers = [handler]
    root.setLevel(logging.INFO)
    logging.getLogger("alembic").setLevel(logging.WARNING)


def forbid_dumps() -> None:
    """Hide memory and environment from other processes of the same user (Linux).

    A solver reads strangers' files; one that was taken over must not find the service's secrets.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_DUMPABLE, 0, 0, 0, 0)


def _escape_controls(
    _logger: object, _method: str, event: structlog.typing.EventDict
) -> structlog.typing.EventDict:
    """Let no text of a stranger's do more in a log than be read; tracebacks keep their lines."""
    for key, value in event.items():
        if isinstance(value, str):
            lines = value.split("\n") if key == "exception" else [value]
            event[key] = "\n".join(map(_printable, lines))
    return event


def _printable(line: str) -> str:
    return line if line.isprintable() else line.encode("unicode_escape").decode()


def die_with_parent(parent: int, number: int) -> None:
    """Get the signal ``number`` when the process ``parent`` dies (Linux; a no-op elsewhere).

    Linux sends it already when the *thread* that started this process ends.
    """
    if sys.platform != "linux":
        return
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, number)
    if os.getppid() != parent:
        sys.exit("the parent process died first")
