"""Bounds on a stranger's ZIP before anything is unpacked, the same for the API and the readers."""

from __future__ import annotations

import struct
import zlib
from typing import IO
from zipfile import ZIP_DEFLATED, ZIP_STORED, BadZipFile, ZipInfo

# Errors of reading a ZIP that is damaged, or packed in a way that is not known.
NOT_READABLE = (OSError, EOFError, BadZipFile, RuntimeError, struct.error, zlib.error)
MOST_DIRECTORY_BYTES = 1 << 20  # of a ZIP's list of members; each takes about a hundred

# The end of a ZIP's directory, and the locator of the end that large archives have besides.
END_OF_DIRECTORY = struct.Struct("<4s4H2LH")
FIRST_MAGIC, END_MAGIC, LARGE_MAGIC = b"PK\3\4", b"PK\5\6", b"PK\6\7"
LARGE_SIZE, LONGEST_COMMENT = 20, 1 << 16  # bytes
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
