"""PLY (ascii and binary), read strictly: only the vertex element, in the order of the file."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from solver.scans.faults import empty, not_finite, truncated, unreadable, unsupported
from solver.surface import Floats

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
