"""Take out of photographs what says where, when and by whom they were taken, their pixels kept.

Nothing is decoded: segments of a JPEG and chunks of a PNG are walked by their lengths, and those
that neither pixels nor colours need are filled with zeros. A file keeps its size, so that offsets
and sizes of its upload stay true. Of EXIF only the tags of :data:`KEPT` stay, by which a fit turns
a picture and knows its focal length. What lies behind a JPEG's end, as the film of a live photo
and further pictures, is emptied as well.
"""

from __future__ import annotations

import mmap
import re
import shutil
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Literal
from uuid import uuid4

SUFFIXES = frozenset({".jpg", ".jpeg", ".png"})
MOST_BYTES = 256 << 20  # of a picture that a fit reads; what is larger is no photograph of use
MOST_PARTS = (
    100_000  # that are walked: a file of more was made to take long, and its end stays as it is
)
BLOCK = 1 << 20

JPEG = b"\xff\xd8\xff"
MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]", re.DOTALL)  # of a segment, after any data
END_OF_IMAGE = 0xD9
APP0, APP1, APP2, APP14, APP15, COMMENT = 0xE0, 0xE1, 0xE2, 0xEE, 0xEF, 0xFE
# what these segments begin with if pixels or colours need them
NEEDED = {APP0: b"JFIF\0", APP2: b"ICC_PROFILE\0", APP14: b"Adobe"}
EXIF = b"Exif\0\0"

PNG = b"\x89PNG\r\n\x1a\n"
# chunks that pixels, colours and an animation need; of all others the content goes
CHUNKS = frozenset(
    b"IHDR PLTE IDAT IEND tRNS cHRM gAMA iCCP sBIT sRGB cICP mDCV cLLI bKGD hIST pHYs sPLT"
    b" acTL fcTL fdAT".split()
)
EXIF_CHUNK = b"eXIf"
EMPTY_CHUNK = b"voId"  # private, and nobody needs to understand it

# of EXIF by its first bytes, as struct and as int have it
SIGNS = {b"II": "<", b"MM": ">"}
ORDERS: dict[bytes, Literal["little", "big"]] = {b"II": "little", b"MM": "big"}
ORIENTATION = 0x0112
DETAILS = 0x8769  # the block with the other tags
# orientation; pixels a unit of the sensor, its unit; width, height; focal length, and that on film
KEPT = frozenset({ORIENTATION, 0xA20E, 0xA210, 0xA002, 0xA003, 0x920A, 0xA405})
SIZES = {3: 2, 4: 4, 5: 8, 10: 8}  # bytes of SHORT, LONG, RATIONAL and SRATIONAL
XMP_ORIENTATION = re.compile(rb"tiff:Orientation(?:=\"|>)([1-8])")


@dataclass(frozen=True)
class Surplus:
    """A part of a file that is to be emptied: its content, and what a PNG's chunk has around."""

    start: int
    end: int
    is_chunk: bool = False
    takes_exif: bool = False


@dataclass(frozen=True)
class Tag:
    """A number of EXIF as its file has it."""

    kind: int
    value: bytes


@contextmanager
def without_metadata(picture: Path, filename: str) -> Iterator[Path]:
    """Give a copy of a photograph without metadata for a while; the file itself if it has none.

    What is no JPEG or PNG by its ``filename`` and its first bytes stays as it is.
    """
    is_photo = PurePath(filename).suffix.lower() in SUFFIXES
    if not is_photo or not 0 < picture.stat().st_size <= MOST_BYTES:
        yield picture
        return
    # named as an upload's bytes, which are tidied if this process dies
    copy = picture.with_name(str(uuid4()))
    try:
        shutil.copyfile(picture, copy)
        with copy.open("r+b") as file, mmap.mmap(file.fileno(), 0) as content:
            is_changed = _clean(content)
        yield copy if is_changed else picture
    finally:
        copy.unlink(missing_ok=True)


def _clean(content: mmap.mmap) -> bool:
    """Empty what a picture does not need; returns whether there was anything."""
    if content[: len(PNG)] == PNG:
        spans = [*_png_spans(content)]
        lead = b""
    elif content[: len(JPEG)] == JPEG:
        spans = [*_jpeg_spans(content)]
        lead = EXIF
    else:
        return False
    kept = _kept_exif(content, spans, lead)
    is_changed = False
    for span in spans:
        fits = span.takes_exif and 0 < len(kept) <= span.end - span.start
        head = kept if fits else b""
        is_changed |= _empty(content, span, head)
        kept = b"" if fits else kept
    return is_changed


def _jpeg_spans(content: mmap.mmap) -> Iterator[Surplus]:
    place = 2
    for _ in range(MOST_PARTS):
        if (found := MARKER.search(content, place)) is None:
            return
        marker = content[found.start() + 1]
        place = found.end()
        if marker == END_OF_IMAGE:
            yield Surplus(place, len(content))
            return
        length = int.from_bytes(content[place : place + 2], "big")
        end = min(place + max(length, 2), len(content))
        inner = Surplus(place + 2, end, takes_exif=marker == APP1)
        place += length
        if APP0 <= marker <= APP15:
            needed = NEEDED.get(marker)
            if needed is None or content[inner.start : inner.start + len(needed)] != needed:
                yield inner
        elif marker == COMMENT:
            yield inner


def _png_spans(content: mmap.mmap) -> Iterator[Surplus]:
    place = len(PNG)
    for _ in range(MOST_PARTS):
        if place + 12 > len(content):
            return
        length, kind = struct.unpack_from(">I4s", content, place)
        end = place + 8 + length
        if end + 4 > len(content):
            return
        if kind not in CHUNKS:
            yield Surplus(place + 8, end, is_chunk=True, takes_exif=True)
        place = end + 4
        if kind == b"IEND":
            yield Surplus(place, len(content))
            return


def _empty(content: mmap.mmap, span: Surplus, head: bytes) -> bool:
    """Put ``head`` and zeros into a span; returns whether that changes it."""
    is_changed = False
    place = span.start
    kind = EXIF_CHUNK if head else EMPTY_CHUNK
    check = zlib.crc32(kind)
    while place < span.end:
        size = min(BLOCK, span.end - place)
        block = head.ljust(size, b"\0") if place == span.start else bytes(size)
        if content[place : place + size] != block:
            content[place : place + size] = block
            is_changed = True
        check = zlib.crc32(block, check)
        place += size
    if span.is_chunk and (is_changed or content[span.start - 4 : span.start] != kind):
        content[span.start - 4 : span.start] = kind
        content[span.end : span.end + 4] = check.to_bytes(4, "big")
        is_changed = True
    return is_changed


def _kept_exif(content: mmap.mmap, spans: list[Surplus], lead: bytes) -> bytes:
    """Return EXIF, after ``lead``, with the tags of a picture that are kept; empty without any."""
    likely = [span for span in spans if span.takes_exif]
    order = b"II"
    tags: dict[int, Tag] = {}
    for span in likely:
        block = content[span.start : min(span.end, span.start + BLOCK)]
        is_exif = block.startswith(lead) if lead else _kind(content, span) == EXIF_CHUNK
        if is_exif and (tags := _read_tags(block[len(lead) :])):
            order = block[len(lead) : len(lead) + 2]
            break
    if ORIENTATION not in tags:  # readers of pictures take it from elsewhere then
        for span in likely:
            end = min(span.end, span.start + BLOCK)
            if found := XMP_ORIENTATION.search(content, span.start, end):
                tags[ORIENTATION] = Tag(3, int(found[1]).to_bytes(2, ORDERS[order]))
                break
    return lead + _write_tags(order, tags) if tags else b""


def _kind(content: mmap.mmap, span: Surplus) -> bytes:
    return content[span.start - 4 : span.start] if span.is_chunk else b""


def _read_tags(tiff: bytes) -> dict[int, Tag]:
    """Return the tags of EXIF that are kept; what its lengths do not bear out is left out."""
    found: dict[int, Tag] = {}
    if tiff[:2] not in SIGNS or len(tiff) < 8:
        return found
    order = SIGNS[tiff[:2]]
    starts = [struct.unpack_from(f"{order}I", tiff, 4)[0]]
    for block in range(2):  # the first, and that of details
        if len(starts) <= block or starts[block] + 2 > len(tiff):
            break
        (count,) = struct.unpack_from(f"{order}H", tiff, starts[block])
        first = starts[block] + 2
        for place in range(first, min(first + 12 * count, len(tiff) - 11), 12):
            tag, kind, many, value = struct.unpack_from(f"{order}HHI4s", tiff, place)
            (number,) = struct.unpack(f"{order}I", value)
            if tag == DETAILS:
                starts.append(number)
            elif tag in KEPT and many == 1 and kind in SIZES:
                size = SIZES[kind]
                raw = value[:size] if size <= 4 else tiff[number : number + size]
                if len(raw) == size:
                    found[tag] = Tag(kind, raw)
    return found


def _write_tags(order: bytes, tags: dict[int, Tag]) -> bytes:
    """Return EXIF in a byte ``order`` with ``tags``, each where readers look for it."""
    sign = SIGNS[order]
    details = {tag: each for tag, each in tags.items() if tag != ORIENTATION}
    first = {tag: each for tag, each in tags.items() if tag == ORIENTATION}
    start = 8
    if details:
        after = start + 6 + 12 * (len(first) + 1)
        first[DETAILS] = Tag(4, struct.pack(f"{sign}I", after))
    out = order + struct.pack(f"{sign}HI", 42, start) + _block(sign, first, start)
    return out + (_block(sign, details, len(out)) if details else b"")


def _block(sign: str, tags: dict[int, Tag], start: int) -> bytes:
    """Return a block of tags that begins at ``start``, with the values that do not fit into it."""
    values = b""
    entries = b""
    beyond = start + 6 + 12 * len(tags)
    for number, tag in sorted(tags.items()):
        inside = tag.value.ljust(4, b"\0")
        if len(tag.value) > 4:
            inside = struct.pack(f"{sign}I", beyond + len(values))
            values += tag.value
        entries += struct.pack(f"{sign}HHI4s", number, tag.kind, 1, inside)
    return struct.pack(f"{sign}H", len(tags)) + entries + bytes(4) + values
