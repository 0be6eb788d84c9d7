"""The template's tetrahedra: made once, carried into every person."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import scipy.sparse as sp

from solver.archive import Arrays, csr_arrays, csr_from
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class TemplateMesh:
    """Tetrahedra of the flesh in the neutral pose; mm.

    edge_mm
        The edge length on the face that was asked for.
    vertices
        (p, 3) rest vertices.
    tets
        (n, 4) vertex numbers, every volume positive.
    cranium, mandible, cut, sliding
        Vertex numbers, disjoint; see :class:`solver.model.SubjectModel`.
    embedded, embedding
        (e,) skin vertices that follow the flesh, and their (e, p) barycentric rows.
    attached_mandible
        Skin vertices that move rigidly with the mandible.
    weights
        (n, m + 1) initial S, which every person shares.
    """

    edge_mm: float
    vertices: Floats
    tets: Ints
    cranium: Ints
    mandible: Ints
    cut: Ints
    sliding: Ints
    embedded: Ints
    embedding: sp.csr_array
    attached_mandible: Ints
    weights: sp.csr_array

    def arrays(self) -> Arrays:
        """Return the mesh as named arrays, for a file."""
        arrays: Arrays = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, sp.csr_array):
                arrays |= csr_arrays(field.name, value)
            else:
                arrays[field.name] = np.asarray(value)
        return arrays

    @classmethod
    def from_arrays(cls, arrays: Arrays, muscle_count: int) -> TemplateMesh:
        """Return the mesh that :meth:`arrays` described."""
        matrices = {
            "embedding": csr_from("embedding", arrays, len(arrays["vertices"])),
            "weights": csr_from("weights", arrays, muscle_count + 1),
        }
        plain = {f.name: arrays[f.name] for f in fields(cls) if f.name not in matrices}
        return cls(**{**plain, **matrices, "edge_mm": float(arrays["edge_mm"])})
