"""A backup that is killed at some step; the one before it must be whole."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys

from myoface.backup import back_up, verify
from tests.campaigns.chaos.stage import Stage

STEPS = 60
"""Of the hundred or so that a backup takes in its folder, opening and renaming files."""


def kill_backup(stage: Stage) -> bool:
    """Kill a backup, then restore the last good one into a scratch folder."""
    if not stage.store.database.is_sqlite and shutil.which("pg_dump") is None:
        return stage.leave_out("kill-backup", "there is no pg_dump here")
    if not stage.backup.exists():
        back_up(stage.stack.settings, stage.backup)
    step = stage.dice.randint(1, STEPS)
    command = [sys.executable, "-m", "tests.kills.backup_drill", "once", str(step)]
    command += [str(stage.backup)]
    environment = os.environ | stage.stack.settings.environment()
    code = subprocess.run(command, env=environment, check=False).returncode
    assert code in (0, -signal.SIGKILL), code
    verify(stage.backup)
    return code == -signal.SIGKILL
