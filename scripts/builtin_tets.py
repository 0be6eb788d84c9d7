"""Write the tetrahedra of the built-in face: .venv/bin/python scripts/builtin_tets.py (a minute).

fTetWild is not reproducible: another run gives another mesh, on which the demo person fits to 0.11
to 0.13 mm. Look at `make demo` with it before it is committed.
"""

from __future__ import annotations

import numpy as np

from solver.anatomy.meshing import make_mesh
from solver.templates.builtin.build import MESH_FILE, build_template, builtin_head

mesh = make_mesh(build_template(builtin_head()))
np.savez_compressed(MESH_FILE, **mesh.arrays())
size = MESH_FILE.stat().st_size / 1e6
print(f"{len(mesh.tets)} tets, {size:.2f} MB in {MESH_FILE}")  # noqa: T201
