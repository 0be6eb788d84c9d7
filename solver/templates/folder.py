"""Read a template from a folder of meshes and tables that a studio can write.

``template.toml`` says what it is and in which unit and axes; ``skin``, ``parted``, ``cranium``,
``mandible`` and ``muscles/*`` are meshes (OBJ or PLY); the rest are tables. A ZIP of the folder
will do as well. See docs/guide/templates.md.
"""

from __future__ import annotations

import tempfile
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import IO, Any
from zipfile import ZipFile

import numpy as np
from numpy.typing import NDArray

from solver.anatomy.muscle_weights import with_axis
from solver.anatomy.skin_points import SkinPoints
from solver.anatomy.template import Compartments, Depth, Muscle, ShapeBasis, Template, check_arrays
from solver.errors import InputError
from solver.kinds import NOT_READABLE, check_directory
from solver.meshio.raw import read_raw
from solver.registration.units import AXES, UNITS
from solver.surface import Floats, Surface
from solver.templates.tables import (
    CORNERS,
    DESCRIPTION,
    FORMAT,
    WEIGHTS,
    Row,
    file_fault,
    parse_file,
    read_table,
    read_vertex_sets,
    vertex_fault,
)

MAX_UNPACKED_BYTES = 2 * 2**30  # of a ZIP: no real template comes near
MAX_DESCRIPTION_BYTES = 32 * 2**10  # tomllib takes the square of a name's dots
SUFFIXES = (".ply", ".obj")
PARTS = ("flesh", "face", "with_cranium", "with_mandible")  # sets of skin vertices in parts.json
BONES = ("cranium", "mandible")


def read_template(path: Path) -> Template:
    """Return the template of a folder or of a ZIP of one.

    Raises :class:`InputError`: ``template.missing`` for a file that is not there,
    ``template.unreadable``, ``template.table`` (with ``line``), ``template.vertex`` (with
    ``vertex``), ``template.mesh``, ``template.frame`` or ``template.value`` for one that is wrong,
    and as :func:`check_arrays`.
    """
    if path.is_dir():
        return _TemplateFolder(path).template()
    with tempfile.TemporaryDirectory() as unpacked:
        try:
            with path.open("rb") as stream:
                check_directory(stream)
                _unpack(path.name, stream, unpacked)
        except NOT_READABLE as error:
            reason = f"{path.name} is neither a folder nor a ZIP: {error}"
            raise file_fault("template.unreadable", reason, path.name) from error
        inside = sorted(Path(unpacked).rglob(DESCRIPTION), key=lambda found: len(found.parts))
        return _TemplateFolder(inside[0].parent if inside else Path(unpacked)).template()


def _unpack(file: str, stream: IO[bytes], folder: str) -> None:
    with ZipFile(stream) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
        if size > MAX_UNPACKED_BYTES:
            reason = f"{file} unpacks to {size} bytes; at most {MAX_UNPACKED_BYTES} can be"
            limits = {"expected": MAX_UNPACKED_BYTES, "found": size}
            raise file_fault("template.too_large", reason, file, **limits)
        archive.extractall(folder)


class _TemplateFolder:
    """A folder with its description, the ``matrix`` (3, 3) of its frame, and the skin in mm."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        _refuse_long(folder / DESCRIPTION)
        self.description: dict[str, Any] = parse_file(folder / DESCRIPTION, tomllib.loads)
        if self.description.get("format") != FORMAT:
            raise _value_fault(f"format is {self.description.get('format')}, not {FORMAT}")
        self.matrix = self._matrix()
        self.skin = self.mesh("skin")

    def template(self) -> Template:
        """Return the whole template."""
        folder = self.folder
        skin = self.skin
        count = len(self.skin.vertices)
        parts = read_vertex_sets(folder / "parts.json", count)
        absent = [name for name in PARTS if name not in parts]
        if absent:
            reason = f"parts.json lacks {', '.join(absent)}"
            raise file_fault("template.value", reason, "parts.json")
        cranium, mandible = (self.mesh(name) for name in BONES)
        shapes = self.shapes()
        mm = float(np.linalg.norm(self.matrix[0]))  # the unit
        template = Template(
            name=self.text("name"),
            version=self.text("version"),
            source=self.text("source"),
            licence=self.text("licence"),
            skin=skin,
            flesh_faces=np.flatnonzero(np.isin(skin.faces, parts["flesh"]).all(axis=1)),
            face_vertices=parts["face"],
            attached_cranium=parts["with_cranium"],
            attached_mandible=parts["with_mandible"],
            parting=self.parting(shapes),
            cranium=cranium,
            mandible=mandible,
            muscles=self.muscles(np.vstack([cranium.vertices, mandible.vertices])),
            condyles=self.to_mm(np.stack([self.point("condyles", s) for s in ("left", "right")])),
            back_z=mm * self.number("planes", "back"),
            bottom_y=mm * self.number("planes", "bottom"),
            landmarks=self.landmarks(),
            regions=read_vertex_sets(folder / "regions.json", count),
            shapes=shapes,
            depths=self.depths(),
            points=self.points(),
        )
        check_arrays(template, folder.name)
        return template

    def _matrix(self) -> Floats:
        """Return what turns points of the folder into mm, x to the left, y up, z forward."""
        given = self.description.get("frame", {})
        if not isinstance(given, dict):
            raise _value_fault("frame is no table")
        usual = {"unit": "mm", "up": "y", "forward": "z"}
        unit, up, forward = (str(given.get(key, value)) for key, value in usual.items())
        if unit not in UNITS or up not in AXES or forward not in AXES:
            raise _frame_fault(f"unit is one of {', '.join(UNITS)}, axes are x, -x ... -z")
        left = np.cross(AXES[up], AXES[forward])
        if not left.any():
            raise _frame_fault(f"up ({up}) and forward ({forward}) are along one axis")
        return np.asarray(UNITS[unit] * np.stack([left, AXES[up], AXES[forward]]))

    def to_mm(self, points: Floats) -> Floats:
        """Return points (..., 3) in the product's frame."""
        return np.asarray(points @ self.matrix.T)

    def mesh(self, name: str, file: Path | None = None) -> Surface:
        """Return the mesh ``name`` with any known suffix, or that of ``file``."""
        files = [file] if file else [self.folder / f"{name}{suffix}" for suffix in SUFFIXES]
        path = next((each for each in files if each.is_file()), None)
        if path is None:
            shown = " or ".join(each.name for each in files)
            raise file_fault("template.missing", f"{self.folder.name} has no {shown}", shown)
        scan = read_raw(path)
        wrong = np.flatnonzero(~np.isfinite(scan.vertices).all(axis=1))
        if len(wrong):
            reason = f"{path.name}: vertex {wrong[0]} is not finite"
            raise file_fault("template.mesh", reason, path.name, vertex=int(wrong[0]))
        if len(scan.faces) == 0:
            raise file_fault("template.mesh", f"{path.name} has no faces", path.name)
        return Surface(self.to_mm(scan.vertices), scan.faces)

    def displacement(self, path: Path) -> Floats:
        """Return the displacement (n, 3) to a mesh that must have the skin's vertices."""
        vertices = self.mesh(path.stem, path).vertices
        rest = self.skin.vertices
        if len(vertices) != len(rest):
            reason = f"{path.name} has {len(vertices)} vertices, the skin has {len(rest)}"
            counts = {"expected": len(rest), "found": len(vertices)}
            raise file_fault("template.mesh", reason, path.name, **counts)
        return vertices - rest

    def muscles(self, skull: Floats) -> tuple[Muscle, ...]:
        """Return the muscles with the attachments of their rows, or else of their shapes."""
        muscles: dict[str, Muscle] = {}
        for row in read_table(self.folder / "muscles.csv", ("name", "file")):
            name = row.cell("name")
            if name in muscles:
                raise row.fault(f"there is another muscle {name}")
            file = self.folder / row.cell("file")
            if not file.resolve().is_relative_to(self.folder.resolve()):
                raise row.fault(f"file lies outside the folder: {row.text('file')!r}")
            muscles[name] = self.muscle(row, name, self.mesh(name, file), skull)
        if not muscles:
            raise _value_fault("there is no muscle", "muscles.csv")
        return tuple(muscles.values())

    def muscle(self, row: Row, name: str, surface: Surface, skull: Floats) -> Muscle:
        """Return one muscle; without any point in its row it gets an axis by its shape."""
        ring = row.flag("ring")
        try:
            parts = Compartments.read(row.text("cut"), row.text("compartments"))
        except ValueError as error:
            raise row.fault(str(error)) from None
        origin, insertion, fibre = (row.point(each) for each in ("origin", "insertion", "fibre"))
        if origin is None and insertion is None and fibre is None:
            return replace(with_axis(name, surface, skull), ring=ring, compartments=parts)
        if origin is None or insertion is None:
            raise row.fault("origin and insertion are given together, or neither")
        axis = self.to_mm(insertion - origin if fibre is None else fibre)
        length = np.linalg.norm(axis)
        if length == 0:
            raise row.fault("the fibre axis has no length")
        ends = self.to_mm(origin), self.to_mm(insertion)
        return Muscle(name, surface, axis / length, *ends, ring, parts)

    def landmarks(self) -> dict[str, int]:
        """Return name -> skin vertex."""
        landmarks: dict[str, int] = {}
        for row in read_table(self.folder / "landmarks.csv", ("name", "vertex")):
            name = row.cell("name")
            text = row.cell("vertex")
            if name in landmarks:
                raise row.fault(f"there is another landmark {name}")
            landmarks[name] = self._vertex(row, name, text)
        return landmarks

    def points(self) -> SkinPoints | None:
        """Return the points that a detector marks in pictures; a template may come without any."""
        path = self.folder / "points.csv"
        if not path.exists():
            return None
        rows = read_table(path, ("point", *CORNERS, *WEIGHTS, "spread_mm"))
        names = tuple(row.cell("point") for row in rows)
        corners = [
            [self._vertex(row, name, row.cell(corner)) for corner in CORNERS]
            for row, name in zip(rows, names, strict=True)
        ]
        weights = [[row.number(weight) for weight in WEIGHTS] for row in rows]
        return SkinPoints(
            np.array(corners, dtype=np.int64).reshape(-1, 3),
            np.array(weights).reshape(-1, 3),
            names,
            np.array([row.number("spread_mm") for row in rows]),
        )

    def _vertex(self, row: Row, name: str, text: str) -> int:
        """Return the number of a vertex of the skin, of an entry ``name``."""
        count = len(self.skin.vertices)
        if not text.isdecimal():
            raise row.fault(f"vertex is no number: {text!r}")
        if int(text) >= count:
            reason = f"vertex {text} is none of the skin's {count}"
            raise vertex_fault(row.file, name, reason, int(text))
        return int(text)

    def depths(self) -> tuple[Depth, ...]:
        """Return the depths in mm, whatever the folder's unit; a template may come without any."""
        path = self.folder / "depths.csv"
        depths = []
        if not path.exists():
            return ()
        for row in read_table(path, ("landmark", "bone", "depth_mm", "source")):
            if row.cell("bone") not in BONES:
                raise row.fault(f"bone is neither of {' and '.join(BONES)}: {row.text('bone')!r}")
            deviation = row.number("sd_mm") if row.text("sd_mm") else None
            landmark = row.cell("landmark")
            mean = row.number("depth_mm")
            depths.append(Depth(landmark, row.text("bone"), mean, deviation, row.cell("source")))
        return tuple(depths)

    def shapes(self) -> ShapeBasis | None:
        """Return how the skin varies, from whole meshes in ``expressions`` and ``identities``."""
        names, expressions = self._deltas("expressions")
        _, identities = self._deltas("identities")
        if not len(expressions) and not len(identities):
            return None
        return ShapeBasis(identities, expressions, names)

    def _deltas(self, name: str) -> tuple[tuple[str, ...], NDArray[np.float32]]:
        files = sorted(path for path in (self.folder / name).glob("*") if path.suffix in SUFFIXES)
        deltas = np.empty((len(files), *self.skin.vertices.shape), dtype=np.float32)
        for delta, path in zip(deltas, files, strict=True):
            delta[:] = self.displacement(path)
        return tuple(path.stem for path in files), deltas

    def parting(self, shapes: ShapeBasis | None) -> Floats:
        """Return the displacement (n, 3) that parts the lips, of a mesh or weighted expressions."""
        for suffix in SUFFIXES:
            if (path := self.folder / f"parted{suffix}").is_file():
                return self.displacement(path)
        weights = self.description.get("parting")
        if "parting" not in self.description:
            reason = f"has neither parted.ply nor parted.obj, and {DESCRIPTION} no [parting]"
            raise file_fault("template.missing", f"{self.folder.name} {reason}", "parted.ply")
        if not isinstance(weights, dict):
            raise _value_fault("parting is no table")
        parting = np.zeros_like(self.skin.vertices)
        for name in weights:
            if shapes is None or name not in shapes.expression_names:
                raise _value_fault(f"[parting] names the expression {name}, which is not there")
            shape = shapes.expressions[shapes.expression_names.index(name)]
            parting += self.number("parting", name) * shape
        return parting

    def text(self, key: str) -> str:
        """Return a text of the description."""
        value = self.description.get(key)
        if not isinstance(value, str) or not value.strip():
            raise _value_fault(f"{key} is missing or empty")
        return value

    def number(self, table: str, key: str) -> float:
        """Return a number of one of the description's tables."""
        value = self._value(table, key)
        if not _is_number(value):
            raise _value_fault(f"[{table}] {key} is no number")
        return float(value)

    def point(self, table: str, key: str) -> Floats:
        """Return a point (3,) of one of the description's tables."""
        value = self._value(table, key)
        if not isinstance(value, list) or len(value) != 3:
            raise _value_fault(f"[{table}] {key} is no list of three numbers")
        if not all(map(_is_number, value)):
            raise _value_fault(f"[{table}] {key} is no number")
        return np.array(value, dtype=float)

    def _value(self, table: str, key: str) -> Any:
        values = self.description.get(table)
        return values.get(key) if isinstance(values, dict) else None


def _refuse_long(path: Path) -> None:
    size = path.stat().st_size if path.is_file() else 0
    if size > MAX_DESCRIPTION_BYTES:
        reason = f"{path.name} has {size} bytes; at most {MAX_DESCRIPTION_BYTES} can be read"
        limits = {"expected": MAX_DESCRIPTION_BYTES, "found": size}
        raise file_fault("template.too_large", reason, path.name, **limits)


def _is_number(value: Any) -> bool:
    whole_or_float = isinstance(value, int | float) and not isinstance(value, bool)
    return whole_or_float and bool(np.isfinite(value))


def _value_fault(reason: str, file: str = DESCRIPTION) -> InputError:
    return file_fault("template.value", f"{file}: {reason}", file)


def _frame_fault(reason: str) -> InputError:
    return file_fault("template.frame", f"{DESCRIPTION}: {reason}", DESCRIPTION)
