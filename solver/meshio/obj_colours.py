"""Images on a Wavefront OBJ: its ``vt`` lines, and the materials of the MTL files it names."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from solver.errors import InputError, file_error, quote
from solver.meshio.mesh import fan, parse_rows
from solver.meshio.paint import BARE, Paint
from solver.meshio.texture_images import ImageReader, Texels, read_sidecar, sidecar
from solver.surface import Floats, Ints

COORDINATE = (b"vt ", b"vt\t")
FACE = (b"f ", b"f\t")
# Options of map_Kd, each with the words that may follow it: numbers, or one of another kind.
NUMBERS = {"-o": 3, "-s": 3, "-t": 3, "-mm": 2, "-bm": 1, "-boost": 1, "-texres": 1}
WORDS = {"-blendu", "-blendv", "-cc", "-clamp", "-imfchan", "-type"}
UDIM = re.compile("<UDIM>", re.IGNORECASE)  # in a name: the number of a tile


@dataclass(frozen=True)
class Map:
    """An image of a material: the place of texture coordinates c in it is scale c + offset."""

    name: str
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)


def paint_of_obj(path: Path, content: bytes) -> Paint | None:
    """Return the images on an OBJ that can be read; None: no face has one.

    MTL files and images are those beside it. Raises :class:`InputError`: ``texture.path``,
    ``texture.missing`` or ``texture.unreadable``.
    """
    lines = re.sub(rb"\\\r?\n", b" ", content).split(b"\n")
    libraries = _names(lines, b"mtllib")
    rows = [line[3:] for line in lines if line.startswith(COORDINATE)]
    if not libraries or not rows:
        return None
    faces = _Faces.of(lines)
    maps: dict[str, Map] = {}
    for name in dict.fromkeys(libraries):
        maps = read_materials(sidecar(path, name, path.name)) | maps
    used = [name for name in faces.materials if name in maps]
    if not used:
        return None
    parsed = parse_rows(rows, (1, 2, 3))
    if parsed is None:
        raise file_error("texture.unreadable", path.name, "a 'vt' line holds no two numbers")
    values, counts = parsed
    start = np.cumsum(counts) - counts
    second = np.where(counts > 1, values[np.minimum(start + 1, len(values) - 1)], 0.0)
    places = np.column_stack([values[start], second])
    return _paint(path, places, faces, {name: maps[name] for name in used})


@dataclass(frozen=True)
class _Faces:
    """The faces of an OBJ: texture coordinates of corners, counted from 0, -1 for none."""

    corners: Ints  # (t, 3) of triangles
    material: Ints  # (t,) number among ``materials``, -1 for none
    materials: tuple[str, ...]

    @classmethod
    def of(cls, lines: list[bytes]) -> _Faces:
        materials: dict[str, int] = {}
        current = -1
        before = 0
        numbers: list[int] = []
        counts: list[int] = []
        chosen: list[int] = []
        for line in lines:
            if line.startswith(COORDINATE):
                before += 1
            elif line.startswith(b"usemtl"):
                name = _text(line[6:])
                current = materials.setdefault(name, len(materials))
            elif line.startswith(FACE):
                words = line.split()[1:]
                counts.append(len(words))
                chosen.append(current)
                numbers += [_coordinate(word, before) for word in words]
        sizes = np.array(counts, np.int64)
        corners = np.array(numbers, np.int64)
        triangles = fan(corners, sizes)
        return cls(triangles, np.repeat(chosen, np.maximum(sizes - 2, 0)), tuple(materials))


def _coordinate(word: bytes, before: int) -> int:
    """Return the number of a corner's texture coordinates, of ``before`` that stand before it."""
    second = word.split(b"/", 2)[1:2]
    try:
        number = int(second[0]) if second else 0
    except ValueError:
        return -1
    return number - 1 if number > 0 else before + number if number < 0 else -1


def _paint(path: Path, places: Floats, faces: _Faces, maps: dict[str, Map]) -> Paint:
    reader = ImageReader()
    corners = faces.corners
    whole = np.asarray(((corners >= 0) & (corners < len(places))).all(axis=1))
    coordinates = np.where(whole[:, None, None], places[np.where(whole[:, None], corners, 0)], 0.0)
    images_of = np.full(len(corners), BARE)
    files: dict[str, int] = {}
    images: list[Texels] = []
    missing: dict[str, InputError] = {}
    for name, one in maps.items():
        own = np.flatnonzero(whole & (faces.material == faces.materials.index(name)))
        coordinates[own] = coordinates[own] * one.scale + one.offset
        written_in = f"the material {quote(name)} of {path.name}"
        for file, triangles in _tiles(one.name, coordinates[own]).items():
            if file not in files:
                try:
                    image = sidecar(path, file, written_in)
                except InputError as error:
                    if file == one.name or error.code != "texture.missing":
                        raise
                    missing[file] = error  # a tile: others may be there
                    continue
                files[file] = len(images)
                images.append(reader.read(image.name, read_sidecar(image)))
            images_of[own[triangles]] = files[file]
    if missing and not images:
        raise next(iter(missing.values()))
    coordinates[:, :, 1] = 1.0 - coordinates[:, :, 1]  # v goes up from the lower edge
    return Paint(tuple(images), images_of, coordinates, missing=tuple(missing))


def _tiles(name: str, coordinates: Floats) -> dict[str, Ints]:
    """Return the triangles on each image of a material, given their corners' places (t, 3, 2).

    A name with ``<UDIM>`` has an image for each unit square, which are numbered from 1001 on, ten
    in a row. A triangle that lies in none of them is in no image.
    """
    if not UDIM.search(name):
        return {name: np.arange(len(coordinates))}
    middle = np.nan_to_num(coordinates.mean(axis=1), nan=-1.0)
    column, row = np.floor(middle).T
    within = (column >= 0) & (column < 10) & (row >= 0) & (row < 100)
    numbers = np.where(within, 1001 + column + 10 * row, 0).astype(np.int64)
    return {
        UDIM.sub(str(number), name): np.flatnonzero(numbers == number)
        for number in np.unique(numbers[within])
    }


def read_materials(path: Path) -> dict[str, Map]:
    """Return the image of the diffuse colour (``map_Kd``) of each material of an MTL that has one.

    Raises :class:`InputError` (``texture.unreadable``) for a line that names none.
    """
    maps: dict[str, Map] = {}
    material = ""
    for number, line in enumerate(read_sidecar(path).split(b"\n"), start=1):
        key, _, rest = line.strip().partition(b" ")
        if not rest:
            key, _, rest = line.strip().partition(b"\t")
        if key == b"newmtl":
            material = _text(rest)
        elif key.lower() == b"map_kd":
            found = _map(_text(rest))
            if found is None:
                reason = "map_Kd names no image"
                raise file_error("texture.unreadable", path.name, reason, line=number)
            maps.setdefault(material, found)
    return maps


def _map(text: str) -> Map | None:
    """Return the image that a ``map_Kd`` line names after its options; None: none."""
    pairs = {"-s": [1.0, 1.0], "-o": [0.0, 0.0]}
    rest = text
    while rest.startswith("-"):
        option, _, rest = rest.partition(" ")
        rest = rest.lstrip()
        if option in NUMBERS:
            values: list[float] = []
            while len(values) < NUMBERS[option]:
                word, _, after = rest.partition(" ")
                value = _number(word)
                if value is None:
                    break
                values.append(value)
                rest = after.lstrip()
            if option in pairs:
                pairs[option][: len(values[:2])] = values[:2]
        elif option in WORDS:
            rest = rest.partition(" ")[2].lstrip()
        else:
            rest = f"{option} {rest}".strip()
            break
    if not rest:
        return None
    return Map(rest, (pairs["-s"][0], pairs["-s"][1]), (pairs["-o"][0], pairs["-o"][1]))


def _number(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None


def _names(lines: list[bytes], key: bytes) -> list[str]:
    """Return the names after a key word: MTL files may have blanks in them."""
    return [_text(line[len(key) :]) for line in lines if re.match(key + rb"[ \t]", line)]


def _text(words: bytes) -> str:
    try:
        return words.strip().decode("utf-8")
    except UnicodeDecodeError:  # of older programs on Windows
        return words.strip().decode("cp1252", "replace")
