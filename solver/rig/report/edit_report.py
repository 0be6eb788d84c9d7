"""Figures of what edits did to a person, and the files of an edited person."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from solver.anatomy.tetrahedra import ML, volume_ml, volumes
from solver.contact import Gauge
from solver.drawing.head import SIDE, THREE_QUARTER, DrawnHead, face_camera
from solver.drawing.sheet import Column, SheetLayout, draw_sheet
from solver.edits import Edited, Replayed
from solver.model import SubjectModel
from solver.rig.frames.gltf import in_turn, write_face
from solver.rig.frames.read_back import NEUTRAL, compare_expressions, read_glb
from solver.storage import csr_arrays, read_arrays, write_json
from solver.surface import Floats, vertex_areas, vertex_normals

FORMAT = 1  # of edit.json and edit.npz


@dataclass(frozen=True)
class EditedExpression:
    """One expression ``before`` and ``after`` edits (None: no rest found), as ``fitted`` (V, 3)."""

    name: str
    before: Replayed | None
    after: Replayed | None
    fitted: Floats


@dataclass(frozen=True)
class EditedPerson:
    """The person before and after an edit, at rest and in all expressions."""

    edited: Edited
    before: Replayed
    after: Replayed
    expressions: Sequence[EditedExpression]

    @property
    def original(self) -> SubjectModel:
        """Return the person before the edits."""
        return self.edited.unedited

    @property
    def moved_mm(self) -> Floats:
        """Return how far (V,) the skin at rest has moved."""
        return np.asarray(np.linalg.norm(self.after.skin - self.before.skin, axis=1))

    def drift_mm(self, compared: EditedExpression) -> Floats | None:
        """Return how much (k,) an expression's motion of the face differs from that before."""
        if compared.before is None or compared.after is None:
            return None
        face = self.original.face
        motion = compared.after.skin[face] - self.after.skin[face]
        wanted = compared.before.skin[face] - self.before.skin[face]
        return np.asarray(np.linalg.norm(motion - wanted, axis=1))


def edit_report(person: EditedPerson) -> dict[str, Any]:
    """Return the figures of ``edit.json``: lengths in mm, volumes in ml."""
    face = person.original.face
    gauge = Gauge(person.edited.model, person.original)
    expressions = [_expression(person, each, gauge) for each in person.expressions]
    drifts = [each["drift_mm"] for each in expressions if each["drift_mm"] is not None]
    return {
        "format": FORMAT,
        "volume": _volume(person),
        "flesh": _flesh(person.edited, person.original),
        "regions": _regions(person),
        "neutral": {
            "moved_mm": float(person.moved_mm[face].mean()),
            "moved_max_mm": float(person.moved_mm[face].max()),
            **_pose_figures(person.after, gauge),
        },
        "penetration_neutral_mm": gauge.neutral().most,
        "expressions": expressions,
        "drift_mm": float(np.mean(drifts)) if drifts else None,
    }


def write_edit(person: EditedPerson, report: dict[str, Any], out: Path) -> list[Path]:
    """Write ``edit.json``, ``edit.npz`` and ``edit.glb`` and return their paths.

    The report gets ``files``: how far both, read back, are off the skins. The GLB is the edited
    person at rest; its morph targets are the person before the edits and every expression after
    them. The NPZ has them all, and what the edits came to.
    """
    files = [out / "edit.json", out / "edit.npz", out / "edit.glb"]
    edited = person.edited
    reached = [(each.name, each.after) for each in person.expressions if each.after is not None]
    poses = [person.after, *(after for _, after in reached)]
    taken = {name for name, _ in reached}
    at_rest, unedited = (_free_name(name, taken) for name in (NEUTRAL, "unedited"))
    np.savez_compressed(
        files[1],
        allow_pickle=False,
        format=np.array(FORMAT),
        names=np.array([at_rest, *(name for name, _ in reached)], dtype=np.str_),
        skin=np.array([pose.skin for pose in poses], dtype=np.float32),
        x=np.array([pose.x for pose in poses]),
        growth=edited.growth,
        stiffness=edited.stiffness_factor,
        density=edited.density,
        bones=edited.bones,
        **csr_arrays("S", edited.S),
    )
    shapes = {unedited: person.before.skin, **{name: after.skin for name, after in reached}}
    write_face(files[2], edited.model.skin.with_vertices(person.after.skin), shapes, in_turn)
    stored = read_arrays(files[1])
    packed = dict(zip(stored["names"].tolist(), stored["skin"], strict=True))
    skins = {at_rest: person.after.skin, **{name: after.skin for name, after in reached}}
    measured = {
        files[1].name: compare_expressions(files[1], packed, skins),
        files[2].name: compare_expressions(
            files[2], read_glb(files[2]).expressions(), {NEUTRAL: person.after.skin, **shapes}
        ),
    }
    write_json(files[0], {**report, "files": measured})
    return files


def _free_name(name: str, taken: Collection[str]) -> str:
    """Return a name that no expression has: this one, or with bars behind it."""
    while name in taken:
        name += "_"
    return name


def _volume(person: EditedPerson) -> dict[str, float]:
    tets = person.original.tets
    before, after = (volume_ml(pose.x, tets) for pose in (person.before, person.after))
    change = after - before
    percent = 100.0 * (after / before - 1.0)
    return {"before_ml": before, "after_ml": after, "change_ml": change, "change_percent": percent}


def _flesh(edited: Edited, unedited: SubjectModel) -> dict[str, Any]:
    """Return the range of what the edits ask of the flesh, and how much muscle is left."""

    def ends(asked: Floats) -> list[float]:
        return [float(asked.min()), float(asked.max())]

    muscle = np.asarray(edited.S[:, 1:].sum(axis=1)).ravel()
    return {
        "growth": ends(edited.growth),
        "stiffness": ends(edited.stiffness_factor),
        "density": ends(edited.density),
        "bones_mm": float(np.linalg.norm(edited.bones, axis=1).max()),
        "muscle_ml": float(volumes(unedited.rest, unedited.tets) @ muscle) * ML,
    }


def _regions(person: EditedPerson) -> dict[str, dict[str, float]]:
    """Return how far each of the face's regions moved, and the volume it moved outward through."""
    model = person.original
    before = model.skin.with_vertices(person.before.skin)
    outward = ((person.after.skin - before.vertices) * vertex_normals(before)).sum(axis=1)
    swept = outward * vertex_areas(before.vertices, before.faces) * ML
    seen = {name: np.intersect1d(ids, model.face) for name, ids in model.regions.items()}
    moved = person.moved_mm
    return {
        name: {"moved_mm": float(moved[ids].mean()), "outward_ml": float(swept[ids].sum())}
        for name, ids in seen.items()
        if len(ids)
    }


def _expression(person: EditedPerson, compared: EditedExpression, gauge: Gauge) -> dict[str, Any]:
    face = person.original.face
    before = compared.before
    after = compared.after
    drift = person.drift_mm(compared)
    figures: dict[str, Any] = {
        "name": compared.name,
        "status": "found" if after is not None else "failed",
        "drift_mm": None if drift is None else float(drift.mean()),
        "drift_max_mm": None if drift is None else float(drift.max()),
    }
    if before is not None:
        figures["motion_mm"] = _mean(before.skin[face] - person.before.skin[face])
        figures["off_fit_mm"] = _mean(before.skin[face] - compared.fitted[face])
    if after is not None:
        figures |= _pose_figures(after, gauge)
    return figures


def _pose_figures(pose: Replayed, gauge: Gauge) -> dict[str, Any]:
    return {
        "inverted": pose.inverted,
        "penetration_mm": gauge.at(pose.x, pose.jaw).most,
        "seconds": round(pose.seconds, 2),
    }


def _mean(motion: Floats) -> float:
    return float(np.linalg.norm(motion, axis=1).mean())


# A sheet of an edited person: before, after, and how far the skin has moved.


@dataclass(frozen=True)
class EditSheetOptions:
    """Amount of an edited person that a sheet shows."""

    expressions: int = 4  # columns beside those at rest, at most
    # ends of the colours' scale: the least that holds nearly all of the motion
    scales_mm: tuple[float, ...] = (1.0, 2.0, 4.0, 8.0, 16.0)
    nearly_all: float = 99.5  # percent of the face's vertices


def edit_picture(
    person: EditedPerson,
    title: str,
    detail: str,
    path: Path,
    options: EditSheetOptions = EditSheetOptions(),
) -> None:
    """Draw the person at rest from three sides and in up to four expressions, in columns.

    Where there are more, or some found no rest, the heading says how many are shown.
    """
    still = person.before.skin, person.after.skin
    sides = (("at rest", 0.0), ("three quarters", THREE_QUARTER), ("left side", SIDE))
    # each a name, the camera's angle, and the skins before and after
    expressions = [
        (each.name.replace("_", " "), 0.0, each.before.skin, each.after.skin)
        for each in person.expressions
        if each.before is not None and each.after is not None
    ][: options.expressions]
    views = [*((name, yaw, *still) for name, yaw in sides), *expressions]
    if len(expressions) < (there := len(person.expressions)):
        detail = f"{detail}; {len(expressions)} of {there} expressions are shown"
    moved = [np.linalg.norm(after - before, axis=1) for _, _, before, after in views]
    model = person.original
    usual = np.percentile([each[model.face] for each in moved], options.nearly_all)
    ends = options.scales_mm
    most = next((end for end in ends if end >= usual), ends[-1])
    head = DrawnHead(model.skin)
    layout = SheetLayout()
    columns = []
    for (name, yaw, before, after), motion in zip(views, moved, strict=True):
        camera = face_camera(model.skin.vertices, model.face, yaw)
        bodies = head.compare(before, after, motion, most)
        columns.append(Column.of(name, bodies, camera, layout))
    draw_sheet(path, title, detail, ("Before", "After", "Moved"), columns, layout, most)
