"""Pack an OBJ or PLY with its MTL files and images, as an upload is one file."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from zipfile import ZipFile, ZipInfo

import anyio

LIBRARY = re.compile(rb"^mtllib[ \t]+(.+?)[ \t\r]*$", re.MULTILINE)
IMAGE = re.compile(rb"^[ \t]*map_Kd[ \t]+(.+?)[ \t\r]*$", re.MULTILINE | re.IGNORECASE)
COMMENT = re.compile(rb"^comment[ \t]+TextureFile[ \t]+(.+?)[ \t\r]*$", re.MULTILINE)
UDIM = re.compile("<UDIM>", re.IGNORECASE)  # in an image's name: the number of a tile
TILE = re.compile(r"1\d{3}")
LONGEST_MTL = 1 << 24  # bytes
LONGEST_HEADER = 1 << 16  # of a PLY


def with_images(scan: Path, folder: Path) -> Path:
    """Return a ZIP in ``folder`` of a mesh and what it names beside it, or the ``scan`` itself.

    The same files give the same bytes, so that a scan which is there already is known again. What
    does not lie beside the scan is left out: its registration tells.
    """
    files = {scan.name: scan}
    if scan.suffix.lower() == ".obj":
        libraries = _beside(scan, LIBRARY.findall(scan.read_bytes()))
        files |= libraries
        for library in libraries.values():
            files |= _beside(scan, IMAGE.findall(_start(library, LONGEST_MTL)))
    elif scan.suffix.lower() == ".ply":
        files |= _beside(scan, COMMENT.findall(_start(scan, LONGEST_HEADER)))
    if len(files) == 1:
        return scan
    packed = folder / f"{scan.stem}.zip"
    with ZipFile(packed, "w") as archive:
        for name, path in sorted(files.items()):
            archive.writestr(ZipInfo(name), path.read_bytes())
    return packed


async def async_with_images(scan: Path, folder: Path) -> Path:
    """Return a scan with its images, packed in a thread."""
    return await anyio.to_thread.run_sync(with_images, scan, folder)


def _start(path: Path, most: int) -> bytes:
    with path.open("rb") as stream:
        return stream.read(most)


def _beside(scan: Path, lines: list[bytes]) -> dict[str, Path]:
    """Return the files beside a scan that lines end with the names of: they may have blanks."""
    found = {}
    for line in _tiled(scan, lines):
        words = line.removeprefix("./").split(" ")
        ends = (" ".join(words[first:]).removeprefix("./") for first in range(len(words)))
        for name in ends:
            path = scan.with_name(name) if name and not re.search(r"[/\\:]", name) else None
            if path is not None and path.is_file() and path != scan:
                found[name] = path
                break
    return found


def _tiled(scan: Path, lines: list[bytes]) -> Iterator[str]:
    """Yield lines as text, one with ``<UDIM>`` once for each tile that may lie beside a scan."""
    for line in lines:
        text = line.decode("utf-8", "replace")
        if UDIM.search(text):
            names = " ".join(path.name for path in scan.parent.iterdir())
            yield from (UDIM.sub(number, text) for number in sorted({*TILE.findall(names)}))
        else:
            yield text
