"""Readable tables behind the anatomies, and where their numbers come from."""

from __future__ import annotations

import csv
import json
from importlib import resources
from typing import Any


def read_table(name: str) -> list[dict[str, str]]:
    """Return the rows of one of the folder's CSV tables, cells by column."""
    with resources.files(__name__).joinpath(f"{name}.csv").open() as stream:
        return list(csv.DictReader(stream))


def listed(cell: str) -> tuple[str, ...]:
    """Return what a cell lists between semicolons."""
    return tuple(cell.split("; ")) if cell else ()


def read_json(name: str) -> Any:
    """Return one of the folder's JSON files."""
    return json.loads(resources.files(__name__).joinpath(f"{name}.json").read_text())
