"""Files of templates and captures: written, and read so that a fault names its file and line."""

from __future__ import annotations

import csv
import json
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import astuple, dataclass
from functools import partial
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Any
from zipfile import BadZipFile, ZipFile

import numpy as np

from solver.anatomy.skin_points import SkinPoints
from solver.anatomy.template import Muscle, Template
from solver.errors import InputError, file_error
from solver.kinds import NOT_READABLE
from solver.meshio.obj import write_obj
from solver.meshio.ply import write_ply
from solver.surface import Floats, Ints, Surface

FORMAT = 1  # of template.toml
DESCRIPTION = "template.toml"
# columns of points.csv: three vertices of the skin, and their weights
CORNERS = ("vertex_a", "vertex_b", "vertex_c")
WEIGHTS = ("weight_a", "weight_b", "weight_c")
_RANGE = re.compile(r"(\d+)-(\d+)")


class Row:
    """One line of a CSV table: its cells by column, and where it stands."""

    def __init__(self, file: str, line: int, cells: dict[str, str]) -> None:
        self.file = file
        self.line = line
        self._cells = cells

    def text(self, column: str, default: str = "") -> str:
        """Return a cell; ``default`` where it is empty."""
        return self._cells.get(column) or default

    def cell(self, column: str) -> str:
        """Return a cell that must not be empty."""
        text = self.text(column)
        if not text:
            raise self.fault(f"{column} is empty")
        return text

    def number(self, column: str) -> float:
        """Return a cell as a finite number."""
        try:
            value = float(self.cell(column))
        except ValueError:
            raise self.fault(f"{column} is no number: {self.text(column)!r}") from None
        if not np.isfinite(value):
            raise self.fault(f"{column} is not finite")
        return value

    def point(self, name: str) -> Floats | None:
        """Return the point (3,) in columns name_x, name_y, name_z; None if all are empty."""
        columns = [f"{name}_{axis}" for axis in "xyz"]
        if not any(self.text(column) for column in columns):
            return None
        return np.array([self.number(column) for column in columns])

    def flag(self, column: str) -> bool:
        """Return a cell of yes or no; empty is no."""
        text = self.text(column, "no").lower()
        if text not in ("yes", "no"):
            raise self.fault(f"{column} is neither yes nor no: {text!r}")
        return text == "yes"

    def fault(self, reason: str) -> InputError:
        """Return an error about this line."""
        return file_error("template.table", self.file, reason, line=self.line)


def read_table(path: Path, columns: Iterable[str]) -> list[Row]:
    """Return the rows of a CSV file that has at least ``columns``.

    Raises :class:`InputError`: ``template.missing`` if there is no such file, ``template.table``
    for one that is no such table.
    """
    reader = csv.DictReader(_read_text(path).splitlines())
    missing = set(columns) - set(reader.fieldnames or ())
    if missing:
        reason = f"lacks the columns {', '.join(sorted(missing))}"
        raise file_error("template.table", path.name, reason, line=1)
    rows = []
    for cells in reader:
        row = Row(path.name, reader.line_num, {k: (v or "").strip() for k, v in cells.items() if k})
        if None in cells:
            raise row.fault("has more cells than the first line")
        rows.append(row)
    return rows


def read_vertex_sets(path: Path, count: int) -> dict[str, Ints]:
    """Return name -> vertex numbers of a JSON object of lists of numbers and ranges "from-to".

    Raises :class:`InputError`: ``template.missing``, ``template.unreadable``, or
    ``template.vertex`` for what is no vertex of the ``count``.
    """
    sets = parse_file(path, json.loads)
    if not isinstance(sets, dict) or not all(isinstance(value, list) for value in sets.values()):
        raise file_fault("template.unreadable", f"{path.name} is no object of lists", path.name)
    return {name: _vertices(path.name, name, value, count) for name, value in sets.items()}


def vertex_ranges(vertices: Ints) -> list[int | str]:
    """Return ascending vertex numbers as a list that :func:`read_vertex_sets` reads."""
    starts = np.flatnonzero(np.diff(vertices, prepend=-2) != 1)
    ends = np.flatnonzero(np.diff(vertices, append=-2) != 1)
    return [
        int(vertices[start]) if start == end else f"{vertices[start]}-{vertices[end]}"
        for start, end in zip(starts, ends, strict=True)
    ]


def _vertices(file: str, name: str, items: list[Any], count: int) -> Ints:
    numbers: list[int] = []
    for item in items:
        found = _RANGE.fullmatch(item) if isinstance(item, str) else None
        if found:
            if int(found[1]) > int(found[2]) or int(found[1]) >= count:
                reason = f"the range {item} is not one of the {count} vertices"
                raise vertex_fault(file, name, reason)
            # the first that is too large is enough to tell, and a range may be very long
            numbers.extend(range(int(found[1]), min(int(found[2]), count) + 1))
        elif isinstance(item, int) and not isinstance(item, bool):
            numbers.append(item)
        else:
            raise vertex_fault(file, name, f"{item!r} is neither a vertex nor a range like '10-20'")
    bad = [number for number in numbers if not 0 <= number < count]
    if bad:
        raise vertex_fault(file, name, f"vertex {bad[0]} is none of the skin's {count}", bad[0])
    return np.unique(np.array(numbers, dtype=np.int64))


def vertex_fault(file: str, name: str, reason: str, vertex: int | None = None) -> InputError:
    """Return an error about a vertex number of an entry ``name``."""
    return file_fault("template.vertex", f"{file}, {name}: {reason}", file, vertex=vertex)


def file_fault(code: str, reason: str, file: object, **context: Any) -> InputError:
    """Return an error about a file."""
    return InputError(code, reason, file=str(file), **context)


def parse_file(path: Path, parse: Callable[[str], Any]) -> Any:
    """Return what a text file holds; raises ``template.missing`` or ``template.unreadable``."""
    text = _read_text(path)
    try:
        return parse(text)
    except (ValueError, RecursionError) as error:
        raise file_fault("template.unreadable", f"{path.name}: {error}", path.name) from error


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")  # spreadsheets begin CSV files with a mark
    except FileNotFoundError:
        reason = f"{path.parent.name} has no {path.name}"
        raise file_fault("template.missing", reason, path.name) from None
    except (OSError, UnicodeDecodeError) as error:
        raise file_fault("template.unreadable", f"{path.name}: {error}", path.name) from error


# Files of a public download, as it arrives: in a folder, in its subfolders, or in its ZIPs.


_broken_mesh = partial(file_error, "download.mesh")


@dataclass(frozen=True)
class PublicFile:
    """A file at ``path``, or the ``member`` of the ZIP archive there."""

    path: Path
    member: str | None = None

    @property
    def name(self) -> str:
        """The file's name without folders."""
        return self.path.name if self.member is None else PurePosixPath(self.member).name

    @property
    def folder(self) -> tuple[Path, PurePosixPath]:
        """The place of the file: equal for files of one folder."""
        if self.member is None:
            return self.path.parent, PurePosixPath()
        return self.path, PurePosixPath(self.member).parent

    def read(self) -> bytes:
        """Return the content; raises ``download.unreadable`` if file or archive is damaged."""
        try:
            if self.member is None:
                return self.path.read_bytes()
            with ZipFile(self.path) as archive:
                return archive.read(self.member)
        except NOT_READABLE as error:
            reason = f"{self} cannot be read: {error}"
            raise file_fault("download.unreadable", reason, self) from error

    def __str__(self) -> str:
        return str(self.path) if self.member is None else f"{self.path}: {self.member}"


def public_files(folder: Path, suffix: str) -> list[PublicFile]:
    """Return all files below ``folder`` with a ``suffix``: those in ZIP archives, then the others.

    Raises :class:`InputError` (``download.unreadable``) for an archive that is none.
    """
    packed = [
        PublicFile(archive, member)
        for archive in sorted(folder.rglob("*.zip"))
        for member in _members(archive)
        if member.endswith(suffix)
    ]
    loose = [PublicFile(path) for path in sorted(folder.rglob(f"*{suffix}"))]
    # macOS adds a file "._name" of its own to each in an archive.
    return [file for file in packed + loose if not file.name.startswith(".")]


def _members(archive: Path) -> list[str]:
    try:
        with ZipFile(archive) as opened:
            return opened.namelist()
    except (OSError, BadZipFile) as error:
        reason = f"{archive} is no ZIP archive: {error}"
        raise file_fault("download.unreadable", reason, archive) from error


def obj_mesh(file: PublicFile) -> tuple[Floats, Ints]:
    """Return vertices (n, 3) and polygons (f, 4) of a Wavefront OBJ of triangles and quads.

    The fourth column of a triangle is -1. Raises as :func:`obj_vertices`.
    """
    rows = file.read().splitlines()
    vertices = obj_vertices(file, rows)
    faces = [(line, row) for line, row in enumerate(rows, start=1) if row.startswith(b"f ")]
    polygons = [_corners(file, line, row, len(vertices)) for line, row in faces]
    return vertices, np.array(polygons, dtype=np.int64).reshape(-1, 4)


def obj_texture(file: PublicFile) -> tuple[Floats, Ints] | None:
    """Return texture coordinates (k, 2) and those of polygons' corners (f, 4), as :func:`obj_mesh`.

    None: not every corner has one.
    """
    rows = file.read().splitlines()
    try:
        places = [[float(word) for word in row.split()[1:3]] for row in rows if row[:3] == b"vt "]
        polygons = [
            [int(word.split(b"/")[1]) - 1 for word in row.split()[1:]]
            for row in rows
            if row[:2] == b"f "
        ]
    except (ValueError, IndexError):
        return None
    corners = np.array([[*polygon, -1][:4] for polygon in polygons], np.int64).reshape(-1, 4)
    found = np.array(places, np.float64).reshape(-1, 2)
    fits = len(found) and corners[:, :3].min() >= 0 and corners.max() < len(found)
    return (found, corners) if fits and np.isfinite(found).all() else None


def obj_vertices(file: PublicFile, rows: list[bytes] | None = None) -> Floats:
    """Return the vertices (n, 3) of a Wavefront OBJ, in its own unit and order.

    Raises :class:`InputError` (``download.mesh``) with ``file`` and ``line``.
    """
    rows = file.read().splitlines() if rows is None else rows
    vertices: list[tuple[float, float, float]] = []
    for line, row in enumerate(rows, start=1):
        if row.startswith(b"v "):
            try:
                x, y, z = map(float, row.split()[1:4])
            except ValueError:
                raise _broken_mesh(file, "not three numbers", line=line) from None
            if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
                raise _broken_mesh(file, f"vertex {len(vertices)} is not finite", line=line)
            vertices.append((x, y, z))
    if not vertices:
        raise _broken_mesh(file, "the file has no vertices", line=len(rows))
    return np.array(vertices)


def _corners(file: PublicFile, line: int, row: bytes, vertices: int) -> list[int]:
    try:
        corners = [int(word.partition(b"/")[0]) - 1 for word in row.split()[1:]]
    except ValueError:
        raise _broken_mesh(file, "a face holds what is not a vertex number", line=line) from None
    if len(corners) not in (3, 4):
        raise _broken_mesh(file, f"a face has {len(corners)} corners, not 3 or 4", line=line)
    if min(corners) < 0 or max(corners) >= vertices:
        raise _broken_mesh(file, f"a face uses a vertex that is none of the {vertices}", line=line)
    return corners if len(corners) == 4 else [*corners, -1]


@dataclass(frozen=True)
class CaptureSet:
    """Registered scans of one subject by name, in mm, all with the faces of ``neutral``."""

    neutral: Surface
    train: dict[str, Surface]  # expressions that the muscle geometry is fitted to
    test: dict[str, Surface]  # those that are solved for activations only

    def first(self, train: int, test: int) -> CaptureSet:
        """Return the neutral with the first expressions only."""
        first = islice(self.train.items(), train)
        others = islice(self.test.items(), test)
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
    if template.points is not None:
        _write_points(template.points, folder / "points.csv")
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
    taken: Counter[str] = Counter()
    for muscle in muscles:
        plain = re.sub(r"[^A-Za-z0-9]+", "_", muscle.name)
        taken[plain.lower()] += 1  # names that differ in what no file's name has
        number = "" if taken[plain.lower()] == 1 else f"-{taken[plain.lower()]}"
        file = f"muscles/{plain}{number}.ply"
        write_ply(folder / file, muscle.surface)
        values = muscle.axis[[1, 2, 0]].ravel().tolist()
        parts = muscle.compartments
        cut = parts.cells if parts else ("", "")
        rows.append((muscle.name, file, "yes" if muscle.ring else "no", *values, *cut))
    columns = ("name", "file", "ring", *points, "cut", "compartments")
    _write_table(folder / "muscles.csv", columns, rows)


def _write_points(points: SkinPoints, path: Path) -> None:
    arrays = points.names, points.corners, points.weights, points.spread_mm.tolist()
    rows = [
        (name, *corners.tolist(), *weights.tolist(), spread_mm)
        for name, corners, weights, spread_mm in zip(*arrays, strict=True)
    ]
    _write_table(path, ("point", *CORNERS, *WEIGHTS, "spread_mm"), rows)


def _write_shapes(
    template: Template, folder: Path, names: Iterable[str], deltas: np.ndarray
) -> None:
    folder.mkdir()
    for name, delta in zip(names, deltas, strict=True):
        if name != Path(name).name:
            raise file_fault(
                "template.value", f"the shape {name!r} has no name for a file", str(folder)
            )
        write_ply(
            folder / f"{name}.ply", template.skin.with_vertices(template.skin.vertices + delta)
        )


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
