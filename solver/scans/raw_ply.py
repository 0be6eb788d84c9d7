"""PLY (ascii and binary) as a raw scan: vertices, normals, colours and polygons."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from solver.scans.faults import empty, truncated, unreadable, unsupported
from solver.scans.mesh import NO_FACES, Mesh, unit_colours
from solver.scans.ply import BYTE_ORDERS, Element, read_header, read_ply
from solver.scans.rows import fan, numbers_by_row
from solver.surface import Floats, Ints

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
