"""``python -m tests.campaigns.two_hosts``: a job on another host survives a broken link.

Makes two network namespaces and runs `tests.campaigns.two_hosts.run` inside that of the stores.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from typer import echo as say

from tests.campaigns.two_hosts.network import STORES, inside, two_hosts
from tests.servers import UnavailableError, required

ROOT = Path(__file__).parents[3]


def main() -> int:
    """Run it; returns the exit code."""
    try:
        with two_hosts():
            command = [
                *inside(STORES),
                sys.executable,
                "-m",
                "tests.campaigns.two_hosts.run",
                *sys.argv[1:],
            ]
            environment = os.environ | {"PYTHONPATH": str(ROOT)}
            return subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode
    except UnavailableError as error:
        say(f"skipped: {error}")
        return int(required())


if __name__ == "__main__":
    sys.exit(main())
