"""The number of its format that a file of ours says it has, read without numerics."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from zipfile import ZipFile

from solver.kinds.packing import NOT_READABLE, check_directory, is_plainly_packed

MOST_BYTES = 1 << 24  # of a JSON file or a header; ours have some thousands
NPY_LENGTH = slice(8, 10)  # in an NPY file of version 1: how long its own header is


def format_number(path: Path) -> int | None:
    """Return the number of a file's format; None: it says none, or is no file of ours.

    JSON has it as the member ``format``. NPZ has it in its array ``header``, which is JSON, or in
    an array ``format`` of one whole number.
    """
    try:
        if path.suffix == ".json":
            return _whole(_read_json(path))
        with path.open("rb") as stream:
            check_directory(stream)
            with ZipFile(stream) as archive:
                if "header.npy" in archive.namelist():
                    return _whole(json.loads(_values(archive, "header.npy")))
                return int.from_bytes(_values(archive, "format.npy"), "little")
    except (*NOT_READABLE, LookupError, RecursionError, ValueError):
        return None


def _read_json(path: Path) -> Any:
    with path.open("rb") as stream:
        content = stream.read(MOST_BYTES + 1)
    return json.loads(content) if len(content) <= MOST_BYTES else None


def _whole(document: Any) -> int | None:
    found = document.get("format") if isinstance(document, dict) else None
    return found if type(found) is int else None


def _values(archive: ZipFile, name: str) -> bytes:
    """Return the values of an array, as bytes."""
    member = archive.getinfo(name)
    if member.file_size > MOST_BYTES or not is_plainly_packed(member):
        raise ValueError(f"{name} is no header of ours")
    content = archive.read(member)
    start = NPY_LENGTH.stop + int.from_bytes(content[NPY_LENGTH], "little")
    return content[start:]
