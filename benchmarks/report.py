"""What every benchmark does at its end: one JSON object, to a file or to standard output."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any


def parser(description: str) -> argparse.ArgumentParser:
    """Return a parser with the options all benchmarks share."""
    arguments = argparse.ArgumentParser(description=description)
    arguments.add_argument("--json", required=True, help="file to write, - for standard output")
    arguments.add_argument("--quick", action="store_true", help="a smaller run of the same code")
    return arguments


def write(figures: dict[str, Any], destination: str) -> None:
    """Write the figures with the machine's size beside them."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    machine = {"cores": os.cpu_count(), "memory_gib": round(memory)}
    text = json.dumps({**figures, "machine": machine}, indent=2, allow_nan=False) + "\n"
    if destination == "-":
        sys.stdout.write(text)
    else:
        Path(destination).write_text(text, encoding="utf-8")
