"""The template's tets carried into many people, and whether they are sound in all of them.

The template of ``--faces`` and ``--anatomy`` is built and meshed from scratch, then transported
into random identities: ``default_rng(seed).standard_normal`` for the identity shapes' weights,
``none`` for the template's own neutral. Every person is built twice, which has to give the same
model to the bit.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from benchmarks import report
from solver.anatomy import ict_facekit
from solver.anatomy.build import build_subject_model, model_summary
from solver.anatomy.ict_captures import identity
from solver.anatomy.ict_facekit import FaceKit, read_facekit
from solver.anatomy.ict_template import build_ict_template
from solver.anatomy.meshing import EDGE_MM, with_mesh
from solver.anatomy.template import Template
from solver.mechanics import jaw
from solver.model import SubjectModel
from solver.surface import Floats

SMALL_MM3 = 600.0
"""Muscles below this volume are the small ones."""
CORNERS = 0.15
"""Part of the mouth's width at each corner where the lips are one."""


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    parser.add_argument("--anatomy", type=Path, required=True, help="folder of BodyParts3D meshes")
    parser.add_argument("--faces", type=Path, required=True, help="folder of ICT-FaceKit")
    parser.add_argument("--identity-seeds", type=_seeds, default="none,1,2,11,23", metavar="LIST")
    parser.add_argument("--template", type=Path, help="a template that is already meshed")
    options = parser.parse_args()
    report.write(run(options), options.json)


def _seeds(text: str) -> list[int | None]:
    return [None if word == "none" else int(word) for word in text.split(",")]


def run(options: argparse.Namespace) -> dict[str, Any]:
    """Build every subject and return the figures."""
    kit = read_facekit(options.faces)
    template, made = _template(options)
    seeds = options.identity_seeds[: 1 if options.quick else None]
    subjects = [{"identity_seed": seed, **_subject(template, kit, seed)} for seed in seeds]
    return {
        **made,
        "template": template.name,
        "template_hash": template.sha256,
        "subjects": subjects,
    }


def _template(options: argparse.Namespace) -> tuple[Template, dict[str, Any]]:
    if options.template is not None:
        return Template.load(options.template), {}
    start = time.perf_counter()
    bare = build_ict_template(options.anatomy, options.faces)
    built = time.perf_counter()
    template = with_mesh(bare, EDGE_MM)
    return template, {
        "template_seconds": built - start,
        "from_scratch_seconds": time.perf_counter() - built,
    }


def _subject(template: Template, kit: FaceKit, seed: int | None) -> dict[str, Any]:
    neutral = kit.skin if seed is None else identity(kit, seed)
    start = time.perf_counter()
    model = build_subject_model(template, neutral.vertices)
    seconds = time.perf_counter() - start
    again = build_subject_model(template, neutral.vertices)
    figures = model_summary(model)
    kept = figures["muscle_volume_kept"]
    small = [
        name
        for name, volume in figures["muscle_volume_enclosed_cm3"].items()
        if 1000.0 * volume < SMALL_MM3
    ]
    mean, greatest = jaw_residual(model, kit, neutral.vertices)
    return {
        "inverted": figures["inverted"],
        "min_dihedral_deg": figures["smallest_dihedral_deg"],
        "embed_max_mm": figures["embedding_max_mm"],
        "embed_mean_mm": figures["embedding_mean_mm"],
        "muscles": model.muscle_count,
        "bone_clearance_mm": figures["bone_clearance_mm"],
        "lips_separate": lips_separate(model),
        "jaw_teeth_residual_mm": mean,
        "jaw_teeth_residual_max_mm": greatest,
        "small_muscle_volume_kept": min(kept[name] for name in small),
        "small_muscles": len(small),
        "seconds": seconds,
        "mesh_source": model.mesh_source,
        "vertices": len(model.rest),
        "tets": len(model.tets),
        "model_hash": model.sha256,
        "model_hash_again": again.sha256,
        "deterministic": model.sha256 == again.sha256,
    }


def jaw_residual(model: SubjectModel, kit: FaceKit, neutral: Floats) -> tuple[float, float]:
    """Return root mean square and maximum in mm of what five degrees of freedom miss.

    They are fitted to the motion of the lower teeth in the head's ``jawOpen``.
    """
    ids = slice(ict_facekit.LOWER_TEETH.start, ict_facekit.LOWER_TEETH.stop)
    teeth = neutral[ids]
    opened = teeth + kit.deltas["jawOpen"][ids]
    fit = least_squares(
        lambda b: (jaw.move(model.jaw, teeth, b) - opened).ravel(),
        np.zeros(jaw.DEGREES_OF_FREEDOM),
        lambda b: jaw.jacobian(model.jaw, teeth, b).reshape(-1, jaw.DEGREES_OF_FREEDOM),
    )
    missed = np.linalg.norm(jaw.move(model.jaw, teeth, fit.x) - opened, axis=1)
    return float(np.sqrt(np.mean(missed**2))), float(missed.max())


def lips_separate(model: SubjectModel) -> bool:
    """Return whether no tet joins skin of the upper lip to skin of the lower, corners left out."""
    skin = model.skin.vertices
    lips = {name: model.regions[name] for name in ("upper_lip", "lower_lip")}
    across = skin[np.concatenate(list(lips.values())), 0]
    margin = CORNERS * np.ptp(across)
    touches = []
    for ids in lips.values():
        inner = ids[(skin[ids, 0] > across.min() + margin) & (skin[ids, 0] < across.max() - margin)]
        rows = model.embedding[np.flatnonzero(np.isin(model.embedded, inner))]
        touches.append(np.isin(model.tets, rows.indices[rows.data > 0]).any(axis=1))
    return not bool((touches[0] & touches[1]).any())


if __name__ == "__main__":
    main()
