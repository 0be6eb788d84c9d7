"""Write the built-in face's tetrahedra and their S: .venv/bin/python scripts/builtin_tets.py.

fTetWild is not reproducible: another run gives another mesh (a minute). Look at `make demo` with it
before it is committed. With --train the tets stay as they are, and S alone is trained anew by the
template's expressions (ten minutes).
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np

from solver.anatomy.meshing import make_mesh
from solver.anatomy.template import Template
from solver.fitting.training import train
from solver.progress import Step
from solver.templates.builtin.build import MESH_FILE, build_template, builtin_head, builtin_template


def tell(step: Step) -> None:
    """Print how far it is."""
    print(step.phase, f"{step.fraction:.2f}", step.mean_error_mm or "", flush=True)  # noqa: T201


def with_tets() -> Template:
    """Return the built-in face, with new tets unless they are to stay."""
    if "--train" in sys.argv:
        return builtin_template()
    bare = build_template(builtin_head())
    return replace(bare, mesh=make_mesh(bare))


made = train(with_tets(), progress=tell)
assert made.mesh is not None
np.savez_compressed(MESH_FILE, **made.mesh.arrays())
size = MESH_FILE.stat().st_size / 1e6
print(f"{len(made.mesh.tets)} tets, {size:.2f} MB in {MESH_FILE}")  # noqa: T201
