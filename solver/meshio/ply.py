"""PLY, ascii and binary: vertices with normals, colours and confidence, and polygons."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from solver.errors import InputError
from solver.meshio.faults import (
    empty_error,
    not_finite_error,
    truncated_error,
    unreadable_error,
    unsupported_error,
)
from solver.meshio.mesh import NO_FACES, Mesh, fan, numbers_by_row, parse_numbers, unit_colours
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
PLACE, NORMAL, COLOUR = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
CONFIDENCE = "confidence"
INDEX_NAMES = ("vertex_indices", "vertex_index")

MAX_HEADER_LINES = 1000  # so that a binary file without end_header is not searched to its end
MAX_DIGITS = 12  # of a count

Columns = dict[str, Floats]
Polygons = tuple[Ints, Ints]  # all corners one after the other, and how many each polygon has
Rows = tuple[Columns, dict[str, Polygons]]


@dataclass
class Element:
    """One element of the header: its rows, and per property (name, NumPy type).

    A list property is entered with the type of its length, the least it takes in a row; ``items``
    maps its name to the type of its items.
    """

    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)
    items: dict[str, str] = field(default_factory=dict)

    @property
    def has_list(self) -> bool:
        """Tell whether rows differ in length."""
        return bool(self.items)

    def row_type(self, byte_order: str) -> np.dtype:
        """Return the type of a binary row (without the items of lists)."""
        return np.dtype([(name, byte_order + code) for name, code in self.properties])


def read_ply(file: str, content: bytes, *, strict: bool = False) -> Mesh:
    """Return the mesh of PLY ``content``; without faces it is a point cloud.

    Parameters
    ----------
    file
        The file's name, for errors.
    content
        Its bytes.
    strict
        For registered scans: the vertices must be the first element, without lists, and nothing
        else is read; in text they must be finite. Otherwise blank lines of text do not count.

    Raises
    ------
    InputError
        ``scan.empty``, ``scan.unreadable``, ``scan.truncated``, ``scan.format`` or ``scan.nan``,
        with the ``line`` of the fault in text.
    """
    form, elements, start = read_header(file, content)
    if strict and (not elements or elements[0].name != "vertex" or elements[0].has_list):
        reason = "the first element must be 'vertex', without list properties"
        raise unsupported_error(file, reason)
    body: _AsciiBody | _BinaryBody
    if form == "ascii":
        body = _AsciiBody(file, content, elements, start, strict)
    else:
        body = _BinaryBody(file, content, elements, start, BYTE_ORDERS[form])
    vertex: Columns = {}
    polygons: Polygons = (np.zeros(0, np.int64), np.zeros(0, np.int64))
    for element in elements[:1] if strict else elements:
        if element.name == "tristrips":
            raise unsupported_error(file, "triangle strips are not supported: export triangles")
        scalars, lists = body.read(element)
        if element.name == "vertex":
            vertex = scalars
        elif element.name == "face" and element.count:
            index = next((name for name in INDEX_NAMES if name in lists), None)
            if index is None:
                raise unreadable_error(file, "the faces have no vertex_indices")
            polygons = lists[index]
    if not set(PLACE) <= set(vertex):
        raise unreadable_error(file, "the vertices have no x, y and z")
    if len(vertex["x"]) == 0:
        raise empty_error(file)
    if strict and isinstance(body, _AsciiBody):
        _check_finite_rows(file, vertex, body)
    colours = _columns(vertex, COLOUR)
    return Mesh(
        vertices=np.stack([vertex[name] for name in PLACE], axis=1),
        faces=_triangles(file, polygons, len(vertex["x"])),
        normals=_columns(vertex, NORMAL),
        colours=None if colours is None else unit_colours(colours),
        confidence=vertex.get(CONFIDENCE),
    )


def read_header(file: str, content: bytes) -> tuple[str, list[Element], int]:
    """Return the format, the elements, and the byte at which the body starts."""
    form = ""
    elements: list[Element] = []
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
        elif not words or words[0] in ("comment", "obj_info"):
            continue
        elif words[0] == "format" and len(words) == 3 and words[1] in BYTE_ORDERS:
            form = words[1]
        elif words[0] == "element" and len(words) == 3 and _is_count(words[2]):
            elements.append(Element(words[1], int(words[2])))
        elif words[0] == "property" and elements:
            _add_property(file, line, elements[-1], words[1:])
        else:
            raise unreadable_error(file, f"not a header line: {' '.join(words)[:60]!r}", line=line)
    raise unreadable_error(file, f"the header is longer than {MAX_HEADER_LINES} lines")


def _is_count(word: str) -> bool:
    return word.isascii() and word.isdigit() and len(word) <= MAX_DIGITS


def _add_property(file: str, line: int, element: Element, words: list[str]) -> None:
    is_list = words[:1] == ["list"]
    types, name = words[int(is_list) : -1], words[-1] if words else ""
    if len(types) != (2 if is_list else 1) or any(word not in TYPES for word in types):
        raise unreadable_error(file, "not a property this format knows", line=line)
    if is_list and TYPES[types[0]].startswith("f"):
        raise unreadable_error(file, "the length of a list must be a whole number", line=line)
    if any(name == other for other, _ in element.properties):
        raise unreadable_error(file, f"property {name[:60]!r} appears twice", line=line)
    if is_list:
        element.items[name] = TYPES[types[1]]
    element.properties.append((name, TYPES[types[0]]))


class _BinaryBody:
    """Reads one element after the other from a binary body."""

    def __init__(
        self, file: str, content: bytes, elements: list[Element], start: int, order: str
    ) -> None:
        self._file, self._content, self._position, self._order = file, content, start, order
        expected = sum(element.count * element.row_type(order).itemsize for element in elements)
        if len(content) - start < expected:
            raise truncated_error(
                file,
                f"the header announces at least {expected} bytes, {len(content) - start} follow",
                expected=expected,
                found=len(content) - start,
            )

    def read(self, element: Element) -> Rows:
        """Return the columns and lists of an element."""
        lengths = self._list_lengths(element) if element.count else {}
        row = _row_type(element, lengths, self._order)
        end = self._position + row.itemsize * element.count
        if end <= len(self._content):
            rows = np.frombuffer(self._content, row, count=element.count, offset=self._position)
            if all((rows[_length(name)] == count).all() for name, count in lengths.items()):
                self._position = end
                return _table(rows, element, lengths)
        return {}, self._read_lists(element)

    def _read_lists(self, element: Element) -> dict[str, Polygons]:
        """Return the lists of rows that differ in length."""
        lists: dict[str, tuple[list[Ints], list[int]]] = {name: ([], []) for name in element.items}
        for number in range(element.count):
            lengths = self._list_lengths(element)
            row = _row_type(element, lengths, self._order)
            if self._position + row.itemsize > len(self._content):
                raise truncated_error(
                    self._file,
                    f"{element.count} rows of {element.name!r} announced, {number} follow",
                    expected=element.count,
                    found=number,
                )
            values = np.frombuffer(self._content, row, count=1, offset=self._position)[0]
            self._position += row.itemsize
            for name, count in lengths.items():
                lists[name][0].append(values[name].astype(np.int64))
                lists[name][1].append(count)
        return {
            name: (np.concatenate(items), np.array(counts, np.int64))
            for name, (items, counts) in lists.items()
        }

    def _list_lengths(self, element: Element) -> dict[str, int]:
        """Return how many items each list of the next row has (0 behind the end).

        Of a list longer than the file, only as many are counted as no longer fit in it.
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


def _length(name: str) -> str:
    return f"number of {name}"


def _row_type(element: Element, lengths: dict[str, int], order: str) -> np.dtype:
    fields: list[tuple[Any, ...]] = []
    for name, code in element.properties:
        if name in lengths:
            fields.append((_length(name), order + code))
            fields.append((name, order + element.items[name], (lengths[name],)))
        else:
            fields.append((name, order + code))
    return np.dtype(fields)


def _table(rows: np.ndarray, element: Element, lengths: dict[str, int]) -> Rows:
    """Return the columns and lists of rows that are all of one length."""
    scalars = {
        name: rows[name].astype(np.float64)
        for name, _ in element.properties
        if name not in element.items
    }
    lists = {
        name: (rows[name].astype(np.int64).ravel(), np.full(len(rows), count, np.int64))
        for name, count in lengths.items()
    }
    return scalars, lists


class _AsciiBody:
    """Reads one element after the other from a body of text, a row a line."""

    def __init__(
        self, file: str, content: bytes, elements: list[Element], start: int, strict: bool
    ) -> None:
        self._file, self._content, self._start = file, content, start
        self._every = content[start:].removesuffix(b"\n").split(b"\n")
        self._rows = self._every if strict else [row for row in self._every if row.strip()]
        self._position = 0
        expected = sum(element.count for element in elements)
        if len(self._rows) < expected:
            raise truncated_error(
                file,
                f"the header announces {expected} rows, {len(self._rows)} follow",
                expected=expected,
                found=len(self._rows),
            )

    def line(self, row: int) -> int:
        """Return the line of the file, from 1, in which a row stands."""
        if self._rows is not self._every:
            filled = (k for k, text in enumerate(self._every) if text.strip())
            row = next(islice(filled, row, None))
        return self._content.count(b"\n", 0, self._start) + 1 + row

    def read(self, element: Element) -> Rows:
        """Return the columns of an element, or of one with lists the first list."""
        start, self._position = self._position, self._position + element.count
        rows = self._rows[start : self._position]
        width = len(element.properties)
        if not rows:
            return {name: np.zeros(0) for name, _ in element.properties}, {}
        parsed = numbers_by_row(b"\n".join(rows))
        if parsed is None:
            raise self._fault(element, rows, start)
        values, counts = parsed
        if element.has_list:
            return {}, self._read_list(element, values, counts, start)
        if (counts != width).any():
            raise self._fault(element, rows, start)
        table = values.reshape(-1, width)
        return {name: table[:, k] for k, (name, _) in enumerate(element.properties)}, {}

    def _read_list(
        self, element: Element, values: Floats, counts: Ints, start: int
    ) -> dict[str, Polygons]:
        name = next(iter(element.items))
        before = [other for other, _ in element.properties].index(name)
        starts = np.cumsum(counts) - counts + before
        at = np.minimum(starts, len(values) - 1)
        lengths = np.where(counts > before, values[at].astype(np.int64), -1)
        short = (lengths < 0) | (before + 1 + lengths > counts)
        if short.any():
            row = start + int(np.argmax(short))
            if row == len(self._rows) - 1 and not self._content.endswith(b"\n"):
                raise truncated_error(self._file, "the last line is not whole", line=self.line(row))
            reason = "a list is shorter than it says"
            raise unreadable_error(self._file, reason, line=self.line(row))
        items = np.repeat(starts + 1, lengths) + _count_up(lengths)
        return {name: (values[items].astype(np.int64), lengths)}

    def _fault(self, element: Element, rows: list[bytes], start: int) -> InputError:
        """Return the fault of the first row that is not as announced."""
        width, of_vertex = len(element.properties), element.name == "vertex"
        for number, row in enumerate(rows):
            words = row.split()
            numbers = parse_numbers(row)
            if len(words) != width and not element.has_list:
                reason = f"{width} numbers expected, {len(words)} found"
            elif numbers is None:
                reason = (
                    "not three numbers"
                    if of_vertex
                    else f"not a row of {element.name!r}: {row[:60]!r}"
                )
            else:
                continue
            where = {"vertex": number} if of_vertex else {}
            return unreadable_error(self._file, reason, line=self.line(start + number), **where)
        return unreadable_error(self._file, f"the rows of {element.name!r} are not as announced")


def _count_up(lengths: Ints) -> Ints:
    """Return 0, 1, ... up to each of ``lengths``, one after the other."""
    return np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)


def _triangles(file: str, polygons: Polygons, vertices: int) -> Ints:
    corners, counts = polygons
    if len(corners) == 0:
        return NO_FACES
    outside = (corners < 0) | (corners >= vertices)
    if outside.any():
        face = int(np.searchsorted(np.cumsum(counts), np.argmax(outside), side="right"))
        found = int(corners[np.argmax(outside)])
        raise unreadable_error(
            file,
            f"face {face} uses vertex {found}, but there are {vertices}",
            face=face,
            found=found,
            expected=vertices,
        )
    return fan(corners, counts)


def _columns(vertex: Columns, names: tuple[str, ...]) -> Floats | None:
    if not set(names) <= set(vertex):
        return None
    return np.stack([vertex[name] for name in names], axis=1)


def _check_finite_rows(file: str, vertex: Columns, body: _AsciiBody) -> None:
    """Raise ``scan.nan``, with its line, for the first vertex that is not finite."""
    names = [name for name in (*PLACE, CONFIDENCE) if name in vertex]
    table = np.stack([vertex[name] for name in names], axis=1)
    bad = ~np.isfinite(table).all(axis=1)
    if bad.any():
        number = int(np.argmax(bad))
        found = tuple(table[number].tolist())
        raise not_finite_error(file, number, found, line=body.line(number))


# Writing: binary, in double precision, so that what is read back is equal.

_FACE = np.dtype([("count", "u1"), ("corners", "<i4", (3,))])


def write_ply(path: Path, surface: Surface, values: Mapping[str, Floats] | None = None) -> None:
    """Write triangles as PLY; what is read back is equal.

    ``values`` are further properties of the vertices, name -> (n,), in single precision.
    """
    columns = {"x": "<f8", "y": "<f8", "z": "<f8", **dict.fromkeys(values or {}, "<f4")}
    vertices = np.empty(len(surface.vertices), dtype=list(columns.items()))
    for name, column in {
        **dict(zip("xyz", surface.vertices.T, strict=True)),
        **(values or {}),
    }.items():
        vertices[name] = column
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(surface.vertices)}\n"
        + "".join(
            f"property {'double' if code == '<f8' else 'float'} {name}\n"
            for name, code in columns.items()
        )
        + f"element face {len(surface.faces)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    faces = np.empty(len(surface.faces), dtype=_FACE)
    faces["count"], faces["corners"] = 3, surface.faces
    path.write_bytes(header.encode() + vertices.tobytes() + faces.tobytes())
