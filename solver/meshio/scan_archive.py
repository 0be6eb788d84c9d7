"""A raw scan as a ZIP: its mesh with the MTL files and images that lie beside it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from solver.errors import file_error, quote
from solver.kinds.inputs import ARCHIVES, MESHES
from solver.meshio.archive import ArchiveLimits, Member, unpacked

# 200 files beside a mesh
LIMITS = ArchiveLimits(2 << 30, 200, "scan.archive", "its mesh and what lies beside it")


@contextmanager
def opened_scan(path: Path, limits: ArchiveLimits = LIMITS) -> Iterator[Path]:
    """Give the mesh file of a raw scan: ``path`` itself, or what a ZIP holds, for a while unpacked.

    Of a ZIP only the folder that the mesh lies in is unpacked, by plain names. Raises
    :class:`~solver.errors.InputError` (``scan.archive``) for a ZIP that is damaged, holds no mesh
    or several, or unpacks to too much.
    """
    if path.suffix.lower() not in ARCHIVES:
        yield path
        return

    def together(members: Sequence[Member]) -> list[Member]:
        """Return the one mesh of an archive and the files beside it."""
        meshes = [place for place, _ in members if place.suffix.lower() in MESHES]
        if len(meshes) != 1:
            names = [quote(place) for place in meshes]
            found = f"it holds {len(names)} ({', '.join(names[:4])})" if names else "it holds none"
            reason = f"a ZIP of a scan has one mesh ({', '.join(MESHES)}): {found}"
            raise file_error(limits.code, path.name, reason, found=names)
        return [each for each in members if each[0].parent == meshes[0].parent]

    with unpacked(path, limits, together) as folder:
        (mesh,) = (each for each in folder.iterdir() if each.suffix.lower() in MESHES)
        yield mesh
