"""PLY, ascii and binary: vertices with normals, colours and confidence, and polygons."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from solver.errors import InputError, quote
from solver.meshio.mesh import (
    Mesh,
    check_finite,
    count_up,
    empty_error,
    fan,
    find_bad_row,
    parse_count,
    parse_rows,
    truncated_error,
    unit_colours,
    unreadable_error,
    unsupported_error,
)
from solver.surface import Floats, Ints, Surface

TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
PLACE = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")
COLOUR = ("red", "green", "blue")
CONFIDENCE = "confidence"
INDEX_NAMES = ("vertex_indices", "vertex_index")

MAX_HEADER_LINES = 1000  # so that a binary file without end_header is not searched to its end

Columns = dict[str, Floats]
# all items one after the other, whole numbers where the header says so, and how many each row has
Lists = tuple[np.ndarray, Ints]
Rows = tuple[Columns, dict[str, Lists]]


@dataclass
class PlyElement:
    """One element of the header, with NumPy's codes of types."""

    name: str
    count: int  # of its rows
    # names and types; of a list the type of its length, the least it takes in a row
    properties: list[tuple[str, str]] = field(default_factory=list)
    items: dict[str, str] = field(default_factory=dict)  # list -> type of its items

    def item_type(self, name: str) -> type:
        """Return the type that the items of a list are read to."""
        return np.float64 if self.items[name].startswith("f") else np.int64

    def row_type(self, order: str, lengths: Mapping[str, int] | None = None) -> np.dtype:
        """Return the type of a binary row whose lists have these ``lengths``, none by default."""
        fields: list[tuple[Any, ...]] = []
        for name, code in self.properties:
            if lengths and name in lengths:
                fields.append((_length(name), order + code))
                fields.append((name, order + self.items[name], (lengths[name],)))
            else:
                fields.append((name, order + code))
        return np.dtype(fields)


def _length(name: str) -> str:
    return f"number of {name}"


def read_ply(file: str, content: bytes, *, strict: bool = False) -> Mesh:
    """Return the mesh of PLY ``content``; without faces it is a point cloud.

    For registered scans (``strict``) the vertices must be the first element, without lists, and
    nothing else is read; in text they must be finite. Otherwise blank lines of text do not count.

    Raises :class:`InputError`: ``scan.empty``, ``scan.unreadable``, ``scan.truncated``,
    ``scan.format`` or ``scan.nan``, with the ``line`` of the fault in text; ``file`` names it.
    """
    elements, body = _open_body(file, content, strict)
    if strict and (not elements or elements[0].name != "vertex" or elements[0].items):
        reason = "the first element must be 'vertex', without list properties"
        raise unsupported_error(file, reason)
    vertex: Columns = {}
    polygons: Lists = (np.zeros(0, np.int64), np.zeros(0, np.int64))
    for element in elements[:1] if strict else elements:
        if element.name == "tristrips":
            raise unsupported_error(file, "triangle strips are not supported: export triangles")
        scalars, lists = body.read(element)
        if element.name == "vertex":
            vertex = scalars
        elif element.name == "face" and element.count:
            polygons = corner_lists(file, lists)
    vertices, normals, colours = (_columns(vertex, names) for names in (PLACE, NORMAL, COLOUR))
    if vertices is None:
        raise unreadable_error(file, "the vertices have no x, y and z")
    if not len(vertices):
        raise empty_error(file)
    confidence = vertex.get(CONFIDENCE)
    if strict and isinstance(body, _AsciiBody):
        known = [vertices] if confidence is None else [vertices, confidence[:, None]]
        check_finite(file, np.hstack(known), body.line)
    colours = None if colours is None else unit_colours(colours)
    faces = _triangles(file, polygons, len(vertices))
    return Mesh(vertices, faces, normals, colours, confidence)


def read_rows(file: str, content: bytes) -> dict[str, Rows]:
    """Return all that a PLY holds, by its elements; raises as :func:`read_ply`."""
    elements, body = _open_body(file, content)
    return {element.name: body.read(element) for element in elements}


def corner_lists(file: str, lists: Mapping[str, Lists]) -> Lists:
    """Return the corners of faces; raises :class:`InputError` if they have none."""
    index = next((name for name in INDEX_NAMES if name in lists), None)
    if index is None:
        raise unreadable_error(file, "the faces have no vertex_indices")
    return lists[index]


def _open_body(
    file: str, content: bytes, strict: bool = False
) -> tuple[list[PlyElement], _AsciiBody | _BinaryBody]:
    """Return the elements of a file, and what reads their rows one after the other."""
    form, elements, start = read_header(file, content)
    source = file, content, elements, start
    if form == "ascii":
        return elements, _AsciiBody(*source, strict)
    return elements, _BinaryBody(*source, BYTE_ORDERS[form])


def read_header(file: str, content: bytes) -> tuple[str, list[PlyElement], int]:
    """Return the format, the elements, and the byte at which the body starts."""
    form = ""
    elements: list[PlyElement] = []
    position = 0
    for line in range(1, MAX_HEADER_LINES):
        end = content.find(b"\n", position)
        if end < 0:
            raise truncated_error(file, "the header has no 'end_header'")
        words = content[position:end].decode("ascii", "replace").split()
        position = end + 1
        if line == 1:
            if words != ["ply"]:
                raise unreadable_error(file, "not a PLY file: the first line is not 'ply'", line=1)
        elif words == ["end_header"]:
            if not form:
                raise unreadable_error(file, "the header names no format", line=line)
            return form, elements, position
        elif words[:1] in ([], ["comment"], ["obj_info"]):
            continue
        elif words[0] == "format" and len(words) == 3 and words[1] in BYTE_ORDERS:
            form = words[1]
        elif words[0] == "element" and len(words) == 3 and parse_count(words[2]) is not None:
            elements.append(PlyElement(words[1], int(words[2])))
        elif words[0] == "property" and elements:
            _add_property(file, line, elements[-1], words[1:])
        else:
            reason = f"not a header line: '{quote(' '.join(words))}'"
            raise unreadable_error(file, reason, line=line)
    raise unreadable_error(file, f"the header is longer than {MAX_HEADER_LINES} lines")


def _add_property(file: str, line: int, element: PlyElement, words: list[str]) -> None:
    is_list = words[:1] == ["list"]
    types = words[int(is_list) : -1]
    name = words[-1] if words else ""
    if len(types) != (2 if is_list else 1) or any(word not in TYPES for word in types):
        raise unreadable_error(file, "not a property this format knows", line=line)
    if is_list and TYPES[types[0]].startswith("f"):
        raise unreadable_error(file, "the length of a list must be a whole number", line=line)
    if any(name == other for other, _ in element.properties):
        raise unreadable_error(file, f"property '{quote(name)}' appears twice", line=line)
    if is_list:
        element.items[name] = TYPES[types[1]]
    element.properties.append((name, TYPES[types[0]]))


class _BinaryBody:
    """Reads one element after the other from a binary body."""

    def __init__(
        self, file: str, content: bytes, elements: list[PlyElement], start: int, order: str
    ) -> None:
        self._file = file
        self._content = content
        self._position = start
        self._order = order
        expected = sum(element.count * element.row_type(order).itemsize for element in elements)
        found = len(content) - start
        if found < expected:
            reason = f"the header announces at least {expected} bytes, {found} follow"
            raise truncated_error(file, reason, expected=expected, found=found)

    def read(self, element: PlyElement) -> Rows:
        """Return the columns and lists of an element."""
        lengths = self._list_lengths(element) if element.count else {}
        row = element.row_type(self._order, lengths)
        end = self._position + row.itemsize * element.count
        if end > len(self._content):
            return self._read_uneven(element)
        rows = np.frombuffer(self._content, row, count=element.count, offset=self._position)
        if any((rows[_length(name)] != count).any() for name, count in lengths.items()):
            return self._read_uneven(element)
        self._position = end
        scalars = [name for name, _ in element.properties if name not in element.items]
        return {name: rows[name].astype(np.float64) for name in scalars}, {
            name: (
                rows[name].astype(element.item_type(name)).ravel(),
                np.full(len(rows), count, np.int64),
            )
            for name, count in lengths.items()
        }

    def _read_uneven(self, element: PlyElement) -> Rows:
        """Return the columns and lists of rows that differ in length."""
        lists: dict[str, tuple[list[np.ndarray], list[int]]] = {
            name: ([], []) for name in element.items
        }
        columns: dict[str, list[float]] = {
            name: [] for name, _ in element.properties if name not in element.items
        }
        for number in range(element.count):
            lengths = self._list_lengths(element)
            row = element.row_type(self._order, lengths)
            if self._position + row.itemsize > len(self._content):
                count = element.count
                what = quote(element.name)
                reason = f"{count} rows of '{what}' announced, {number} follow"
                raise truncated_error(self._file, reason, expected=count, found=number)
            values = np.frombuffer(self._content, row, count=1, offset=self._position)[0]
            self._position += row.itemsize
            for name, count in lengths.items():
                lists[name][0].append(values[name].astype(element.item_type(name)))
                lists[name][1].append(count)
            for name, column in columns.items():
                column.append(float(values[name]))
        return {name: np.array(column) for name, column in columns.items()}, {
            name: (np.concatenate(items), np.array(counts, np.int64))
            for name, (items, counts) in lists.items()
        }

    def _list_lengths(self, element: PlyElement) -> dict[str, int]:
        """Return how many items each list of the next row has (0 behind the end).

        A list longer than the file counts with just more items than fit in the file.
        """
        position = self._position
        lengths: dict[str, int] = {}
        for name, code in element.properties:
            kind = np.dtype(self._order + code)
            if name in element.items:
                value = self._content[position : position + kind.itemsize]
                whole = len(value) == kind.itemsize
                announced = max(int(np.frombuffer(value, kind)[0]), 0) if whole else 0
                size = np.dtype(element.items[name]).itemsize
                lengths[name] = min(announced, len(self._content) // size + 1)
                position += lengths[name] * size
            position += kind.itemsize
        return lengths


class _AsciiBody:
    """Reads one element after the other from a body of text, a row a line."""

    def __init__(
        self, file: str, content: bytes, elements: list[PlyElement], start: int, strict: bool
    ) -> None:
        self._file = file
        self._content = content
        self._start = start
        self._every = content[start:].removesuffix(b"\n").split(b"\n")
        self._rows = self._every if strict else [row for row in self._every if row.strip()]
        self._position = 0
        expected = sum(element.count for element in elements)
        found = len(self._rows)
        if found < expected:
            reason = f"the header announces {expected} rows, {found} follow"
            raise truncated_error(file, reason, expected=expected, found=found)

    def line(self, row: int) -> int:
        """Return the line of the file, from 1, in which a row stands."""
        if self._rows is not self._every:
            filled = (k for k, text in enumerate(self._every) if text.strip())
            row = next(islice(filled, row, None))
        return self._content.count(b"\n", 0, self._start) + 1 + row

    def read(self, element: PlyElement) -> Rows:
        """Return the columns and lists of an element."""
        start = self._position
        self._position = self._position + element.count
        rows = self._rows[start : self._position]
        width = len(element.properties)
        if not rows or not width:
            return {name: np.zeros(0) for name, _ in element.properties}, {}
        parsed = parse_rows(rows, None if element.items else (width,))
        if parsed is None:
            raise self._fault(element, rows, start)
        values, counts = parsed
        if element.items:
            return self._read_uneven(element, values, counts, start)
        table = values.reshape(-1, width)
        return {name: table[:, k] for k, (name, _) in enumerate(element.properties)}, {}

    def _read_uneven(self, element: PlyElement, values: Floats, counts: Ints, start: int) -> Rows:
        """Return the columns and lists of rows of ``counts`` (n,) ``values``."""
        columns: Columns = {}
        lists: dict[str, Lists] = {}
        places = np.cumsum(counts) - counts
        ends = places + counts
        for name, _ in element.properties:
            at = np.minimum(places, len(values) - 1)
            if name not in element.items:
                # what stands behind the lists is nobody's who reads corners alone
                columns[name] = np.where(places < ends, values[at], np.nan)
                places = places + 1
                continue
            lengths = np.where(places < ends, values[at].astype(np.int64), -1)
            short = (lengths < 0) | (places + 1 + lengths > ends)
            if short.any():
                raise self._short_list(start + int(np.argmax(short)))
            items = np.repeat(places + 1, lengths) + count_up(lengths)
            lists[name] = values[items].astype(element.item_type(name)), lengths
            places = places + 1 + lengths
        return columns, lists

    def _short_list(self, row: int) -> InputError:
        line = self.line(row)
        if row == len(self._rows) - 1 and not self._content.endswith(b"\n"):
            return truncated_error(self._file, "the last line is not whole", line=line)
        return unreadable_error(self._file, "a list is shorter than it says", line=line)

    def _fault(self, element: PlyElement, rows: list[bytes], start: int) -> InputError:
        """Return the fault of the first row that is not as announced."""
        width = len(element.properties)
        name = quote(element.name)
        bad = find_bad_row(rows, None if element.items else (width,))
        if bad is None:
            return unreadable_error(self._file, f"the rows of '{name}' are not as announced")
        row, words, _ = bad
        reason = "not three numbers"
        if words != width and not element.items:
            reason = f"{width} numbers expected, {words} found"
        elif name != "vertex":
            reason = f"not a row of '{name}': {quote(rows[row])}"
        where = {"vertex": row} if name == "vertex" else {}
        return unreadable_error(self._file, reason, line=self.line(start + row), **where)


def _triangles(file: str, polygons: Lists, vertices: int) -> Ints:
    corners, counts = polygons
    outside = (corners < 0) | (corners >= vertices)
    if outside.any():
        face = int(np.searchsorted(np.cumsum(counts), np.argmax(outside), side="right"))
        found = int(corners[np.argmax(outside)])
        reason = f"face {face} uses vertex {found}, but there are {vertices}"
        raise unreadable_error(file, reason, face=face, found=found, expected=vertices)
    return fan(corners, counts)


def _columns(vertex: Columns, names: tuple[str, ...]) -> Floats | None:
    if not set(names) <= set(vertex):
        return None
    return np.stack([vertex[name] for name in names], axis=1)


# Writing: binary, in double precision, so that what is read back is equal.

_FACE = np.dtype([("count", "u1"), ("corners", "<i4", (3,))])


def write_ply(
    path: Path, surface: Surface, values: Mapping[str, Floats] | None = None, *, comment: str = ""
) -> None:
    """Write triangles; ``values`` are properties of vertices, name -> (n,), in single precision."""
    columns = dict(zip("xyz", surface.vertices.T, strict=True)) | dict(values or {})
    kinds = {name: "double" if name in PLACE else "float" for name in columns}
    row = [(name, f"<{TYPES[kind]}") for name, kind in kinds.items()]
    vertices = np.empty(len(surface.vertices), row)
    for name, column in columns.items():
        vertices[name] = column
    properties = "".join(f"property {kind} {name}\n" for name, kind in kinds.items())
    said = f"comment {comment}\n" if comment else ""
    header = (
        f"ply\nformat binary_little_endian 1.0\n{said}element vertex {len(vertices)}\n{properties}"
        f"element face {len(surface.faces)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    faces = np.empty(len(surface.faces), dtype=_FACE)
    faces["count"] = 3
    faces["corners"] = surface.faces
    path.write_bytes(header.encode() + vertices.tobytes() + faces.tobytes())
