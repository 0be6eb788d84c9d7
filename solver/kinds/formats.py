"""Headers of files, read without numerics: the format of ours, a ZIP's members."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path
from typing import IO, Any
from zipfile import ZIP_DEFLATED, ZIP_STORED, BadZipFile, ZipFile, ZipInfo

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


# Bounds on a stranger's ZIP before anything is unpacked, the same for the API and the readers.

# Errors of reading a ZIP that is damaged, or packed in a way that is not known.
NOT_READABLE = (OSError, EOFError, BadZipFile, RuntimeError, struct.error, zlib.error)
MOST_DIRECTORY_BYTES = 1 << 20  # of a ZIP's list of members; each takes about a hundred

# The end of a ZIP's directory, and the locator of the end that large archives have besides.
END_OF_DIRECTORY = struct.Struct("<4s4H2LH")
FIRST_MAGIC = b"PK\3\4"
END_MAGIC = b"PK\5\6"
LARGE_MAGIC = b"PK\6\7"
LARGE_SIZE = 20  # bytes of ZIP64's locator
LONGEST_COMMENT = 1 << 16  # bytes
ENCRYPTED = 1  # the bit of a member's flags


def check_directory(stream: IO[bytes]) -> None:
    """Raise :class:`BadZipFile` if a ZIP's list of members is long, and go back to its beginning.

    The list is read at once, and each entry becomes an object, and a file where it is unpacked. A
    second end of the directory, for archives of many gigabytes, would overrule the first.
    """
    length = stream.seek(0, 2)
    stream.seek(max(0, length - END_OF_DIRECTORY.size - LONGEST_COMMENT - LARGE_SIZE))
    tail = stream.read()
    place = tail.rfind(END_MAGIC)
    if place < 0 or place + END_OF_DIRECTORY.size > len(tail):
        stream.seek(0)
        if stream.read(len(FIRST_MAGIC)) == FIRST_MAGIC:
            raise BadZipFile("it ends too soon: download it again")
        raise BadZipFile("it is not a ZIP")
    size = END_OF_DIRECTORY.unpack_from(tail, place)[5]
    large = tail[max(0, place - LARGE_SIZE) : place].startswith(LARGE_MAGIC)
    if large or size > MOST_DIRECTORY_BYTES:
        raise BadZipFile("it lists too many members")
    stream.seek(0)


def is_plainly_packed(member: ZipInfo) -> bool:
    """Return whether a member is packed as NumPy does.

    Python unpacks bzip2 and LZMA without a bound: the first byte of a member may cost gigabytes.
    """
    is_known = member.compress_type in (ZIP_STORED, ZIP_DEFLATED)
    return is_known and not member.flag_bits & ENCRYPTED
