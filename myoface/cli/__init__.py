"""The command ``myoface``."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from glob import glob
from io import TextIOWrapper

from myoface import __version__
from myoface.cli.batches import batches
from myoface.cli.captures import add, captures
from myoface.cli.client import jobs, subjects, templates
from myoface.cli.commands import Group, UsageError
from myoface.cli.console import complain
from myoface.cli.export import export
from myoface.cli.keys import keys
from myoface.cli.live import live
from myoface.cli.operator import OPERATOR
from myoface.cli.rigs import rigs
from myoface.cli.webhooks import webhooks
from myoface.errors import ApiError, StackError

app = Group(
    "Anatomical, muscle-driven faces from 3D scans. Which version this is: myoface --version.",
    {
        "subjects": subjects,
        "captures": captures,
        "batches": batches,
        "jobs": jobs,
        "rigs": rigs,
        "templates": templates,
        "keys": keys,
        "webhooks": webhooks,
    },
)
app.command("upload", help="Short for `captures add`.")(add)
app.command()(export)
app.command()(live)
app.members.update(OPERATOR)


def run(words: Sequence[str]) -> int:
    """Run a command line and return its exit code; a fault that a person can act on is a line."""
    try:
        if list(words) == ["--version"]:
            print(__version__, flush=True)  # noqa: T201
            return 0
        app.run(words, "myoface")
    except (ApiError, StackError) as error:
        complain(str(error))
        return 1
    except UsageError as error:
        complain(str(error))
        return 2
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # who reads has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        where = "" if error.filename is None else f"{error.filename}: "
        complain(f"{where}{error.strerror or error}")
        return 1
    return 0


def expand_wildcards(words: Sequence[str]) -> list[str]:
    """Return the words with the files that a wildcard stands for, as other systems' shells do."""
    if os.name != "nt":
        return list(words)
    return [
        file
        for word in words
        for file in ((sorted(glob(word)) or [word]) if set(word) & set("*?") else [word])
    ]


def main() -> None:
    """Run the command line of this process."""
    os.umask(0o077)  # what it writes is faces, and nobody else's to read
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # none where it was closed
            stream.reconfigure(errors="backslashreplace")  # code pages
    raise SystemExit(run(expand_wildcards(sys.argv[1:])))
