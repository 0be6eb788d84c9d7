"""The scans of one session: a neutral, the expressions to train on and the unseen ones."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterable
from dataclasses import astuple, dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from solver.anatomy.template import Muscle, Template
from solver.meshio.obj import write_obj
from solver.meshio.ply import write_ply
from solver.surface import Ints, Surface
from solver.templates.folder import DESCRIPTION, FORMAT
from solver.templates.tables import file_fault, vertex_ranges


@dataclass(frozen=True)
class CaptureSet:
    """Registered scans of one subject by name, in mm, all with the faces of ``neutral``."""

    neutral: Surface
    train: dict[str, Surface]  # expressions that the muscle geometry is fitted to
    test: dict[str, Surface]  # those that are solved for activations only

    def first(self, train: int, test: int) -> CaptureSet:
        """Return the neutral with the first expressions only."""
        first, others = islice(self.train.items(), train), islice(self.test.items(), test)
        return CaptureSet(self.neutral, dict(first), dict(others))

    def write(self, folder: Path) -> dict[str, Path]:
        """Write every scan as OBJ into ``folder`` and return name -> path (``neutral`` first)."""
        folder.mkdir(parents=True, exist_ok=True)
        scans = {"neutral": self.neutral, **self.train, **self.test}
        paths = {name: folder / f"{name}.obj" for name in scans}
        for name, scan in scans.items():
            write_obj(paths[name], scan)
        return paths


def write_template(template: Template, folder: Path) -> None:
    """Write a template, without its tetrahedra, into a new or empty folder, in mm.

    Raises :class:`InputError`: ``template.folder`` if there is something in it, ``template.value``
    for a shape whose name would lead out of it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if any(folder.iterdir()):
        raise file_fault("template.folder", f"{folder} is not empty", str(folder))
    (folder / DESCRIPTION).write_text(_description(template), encoding="utf-8")
    meshes = {name: getattr(template, name) for name in ("skin", "cranium", "mandible")}
    for name, surface in (meshes | {"parted": template.parted_skin}).items():
        write_ply(folder / f"{name}.ply", surface)
    _write_muscles(template.muscles, folder)
    _write_table(folder / "landmarks.csv", ("name", "vertex"), template.landmarks.items())
    if template.depths:
        columns = ("landmark", "bone", "depth_mm", "sd_mm", "source")
        _write_table(folder / "depths.csv", columns, map(astuple, template.depths))
    parts = {
        "flesh": template.skin.faces[template.flesh_faces],
        "face": template.face_vertices,
        "with_cranium": template.attached_cranium,
        "with_mandible": template.attached_mandible,
    }
    _write_sets(folder / "parts.json", parts)
    _write_sets(folder / "regions.json", template.regions)
    if (shapes := template.shapes) is not None:
        numbers = [f"{number:03d}" for number in range(len(shapes.identity))]
        _write_shapes(template, folder / "identities", numbers, shapes.identity)
        _write_shapes(template, folder / "expressions", shapes.expression_names, shapes.expressions)


def _description(template: Template) -> str:
    left, right = template.condyles.astype(float).tolist()
    return f"""\
format = {FORMAT}
name = {_quote(template.name)}
version = {_quote(template.version)}
source = {_quote(template.source)}
licence = {_quote(template.licence or "unknown")}

[frame]  # unit and axes of meshes and of points in tables; x is to the subject's left
unit = "mm"
up = "y"
forward = "z"

[planes]  # there is no flesh behind and below
back = {template.back_z!r}
bottom = {template.bottom_y!r}

[condyles]  # centres of the mandible's
left = {left}
right = {right}
"""


def _quote(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)  # TOML knows no surrogate pairs


def _write_muscles(muscles: Iterable[Muscle], folder: Path) -> None:
    (folder / "muscles").mkdir()
    points = [f"{point}_{axis}" for point in ("origin", "insertion", "fibre") for axis in "xyz"]
    rows = []
    for muscle in muscles:
        file = f"muscles/{re.sub(r'[^A-Za-z0-9]+', '_', muscle.name)}.ply"
        write_ply(folder / file, muscle.surface)
        values, parts = muscle.axis[[1, 2, 0]].ravel().tolist(), muscle.compartments
        cut = (parts.cut, "; ".join(parts.names)) if parts else ("", "")
        rows.append((muscle.name, file, "yes" if muscle.ring else "no", *values, *cut))
    columns = ("name", "file", "ring", *points, "cut", "compartments")
    _write_table(folder / "muscles.csv", columns, rows)


def _write_shapes(
    template: Template, folder: Path, names: Iterable[str], deltas: np.ndarray
) -> None:
    folder.mkdir()
    for name, delta in zip(names, deltas, strict=True):
        if name != Path(name).name:
            raise file_fault(
                "template.value", f"the shape {name!r} has no name for a file", str(folder)
            )
        write_ply(folder / f"{name}.ply", template.skin.moved(template.skin.vertices + delta))


def _write_table(path: Path, columns: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(columns)
        writer.writerows(rows)


def _write_sets(path: Path, sets: dict[str, Ints]) -> None:
    lines = [
        f"  {json.dumps(name)}: {json.dumps(vertex_ranges(np.unique(vertices)))}"
        for name, vertices in sets.items()
    ]
    path.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
