"""The template's tetrahedra: made once, carried into every person."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import scipy.sparse as sp

from solver.anatomy.embedding import rows_of, shares_in_tets
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
    embedded, embedded_in, shares
        (e,) skin vertices that follow the flesh, the tets (e,) under them, and the (e, 4)
        barycentric coordinates of their nearest point on the flesh's outside, none negative.
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
    embedded_in: Ints
    shares: Floats
    attached_mandible: Ints
    weights: sp.csr_array

    @property
    def surface_rows(self) -> sp.csr_array:
        """Return rows (e, p) that carry each embedded vertex's point on the flesh's outside."""
        return rows_of(self.tets[self.embedded_in], self.shares, len(self.vertices))

    def embedding(self, skin: Floats) -> sp.csr_array:
        """Return rows (e, p) that carry the embedded vertices of ``skin`` (n, 3) themselves."""
        corners = self.tets[self.embedded_in]
        shares = shares_in_tets(skin[self.embedded], self.vertices, corners, self.shares)
        return rows_of(corners, shares, len(self.vertices))

    def arrays(self) -> Arrays:
        """Return the mesh as named arrays, for a file."""
        plain = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "weights"}
        return {name: np.asarray(value) for name, value in plain.items()} | csr_arrays(
            "weights", self.weights
        )

    @classmethod
    def from_arrays(cls, arrays: Arrays, muscle_count: int) -> TemplateMesh:
        """Return the mesh that :meth:`arrays` described."""
        plain = {f.name: arrays[f.name] for f in fields(cls) if f.name != "weights"}
        weights = csr_from("weights", arrays, muscle_count + 1)
        return cls(**{**plain, "edge_mm": float(arrays["edge_mm"]), "weights": weights})
