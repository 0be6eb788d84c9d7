"""A template's tets where its file carries none of the wanted size: made once, then kept."""

from __future__ import annotations

import os
import tempfile
from dataclasses import replace
from pathlib import Path

import structlog

from solver.anatomy.builtin_source import cache_directory
from solver.anatomy.meshing import EDGE_MM, with_mesh
from solver.anatomy.template import Template
from solver.errors import InputError
from solver.progress import Progress, silent

MAKING = 4
"""Part of the name in the cache; counts up where meshes are made in another way."""

log = structlog.get_logger(__name__)


def meshed(template: Template, edge_mm: float = EDGE_MM, progress: Progress = silent) -> Template:
    """Return the template with tets of ``edge_mm``: its own, those in the cache, or new ones.

    New ones take minutes and are not reproducible, so they are kept in the cache folder under the
    hash of what they were made from. Raises as :func:`solver.anatomy.meshing.make_mesh`.
    """
    if template.mesh is not None and template.mesh.edge_mm == edge_mm:
        return template
    bare = replace(template, mesh=None)
    path = cache_directory() / f"meshed-{MAKING}-{bare.sha256[:16]}-{edge_mm:g}mm.npz"
    kept = _kept(path)
    if kept is None:
        log.info("making the template's tets", template=template.name, to=str(path))
        _keep(with_mesh(bare, edge_mm, progress), path)
        kept = Template.load(path)
    return kept


def _kept(path: Path) -> Template | None:
    """Return the template in the cache; none if there is none, or a file that was spoilt."""
    if not path.exists():
        return None
    try:
        return Template.load(path)
    except InputError as error:
        log.warning("the template's tets are made anew", reason=str(error))
        path.unlink(missing_ok=True)
        return None


def _keep(template: Template, path: Path) -> None:
    """Store the template unless another process was faster: then its tets are everybody's."""
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        whole = Path(folder) / path.name
        template.save(whole)
        if not path.exists():
            os.replace(whole, path)
