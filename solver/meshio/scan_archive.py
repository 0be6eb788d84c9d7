"""A raw scan as a ZIP: its mesh with the MTL files and images that lie beside it."""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from zipfile import ZipFile, ZipInfo

from solver.errors import InputError, file_error, quote
from solver.kinds import NOT_READABLE, check_directory, is_plainly_packed
from solver.kinds.inputs import ARCHIVES, MESHES

MOST_BYTES = 2 << 30  # that a scan's mesh and what lies beside it unpack to
MOST_FILES = 200  # beside a mesh
HIDDEN = re.compile(r"(^|/)(\.|__MACOSX/)")  # what systems add that nobody sent


@contextmanager
def opened_scan(path: Path) -> Iterator[Path]:
    """Give the mesh file of a raw scan: ``path`` itself, or what a ZIP holds, for a while unpacked.

    Of a ZIP only the folder that the mesh lies in is unpacked, by plain names. Raises
    :class:`InputError` (``scan.archive``) for a ZIP that is damaged, holds no mesh or several, or
    unpacks to too much.
    """
    if path.suffix.lower() not in ARCHIVES:
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        try:
            with path.open("rb") as stream:
                check_directory(stream)
                with ZipFile(stream) as archive:
                    scan = _unpack(path.name, archive, Path(folder))
        except NOT_READABLE as error:
            raise _fault(path.name, f"it cannot be unpacked: {quote(error)}") from None
        yield scan


def _unpack(file: str, archive: ZipFile, folder: Path) -> Path:
    """Unpack the one mesh of an archive and the files beside it; returns the mesh's."""
    members = [
        (PurePosixPath(member.filename), member)
        for member in archive.infolist()
        if not member.is_dir() and not HIDDEN.search(member.filename)
    ]
    meshes = [place for place, _ in members if place.suffix.lower() in MESHES]
    if len(meshes) != 1:
        names = [quote(place) for place in meshes]
        found = f"it holds {len(names)} ({', '.join(names[:4])})" if names else "it holds none"
        reason = f"a ZIP of a scan has one mesh ({', '.join(MESHES)}): {found}"
        raise _fault(file, reason, found=names)
    together = [(place.name, each) for place, each in members if place.parent == meshes[0].parent]
    _check(file, together)
    for name, member in together:
        with archive.open(member) as source, (folder / name).open("xb") as target:
            shutil.copyfileobj(source, target)
    return folder / meshes[0].name


def _check(file: str, members: list[tuple[str, ZipInfo]]) -> None:
    """Refuse what would unpack to too much, or over what was unpacked before."""
    size = sum(member.file_size for _, member in members)
    if size > MOST_BYTES or len(members) > MOST_FILES:
        reason = (
            f"its mesh and what lies beside it are {len(members)} files of {size} bytes; at most "
            f"{MOST_FILES} of {MOST_BYTES} can be"
        )
        raise _fault(file, reason, found=size, expected=MOST_BYTES)
    seen = set()
    for name, member in members:
        if not name.isprintable() or name in seen:
            raise _fault(file, f"it holds {quote(name)} twice, or by a name that is none")
        if not is_plainly_packed(member):
            raise _fault(file, f"{quote(name)} is encrypted, or packed in a way that is not read")
        seen.add(name)


def _fault(file: str, reason: str, **about: object) -> InputError:
    return file_error("scan.archive", file, reason, **about)
