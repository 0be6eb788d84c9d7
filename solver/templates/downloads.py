"""Files of a public download, as it arrives: in a folder, in its subfolders, or in its ZIPs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from zipfile import BadZipFile, ZipFile

import numpy as np

from solver.errors import file_error
from solver.kinds import NOT_READABLE
from solver.surface import Floats, Ints
from solver.templates.tables import file_fault

_broken_mesh = partial(file_error, "download.mesh")


@dataclass(frozen=True)
class PublicFile:
    """A file at ``path``, or the ``member`` of the ZIP archive at ``path``."""

    path: Path
    member: str | None = None

    @property
    def name(self) -> str:
        """The file's name without folders."""
        return self.path.name if self.member is None else PurePosixPath(self.member).name

    @property
    def folder(self) -> tuple[Path, PurePosixPath]:
        """The place of the file: equal for files of one folder."""
        if self.member is None:
            return self.path.parent, PurePosixPath()
        return self.path, PurePosixPath(self.member).parent

    def read(self) -> bytes:
        """Return the content; raises ``download.unreadable`` if file or archive is damaged."""
        try:
            if self.member is None:
                return self.path.read_bytes()
            with ZipFile(self.path) as archive:
                return archive.read(self.member)
        except NOT_READABLE as error:
            reason = f"{self} cannot be read: {error}"
            raise file_fault("download.unreadable", reason, self) from error

    def __str__(self) -> str:
        return str(self.path) if self.member is None else f"{self.path}: {self.member}"


def public_files(folder: Path, suffix: str) -> list[PublicFile]:
    """Return all files below ``folder`` with a ``suffix``: those in ZIP archives, then the others.

    Raises :class:`InputError` (``download.unreadable``) for an archive that is none.
    """
    packed = [
        PublicFile(archive, member)
        for archive in sorted(folder.rglob("*.zip"))
        for member in _members(archive)
        if member.endswith(suffix)
    ]
    loose = [PublicFile(path) for path in sorted(folder.rglob(f"*{suffix}"))]
    # macOS adds a file "._name" of its own to each in an archive.
    return [file for file in packed + loose if not file.name.startswith(".")]


def _members(archive: Path) -> list[str]:
    try:
        with ZipFile(archive) as opened:
            return opened.namelist()
    except (OSError, BadZipFile) as error:
        reason = f"{archive} is no ZIP archive: {error}"
        raise file_fault("download.unreadable", reason, archive) from error


def obj_vertices(file: PublicFile) -> Floats:
    """Return the vertices (n, 3) of a Wavefront OBJ, in its own unit and order.

    Raises :class:`InputError` (``download.mesh``) with ``file`` and ``line``.
    """
    return _vertices(file, file.read().splitlines())


def obj_mesh(file: PublicFile) -> tuple[Floats, Ints]:
    """Return vertices (n, 3) and polygons (f, 4) of a Wavefront OBJ of triangles and quads.

    The fourth column of a triangle is -1. Raises as :func:`obj_vertices`.
    """
    rows = file.read().splitlines()
    vertices = _vertices(file, rows)
    faces = [(line, row) for line, row in enumerate(rows, start=1) if row.startswith(b"f ")]
    polygons = [_corners(file, line, row, len(vertices)) for line, row in faces]
    return vertices, np.array(polygons, dtype=np.int64).reshape(-1, 4)


def _vertices(file: PublicFile, rows: list[bytes]) -> Floats:
    vertices: list[tuple[float, float, float]] = []
    for line, row in enumerate(rows, start=1):
        if row.startswith(b"v "):
            try:
                x, y, z = map(float, row.split()[1:4])
            except ValueError:
                raise _broken_mesh(file, "not three numbers", line=line) from None
            if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
                raise _broken_mesh(file, f"vertex {len(vertices)} is not finite", line=line)
            vertices.append((x, y, z))
    if not vertices:
        raise _broken_mesh(file, "the file has no vertices", line=len(rows))
    return np.array(vertices)


def _corners(file: PublicFile, line: int, row: bytes, vertices: int) -> list[int]:
    try:
        corners = [int(word.partition(b"/")[0]) - 1 for word in row.split()[1:]]
    except ValueError:
        raise _broken_mesh(file, "a face holds what is not a vertex number", line=line) from None
    if len(corners) not in (3, 4):
        raise _broken_mesh(file, f"a face has {len(corners)} corners, not 3 or 4", line=line)
    if min(corners) < 0 or max(corners) >= vertices:
        raise _broken_mesh(file, f"a face uses a vertex that is none of the {vertices}", line=line)
    return corners if len(corners) == 4 else [*corners, -1]
