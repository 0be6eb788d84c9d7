"""Read a template from a folder of meshes and tables that a studio can write.

``template.toml`` says what it is and in which unit and axes; ``skin``, ``parted``, ``cranium``,
``mandible`` and ``muscles/*`` are meshes (OBJ or PLY); the rest are tables. A ZIP of the folder
will do as well. See docs/guide/templates.md.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any
from zipfile import ZipFile

import numpy as np
from numpy.typing import NDArray

from solver.anatomy.muscle_weights import with_axis
from solver.anatomy.template import Depth, Muscle, ShapeBasis, Template, check_arrays
from solver.errors import InputError
from solver.meshio.raw import read_raw
from solver.registration.units import AXES, UNITS
from solver.storage import NOT_READABLE, check_directory
from solver.surface import Floats, Surface
from solver.templates.tables import Row, read_table, read_toml, read_vertex_sets, vertex_fault

FORMAT = 1  # of template.toml
DESCRIPTION = "template.toml"
MAX_UNPACKED_BYTES = 2 * 2**30  # of a ZIP: no real template comes near
SUFFIXES = (".ply", ".obj")
PARTS = ("flesh", "face", "with_cranium", "with_mandible")  # sets of skin vertices in parts.json
BONES = ("cranium", "mandible")


@dataclass(frozen=True)
class FolderFrame:
    """Unit and axes of a folder: ``matrix`` (3, 3) turns its points into the product's, in mm."""

    matrix: Floats

    @classmethod
    def of_axes(cls, unit: str, up: str, forward: str) -> FolderFrame:
        """Return the frame of a unit and two axes such as ``z`` and ``-y``.

        Raises :class:`InputError` (``template.frame``).
        """
        if unit not in UNITS or up not in AXES or forward not in AXES:
            raise _frame_fault(f"unit is one of {', '.join(UNITS)}, axes are x, -x ... -z")
        left = np.cross(AXES[up], AXES[forward])
        if not left.any():
            raise _frame_fault(f"up ({up}) and forward ({forward}) are along one axis")
        return cls(UNITS[unit] * np.stack([left, AXES[up], AXES[forward]]))

    def __call__(self, points: Floats) -> Floats:
        """Return points (..., 3) in mm, x to the subject's left, y up, z forward."""
        return points @ self.matrix.T

    @property
    def mm(self) -> float:
        """The unit in mm."""
        return float(np.linalg.norm(self.matrix[0]))


def read_template(path: Path) -> Template:
    """Return the template of a folder or of a ZIP of one.

    Raises
    ------
    InputError
        ``template.missing`` for a file that is not there, ``template.unreadable``,
        ``template.table`` (with ``line``), ``template.vertex`` (with ``vertex``),
        ``template.mesh``, ``template.frame`` or ``template.value`` for one that is wrong, and the
        codes of :func:`solver.anatomy.template.check_arrays`.
    """
    if path.is_dir():
        return _read(path)
    with tempfile.TemporaryDirectory() as unpacked:
        try:
            with path.open("rb") as stream:
                check_directory(stream)
                _unpack(path.name, stream, unpacked)
        except NOT_READABLE as error:
            raise InputError(
                "template.unreadable",
                f"{path.name} is neither a folder nor a ZIP: {error}",
                file=path.name,
            ) from error
        inside = sorted(Path(unpacked).rglob(DESCRIPTION), key=lambda found: len(found.parts))
        return _read(inside[0].parent if inside else Path(unpacked))


def _unpack(file: str, stream: IO[bytes], folder: str) -> None:
    with ZipFile(stream) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
        if size > MAX_UNPACKED_BYTES:
            raise InputError(
                "template.too_large",
                f"{file} unpacks to {size} bytes; at most {MAX_UNPACKED_BYTES} can be",
                file=file,
                expected=MAX_UNPACKED_BYTES,
                found=size,
            )
        archive.extractall(folder)


def _read(folder: Path) -> Template:
    description = read_toml(folder / DESCRIPTION)
    if description.get("format") != FORMAT:
        raise _value_fault(f"format is {description.get('format')}, not {FORMAT}")
    frame = _frame(description)
    skin = _mesh(folder, "skin", frame)
    count = len(skin.vertices)
    parts = read_vertex_sets(folder / "parts.json", count)
    absent = [name for name in PARTS if name not in parts]
    if absent:
        raise InputError(
            "template.value", f"parts.json lacks {', '.join(absent)}", file="parts.json"
        )
    bones = {name: _mesh(folder, name, frame) for name in BONES}
    shapes = _shapes(folder, frame, skin)
    template = Template(
        name=_text(description, "name"),
        version=_text(description, "version"),
        source=_text(description, "source"),
        licence=_text(description, "licence"),
        skin=skin,
        flesh_faces=np.flatnonzero(np.isin(skin.faces, parts["flesh"]).all(axis=1)),
        face_vertices=parts["face"],
        attached_cranium=parts["with_cranium"],
        attached_mandible=parts["with_mandible"],
        parting=_parting(folder, description, frame, skin, shapes),
        cranium=bones["cranium"],
        mandible=bones["mandible"],
        muscles=_muscles(folder, frame, np.vstack([bones[name].vertices for name in BONES])),
        condyles=frame(np.stack([_point(description, "condyles", s) for s in ("left", "right")])),
        back_z=frame.mm * _number(description, "planes", "back"),
        bottom_y=frame.mm * _number(description, "planes", "bottom"),
        landmarks=_landmarks(folder, count),
        regions=read_vertex_sets(folder / "regions.json", count),
        shapes=shapes,
        depths=_depths(folder),
    )
    check_arrays(template, folder.name)
    return template


def _frame(description: dict[str, Any]) -> FolderFrame:
    given = description.get("frame", {})
    if not isinstance(given, dict):
        raise _value_fault("frame is no table")
    return FolderFrame.of_axes(
        str(given.get("unit", "mm")), str(given.get("up", "y")), str(given.get("forward", "z"))
    )


def _mesh(folder: Path, name: str, frame: FolderFrame, file: Path | None = None) -> Surface:
    """Return the mesh ``name`` with any known suffix, or that of ``file``."""
    path = file or next(
        (found for suffix in SUFFIXES if (found := folder / f"{name}{suffix}").is_file()), None
    )
    if path is None or not path.is_file():
        shown = path.name if path else f"{name}.ply or {name}.obj"
        raise InputError("template.missing", f"{folder.name} has no {shown}", file=shown)
    scan = read_raw(path)
    wrong = np.flatnonzero(~np.isfinite(scan.vertices).all(axis=1))
    if len(wrong):
        raise InputError(
            "template.mesh",
            f"{path.name}: vertex {wrong[0]} is not finite",
            file=path.name,
            vertex=int(wrong[0]),
        )
    if len(scan.faces) == 0:
        raise InputError("template.mesh", f"{path.name} has no faces", file=path.name)
    return Surface(frame(scan.vertices), scan.faces)


def _muscles(folder: Path, frame: FolderFrame, skull: Floats) -> tuple[Muscle, ...]:
    rows = read_table(folder / "muscles.csv", ("name", "file"))
    muscles: dict[str, Muscle] = {}
    for row in rows:
        name = row.cell("name")
        if name in muscles:
            raise row.fault(f"there is another muscle {name}")
        file = folder / row.cell("file")
        if not file.resolve().is_relative_to(folder.resolve()):
            raise row.fault(f"file lies outside the folder: {row.text('file')!r}")
        surface = _mesh(folder, name, frame, file)
        muscles[name] = _muscle(row, name, surface, frame, skull)
    if not muscles:
        raise _value_fault("there is no muscle", "muscles.csv")
    return tuple(muscles.values())


def _muscle(row: Row, name: str, surface: Surface, frame: FolderFrame, skull: Floats) -> Muscle:
    """Return a muscle with the attachments and fibre axis of its row, or else of its shape."""
    ring = row.flag("ring")
    origin, insertion, fibre = (row.point(each) for each in ("origin", "insertion", "fibre"))
    if origin is None and insertion is None and fibre is None:
        return replace(with_axis(name, surface, skull), ring=ring)
    if origin is None or insertion is None:
        raise row.fault("origin and insertion are given together, or neither")
    axis = frame(insertion - origin if fibre is None else fibre)
    length = np.linalg.norm(axis)
    if length == 0:
        raise row.fault("the fibre axis has no length")
    return Muscle(name, surface, axis / length, frame(origin), frame(insertion), ring)


def _landmarks(folder: Path, count: int) -> dict[str, int]:
    landmarks: dict[str, int] = {}
    for row in read_table(folder / "landmarks.csv", ("name", "vertex")):
        name, text = row.cell("name"), row.cell("vertex")
        if name in landmarks:
            raise row.fault(f"there is another landmark {name}")
        if not text.isdecimal():
            raise row.fault(f"vertex is no number: {text!r}")
        if int(text) >= count:
            reason = f"vertex {text} is none of the skin's {count}"
            raise vertex_fault(row.file, name, reason, int(text))
        landmarks[name] = int(text)
    return landmarks


def _depths(folder: Path) -> tuple[Depth, ...]:
    """Return the depths in mm, whatever the folder's unit; a template may come without any."""
    path = folder / "depths.csv"
    if not path.exists():
        return ()
    depths = []
    for row in read_table(path, ("landmark", "bone", "depth_mm", "source")):
        if row.cell("bone") not in BONES:
            raise row.fault(f"bone is neither of {' and '.join(BONES)}: {row.text('bone')!r}")
        deviation = row.number("sd_mm") if row.text("sd_mm") else None
        depths.append(
            Depth(
                row.cell("landmark"),
                row.text("bone"),
                row.number("depth_mm"),
                deviation,
                row.cell("source"),
            )
        )
    return tuple(depths)


def _shapes(folder: Path, frame: FolderFrame, skin: Surface) -> ShapeBasis | None:
    """Return how the skin varies, from whole meshes in ``expressions`` and ``identities``."""
    names, expressions = _deltas(folder / "expressions", frame, skin)
    _, identities = _deltas(folder / "identities", frame, skin)
    if not len(expressions) and not len(identities):
        return None
    return ShapeBasis(identities, expressions, names)


def _deltas(
    folder: Path, frame: FolderFrame, skin: Surface
) -> tuple[tuple[str, ...], NDArray[np.float32]]:
    files = sorted(path for path in folder.glob("*") if path.suffix in SUFFIXES)
    deltas = np.empty((len(files), *skin.vertices.shape), dtype=np.float32)
    for delta, path in zip(deltas, files, strict=True):
        delta[:] = _in_topology(path, frame, skin) - skin.vertices
    return tuple(path.stem for path in files), deltas


def _in_topology(path: Path, frame: FolderFrame, skin: Surface) -> Floats:
    """Return the vertices (n, 3) of a mesh that must have the skin's."""
    vertices = _mesh(path.parent, path.stem, frame, path).vertices
    if len(vertices) != len(skin.vertices):
        raise InputError(
            "template.mesh",
            f"{path.name} has {len(vertices)} vertices, the skin has {len(skin.vertices)}",
            file=path.name,
            expected=len(skin.vertices),
            found=len(vertices),
        )
    return vertices


def _parting(
    folder: Path,
    description: dict[str, Any],
    frame: FolderFrame,
    skin: Surface,
    shapes: ShapeBasis | None,
) -> Floats:
    """Return the displacement (n, 3) that parts the lips, of a mesh or of weighted expressions."""
    for suffix in SUFFIXES:
        if (path := folder / f"parted{suffix}").is_file():
            return _in_topology(path, frame, skin) - skin.vertices
    if "parting" not in description:
        raise InputError(
            "template.missing",
            f"{folder.name} has neither parted.ply nor parted.obj, and {DESCRIPTION} no [parting]",
            file="parted.ply",
        )
    if not isinstance(description["parting"], dict):
        raise _value_fault("parting is no table")
    parting = np.zeros_like(skin.vertices)
    known = () if shapes is None else shapes.expression_names
    for name in description["parting"]:
        if shapes is None or name not in known:
            raise _value_fault(f"[parting] names the expression {name}, which is not there")
        weight = _number(description, "parting", name)
        parting += weight * shapes.expressions[known.index(name)]
    return parting


def _text(description: dict[str, Any], key: str) -> str:
    value = description.get(key)
    if not isinstance(value, str) or not value.strip():
        raise _value_fault(f"{key} is missing or empty")
    return value


def _number(description: dict[str, Any], table: str, key: str) -> float:
    values = description.get(table)
    value = values.get(key) if isinstance(values, dict) else None
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise _value_fault(f"[{table}] {key} is no number")
    return float(value)


def _point(description: dict[str, Any], table: str, key: str) -> Floats:
    values = description.get(table)
    value = values.get(key) if isinstance(values, dict) else None
    if not isinstance(value, list) or len(value) != 3:
        raise _value_fault(f"[{table}] {key} is no list of three numbers")
    return np.array([_number({table: {key: each}}, table, key) for each in value])


def _value_fault(reason: str, file: str = DESCRIPTION) -> InputError:
    return InputError("template.value", f"{file}: {reason}", file=file)


def _frame_fault(reason: str) -> InputError:
    return InputError("template.frame", f"{DESCRIPTION}: {reason}", file=DESCRIPTION)
