"""The template's tets carried into many people, and whether they are sound in all of them.

The template of ``--faces`` and ``--anatomy`` is built and meshed from scratch, then transported
into random identities: ``default_rng(seed).standard_normal`` for the identity shapes' weights,
``none`` for the template's own neutral. Every person is built twice, which has to give the same
model to the bit.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from benchmarks import report
from benchmarks.documents import Section, Table
from solver.anatomy.build import build_subject_model, model_summary
from solver.anatomy.meshing import EDGE_MM, make_mesh
from solver.anatomy.template import Template
from solver.mechanics.boundary import JAW_FREEDOM, jaw_jacobian, move_jaw
from solver.model import JawFrame, SubjectModel
from solver.similarity import fit_similarity
from solver.surface import Floats
from solver.templates import ict_facekit
from solver.templates.ict_facekit import FaceKit, identity, read_facekit
from solver.templates.ict_template import build_ict_template

SMALL_MM3 = 600.0
"""Muscles below this volume are the small ones."""


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    parser.add_argument("--anatomy", type=Path, required=True, help="folder of BodyParts3D meshes")
    parser.add_argument("--faces", type=Path, required=True, help="folder of ICT-FaceKit")
    parser.add_argument("--identity-seeds", type=_seeds, default="none,1,2,11,23", metavar="LIST")
    parser.add_argument("--template", type=Path, help="a template that is already meshed")
    options = parser.parse_args()
    report.finish(run(options), options, section)


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


def section(figures: dict[str, Any]) -> Section:
    """Return the document's section."""
    first = figures["subjects"][0]
    columns = {
        "seconds": "seconds",
        "inverted": "inverted tets",
        "min_dihedral_deg": "smallest angle, deg",
        "embed_max_mm": "skin off the tets, mm",
        "bone_clearance_mm": "bone under skin, mm",
        "jaw_teeth_residual_mm": "jaw, mm",
        "small_muscle_volume_kept": "small muscles kept",
        "deterministic": "same twice",
    }
    rows = [
        ["template's own" if person["identity_seed"] is None else f"seed {person['identity_seed']}"]
        + [person[key] for key in columns]
        for person in figures["subjects"]
    ]
    made = "The template was made beforehand."
    if "from_scratch_seconds" in figures:
        made = (
            f"The template took {figures['template_seconds']:.0f} s, its mesh from scratch "
            f"{figures['from_scratch_seconds']:.0f} s."
        )
    return Section(
        title="One mesh for everybody",
        compared=(
            f"The tets of the template `{figures['template']}` ({first['vertices']:,} vertices, "
            f"{first['tets']:,} tets, {first['muscles']} muscles) carried into random identities, "
            f"each built twice. {made} The angle is the smallest dihedral one; `jaw` is what the "
            "jaw's degrees of freedom miss of the lower teeth's motion; of the small muscles it "
            "is the share of the volume that the tets keep, the worst muscle's."
        ),
        parts=[Table(["identity", *columns.values()], rows)],
    )


def _template(options: argparse.Namespace) -> tuple[Template, dict[str, Any]]:
    if options.template is not None:
        return Template.load(options.template), {}
    start = time.perf_counter()
    bare = build_ict_template(options.anatomy, options.faces)
    built = time.perf_counter()
    template = replace(bare, mesh=make_mesh(bare, EDGE_MM))
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
    return {
        "inverted": figures["inverted"],
        "min_dihedral_deg": figures["smallest_dihedral_deg"],
        "embed_max_mm": figures["embedding_max_mm"],
        "embed_mean_mm": figures["embedding_mean_mm"],
        "surface_max_mm": figures["surface_max_mm"],
        "surface_mean_mm": figures["surface_mean_mm"],
        "muscles": model.muscle_count,
        "bone_clearance_mm": figures["bone_clearance_mm"],
        "lips_separate": lips_separate(template),
        **jaw_residuals(model, kit, neutral.vertices),
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


@dataclass(frozen=True)
class JawResidual:
    """The part of a motion of the lower teeth that five degrees of freedom ``b`` (5,) miss, in mm.

    ``rms`` and ``greatest`` are distances to the teeth in the closest rigid motion, and
    ``not_rigid`` is what that motion itself misses (root mean square): a linear face model
    stretches other people's teeth when it turns them, and no jaw follows that.
    """

    b: Floats
    rms: float
    greatest: float
    not_rigid: float


def jaw_residual(frame: JawFrame, rest: Floats, moved: Floats) -> JawResidual:
    """Fit the jaw to points ``rest`` (k, 3) that moved to ``moved`` (k, 3), in mm."""
    rotation = fit_similarity(rest, moved).rotation
    rigid = (rest - rest.mean(axis=0)) @ rotation.T + moved.mean(axis=0)
    freedom = JAW_FREEDOM
    fit = least_squares(
        lambda b: (move_jaw(frame, rest, b) - rigid).ravel(),
        np.zeros(freedom),
        lambda b: jaw_jacobian(frame, rest, b).reshape(-1, freedom),
    )
    missed = np.linalg.norm(move_jaw(frame, rest, fit.x) - rigid, axis=1)
    return JawResidual(
        b=fit.x,
        rms=float(np.sqrt(np.mean(missed**2))),
        greatest=float(missed.max()),
        not_rigid=float(np.sqrt(np.mean(np.sum((moved - rigid) ** 2, axis=1)))),
    )


def jaw_residuals(model: SubjectModel, kit: FaceKit, neutral: Floats) -> dict[str, float]:
    """Return what the jaw's degrees of freedom miss of the lower teeth's motion in ``jawOpen``.

    ``jawOpen`` is one displacement for all heads: on teeth of another size it stretches them,
    which no bone does. ``jaw_teeth_residual_mm`` is therefore against the nearest rigid motion,
    and ``jaw_stretch_mm`` is how far that is from ``jawOpen``; both root mean squares.
    """
    ids = slice(ict_facekit.LOWER_TEETH.start, ict_facekit.LOWER_TEETH.stop)
    teeth = neutral[ids]
    found = jaw_residual(model.jaw, teeth, teeth + kit.deltas["jawOpen"][ids])
    return {
        "jaw_teeth_residual_mm": found.rms,
        "jaw_teeth_residual_max_mm": found.greatest,
        "jaw_stretch_mm": found.not_rigid,
    }


def lips_separate(template: Template) -> bool:
    """Return whether no tet joins skin of one lip to skin of the other.

    The lips are the skin that parting them moves up, or down, by at least half of the widest; the
    tets and what skin lies on them are the same for everybody.
    """
    mesh = template.mesh
    if mesh is None:
        return False
    upwards = template.parting[mesh.embedded, 1]
    corners = mesh.tets[mesh.embedded_in]
    surface = mesh.shares > 0
    touched = []
    for lip in (upwards > upwards.max() / 2, upwards < upwards.min() / 2):
        touched.append(np.isin(mesh.tets, corners[lip][surface[lip]]).any(axis=1))
    return not bool((touched[0] & touched[1]).any())


if __name__ == "__main__":
    main()
