"""Contractions of the muscles that literature names when a rig makes units of FACS.

Shapes of the template, on the rig's person, are fitted by activations and jaw with the rig's S, and
compared with the muscles that anatomy texts name for their action units
(:mod:`solver.rig.report.prime_movers`). The parts, of which ``--parts`` names some:

``units``: every shape that is one unit, at full strength. ``prime_mover_top3`` is the part of
    them, among those whose muscles the template has, in which on each side one of these is among
    the three that contract most; ``contradicted`` the part in which a named muscle lengthens or an
    antagonist contracts more.
``held_out``: the same of a third of the units, the first to third by ``--third``, by a model that
    lacks their shapes, of a template that was trained without them. S is fitted with that model, so
    that nothing told of them; its training scans are the same.
``strong``, ``drawn``: mixtures, the strong scans and thirty of two to five units that go together.
    ``units_contract`` is the part of their units, on each side, of which a muscle contracts,
    ``unnamed`` the part of all contraction that is in muscles which no unit of the mixture names.

``closers`` are the muscles that close the jaw and contract while it is open, over all parts. S is
fitted to the subject's training scans unless ``--rig`` and ``--held-rig`` are there; else they are
left in them, for the pieces of a run to share.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import report, subject_fits, subjects
from benchmarks.documents import Figures, Section, Table
from benchmarks.rig_figures import pulling_closers
from benchmarks.strong import DrawOptions, called_actions, draw_mixtures, mixed, strong_mixtures
from benchmarks.subject_fits import Fits
from solver.anatomy.action_units import (
    Action,
    action_units,
    actions_of,
    is_one_of,
    joined_codes,
    units_of,
)
from solver.anatomy.template import CORRECTED, ShapeBasis, Template, split_side
from solver.animation.blendshapes import expression_targets
from solver.fitting.face import Face
from solver.model import SubjectModel
from solver.rig.report.certificate import ExpressionMuscles, jaw_motion, muscles
from solver.rig.report.prime_movers import MoverOptions, Movers, movers, rank_contractions
from solver.surface import Surface

QUICK_MIXTURES = 6
SINGLE = ("units", "held_out")
MIXED = ("strong", "drawn")
SUMMARY = ("prime_mover_top3", "contradicted", "judged", *SINGLE[1:], *MIXED, "closers", "seconds")


@dataclass(frozen=True)
class HeldOutOptions:
    """Units that a model does not know: every so many, in the order of their table."""

    every: int = 3
    first: int = 1  # how many are known before it


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    subjects.add_options(parser)
    report.add_list(parser, "--parts", PARTS)
    for option, of in (("--rig", "S"), ("--held-rig", "S by the model without some units")):
        words = f"rig.npz of {of}: read if there, else S is left in it"
        parser.add_argument(option, type=Path, help=words)
    parser.add_argument("--shapes", help="ARKit's names without sides, joined by commas; else all")
    words = "which third of the units to hold out"
    parser.add_argument("--third", type=int, choices=(1, 2, 3), default=2, help=words)
    subjects.add_controls(parser)
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Return the figures of the parts that were asked for."""
    person = Person(options)
    found = {}
    for part in options.parts:
        found[part] = PARTS[part](person)
    return summarised(
        {
            "parts": {part: figures["shapes"] for part, figures in found.items()},
            "failed": {part: figures["failed"] for part, figures in found.items()},
            "seconds": {part: figures["seconds"] for part, figures in found.items()},
        }
    )


class Person:
    """The rig's person, and shapes to fit; S is fitted when it is asked for."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self.basis = subjects.shapes(options)
        self.held_out = HeldOutOptions(first=options.third - 1)

    @cached_property
    def face(self) -> Face:
        """The rig's face."""
        return subject_fits.face_of_rig(self.options, self.options.rig)

    @cached_property
    def uninformed(self) -> Face:
        """The face of a model that lacks the shapes of the units that are held out."""
        return subject_fits.face_of_rig(self.options, self.options.held_rig, self._hold_out)

    def _hold_out(self, model: SubjectModel) -> SubjectModel:
        """Return a model of a template that has no shape of the units, nor learned them."""
        held = replace(without_held_out(model, self.held_out), trained=None)
        if self.options.quick or held.expressions is None:
            return held
        template = subjects.chosen_template(self.options, subjects.EDGE_MM)
        learned = subjects.trained(untaught(template, held.expressions.names)).mesh
        return replace(held, trained=None if learned is None else learned.trained)

    def units(self, face: Face) -> dict[str, Surface]:
        """Return the skins of the single units that were asked for."""
        scans = single_units(face.model, self.basis)
        if self.options.quick:
            scans = {name: scan for name, scan in scans.items() if split_side(name)[1] != "right"}
        if self.options.shapes:
            kept = self.options.shapes.split(",")
            scans = {name: scan for name, scan in scans.items() if split_side(name)[0] in kept}
        return scans

    def mixtures(self, weights: Mapping[str, Mapping[str, float]]) -> Figures:
        """Fit mixtures, name -> shape -> weight, and return their figures."""
        face = self.face
        scans = {name: mixed(face.model.skin, self.basis, each) for name, each in weights.items()}
        return measure_mixtures(face, scans, weights)


def _units(person: Person) -> Figures:
    return measure(person.face, person.units(person.face))


def _held_out(person: Person) -> Figures:
    face = person.uninformed
    codes = held_out_units(person.basis.expression_names, face.model.muscle_groups, person.held_out)
    scans = {name: scan for name, scan in person.units(face).items() if has_unit(name, codes)}
    return measure(face, scans)


def _strong(person: Person) -> Figures:
    found = strong_mixtures(person.basis.expression_names)
    count = 2 if person.options.quick else len(found)
    return person.mixtures(dict(list(found.items())[:count]))


def _drawn(person: Person) -> Figures:
    draw = DrawOptions(count=QUICK_MIXTURES) if person.options.quick else DrawOptions()
    return person.mixtures(draw_mixtures(drawn_shapes(person.face.model, person.basis), draw))


PARTS: dict[str, Callable[[Person], Figures]] = {
    "units": _units,
    "held_out": _held_out,
    "strong": _strong,
    "drawn": _drawn,
}


def drawn_shapes(model: SubjectModel, basis: ShapeBasis) -> list[str]:
    """Return the shapes of one unit each that a model's muscles, or its jaw, can make."""
    wholes = set(model.muscle_groups)
    return [name for name in single_units(model, basis) if _is_made(name, wholes)]


def _is_made(shape: str, wholes: Iterable[str]) -> bool:
    """Tell whether a template's muscles, or its jaw, make every unit of a shape."""
    if shape.startswith("jaw"):
        return True
    units = units_of(split_side(shape)[0])
    return all(any(is_one_of(whole, unit.muscles) for whole in wholes) for unit in units)


def single_units(model: SubjectModel, basis: ShapeBasis | None) -> dict[str, Surface]:
    """Return name -> skin of every shape, at weight 1, that muscles make and one unit names.

    A corrective shape is none of its own. Raises as :func:`expression_targets`.
    """
    moving = expression_targets(model, basis)
    assert basis is not None, "without shapes there are no targets"
    return {
        name: model.skin.with_vertices(model.skin.vertices + shape)
        for name, shape in zip(basis.expression_names, basis.expressions, strict=True)
        if name in moving and name not in CORRECTED and actions_of(name)
    }


def held_out_units(
    shapes: Iterable[str], wholes: Iterable[str], options: HeldOutOptions = HeldOutOptions()
) -> frozenset[str]:
    """Return the codes of the units that are held out: of those that can be judged.

    They are single units of a template's ``shapes``, of which it has a muscle among ``wholes``.
    """
    found = [units_of(split_side(shape)[0]) for shape in shapes]
    single = {units[0].code for units in found if len(units) == 1}
    wholes = set(wholes)
    judged = [
        code
        for code, unit in action_units().items()
        if code in single and any(is_one_of(whole, unit.muscles) for whole in wholes)
    ]
    return frozenset(judged[options.first :: options.every])


def has_unit(shape: str, codes: frozenset[str]) -> bool:
    """Tell whether a shape has one of the units ``codes``."""
    return any(action.unit.code in codes for action in actions_of(shape))


def without_held_out(
    model: SubjectModel, options: HeldOutOptions = HeldOutOptions()
) -> SubjectModel:
    """Return a model whose expressions lack all that have a unit which is held out."""
    known = model.expressions
    if known is None:
        return model
    codes = held_out_units(known.names, model.muscle_groups, options)
    kept = [row for row, name in enumerate(known.names) if not has_unit(name, codes)]
    names = tuple(known.names[row] for row in kept)
    return replace(model, expressions=replace(known, names=names, motions=known.motions[kept]))


def untaught(template: Template, names: Sequence[str]) -> Template:
    """Return a template with the expressions ``names`` alone, which nobody trained yet."""
    shapes = template.shapes
    mesh = template.mesh
    if shapes is None or mesh is None:
        return template
    kept = [row for row, name in enumerate(shapes.expression_names) if name in names]
    shapes = replace(shapes, expressions=shapes.expressions[kept], expression_names=tuple(names))
    return replace(template, shapes=shapes, mesh=replace(mesh, trained=None))


def measure(face: Face, scans: Mapping[str, Surface]) -> Figures:
    """Fit activations to skins of single units, name -> skin, and judge their prime movers."""
    fits = subject_fits.by_activations(face, scans)
    return _measured(fits, {name: _shape(fits, name) for name in fits.states})


def measure_mixtures(
    face: Face, scans: Mapping[str, Surface], weights: Mapping[str, Mapping[str, float]]
) -> Figures:
    """Fit activations to skins of mixtures of units, and see whose muscles contract."""
    fits = subject_fits.by_activations(face, scans)
    return _measured(fits, {name: _mixture(fits, name, weights[name]) for name in fits.states})


def _measured(fits: Fits, shapes: Figures) -> Figures:
    return {"shapes": shapes, "failed": fits.failed, "seconds": fits.seconds}


def summarised(figures: Figures) -> Figures:
    """Return figures of all ``parts`` with what they come to."""
    parts: dict[str, Figures] = figures["parts"]
    found: Figures = {}
    for part in SINGLE:
        if part in parts:
            of_part = single_summary(parts[part].values())
            found |= of_part if part == "units" else {part: of_part}
    for part in MIXED:
        if part in parts:
            found[part] = mixture_summary(parts[part].values())
    closers = [each["closers"] for shapes in parts.values() for each in shapes.values()]
    return {**found, "closers": sum(map(len, closers)), **figures}


def single_summary(shapes: Iterable[Figures]) -> Figures:
    """Return what the figures of shapes that are one unit each come to."""
    judged = [shape for shape in shapes if shape["prime"] is not None]
    return {
        "prime_mover_top3": report.part_true(shape["prime"] for shape in judged),
        "contradicted": report.part_true(bool(shape["contradictions"]) for shape in judged),
        "judged": len(judged),
    }


def mixture_summary(mixtures: Iterable[Figures]) -> Figures:
    """Return what the figures of mixtures come to: units by their number, contraction by amount."""
    mixtures = list(mixtures)
    contract = [each for mixture in mixtures for each in mixture["units"].values()]
    whole, unnamed = (sum(each[key] for each in mixtures) for key in ("contraction", "unnamed"))
    return {
        "units_contract": report.part_true(contract),
        "unnamed": unnamed / whole if whole > 0.0 else None,
        "judged": len(contract),
        "mean_mm": float(np.mean([each["mean_mm"] for each in mixtures])) if mixtures else None,
    }


def _muscles(fits: Fits, name: str) -> ExpressionMuscles:
    face = fits.face
    return muscles(face.model, face.flesh.volumes, face.S, fits.states[name].pose.a)


def _movers(model: SubjectModel, found: ExpressionMuscles, actions: Sequence[Action]) -> Movers:
    wholes = dict(zip(model.muscle_names, model.muscle_groups, strict=True))
    ranked = rank_contractions(model.muscle_names, found.contraction, found.is_judged)
    return movers(ranked, wholes, actions)


def _fit(fits: Fits, name: str, found: ExpressionMuscles) -> Figures:
    """Return the figures that any fit has."""
    model = fits.face.model
    jaw = jaw_motion(model, fits.face.jaw.matrix(fits.states[name].pose.b))
    return {
        "opening_mm": jaw.opening_mm,
        "closers": pulling_closers(model, found, jaw),
        "mean_mm": float(fits.distances(name).mean()),
    }


def _shape(fits: Fits, name: str) -> Figures:
    of = _muscles(fits, name)
    found = _movers(fits.face.model, of, actions_of(name))
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
        **_fit(fits, name, of),
    }


def _mixture(fits: Fits, name: str, weights: Mapping[str, float]) -> Figures:
    """Return the figures of a mixture: who contracts of those that its units name, and who else.

    A whole muscle counts by the compartment that contracts most.
    """
    of = _muscles(fits, name)
    actions = called_actions(weights)
    found = _movers(fits.face.model, of, actions)
    most: dict[str, float] = {}
    for muscle, by in found.contractions.items():
        most.setdefault(found.wholes[muscle], max(by, 0.0))
    named = {found.wholes[muscle] for check in found.actions for muscle in check.muscles}
    others = {whole: by for whole, by in most.items() if whole not in named}
    return {
        "weights": {shape: round(weight, 3) for shape, weight in weights.items()},
        "units": {
            f"{check.action.unit.code} {check.action.side}": check.rank is not None
            for check in found.actions
            if check.is_judged
        },
        "contraction": sum(most.values()),
        "unnamed": sum(others.values()),
        "others": {
            whole: round(by, 3)
            for whole, by in list(others.items())[: MoverOptions.places]
            if by >= MoverOptions.least
        },
        **_fit(fits, name, of),
    }


def section(figures: Figures) -> Section:
    """Return the section of docs/science/benchmarks.md."""
    parts: dict[str, Figures] = figures["parts"]
    tables = []
    judged: dict[str, Any] = {"units": figures, "held_out": figures.get("held_out")}
    single = {part: judged[part] for part in SINGLE if part in parts}
    if single:
        keys = ("prime_mover_top3", "contradicted", "judged")
        rows = [[part.replace("_", " "), *(it[key] for key in keys)] for part, it in single.items()]
        tables.append(Table(["units", "among three", "contradicted", "shapes judged"], rows))
    made = {part: figures[part] for part in MIXED if part in parts}
    if made:
        figure = ("units_contract", "unnamed", "judged", "mean_mm")
        rows = [[part, *(it[key] for key in figure)] for part, it in made.items()]
        heads = ["mixtures", "units that contract", "contraction unnamed", "units", "mean, mm"]
        tables.append(Table(heads, rows))
    heads = ["shape", "unit", "among three", "muscles named", "contract more", "mean, mm"]
    for part in single:
        tables.append(Table(heads, _shape_rows(parts[part]), part.replace("_", " ").capitalize()))
    heads = ["mixture", "of", "units idle", "others contract", "jaw closers", "mean, mm"]
    for part in made:
        tables.append(Table(heads, _mixture_rows(parts[part]), part.capitalize()))
    return Section(
        title="Prime movers",
        compared="Shapes of the template that are one action unit of FACS, fitted with a rig's S: "
        "whether one of the muscles that literature names is among the three that contract most "
        "on each side, and how often a named muscle lengthens or an antagonist contracts more. "
        "Units that are held out are unknown to the model, and to the fit of S. Mixtures are "
        "the strong scans, and some drawn of two to five units: which part of their units has a "
        "muscle that contracts, and which part of the contraction is in muscles that none names. "
        f"Muscles that close the jaw contract while it is open: {figures['closers']}.",
        parts=tables,
    )


def _shape_rows(shapes: Figures) -> list[list[Any]]:
    return [
        [
            name,
            shape["unit"],
            "not judged" if shape["prime"] is None else shape["prime"],
            _listed(shape["named"]) or f"no {', '.join(shape['missing'])}",
            _listed(shape["ahead"]),
            shape["mean_mm"],
        ]
        for name, shape in shapes.items()
    ]


def _mixture_rows(mixtures: Figures) -> list[list[Any]]:
    return [
        [
            name,
            _listed(mixture["weights"]),
            ", ".join(unit for unit, contracts in mixture["units"].items() if not contracts),
            _listed(mixture["others"]),
            _listed(mixture["closers"]),
            mixture["mean_mm"],
        ]
        for name, mixture in mixtures.items()
    ]


def _listed(contractions: dict[str, float]) -> str:
    most = sorted(contractions.items(), key=lambda item: -item[1])
    return ", ".join(f"{muscle} {100 * by:.0f} %" for muscle, by in most)


if __name__ == "__main__":
    main()
