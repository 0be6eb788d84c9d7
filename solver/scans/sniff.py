"""What a file holds, whatever its suffix says."""

from __future__ import annotations

import re

from solver.errors import InputError
from solver.scans.stl import FACET, HEADER_BYTES

OTHERS = {
    b"\x89PNG": "a PNG picture",
    b"\xff\xd8\xff": "a JPEG picture",
    b"%PDF": "a PDF document",
    b"PK\x03\x04": "a ZIP archive",
    b"Rar!": "a RAR archive",
    b"7z\xbc\xaf": "a 7-Zip archive",
    b"\x1f\x8b": "a gzip archive",
    b"Kaydara FBX": "an FBX scene",
    b"BLENDER": "a Blender file",
    b"<!DOCTYPE": "a web page",
    b"<html": "a web page",
    b"\x93NUMPY": "a NumPy array",
    b"DICM": "a DICOM image",
}
HEAD_BYTES = 65536
OBJ_LINE = re.compile(rb"^(v|vn|vt|f|g|o|s|mtllib|usemtl)[ \t]+\S", re.MULTILINE)
POINT_LINE = re.compile(rb"^[ \t]*[-+\d.][-+\d.eE]*([ \t,;]+[-+\w.]+){2,}[ \t\r]*$", re.MULTILINE)


def sniff(file: str, content: bytes, suffix_format: str) -> str:
    """Return the format that ``content`` holds; in doubt the one its suffix says.

    Raises :class:`InputError` (``scan.wrong_extension``) if it is known to be no scan at all.
    """
    head = content[:HEAD_BYTES]
    found = next((what for magic, what in OTHERS.items() if head.startswith(magic)), None)
    if found is not None:
        raise InputError(
            "scan.wrong_extension",
            f"{file} is {found}, not a scan in {suffix_format.upper()} format",
            file=file,
            expected=suffix_format,
            found=found,
        )
    if re.match(rb"ply\r?\n", head):
        return "ply"
    if head.startswith(b"glTF"):
        return "glb"
    if b"\0" in head:
        facets = int.from_bytes(content[80:84], "little")
        is_stl = len(content) == HEADER_BYTES + facets * FACET.itemsize
        return "stl" if is_stl else suffix_format
    if re.match(rb"\s*solid\b.*\s+(facet|endsolid)\b", head):
        return "stl"
    if OBJ_LINE.search(head):
        return "obj"
    return "xyz" if POINT_LINE.search(head) else suffix_format
