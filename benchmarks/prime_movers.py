"""Whether the muscles that literature names contract when a rig makes one action unit alone.

Every shape of the template that is one action unit of FACS, at full strength on the rig's person,
is fitted by activations and jaw with the rig's S. ``prime_mover_top3`` is the part of the shapes,
among those whose muscles the template has, in which on each side one of these is among the three
that contract most (:mod:`solver.rig.report.prime_movers`); ``contradicted`` the part in which a
named muscle lengthens or an antagonist contracts more. Without ``--rig`` S is fitted to the
subject's training scans first.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Iterable, Mapping
from pathlib import Path

from benchmarks import report, subject_fits, subjects
from benchmarks.documents import Figures, Section, Table
from benchmarks.subject_fits import Fits
from benchmarks.subjects import COARSE_EDGE_MM, EDGE_MM
from solver.anatomy.action_units import actions_of, joined_codes
from solver.anatomy.template import ShapeBasis, split_side
from solver.animation.blendshapes import CORRECTED, expression_targets
from solver.fitting.face import Face
from solver.fitting.geometry import GeometryOptions
from solver.model import SubjectModel
from solver.rig.report.certificate import muscles
from solver.rig.report.prime_movers import MoverOptions, movers, rank_contractions
from solver.rig.rig import Rig
from solver.surface import Surface
from solver.templates.builtin.build import builtin_template
from solver.templates.ict_facekit import read_facekit, shape_basis

QUICK_ROUNDS = 4


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    subjects.add_options(parser)
    parser.add_argument("--rig", type=Path, help="rig.npz of the template (of --faces, if given)")
    parser.add_argument("--shapes", help="ARKit's names without sides, joined by commas; else all")
    subjects.add_controls(parser)
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Return the figures of one rig."""
    is_builtin = options.faces is None
    shapes = builtin_template().shapes if is_builtin else shape_basis(read_facekit(options.faces))
    face = _face(options)
    scans = single_units(face.model, shapes)
    if options.quick:
        scans = {name: scan for name, scan in scans.items() if split_side(name)[1] != "right"}
    if options.shapes:
        kept = options.shapes.split(",")
        scans = {name: scan for name, scan in scans.items() if split_side(name)[0] in kept}
    return measure(face, scans)


def _face(options: argparse.Namespace) -> Face:
    if options.rig is not None:
        rig = Rig.load(options.rig)
        return subjects.bounded(Face(rig.model, rig.weights), options)
    model, captures = subjects.load(options, COARSE_EDGE_MM if options.quick else EDGE_MM)
    rounds = QUICK_ROUNDS if options.quick else GeometryOptions.rounds
    schedule = subjects.schedule(options, rounds)
    return subject_fits.by_geometry(Face(model), captures.train, schedule).face


def single_units(model: SubjectModel, basis: ShapeBasis | None) -> dict[str, Surface]:
    """Return name -> skin of every shape, at weight 1, that muscles make and one unit names.

    A corrective shape is none of its own. Raises as :func:`expression_targets`.
    """
    moving = expression_targets(model, basis)
    assert basis is not None, "without shapes there are no targets"
    return {
        name: model.skin.moved(model.skin.vertices + shape)
        for name, shape in zip(basis.expression_names, basis.expressions, strict=True)
        if name in moving and name not in CORRECTED and actions_of(name)
    }


def measure(face: Face, scans: Mapping[str, Surface]) -> Figures:
    """Fit activations to skins of single units, name -> skin, and count their prime movers."""
    fits = subject_fits.by_activations(face, scans)
    shapes = {name: _shape(fits, name) for name in fits.states}
    judged = [figures for figures in shapes.values() if figures["prime"] is not None]
    return {
        "prime_mover_top3": _part(figures["prime"] for figures in judged),
        "contradicted": _part(bool(figures["contradictions"]) for figures in judged),
        "judged": len(judged),
        "failed": fits.failed,
        "seconds": fits.seconds,
        "shapes": shapes,
    }


def _part(answers: Iterable[bool]) -> float | None:
    """Return the part that is true; None of nothing."""
    listed = list(answers)
    return sum(listed) / len(listed) if listed else None


def _shape(fits: Fits, name: str) -> Figures:
    face = fits.face
    a = fits.states[name].pose.a
    model = face.model
    of = muscles(model, face.flesh.volumes, face.S, a)
    wholes = dict(zip(model.muscle_names, model.muscle_groups, strict=True))
    found = movers(
        rank_contractions(model.muscle_names, of.contraction, of.is_judged),
        wholes,
        actions_of(name),
    )
    judged = [check for check in found.actions if check.is_judged]
    named = sorted({muscle for check in judged for muscle in check.muscles})
    ahead = sorted({muscle for check in judged for muscle in check.ahead[: MoverOptions.places]})
    return {
        "unit": joined_codes(check.action.unit for check in found.actions),
        "prime": all(check.is_prime for check in judged) if judged else None,
        "ranks": [check.rank for check in judged],
        "named": {muscle: round(found.contractions[muscle], 3) for muscle in named},
        "ahead": {muscle: round(found.contractions[muscle], 3) for muscle in ahead},
        "missing": sorted({muscle for check in found.actions for muscle in check.missing}),
        "contradictions": [str(each) for each in found.contradictions()],
        "idle": [str(each) for each in found.idle()],
        "mean_mm": float(fits.distances(name).mean()),
    }


def section(figures: Figures) -> Section:
    """Return the section of docs/science/benchmarks.md."""
    rows = [
        [
            name,
            shape["unit"],
            "not judged" if shape["prime"] is None else shape["prime"],
            _listed(shape["named"]) or f"no {', '.join(shape['missing'])}",
            _listed(shape["ahead"]),
            shape["mean_mm"],
        ]
        for name, shape in figures["shapes"].items()
    ]
    heads = ["shape", "unit", "among three", "muscles named", "contract more", "mean, mm"]
    whole = [[figures["prime_mover_top3"], figures["contradicted"], figures["judged"]]]
    return Section(
        title="Prime movers",
        compared="Shapes of the template that are one action unit of FACS, fitted with a rig's S: "
        "whether one of the muscles that literature names is among the three that contract most "
        "on each side, and how often a named muscle lengthens or an antagonist contracts more.",
        parts=[Table(["among three", "contradicted", "shapes judged"], whole), Table(heads, rows)],
    )


def _listed(contractions: dict[str, float]) -> str:
    most = sorted(contractions.items(), key=lambda item: -item[1])
    return ", ".join(f"{muscle} {100 * by:.0f} %" for muscle, by in most)


if __name__ == "__main__":
    main()
