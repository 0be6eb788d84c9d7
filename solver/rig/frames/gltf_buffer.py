"""The one binary buffer of a glTF file, with its views and accessors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import pygltflib as gl

from solver.surface import Floats, Ints

METRES = 1e-3  # a mm, glTF's unit is the metre
SPARSE_COST = 14 / 12  # bytes of a sparse entry by those of a dense one


@dataclass(frozen=True)
class SparsePlaces:
    """Numbers of the vertices, among ``of``, that sparse values are of."""

    indices: gl.AccessorSparseIndices
    count: int
    of: int


class Buffer:
    """The one binary buffer, with its views and accessors as they are added."""

    def __init__(self) -> None:
        self.content = bytearray()
        self.views: list[gl.BufferView] = []
        self.accessors: list[gl.Accessor] = []

    def dense(
        self, values: Floats, kind: str, target: int | None = None, *, bounds: bool = False
    ) -> int:
        """Add values as 32-bit floats and return the accessor's number."""
        stored = np.ascontiguousarray(values, dtype="<f4")
        view = self._view(stored, target)
        return self._add(gl.FLOAT, len(stored), kind, stored if bounds else None, view)

    def indices(self, faces: Ints) -> int:
        """Add triangles and return the accessor's number."""
        view = self._view(np.ascontiguousarray(faces, "<u4"), gl.ELEMENT_ARRAY_BUFFER)
        return self._add(gl.UNSIGNED_INT, faces.size, gl.SCALAR, None, view)

    def image(self, content: bytes) -> int:
        """Add an image's file and return its view's number."""
        return self._view(np.frombuffer(content, np.uint8))

    def bindings(self, rest: Floats) -> int:
        """Add what takes points to joints whose places at rest are ``rest`` (k, 3), mm."""
        back = np.tile(np.eye(4), (len(rest), 1, 1))
        back[:, :3, 3] = -rest * METRES
        return self.dense(np.swapaxes(back, 1, 2).reshape(-1, 16), gl.MAT4)

    def joints(self, numbers: Ints) -> int:
        """Add the numbers (v, 4) of the joints that move each vertex."""
        view = self._view(np.ascontiguousarray(numbers, "<u1"), gl.ARRAY_BUFFER)
        return self._add(gl.UNSIGNED_BYTE, len(numbers), gl.VEC4, None, view)

    def morph(self, change: Floats, still: float, *, bounds: bool = False) -> int:
        """Add a change (v, 3) of an attribute, sparse where that is smaller."""
        moving = np.flatnonzero((np.abs(change) > still).any(axis=1))
        if len(moving) * SPARSE_COST > len(change):
            return self.dense(change, gl.VEC3, gl.ARRAY_BUFFER, bounds=bounds)
        moving = moving if len(moving) else np.zeros(1, np.int64)  # glTF wants one entry at least
        values = np.ascontiguousarray(change[moving], "<f4")
        return self._sparse(gl.FLOAT, values, self.places(moving, len(change)), bounds)

    def places(self, moving: Ints, count: int) -> SparsePlaces:
        """Add the numbers (k,) of the vertices of ``count`` that sparse values are of."""
        short = count <= 2**16
        indices = gl.AccessorSparseIndices(
            bufferView=self._view(moving.astype("<u2" if short else "<u4")),
            componentType=gl.UNSIGNED_SHORT if short else gl.UNSIGNED_INT,
        )
        return SparsePlaces(indices, len(moving), count)

    def quantise(
        self, values: Floats, places: SparsePlaces, bits: Literal[8, 16], *, bounds: bool = False
    ) -> int:
        """Add values (k, 3) from -1 to 1 at ``places``, zero elsewhere, as whole numbers.

        KHR_mesh_quantization stores them so: values beyond are cut off. Returns the accessor's
        number.
        """
        most = 2 ** (bits - 1) - 1
        stored = np.rint(np.clip(values, -1.0, 1.0) * most).astype(f"<i{bits // 8}")
        number = self._sparse(gl.BYTE if bits == 8 else gl.SHORT, stored, places, bounds)
        self.accessors[number].normalized = True
        return number

    def _sparse(
        self, component: int, stored: np.ndarray, places: SparsePlaces, bounds: bool
    ) -> int:
        """Add vectors at ``places``, zero elsewhere."""
        still = np.zeros((0 if places.count == places.of else 1, 3), stored.dtype)
        bounded = np.vstack([stored, still]) if bounds else None
        number = self._add(component, places.of, gl.VEC3, bounded)
        self.accessors[number].sparse = gl.Sparse(
            count=places.count,
            indices=places.indices,
            values=gl.AccessorSparseValues(bufferView=self._view(stored)),
        )
        return number

    def _view(self, stored: np.ndarray, target: int | None = None) -> int:
        self.content += b"\0" * (-len(self.content) % 4)
        view = gl.BufferView(
            buffer=0, byteOffset=len(self.content), byteLength=stored.nbytes, target=target
        )
        self.content += stored.tobytes()
        self.views.append(view)
        return len(self.views) - 1

    def _add(
        self,
        component: int,
        count: int,
        kind: str,
        bounded: np.ndarray | None,
        view: int | None = None,
    ) -> int:
        """Add an accessor with min and max, as glTF demands for positions and key times."""
        accessor = gl.Accessor(
            bufferView=view,
            byteOffset=None if view is None else 0,
            componentType=component,
            count=count,
            type=kind,
        )
        if bounded is not None:
            table = bounded.reshape(len(bounded), -1)
            accessor.min = table.min(axis=0).astype(float).tolist()
            accessor.max = table.max(axis=0).astype(float).tolist()
        self.accessors.append(accessor)
        return len(self.accessors) - 1
