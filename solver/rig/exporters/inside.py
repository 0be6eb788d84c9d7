"""``inside.bin``: the flesh, bones and muscles of a rig for a page that shows them.

docs/reference/rig-format.md describes it. Displacements are in half precision, at most 0.004 mm off
up to 16 mm and 0.016 mm up to 64 mm.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from solver.anatomy.embedding import tet_binder
from solver.mechanics.boundary import FreeJaw
from solver.model import SubjectModel
from solver.rig.exporters import NO_OPTIONS
from solver.rig.exporters import NoOptions as Options
from solver.rig.frames.read_back import NEUTRAL, compare_expressions
from solver.rig.rig import Rig
from solver.storage import Arrays, read_container, write_container
from solver.surface import Surface

FILE = "inside.bin"
MEDIA_TYPE = "application/octet-stream"
WITH_EVERY_RIG = True


NO_MUSCLE = 255  # the number for none, in a byte
NO_SURFACE = Surface(np.zeros((0, 3)), np.zeros((0, 3), np.int64))


def write(rig: Rig, path: Path, _options: Options = NO_OPTIONS) -> None:
    """Write the tets in every expression, and the bones and muscles that move with them.

    ``at/k`` is left out for an expression whose tets the rig does not hold. Muscles are numbered as
    in ``view.bin``; one without a surface has no triangles.
    """
    model = rig.model
    header = {
        "bones": [
            {"name": name, "moves_with": "jaw" if name == "mandible" else "skull"}
            for name in model.bones
        ],
        "muscles": list(model.muscle_names),
    }
    arrays = {
        "rest": model.rest.astype(np.float32),
        "tets": model.tets.astype(np.uint32),
        "main_muscle": _main_muscles(rig.weights),
        # the mandible's motions (4, 4), matrices of columns (x, y, z, 1) in mm
        "jaw": np.array([FreeJaw(model.jaw).matrix(fit.jaw) for fit in rig.expressions], "<f4"),
    }
    for k, fit in enumerate(rig.expressions):
        if fit.x is not None:
            arrays[f"at/{k}"] = (fit.x - model.rest).astype(np.float16)
    for i, bone in enumerate(model.bones.values()):
        arrays |= _surface(f"bone/{i}", bone)
    write_container(path, header, arrays | _muscles(model))


def read_back(rig: Rig, path: Path, _options: Options = NO_OPTIONS) -> dict[str, Any]:
    """Return how far the flesh's vertices in the file are off the rig's."""
    arrays = read_container(path).arrays
    rest = arrays["rest"]
    wanted = {NEUTRAL: rig.model.rest}
    shown = {NEUTRAL: arrays["rest"]}
    for k, fit in enumerate(rig.expressions):
        if fit.x is not None:
            wanted[fit.name] = fit.x
            if (moved := arrays.get(f"at/{k}")) is not None:
                shown[fit.name] = rest + moved
    return compare_expressions(path, shown, wanted)


def _surface(name: str, surface: Surface) -> Arrays:
    return {
        f"{name}/vertices": surface.vertices.astype(np.float32),
        f"{name}/faces": surface.faces.astype(np.uint32),
    }


def _muscles(model: SubjectModel) -> Arrays:
    """Return the muscles' surfaces and the tets that their vertices follow."""
    known = model.muscle_surfaces
    surfaces = [known.get(name, NO_SURFACE) for name in model.muscle_names]
    points = np.vstack([surface.vertices for surface in surfaces])
    tet, weights = tet_binder(model.rest, model.tets)(points)
    ends = np.cumsum([len(surface.vertices) for surface in surfaces])[:-1]
    arrays: Arrays = {}
    of_muscles = zip(surfaces, np.split(tet, ends), np.split(weights, ends), strict=True)
    for i, (surface, tets, shares) in enumerate(of_muscles):
        arrays |= _surface(f"muscle/{i}", surface)
        arrays[f"muscle/{i}/tet"] = tets.astype(np.uint32)
        arrays[f"muscle/{i}/weights"] = shares.astype(np.float32)
    return arrays


def _main_muscles(S: sp.csr_array) -> np.ndarray:
    """Return the number (n,) of the muscle with the greatest share of each tet."""
    main = np.asarray(S[:, 1:].tocsr().argmax(axis=1)).ravel()
    passive = np.asarray(S[:, [0]].todense()).ravel()
    # none where passive flesh is the greater part, and beyond what a byte counts
    return np.where((passive < 0.5) & (main < NO_MUSCLE), main, NO_MUSCLE).astype(np.uint8)
