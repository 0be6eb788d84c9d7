"""Make the small person that tests run on: ``python -m tests.make_fixtures`` (two minutes).

The person is the built-in face's demo person, at coarse tets, so nothing in the files is anybody's
but ours: the built-in face is made from CC0 files (docs/guide/builtin-anatomy.md). fTetWild is
not reproducible: another run gives other tets, and tests must not depend on their numbers.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from solver.anatomy.build import build_subject_model
from solver.anatomy.meshing import make_mesh
from solver.templates.builtin.build import builtin_capture_set, builtin_template
from tests.fixtures import EXPRESSIONS_FILE, MODEL_FILE

EDGE_MM = 22.0  # about 5000 tets
NAMES = ("smile", "surprise", "ah")


def main() -> None:
    """Write the model and the skin's displacements (V, 3) in its expressions, mm."""
    template = builtin_template()
    template = replace(template, mesh=make_mesh(template, EDGE_MM))
    captures = builtin_capture_set()
    neutral = captures.neutral.vertices
    model = build_subject_model(template, neutral, edge_mm=EDGE_MM)
    if model.mesh_source != "transport":
        raise SystemExit(f"the template's tets are not the person's: {model.mesh_source}")
    scans = {**captures.train, **captures.test}
    MODEL_FILE.parent.mkdir(exist_ok=True)
    model.save(MODEL_FILE)
    moved = {name: (scans[name].vertices - neutral).astype(np.float32) for name in NAMES}
    np.savez_compressed(EXPRESSIONS_FILE, **moved)
    sizes = [path.stat().st_size / 1e6 for path in (MODEL_FILE, EXPRESSIONS_FILE)]
    print(f"{len(model.tets)} tets, {sizes[0]:.2f} + {sizes[1]:.2f} MB")  # noqa: T201


if __name__ == "__main__":
    main()
