"""Training: the muscle geometry S that a template's own expressions ask for.

Scans of a person show few expressions, so that they leave open what most muscles do. The template
knows better: each of its expressions of one unit of FACS shows a skin, and anatomy names the
muscles that make it (:mod:`solver.anatomy.action_units`). S is fitted to these pairs once a
template, in its neutral, by the fit that persons' scans get (:mod:`solver.fitting.geometry`), with
what is expected of muscles in each (:mod:`solver.fitting.recruitment`). A person has the template's
tets, so that S there is where his own fit begins, and what it is held to.

Units that move different parts of the face are learned two at a time, and both sides together:
a third of the expressions teaches as much.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.sparse as sp

from solver.anatomy.action_units import units_of
from solver.anatomy.build import build_subject_model
from solver.anatomy.meshing import find_or_make_mesh
from solver.anatomy.template import Template, split_side
from solver.errors import InputError
from solver.fitting import geometry
from solver.fitting.contact import terms
from solver.fitting.drives.admissible import Admissible
from solver.fitting.face import Face, PosedFace
from solver.fitting.geometry import GeometryOptions
from solver.fitting.objective import Target, distances
from solver.fitting.recruitment import recruit
from solver.fitting.simplex import mirror_structure
from solver.model import Expressions, SubjectModel
from solver.progress import ProgressCallback, Step, part_of, silent
from solver.surface import Floats


@dataclass(frozen=True)
class TrainingOptions:
    """The tets that S is trained on, how units are joined, and the schedule of the fit."""

    edge_mm: float = 18.0  # of finer tets each takes S from the nearest of these
    overlap: float = 0.1  # of the motions of two units that are learned together, at most
    symmetry: float = 1e-4  # of the mirror prior on S: a template has two like sides
    schedule: GeometryOptions = field(default_factory=lambda: GeometryOptions(within=Admissible()))


def train(
    template: Template,
    options: TrainingOptions = TrainingOptions(),
    progress: ProgressCallback = silent,
) -> Template:
    """Return a template whose tets have the S that its own expressions ask for; in minutes.

    ``progress`` is told about the phases of :func:`find_or_make_mesh` and ``training``. Raises as
    that and as :func:`train_model`.
    """
    coarse = find_or_make_mesh(template, options.edge_mm, part_of(progress, 0.0, 0.2))
    neutral = template.skin.vertices
    model = build_subject_model(coarse, neutral, edge_mm=options.edge_mm, compartments=True)
    S = train_model(model, options, part_of(progress, 0.2, 1.0))
    assert coarse.mesh is not None
    trained = replace(coarse.mesh, trained=S.data.astype(np.float32))
    mesh = template.mesh or trained
    return replace(template, mesh=replace(mesh, trained=mesh.trained_like(trained)))


def train_model(
    model: SubjectModel,
    options: TrainingOptions = TrainingOptions(),
    progress: ProgressCallback = silent,
) -> sp.csr_array:
    """Return the S (n, m + 1) that a model's expressions ask for, in a template's neutral.

    ``progress`` is told about the phase ``training``. Raises :class:`InputError`
    (``template.no_units``) if there is no expression of one unit that the model's muscles make.
    """
    units = {} if model.expressions is None else single_units(model.expressions)
    face = Face(model).with_jaw_on_tracks()
    rest = model.skin.vertices[model.face]
    targets = {
        " + ".join(names): Target.from_points(rest + sum(units[name] for name in names))
        for names in join_units(units, options.overlap)
    }
    recruited = recruit(face, targets)
    if not targets or not recruited:
        message = (
            f"the template {model.template['name']} has no expression of one unit of FACS that its "
            "muscles make: there is nothing that its muscle geometry could be trained by"
        )
        raise InputError("template.no_units", message)
    schedule = options.schedule

    def listen(number: int, states: Mapping[str, PosedFace]) -> None:
        error = geometry.mean_error(face, targets, states)
        progress(Step("training", number / schedule.most_rounds, number + 1, mean_error_mm=error))

    return geometry.fit(
        face,
        terms(face, targets),
        schedule,
        first_terms=distances(face, targets),
        structure=mirror_structure(model, options.symmetry),
        recruited=recruited,
        listen=listen,
    ).S


def single_units(expressions: Expressions) -> dict[str, Floats]:
    """Return the motions (k, 3) mm of the expressions of one unit, both sides together.

    They are by ARKit's names without sides. A unit that is made by no muscle, as puffed cheeks, is
    left out.
    """
    found: dict[str, Floats] = {}
    for name, motion in zip(expressions.names, expressions.motions, strict=True):
        plain = split_side(name)[0]
        units = units_of(plain)
        if len(units) == 1 and units[0].muscles:
            found[plain] = found.get(plain, 0.0) + motion.astype(np.float64)
    return found


def join_units(units: Mapping[str, Floats], overlap: float) -> list[tuple[str, ...]]:
    """Return which ``units``, name -> motion (k, 3), are learned together: one or two each.

    The greatest come first, and take the one whose motion overlaps least with theirs, if by less
    than ``overlap``: the product of how far both move the skin, by its greatest.
    """
    far = {name: np.linalg.norm(motion, axis=1) for name, motion in units.items()}
    left = sorted(far, key=lambda name: -float(far[name] @ far[name]))
    joined: list[tuple[str, ...]] = []
    while left:
        first, *others = left
        shared = {name: _overlap(far[first], far[name]) for name in others}
        partner = min(shared, key=lambda name: shared[name], default=None)
        together = partner is not None and shared[partner] < overlap
        chosen = (first, partner) if partner is not None and together else (first,)
        joined.append(chosen)
        left = [name for name in others if name not in chosen]
    return joined


def _overlap(one: Floats, other: Floats) -> float:
    return float(one @ other / np.sqrt((one @ one) * (other @ other)))
