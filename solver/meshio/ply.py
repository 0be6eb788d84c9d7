"""PLY (ascii and binary), read strictly: only the vertex element, in the order of the file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from solver.meshio.rows import (
    NO_FACES,
    Mesh,
    empty,
    fan,
    not_finite,
    numbers_by_row,
    truncated,
    unit_colours,
    unreadable,
    unsupported,
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
MAX_HEADER_LINES = 1000
MAX_DIGITS = 12


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
        """Return whether rows differ in length."""
        return bool(self.items)

    def row_type(self, byte_order: str) -> np.dtype:
        """Return the type of a binary row (without the items of lists)."""
        return np.dtype([(name, byte_order + code) for name, code in self.properties])


def read_ply(file: str, content: bytes, also: str | None = None) -> Floats:
    """Return the vertices (n, 3) of PLY ``content``; ``file`` names it in errors.

    Where the vertices have the property ``also``, it is the fourth column.
    """
    form, elements, body, body_line = read_header(file, content)
    vertices = elements[0] if elements else Element("", 0)
    if vertices.name != "vertex" or vertices.has_list:
        raise unsupported(file, "the first element must be 'vertex', without list properties")
    if vertices.count == 0:
        raise empty(file)
    names = [name for name, _ in vertices.properties]
    if not {"x", "y", "z"} <= set(names):
        raise unreadable(file, "the vertices have no x, y and z")
    wanted = [*"xyz", also] if also in names else [*"xyz"]
    if form == "ascii":
        columns = [names.index(name) for name in wanted]
        return _ascii_vertices(file, content[body:], elements, columns, body_line)
    order = BYTE_ORDERS[form]
    expected = sum(element.count * element.row_type(order).itemsize for element in elements)
    if len(content) - body < expected:
        raise truncated(
            file,
            f"the header announces at least {expected} bytes, {len(content) - body} follow",
            expected=expected,
            found=len(content) - body,
        )
    rows = np.frombuffer(content, vertices.row_type(order), count=vertices.count, offset=body)
    return np.stack([rows[name] for name in wanted], axis=1).astype(np.float64)


def read_header(file: str, content: bytes) -> tuple[str, list[Element], int, int]:
    """Return the format, the elements, and where the body starts (byte, line)."""
    form = ""
    elements: list[Element] = []
    position = 0
    for line in range(1, MAX_HEADER_LINES):
        end = content.find(b"\n", position)
        if end < 0:
            raise truncated(file, "the header has no 'end_header'")
        words = content[position:end].decode("ascii", "replace").split()
        position = end + 1
        if line == 1:
            if words != ["ply"]:
                raise unreadable(file, "not a PLY file: the first line is not 'ply'", line=1)
        elif words == ["end_header"]:
            if not form:
                raise unreadable(file, "the header names no format", line=line)
            return form, elements, position, line + 1
        elif not words or words[0] in ("comment", "obj_info"):
            continue
        elif words[0] == "format" and len(words) == 3 and words[1] in BYTE_ORDERS:
            form = words[1]
        elif words[0] == "element" and len(words) == 3 and _is_count(words[2]):
            elements.append(Element(words[1], int(words[2])))
        elif words[0] == "property" and elements:
            _add_property(file, line, elements[-1], words[1:])
        else:
            raise unreadable(file, f"not a header line: {' '.join(words)[:60]!r}", line=line)
    raise unreadable(file, f"the header is longer than {MAX_HEADER_LINES} lines")


def _is_count(word: str) -> bool:
    return word.isascii() and word.isdigit() and len(word) <= MAX_DIGITS


def _add_property(file: str, line: int, element: Element, words: list[str]) -> None:
    is_list = words[:1] == ["list"]
    types, name = words[int(is_list) : -1], words[-1] if words else ""
    if len(types) != (2 if is_list else 1) or any(word not in TYPES for word in types):
        raise unreadable(file, "not a property this format knows", line=line)
    if is_list and TYPES[types[0]].startswith("f"):
        raise unreadable(file, "the length of a list must be a whole number", line=line)
    if any(name == other for other, _ in element.properties):
        raise unreadable(file, f"property {name[:60]!r} appears twice", line=line)
    if is_list:
        element.items[name] = TYPES[types[1]]
    element.properties.append((name, TYPES[types[0]]))


def _ascii_vertices(
    file: str, body: bytes, elements: list[Element], columns: list[int], first_line: int
) -> Floats:
    rows = body.splitlines()
    expected = sum(element.count for element in elements)
    if len(rows) < expected:
        raise truncated(
            file,
            f"the header announces {expected} rows, {len(rows)} follow",
            expected=expected,
            found=len(rows),
        )
    vertices = np.empty((elements[0].count, len(columns)))
    width = len(elements[0].properties)
    for vertex in range(len(vertices)):
        words = rows[vertex].split()
        line = first_line + vertex
        if len(words) != width:
            raise unreadable(
                file, f"{width} numbers expected, {len(words)} found", line=line, vertex=vertex
            )
        try:
            vertices[vertex] = [float(words[column]) for column in columns]
        except ValueError:
            raise unreadable(file, "not three numbers", line=line, vertex=vertex) from None
        if not np.isfinite(vertices[vertex]).all():
            raise not_finite(file, vertex, tuple(vertices[vertex].tolist()), line=line)
    return vertices


# Writing a mesh as binary PLY, exactly: coordinates in double precision.


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


# PLY (ascii and binary) as a raw scan: vertices, normals, colours and polygons.


INDEX_NAMES = ("vertex_indices", "vertex_index")
NORMAL, COLOUR = ("nx", "ny", "nz"), ("red", "green", "blue")
Columns = dict[str, Floats]
Polygons = tuple[Ints, Ints]


def read_raw_ply(file: str, content: bytes) -> Mesh:
    """Return the mesh of PLY ``content``; without faces it is a point cloud."""
    form, elements, body, body_line = read_header(file, content)
    read = _ascii_reader if form == "ascii" else _binary_reader
    element_rows = read(file, content, body, body_line, BYTE_ORDERS[form])
    vertex: Columns = {}
    polygons: Polygons = (np.zeros(0, np.int64), np.zeros(0, np.int64))
    for element in elements:
        if element.name == "tristrips":
            raise unsupported(file, "triangle strips are not supported: export triangles")
        scalars, lists = element_rows(element)
        if element.name == "vertex":
            vertex = scalars
        elif element.name == "face" and element.count:
            index = next((name for name in INDEX_NAMES if name in lists), None)
            if index is None:
                raise unreadable(file, "the faces have no vertex_indices")
            polygons = lists[index]
    if not {"x", "y", "z"} <= set(vertex):
        raise unreadable(file, "the vertices have no x, y and z")
    if len(vertex["x"]) == 0:
        raise empty(file)
    return Mesh(
        vertices=np.stack([vertex[name] for name in "xyz"], axis=1),
        faces=_triangles(file, polygons, len(vertex["x"])),
        normals=_columns(vertex, NORMAL),
        colours=None if COLOUR[0] not in vertex else _colours(vertex),
    )


RowReader = Callable[[Element], tuple[Columns, dict[str, Polygons]]]


def _binary_reader(file: str, content: bytes, body: int, _line: int, order: str) -> RowReader:
    """Return a reader of one element after the other from a binary body."""
    position = body

    def read(element: Element) -> tuple[Columns, dict[str, Polygons]]:
        nonlocal position
        lengths = _list_lengths(element, content, position, order) if element.count else {}
        row = _row_type(element, lengths, order)
        if position + row.itemsize * element.count <= len(content):
            rows = np.frombuffer(content, row, count=element.count, offset=position)
            if all((rows[_length(name)] == count).all() for name, count in lengths.items()):
                position += row.itemsize * element.count
                return _fixed(rows, element, lengths)
        if not element.has_list:
            raise truncated(
                file,
                f"{element.count} rows of {element.name!r} announced, "
                f"{(len(content) - position) // row.itemsize} follow",
                expected=element.count,
                found=(len(content) - position) // row.itemsize,
            )
        lists: dict[str, tuple[list[Ints], list[int]]] = {name: ([], []) for name in element.items}
        for number in range(element.count):
            lengths = _list_lengths(element, content, position, order)
            row = _row_type(element, lengths, order)
            if position + row.itemsize > len(content):
                raise truncated(
                    file,
                    f"{element.count} rows of {element.name!r} announced, {number} follow",
                    expected=element.count,
                    found=number,
                )
            values = np.frombuffer(content, row, count=1, offset=position)[0]
            position += row.itemsize
            for name, count in lengths.items():
                lists[name][0].append(values[name].astype(np.int64))
                lists[name][1].append(count)
        return {}, {
            name: (np.concatenate(items), np.array(counts, np.int64))
            for name, (items, counts) in lists.items()
        }

    return read


def _length(name: str) -> str:
    return f"number of {name}"


def _list_lengths(element: Element, content: bytes, position: int, order: str) -> dict[str, int]:
    """Return how many items each list of the row at ``position`` has (0 behind the end).

    Of a list longer than the file, only as many are counted as no longer fit in it.
    """
    lengths: dict[str, int] = {}
    for name, code in element.properties:
        kind = np.dtype(order + code)
        if name in element.items:
            value = content[position : position + kind.itemsize]
            whole = len(value) == kind.itemsize
            announced = max(int(np.frombuffer(value, kind)[0]), 0) if whole else 0
            size = np.dtype(element.items[name]).itemsize
            lengths[name] = min(announced, len(content) // size + 1)
            position += lengths[name] * size
        position += kind.itemsize
    return lengths


def _row_type(element: Element, lengths: dict[str, int], order: str) -> np.dtype:
    fields: list[tuple[Any, ...]] = []
    for name, code in element.properties:
        if name in lengths:
            fields.append((_length(name), order + code))
            fields.append((name, order + element.items[name], (lengths[name],)))
        else:
            fields.append((name, order + code))
    return np.dtype(fields)


def _fixed(
    rows: np.ndarray, element: Element, lengths: dict[str, int]
) -> tuple[Columns, dict[str, Polygons]]:
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


def _ascii_reader(file: str, content: bytes, body: int, line: int, _order: str) -> RowReader:
    """Return a reader of one element after the other from an ascii body."""
    lines = [row for row in content[body:].split(b"\n") if row.strip()]
    position = 0

    def read(element: Element) -> tuple[Columns, dict[str, Polygons]]:
        nonlocal position
        rows = lines[position : position + element.count]
        if len(rows) < element.count:
            raise truncated(
                file,
                f"{element.count} rows of {element.name!r} announced, {len(rows)} follow",
                expected=element.count,
                found=len(rows),
            )
        if not rows:
            return {name: np.zeros(0) for name, _ in element.properties}, {}
        first_line, position = line + position, position + element.count
        parsed = numbers_by_row(b"\n".join(rows))
        at_end = position == len(lines) and not content.endswith(b"\n")
        if parsed is None:
            raise _named(file, content, element, rows, first_line)
        values, counts = parsed
        if not element.has_list:
            width = len(element.properties)
            if (counts != width).any():
                raise _named(file, content, element, rows, first_line)
            table = values.reshape(-1, width)
            return {name: table[:, k] for k, (name, _) in enumerate(element.properties)}, {}
        name = next(iter(element.items))
        before = [other for other, _ in element.properties].index(name)
        starts = np.cumsum(counts) - counts + before
        if (counts <= before).any():
            raise _named(file, content, element, rows, first_line)
        lengths = values[starts].astype(np.int64)
        short = (lengths < 0) | (before + 1 + lengths > counts)
        if short.any():
            number = int(np.argmax(short))
            if at_end and number == len(rows) - 1:
                raise truncated(file, "the last line is not whole", line=first_line + number)
            raise unreadable(file, "a list is shorter than it says", line=first_line + number)
        items = np.repeat(starts + 1, lengths) + _count_up(lengths)
        return {}, {name: (values[items].astype(np.int64), lengths)}

    return read


def _count_up(lengths: Ints) -> Ints:
    """Return 0, 1, ... up to each of ``lengths``, one after the other."""
    return np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)


def _named(
    file: str, content: bytes, element: Element, rows: list[bytes], first_line: int
) -> Exception:
    """Return the fault of the first row that is not as announced."""
    if element.name == "vertex":
        try:
            read_ply(file, content)
        except ValueError as error:
            return error
    for number, row in enumerate(rows):
        try:
            if len([float(word) for word in row.split()]) >= len(element.properties):
                continue
        except ValueError:
            pass
        return unreadable(
            file, f"not a row of {element.name!r}: {row[:60]!r}", line=first_line + number
        )
    return unreadable(file, f"the rows of {element.name!r} are not as announced")


def _triangles(file: str, polygons: Polygons, vertices: int) -> Ints:
    corners, counts = polygons
    if len(corners) == 0:
        return NO_FACES
    outside = (corners < 0) | (corners >= vertices)
    if outside.any():
        face = int(np.searchsorted(np.cumsum(counts), np.argmax(outside), side="right"))
        found = int(corners[np.argmax(outside)])
        raise unreadable(
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


def _colours(vertex: Columns) -> Floats | None:
    colours = _columns(vertex, COLOUR)
    return None if colours is None else unit_colours(colours)
