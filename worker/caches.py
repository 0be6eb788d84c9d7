"""Tenants' caches: meshed templates, which take minutes, kept from job to job.

A solver reads its tenant's through links in its attempt's folder and makes new ones there. Only
supervisors write here, so no job changes what another one is reading. A cached mesh is untrusted:
the reader checks that it is of the template it asked for.
"""

from __future__ import annotations

import os
import re
import time
from contextlib import suppress
from itertools import islice
from pathlib import Path

from service.settings import Settings
from solver.cache import cache_path
from worker.orphans import remove_tree

# Below the work folder, a folder for each tenant
CACHES = "caches"
# The name of what is kept, as `solver.anatomy.meshing` gives it
MESHED = re.compile(r"meshed-[0-9a-z.-]{1,100}\.npz")
# Maximum age of a cached mesh, in seconds
LONGEST_KEPT = 30 * 24 * 3600.0
# Meshes of a tenant, whatever their size
MOST_MESHES = 32


class TenantCache:
    """Cache of a tenant's meshed templates on this host, beside the installation's own files."""

    def __init__(self, tenant: str, settings: Settings) -> None:
        self.folder = settings.work / CACHES / tenant
        self._most_bytes = settings.tenant_cache_bytes
        self.folder.mkdir(parents=True, exist_ok=True)

    def link_into(self, folder: Path) -> None:
        """Link the installation's files and the tenant's into a new folder of an attempt."""
        folder.mkdir()
        for place in (cache_path().absolute(), self.folder):
            for file in filter(Path.is_file, place.glob("*")):
                with suppress(FileExistsError):
                    (folder / file.name).symlink_to(file)

    def keep_new(self, folder: Path) -> None:
        """Keep what an attempt made in its folder, now that its processes have ended."""
        if folder.is_symlink() or not folder.is_dir():
            return
        with os.scandir(folder) as entries:
            meshes = filter(_is_mesh, (Path(entry) for entry in entries))
            made = list(islice(meshes, MOST_MESHES))
        for file in made:
            if _size(file) <= self._most_bytes:
                file.replace(self.folder / file.name)
        self.remove_surplus()

    def remove_surplus(self) -> None:
        """Remove the oldest until the rest is within its bounds of number, bytes and age."""
        count = 0
        kept = 0
        for file in sorted(self.folder.iterdir(), key=_age):
            has_room = count < MOST_MESHES and kept + _size(file) <= self._most_bytes
            if has_room and _is_mesh(file) and _age(file) <= LONGEST_KEPT:
                count = count + 1
                kept = kept + _size(file)
            else:
                remove_tree(file)


def trim_all(settings: Settings) -> None:
    """Remove what is too old or too much in the cache of each tenant."""
    for folder in (settings.work / CACHES).glob("*/"):
        TenantCache(folder.name, settings).remove_surplus()


def _is_mesh(file: Path) -> bool:
    """Tell whether this is what a solver keeps: a plain file, and no link, of such a name."""
    named = MESHED.fullmatch(file.name) is not None
    return named and file.is_file() and not file.is_symlink() and _size(file) > 0


def _age(file: Path) -> float:
    """Return the seconds since a file was made; another worker may remove it meanwhile."""
    try:
        return time.time() - file.lstat().st_mtime
    except FileNotFoundError:
        return 0.0


def _size(file: Path) -> int:
    try:
        return file.lstat().st_size
    except FileNotFoundError:
        return 0
