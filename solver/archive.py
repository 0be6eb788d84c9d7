"""Named arrays and a JSON header in one NPZ file without pickles, with a hash of what is in it."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from solver.errors import InputError
from solver.npz import read_arrays

Arrays = dict[str, np.ndarray]


@dataclass(frozen=True)
class Archive:
    """What is stored: ``header``, JSON values with the ``format`` number, and ``arrays``."""

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

    def write(self, path: Path) -> None:
        """Write the file, replacing it whole: no reader ever sees half of it."""
        header = np.frombuffer(json.dumps(self.header).encode(), dtype=np.uint8)
        unfinished = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            with unfinished.open("wb") as stream:
                np.savez_compressed(stream, allow_pickle=False, header=header, **self.arrays)
            unfinished.replace(path)
        finally:
            unfinished.unlink(missing_ok=True)

    @classmethod
    def read(cls, path: Path, kind: str, noun: str, format_number: int) -> Archive:
        """Read such a file; ``noun`` is what it should be, in words.

        Raises :class:`InputError`: ``<kind>.unreadable`` if it is not one, ``<kind>.format`` if
        its header has another format number.
        """
        try:
            arrays = read_arrays(path)
            header = json.loads(bytes(arrays.pop("header")))
            found = header["format"]
        except (LookupError, RecursionError, TypeError, ValueError) as error:
            raise InputError(
                f"{kind}.unreadable", f"{path.name} is not {noun}: {error}", file=path.name
            ) from error
        if found != format_number:
            raise InputError(
                f"{kind}.format",
                f"{path.name} has {kind} format {found}, not {format_number}",
                file=path.name,
            )
        return cls(header, arrays)


def csr_arrays(name: str, matrix: sp.csr_array) -> Arrays:
    """Return a CSR matrix as three arrays; its explicit zeros are kept."""
    return {
        f"{name}_data": matrix.data,
        f"{name}_indices": matrix.indices,
        f"{name}_indptr": matrix.indptr,
    }


def csr_from(name: str, arrays: Arrays, columns: int) -> sp.csr_array:
    """Return the matrix that :func:`csr_arrays` described."""
    indptr = arrays[f"{name}_indptr"]
    parts = (arrays[f"{name}_data"], arrays[f"{name}_indices"], indptr)
    return sp.csr_array(parts, shape=(len(indptr) - 1, columns))


def with_prefix(arrays: Arrays, prefix: str) -> Arrays:
    """Return the arrays whose names begin so, by the rest of their names."""
    return {
        name.removeprefix(prefix): array
        for name, array in arrays.items()
        if name.startswith(prefix)
    }
