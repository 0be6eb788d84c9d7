"""``python -m tests.campaigns.fuzz``: hostile inputs to every reader.

The exit status is 1 if one of them crashed.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys

from tests.campaigns.fuzz.targets import targets


def main() -> int:
    """Print a table; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.campaigns.fuzz", description=__doc__)
    parser.add_argument("--inputs", type=int, default=4000, help="all together")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("names", nargs="*", help="targets, by default all")
    given = parser.parse_args()
    count = len(given.names or targets())
    each = str(-(-given.inputs // count))
    options = ["--seed", str(given.seed), "--inputs", each]
    child = subprocess.Popen(
        [sys.executable, "-m", "tests.campaigns.fuzz.child", *options, *given.names],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert child.stdout is not None
    total = 0
    sys.stdout.write(f"{'reader':20} {'inputs':>7} {'refused':>8} {'peak MB':>8}\n")
    for line in child.stdout:
        row = json.loads(line)
        total += row["inputs"]
        sys.stdout.write(
            f"{row['target']:20} {row['inputs']:7} {row['refused']:8} {row['peak_mb']:8}\n"
        )
        sys.stdout.flush()
    status = child.wait()
    verdict = "0 crashes" if status == 0 else f"CRASHED (exit status {status})"
    sys.stdout.write(f"{total} hostile inputs, {verdict}\n")
    return 1 if status else 0


if __name__ == "__main__":
    sys.exit(main())
