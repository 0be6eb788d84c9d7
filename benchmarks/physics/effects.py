"""Show 5: edits of a fitted person, and what they do to volume and expressions; fibre muscles.

Each scene of ``docs/examples/scenes`` with edits and no motion is made, and the rig's expressions
are replayed with the same activations, contact on. ``change_ml`` and ``change_percent`` are of the
flesh's volume, ``moved_mm`` the mean motion of the face at rest, ``drift_mm`` how much the motions
of the expressions differ from those before the edit, ``motion_mm`` being these, ``penetration_mm``
the deepest of all poses. ``cheeks_over_nose`` is the mean outward motion at rest of cheeks, jowls
and the skin under the chin over that of nose and lips. ``fibres`` compares the rig's muscles of six
numbers with muscles that only contract along their fibres.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy.sparse as sp

from benchmarks.documents import Figures
from solver.drawing.head import THREE_QUARTER, DrawnHead, face_camera
from solver.drawing.render import render_bust
from solver.drawing.sheet import HEADER, Sheet
from solver.edits import Edited, EditReplay, Replayed, apply
from solver.errors import SolveError
from solver.fitting.drives.fibre_contraction import fit_contractions
from solver.fitting.face import Face
from solver.kinds.scene import ContactEntry, EditScene, FleshEntry
from solver.mechanics.linear import fastest
from solver.model import SubjectModel
from solver.rig import ExpressionFit, Rig
from solver.rig.report.edit_report import EditedExpression, EditedPerson, edit_report
from solver.scene import Physics, edit_of
from solver.scene.document import read_scene
from solver.scene.places import Places
from solver.surface import Floats, Ints, vertex_areas, vertex_normals

SCENES = Path(__file__).parents[2] / "docs" / "examples" / "scenes"
EFFECTS = ("fat", "slim", "full_cheeks", "chin_forward", "lip_filler", "palsy", "zombie")
EXPRESSIONS = ("smile", "surprise", "disgust")
CELL = (250, 300)
FIT_TOLERANCE = 1e-5
DOWNWARD = -0.5  # of a normal's y, under the chin
STILL_MM = 1e-3  # mean motion that is none
NO_CONTACT = FleshEntry(contact=ContactEntry(lips=False, teeth=False, eyes=False))


@dataclass(frozen=True)
class Subject:
    """A model with S (n, m + 1), some of its rig's expressions, and its places."""

    model: SubjectModel
    S: sp.csr_array
    fits: Sequence[ExpressionFit]
    places: Places

    @classmethod
    def load(cls, rig: Path, template: Path | None, names: Sequence[str] = EXPRESSIONS) -> Subject:
        """Read a rig, or its folder, and the model's template."""
        found = Rig.load(rig)
        return cls(
            found.model,
            found.weights,
            [fit for fit in found.expressions if fit.name in names],
            Places.of(found.model, template, {}),
        )


def run(subject: Subject, names: Sequence[str] = EFFECTS) -> dict[str, EditedPerson]:
    """Make the edits of the scenes with these names."""
    physics = Physics(FleshEntry())
    before, all_before = poses(Edited.nothing(subject.model, subject.S), physics, subject.fits)
    people = {}
    for name in names:
        scene = read_scene(json.loads((SCENES / f"{name}.json").read_text()), EditScene)
        edits = [edit_of(entry, subject.places) for entry in scene.edits]
        edited = apply(edits, subject.model, subject.S)
        after, all_after = poses(edited, physics, subject.fits)
        compared = [
            EditedExpression(fit.name, one, other, fit.skin)
            for fit, one, other in zip(subject.fits, all_before, all_after, strict=True)
        ]
        people[name] = EditedPerson(edited, before, after, compared)
    return people


def figures(people: Mapping[str, EditedPerson]) -> Figures:
    """Return the figures of every edit."""
    return {name: _figures(person, edit_report(person)) for name, person in people.items()}


def fibres(subject: Subject) -> Figures:
    """Return the mean distances to the fits, expression by expression, without contact.

    ``blended_mm`` are the muscles as they were fitted, ``projected_mm`` their contractions along
    the fibres, ``fibre_mm`` contractions and jaw fitted anew.
    """
    model = subject.model
    nothing = Edited.nothing(subject.model, subject.S)
    by_fibres = NO_CONTACT.model_copy(update={"activation_model": "fibre"})
    as_fitted = poses(nothing, Physics(NO_CONTACT), subject.fits)[1]
    projected = poses(nothing, Physics(by_fibres), subject.fits)[1]
    face = Face(model, linear=fastest(), tolerance=FIT_TOLERANCE)
    found = {}
    for fit, one, other in zip(subject.fits, as_fitted, projected, strict=True):
        wanted = fit.skin[model.face]
        best = face.face_points(fit_contractions(face.with_weights(subject.S), wanted).state.x)
        found[fit.name] = {
            "motion_mm": _mean(wanted - model.skin.vertices[model.face]),
            "blended_mm": None if one is None else _mean(one.skin[model.face] - wanted),
            "fibre_mm": _mean(best - wanted),
            "projected_mm": None if other is None else _mean(other.skin[model.face] - wanted),
        }
    return found


def poses(
    edited: Edited, physics: Physics, fits: Sequence[ExpressionFit]
) -> tuple[Replayed, list[Replayed | None]]:
    """Return an edited person at rest and in expressions, None for one that finds no rest."""
    replay = EditReplay(edited, physics.face(edited), physics.contacts(edited))
    found: list[Replayed | None] = []
    for fit in fits:
        try:
            found.append(replay.pose(physics.activations(edited, fit.activations), fit.jaw))
        except SolveError:
            found.append(None)
    return replay.neutral, found


def sheet(people: Mapping[str, EditedPerson], path: Path) -> None:
    """Draw all edited persons in columns: at rest from two sides, and in their expressions."""
    first = next(iter(people.values()))
    model = first.original
    unedited = replace(
        first,
        edited=replace(first.edited, model=model),
        after=first.before,
        expressions=[replace(each, after=each.before) for each in first.expressions],
    )
    columns = {"unedited": unedited, **people}
    width, height = CELL
    page = Sheet(width * len(columns), HEADER + 30 + (2 + len(first.expressions)) * height)
    page.heading("Edits", "one rig, the same activations in other flesh")
    for column, (name, person) in enumerate(columns.items()):
        left = column * width
        head = DrawnHead(person.edited.model.skin)
        page.text((left + width // 2, HEADER), name.replace("_", " "), 17, anchor="ma")
        views = [(person.after.skin, 0.0), (person.after.skin, THREE_QUARTER)]
        views += [(each.after.skin, 0.0) for each in person.expressions if each.after is not None]
        for row, (skin, yaw) in enumerate(views):
            camera = face_camera(model.skin.vertices, model.face, yaw)
            image = render_bust([head.body(head.lit(skin))], camera, (width, height))
            page.panel((left, HEADER + 30 + row * height), image)
    page.save(path)


def cheeks_over_nose(person: EditedPerson) -> float | None:
    """Return how much more fat shows in cheeks, jowls and under the chin than on nose and lips.

    It is the ratio of the mean outward motions at rest, by area, of nose and lips without what
    faces back, as the insides of nostrils do; None where these keep their place, or a person has no
    such regions.
    """
    model = person.original
    before = model.skin.with_vertices(person.before.skin)
    normals = vertex_normals(before)
    area = vertex_areas(before.vertices, before.faces)
    outward = ((person.after.skin - before.vertices) * normals).sum(axis=1)

    def part(*names: str) -> Ints:
        ids = [model.regions.get(name, model.face[:0]) for name in names]
        return np.intersect1d(np.concatenate(ids), model.face)

    chin = part("chin")
    cheeks = np.union1d(part("cheeks", "jaw"), chin[normals[chin, 1] < DOWNWARD])
    nose = part("nose", "upper_lip", "lower_lip")
    nose = nose[normals[nose, 2] > 0.0]
    if not len(cheeks) or not len(nose):
        return None
    one, other = (float(np.average(outward[ids], weights=area[ids])) for ids in (cheeks, nose))
    return one / other if abs(other) > STILL_MM else None


def _figures(person: EditedPerson, report: Figures) -> Figures:
    reached = [each for each in report["expressions"] if each["status"] == "found"]
    solved = [report["neutral"], *reached]
    return {
        **{name: report["volume"][name] for name in ("change_ml", "change_percent")},
        "moved_mm": report["neutral"]["moved_mm"],
        "cheeks_over_nose": cheeks_over_nose(person),
        "drift_mm": {each["name"]: each["drift_mm"] for each in report["expressions"]},
        "motion_mm": {each["name"]: each["motion_mm"] for each in reached},
        "inverted": sum(each["inverted"] for each in solved),
        "penetration_mm": max(each["penetration_mm"] for each in solved),
        "seconds": sum(each["seconds"] for each in solved),
    }


def _mean(motion: Floats) -> float:
    return float(np.linalg.norm(motion, axis=1).mean())
