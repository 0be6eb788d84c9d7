"""The container of the files a browser reads: a JSON header and plain arrays it can map in place.

Four bytes ``MYOV``, the header's length H (uint32), H bytes of JSON, padded with spaces so that the
first array lies at a multiple of 8, then the arrays in C order, each at a multiple of 8. All of it
is little-endian. The header's ``arrays`` gives each array's dtype, shape and place in the file.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from solver.errors import InputError
from solver.storage import Archive, Arrays

MAGIC = b"MYOV"
FORMAT = 1  # of the container
DTYPES = ("float32", "float16", "uint32", "uint8")
ALIGNMENT = 8  # bytes: a browser maps arrays of any dtype in place
PREFIX = struct.Struct("<4sI")


def write_container(path: Path, header: Mapping[str, Any], arrays: Arrays) -> None:
    """Write a file of JSON values and arrays, each of one of :data:`DTYPES`; lengths are mm.

    The same content gives the same bytes. ``format``, ``unit`` and ``arrays`` are put into the
    header here. Raises :class:`ValueError` for another dtype and for NaN in the header.
    """
    stored = {name: _store(name, array) for name, array in arrays.items()}
    text, places = _header(header, stored)
    with path.open("wb") as stream:
        stream.write(PREFIX.pack(MAGIC, len(text)) + text)
        for array, place in zip(stored.values(), places, strict=True):
            stream.write(bytes(place - stream.tell()))
            stream.write(array.data)


def read_container(path: str | Path) -> Archive:
    """Read such a file; its header comes without the table of arrays.

    Raises :class:`InputError`: ``view.unreadable`` if it is not one, or arrays lie outside it;
    ``view.format`` if it has another format number.
    """
    path = Path(path)
    content = path.read_bytes()
    try:
        header, arrays = _parse(content)
    except (struct.error, ArithmeticError, LookupError, TypeError, ValueError) as error:
        message = f"{path.name} is no view of a rig: {error}"
        raise InputError("view.unreadable", message, file=path.name) from error
    found = header.pop("format", None)
    if found != FORMAT:
        message = f"{path.name} has view format {found}, not {FORMAT}"
        raise InputError("view.format", message, file=path.name, expected=FORMAT, found=found)
    return Archive(header, arrays)


def _store(name: str, array: np.ndarray) -> np.ndarray:
    if array.dtype.name not in DTYPES:
        raise ValueError(f"{name} has dtype {array.dtype}; a view holds {', '.join(DTYPES)}")
    return np.ascontiguousarray(array, array.dtype.newbyteorder("<"))


def _header(header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> tuple[bytes, list[int]]:
    """Return the header's bytes and where each array begins."""
    sizes = [_align(array.nbytes) for array in arrays.values()]
    begin = 0  # moves on until the header fits: its places are in it, and their digits count
    while True:
        places = [begin + sum(sizes[:number]) for number in range(len(sizes))]
        table = {
            name: {"dtype": array.dtype.name, "shape": list(array.shape), "offset": place}
            for (name, array), place in zip(arrays.items(), places, strict=True)
        }
        content = {"format": FORMAT, "unit": "mm", **header, "arrays": table}
        text = json.dumps(content, allow_nan=False, separators=(",", ":")).encode()
        needed = _align(PREFIX.size + len(text))
        if needed <= begin:
            return text.ljust(begin - PREFIX.size), places
        begin = needed


def _parse(content: bytes) -> tuple[dict[str, Any], Arrays]:
    magic, length = PREFIX.unpack_from(content)
    if magic != MAGIC:
        raise ValueError("it does not begin with MYOV")
    header = json.loads(content[PREFIX.size : PREFIX.size + length])
    arrays = {}
    for name, entry in header.pop("arrays").items():
        if entry["dtype"] not in DTYPES:
            raise ValueError(f"{name} has the unknown dtype {entry['dtype']}")
        if any(size < 0 for size in entry["shape"]):
            raise ValueError(f"{name} has the shape {entry['shape']}")
        dtype, count = np.dtype(entry["dtype"]).newbyteorder("<"), math.prod(entry["shape"])
        flat = np.frombuffer(content, dtype, count, entry["offset"])
        arrays[name] = flat.reshape(entry["shape"])
    return header, arrays


def _align(place: int) -> int:
    return place + -place % ALIGNMENT
