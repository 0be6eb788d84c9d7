"""Files: named arrays with a JSON header, as NPZ without pickles or for a browser, and JSON."""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import shutil
import struct
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from tokenize import TokenError
from typing import IO, Any
from zipfile import ZipFile, ZipInfo

import numpy as np
import scipy.sparse as sp

from solver.errors import InputError, quote
from solver.kinds import NOT_READABLE, check_directory, is_plainly_packed

# Reading arrays that others packed. A megabyte of NPZ can unpack to a gigabyte, and a header can
# claim any shape. So, before room is made, a file's list of members is bounded, every member is an
# array of plain values whose header agrees with its size, and all of them together are no larger
# than a limit. Pickles are never read.

MOST_BYTES = 1 << 30  # that a file may unpack to
PLAIN = "biufU"  # kinds of values: booleans, whole numbers, floats and text


def read_arrays(
    path: Path, most_bytes: int = MOST_BYTES, inside: str = "", names: Collection[str] | None = None
) -> dict[str, np.ndarray]:
    """Return the arrays of an NPZ file, all or by ``names``, of ``most_bytes`` unpacked at most.

    It may lie, by the name ``inside``, in a ZIP among other files, which are not read.

    Raises :class:`ValueError`, in words, for a file that is none, is damaged, holds more, or holds
    anything but plain arrays.
    """
    try:
        with path.open("rb") as stream:
            return _arrays_in(stream, most_bytes, inside, names)
    except (*NOT_READABLE, ArithmeticError) as error:
        raise ValueError(str(error)) from error


def _arrays_in(
    stream: IO[bytes], most_bytes: int, inside: str = "", names: Collection[str] | None = None
) -> dict[str, np.ndarray]:
    check_directory(stream)
    with ZipFile(stream) as archive:
        members = archive.infolist()
        packed = [member for member in members if member.filename == inside]
        if packed:
            _check_packing(packed, most_bytes)
            with TemporaryFile() as unpacked:
                with archive.open(packed[0]) as source:
                    shutil.copyfileobj(source, unpacked)
                return _arrays_in(unpacked, most_bytes, names=names)
        _check_members(members)
        if names is not None:
            members = [member for member in members if member.filename[:-4] in names]
        _check_packing(members, most_bytes)
        for member in members:
            _check_array(archive, member)
        return {member.filename[:-4]: _array(archive, member) for member in members}


def map_array(path: Path) -> np.ndarray:
    """Return the array of an NPY file, mapped: its values are read when they are looked at.

    Raises :class:`ValueError`, in words, for a file that is none or too short, and for anything
    but plain values.
    """
    try:
        with path.open("rb") as stream:
            _check_size(stream, path.stat().st_size)
        return np.lib.format.open_memmap(path, mode="r")
    except (*NOT_READABLE, ArithmeticError) as error:
        raise ValueError(str(error)) from error


def _check_members(members: list[ZipInfo]) -> None:
    names = set()
    for member in members:
        name = quote(member.filename)
        if not member.filename.endswith(".npy"):
            raise ValueError(f"it holds '{name}', which is no array")
        if member.filename in names:
            raise ValueError(f"it holds '{name}' twice")
        names.add(member.filename)


def _check_packing(members: list[ZipInfo], most_bytes: int) -> None:
    for member in members:
        if not is_plainly_packed(member):
            name = quote(member.filename)
            raise ValueError(f"'{name}' is encrypted or packed in another way than NumPy does")
    size = sum(member.file_size for member in members)
    if size > most_bytes:
        raise ValueError(f"it unpacks to {size} bytes; at most {most_bytes} can be read")


def _check_array(archive: ZipFile, member: ZipInfo) -> None:
    with archive.open(member) as stream:
        try:
            _check_size(stream, member.file_size)
        except ValueError as error:
            raise ValueError(f"{quote(member.filename)}: {error}") from error


def _array(archive: ZipFile, member: ZipInfo) -> np.ndarray:
    with archive.open(member) as stream:
        return np.asarray(np.lib.format.read_array(stream, allow_pickle=False))


def _check_size(stream: IO[bytes], size: int) -> None:
    """Raise unless a ``stream`` of so many bytes begins with an NPY header that fits it."""
    shape, dtype = _header(stream)
    if dtype.kind not in PLAIN or not dtype.itemsize:
        raise ValueError(f"it holds {quote(dtype)}, not plain values")
    if any(length < 0 for length in shape):
        raise ValueError(f"it claims the shape {quote(shape)}")
    needed = stream.tell() + math.prod(shape) * dtype.itemsize
    if needed != size:
        claim = f"{quote(dtype)} of shape {quote(shape)} needs {quote(needed)}"
        raise ValueError(f"it has {size} bytes where {claim}")


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], np.dtype]:
    version = np.lib.format.read_magic(stream)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"its format version {version} is not known")
    first = version == (1, 0)
    read = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
    try:
        shape, _, dtype = read(stream)
    except (MemoryError, RecursionError, SyntaxError, TokenError, TypeError) as error:
        raise ValueError("its header is not one of NumPy's") from error
    return shape, dtype


# Archives of our own.

Arrays = dict[str, np.ndarray]
CSR = ("data", "indices", "indptr")  # arrays of a CSR matrix


@dataclass(frozen=True)
class Archive:
    """The content of a file: ``header``, JSON values with the ``format`` number, and ``arrays``."""

    header: dict[str, Any]
    arrays: Arrays

    @property
    def sha256(self) -> str:
        """Return the hash of the content: of names, types, shapes and values, not of zip bytes."""
        digest = hashlib.sha256(json.dumps(self.header, sort_keys=True).encode())
        for name, array in sorted(self.arrays.items()):
            values = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
            digest.update(f"{name} {values.dtype.str} {values.shape}".encode())
            digest.update(values.data)
        return digest.hexdigest()

    def part(self, name: str) -> Archive:
        """Return an archive that was put into this one: its header and arrays under ``name``."""
        return Archive(self.header[name], with_prefix(self.arrays, f"{name}_"))

    def write(self, path: Path | str, *, packed: bool = True) -> None:
        """Write the file, ``packed`` or quickly, replacing it whole: no reader sees half of it."""
        path = Path(path)
        header = np.frombuffer(json.dumps(self.header).encode(), dtype=np.uint8)
        with _replacing(path) as unfinished, unfinished.open("wb") as stream:
            save = np.savez_compressed if packed else np.savez
            save(stream, allow_pickle=False, header=header, **self.arrays)

    @classmethod
    def read(
        cls, path: Path | str, kind: str, noun: str, format_number: int, inside: str = ""
    ) -> Archive:
        """Read such a file, or that of a ZIP (``inside``); ``noun`` says what it should be.

        Raises :class:`InputError`: ``<kind>.unreadable`` if it is not one, ``<kind>.format`` if
        its header has another format number.
        """
        path = Path(path)
        if not path.is_file():
            message = f"there is no file {path.name}"
            raise InputError(f"{kind}.unreadable", message, file=path.name)
        try:
            arrays = read_arrays(path, inside=inside)
            if "header" not in arrays:
                raise ValueError("it is another program's NPZ, without a header")
            header = json.loads(bytes(arrays.pop("header")))
            found = header["format"]
        except (LookupError, RecursionError, TypeError, ValueError) as error:
            message = f"{path.name} is not {noun}: {error}"
            raise InputError(f"{kind}.unreadable", message, file=path.name) from error
        if found != format_number:
            message = f"{path.name} has {kind} format {quote(found)}, not {format_number}"
            raise InputError(f"{kind}.format", message, file=path.name)
        return cls(header, arrays)


def csr_arrays(name: str, matrix: sp.csr_array) -> Arrays:
    """Return a CSR matrix as three arrays; its explicit zeros are kept."""
    return {f"{name}_{part}": getattr(matrix, part) for part in CSR}


def csr_from(name: str, arrays: Arrays, columns: int) -> sp.csr_array:
    """Return the matrix that :func:`csr_arrays` described."""
    parts = tuple(arrays[f"{name}_{part}"] for part in CSR)
    return sp.csr_array(parts, shape=(len(parts[-1]) - 1, columns))


def with_prefix(arrays: Arrays, prefix: str) -> Arrays:
    """Return the arrays whose names begin with ``prefix``, by the rest of their names."""
    named = {name: array for name, array in arrays.items() if name.startswith(prefix)}
    return {name.removeprefix(prefix): array for name, array in named.items()}


def hash_file(path: Path) -> str:
    """Return the SHA-256 of a file's content."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def hash_files(files: Mapping[str, Path]) -> dict[str, str]:
    """Return the hash of each file by its name."""
    return {name: hash_file(path) for name, path in files.items()}


def natural_order(names: Collection[str]) -> list[str]:
    """Return names of files with the numbers in them in order: ``a2`` before ``a10``."""
    parts = {name: re.split(r"(\d+)", name.lower()) for name in names}
    return sorted(
        names, key=lambda name: [int(p) if k % 2 else p for k, p in enumerate(parts[name])]
    )


def copy_whole(source: Path, path: Path) -> None:
    """Copy a file to where no reader sees half of it."""
    with _replacing(path) as unfinished:
        shutil.copyfile(source, unfinished)


@contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    """Give a file beside ``path`` that takes its place once it is written."""
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        yield unfinished
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def write_json(path: Path, values: Any) -> None:
    """Write JSON values for people as well as programs: indented, all of them finite."""
    path.write_text(json.dumps(values, indent=2, allow_nan=False) + "\n", encoding="utf-8")


# The container of the files a browser reads: a JSON header and plain arrays it can map in place.
# Four bytes MYOV, the header's length H (uint32), H bytes of JSON, padded with spaces so that the
# first array lies at a multiple of 8, then the arrays in C order, each at a multiple of 8. All of
# it is little-endian. The header's "arrays" gives each array's dtype, shape and place in the file.

MAGIC = b"MYOV"
VIEW_FORMAT = 1  # of the container
DTYPES = ("float32", "float16", "uint32", "uint8")
ALIGNMENT = 8  # bytes: a browser maps arrays of any dtype in place
PREFIX = struct.Struct("<4sI")


def write_container(path: Path, header: Mapping[str, Any], arrays: Arrays) -> None:
    """Write a file of JSON values and arrays, each of one of :data:`DTYPES`; lengths are mm.

    The same content gives the same bytes. ``format``, ``unit`` and ``arrays`` are put into the
    header here. Raises :class:`ValueError` for another dtype and for NaN in the header.
    """
    stored = {name: _little_endian(name, array) for name, array in arrays.items()}
    text, places = _view_header(header, stored)
    with path.open("wb") as stream:
        stream.write(PREFIX.pack(MAGIC, len(text)) + text)
        for array, place in zip(stored.values(), places, strict=True):
            stream.write(bytes(place - stream.tell()))
            stream.write(array.data)


def read_container(path: str | Path) -> Archive:
    """Read such a file; its header comes without the table of arrays.

    Raises :class:`InputError`: ``view.unreadable`` if it is not one, or arrays lie outside it;
    ``view.format`` if it has another format number.
    """
    path = Path(path)
    content = path.read_bytes()
    try:
        header, arrays = _parse_view(content)
    except (struct.error, ArithmeticError, LookupError, TypeError, ValueError) as error:
        message = f"{path.name} is no view of a rig: {error}"
        raise InputError("view.unreadable", message, file=path.name) from error
    found = header.pop("format", None)
    if found != VIEW_FORMAT:
        message = f"{path.name} has view format {found}, not {VIEW_FORMAT}"
        raise InputError("view.format", message, file=path.name, expected=VIEW_FORMAT, found=found)
    return Archive(header, arrays)


def _little_endian(name: str, array: np.ndarray) -> np.ndarray:
    if array.dtype.name not in DTYPES:
        raise ValueError(f"{name} has dtype {array.dtype}; a view holds {', '.join(DTYPES)}")
    return np.ascontiguousarray(array, array.dtype.newbyteorder("<"))


def _view_header(
    header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
) -> tuple[bytes, list[int]]:
    """Return the header's bytes and where each array begins."""
    sizes = [_align(array.nbytes) for array in arrays.values()]
    begin = 0  # moves on until the header fits: its places are in it, and their digits count
    while True:
        places = [begin + sum(sizes[:number]) for number in range(len(sizes))]
        table = {
            name: {"dtype": array.dtype.name, "shape": list(array.shape), "offset": place}
            for (name, array), place in zip(arrays.items(), places, strict=True)
        }
        content = {"format": VIEW_FORMAT, "unit": "mm", **header, "arrays": table}
        text = json.dumps(content, allow_nan=False, separators=(",", ":")).encode()
        needed = _align(PREFIX.size + len(text))
        if needed <= begin:
            return text.ljust(begin - PREFIX.size), places
        begin = needed


def _parse_view(content: bytes) -> tuple[dict[str, Any], Arrays]:
    magic, length = PREFIX.unpack_from(content)
    if magic != MAGIC:
        raise ValueError("it does not begin with MYOV")
    header = json.loads(content[PREFIX.size : PREFIX.size + length])
    arrays = {}
    for name, entry in header.pop("arrays").items():
        if entry["dtype"] not in DTYPES:
            raise ValueError(f"{name} has the unknown dtype {entry['dtype']}")
        if any(size < 0 for size in entry["shape"]):
            raise ValueError(f"{name} has the shape {entry['shape']}")
        dtype = np.dtype(entry["dtype"]).newbyteorder("<")
        count = math.prod(entry["shape"])
        flat = np.frombuffer(content, dtype, count, entry["offset"])
        arrays[name] = flat.reshape(entry["shape"])
    return header, arrays


def _align(place: int) -> int:
    return place + -place % ALIGNMENT
