"""Stop a backup at each step that it takes in its folder, and restore what is there then.

``python -m tests.kills.backup_drill kill|full DATA BACKUP SCRATCH`` writes a line of JSON for each
step: what the step was, how the backup ended, and which subjects a restore brought back. A step is
what Python tells its audit hooks about the folder: opening, renaming, removing a file and the like.
``kill`` is SIGKILL at that step; ``full`` is a disk that has no room from that step on. With ``once
STEP BACKUP`` one backup of the service that the environment names is killed, at that step.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import sys
from pathlib import Path
from typing import Any

from sqlalchemy import select

from myoface.backup import back_up, restore
from myoface.errors import StackError
from service.settings import Settings
from service.store.database import Store
from service.store.deletion import references
from service.store.models import Subject

CHANGES = {"os.rename", "os.mkdir", "os.link"}
ENDED = 0
REFUSED = 3


def drill(blow: str, data: Path, backup: Path, scratch: Path) -> None:
    """Stop a backup at its first step, at its second, and so on until none is left."""
    number = 0
    ended = False
    while not ended:
        number += 1
        folder = scratch / f"backup {number}"
        shutil.copytree(backup, folder)
        reading, writing = os.pipe()
        child = os.fork()
        if not child:
            os._exit(_stop_at(number, blow, Settings(data_dir=data), folder, writing))
        os.close(writing)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        with os.fdopen(reading) as pipe:
            step = pipe.read()
        ended = not step
        found = _restored(folder, scratch / f"restored {number}")
        sys.stdout.write(json.dumps({"step": step, "code": code, **found}) + "\n")
        shutil.rmtree(folder)


def _stop_at(number: int, blow: str, settings: Settings, folder: Path, writing: int) -> int:
    """Make a backup that meets the blow at a step, which is told to a pipe."""
    left = number

    def watch(event: str, given: tuple[Any, ...]) -> None:
        nonlocal left
        names = (str(each) for each in given if isinstance(each, (str, os.PathLike)))
        if not any(str(folder) in name for name in names):
            return
        if blow == "full" and not (event in CHANGES or (event == "open" and _writes(given))):
            return
        left -= 1
        if left > 0:
            return
        if not left:
            os.write(writing, f"{event} {given}".encode())
        if blow == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        raise OSError(errno.ENOSPC, "No space left on device")

    sys.addaudithook(watch)
    try:
        back_up(settings, folder)
    except StackError:
        return REFUSED
    return ENDED


def _writes(given: tuple[Any, ...]) -> bool:
    _path, mode, flags = given
    if isinstance(mode, str):
        return bool(set(mode) & set("wxa+"))
    return bool(flags & (os.O_WRONLY | os.O_RDWR))


def _restored(folder: Path, target: Path) -> dict[str, Any]:
    settings = Settings(data_dir=target)
    try:
        restore(settings, folder)
    except Exception as error:
        return {"error": str(error)}
    store = Store(settings.database, settings.files, settings.broker)
    with store.read() as session:
        subjects = sorted(session.scalars(select(Subject.name)))
        whole = all(store.files.exists(sha256) for sha256 in references(session))
    store.close()
    shutil.rmtree(target)
    return {"subjects": subjects, "whole": whole}


if __name__ == "__main__":
    if sys.argv[1] == "once":
        nobody = os.open(os.devnull, os.O_WRONLY)
        sys.exit(_stop_at(int(sys.argv[2]), "kill", Settings(), Path(sys.argv[3]), nobody))
    drill(sys.argv[1], *map(Path, sys.argv[2:]))
