"""Skin vertices follow the flesh, in the tetrahedron under the nearest outer triangle."""

from __future__ import annotations

from collections.abc import Callable

import igl
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from solver.anatomy.tetrahedra import barycentric_in_tets
from solver.drawing.head import skin_parts
from solver.model import SubjectModel
from solver.surface import Floats, Ints, Surface, adjacency, vertex_areas

# A vertex may lie this far outside its tetrahedron, as a part of its height: skin crosses over
# where nostrils meet, and then lies behind the tets it covers.
LEAST_COORDINATE = -1.5


def barycentric(points: Floats, surface: Surface) -> tuple[Ints, Floats, Floats]:
    """Return the nearest triangles (n,), coordinates (n, 3) in them and the distance (n,)."""
    squared, face, closest = igl.point_mesh_squared_distance(
        np.ascontiguousarray(points), surface.vertices, surface.faces
    )
    corners = surface.vertices[surface.faces[face]].transpose(1, 0, 2)
    return face, np.asarray(igl.barycentric_coordinates(closest, *corners)), np.sqrt(squared)


def at_nearest(points: Floats, surface: Surface, values: Floats) -> Floats:
    """Return values (v, d) of a surface's vertices where it is nearest to ``points`` (n, 3)."""
    face, shares, _ = barycentric(points, surface)
    return np.asarray(np.einsum("nk,nkd->nd", shares, values[surface.faces[face]]))


def bind_outside(
    points: Floats, vertices: Floats, tets: Ints, faces: Ints, owners: Ints
) -> tuple[Ints, Floats, Floats]:
    """Return the tets (n,) at which points (n, 3) come nearest to some ``faces`` (f, 3) of tets.

    ``owners`` (f,) are the faces' tets. With them come the barycentric coordinates (n, 4) of the
    nearest place in its tet, and the distance (n,).
    """
    face, shares, distance = barycentric(points, Surface(vertices, faces))
    tet = owners[face]
    same = tets[tet][:, :, None] == faces[face][:, None, :]
    return tet, np.einsum("nck,nk->nc", same, shares), distance


def tet_binder(vertices: Floats, tets: Ints) -> Callable[[Floats], tuple[Ints, Floats]]:
    """Return a function of points (n, 3): the tets (n,) that they follow, and their shares (n, 4).

    A point moves by the mean of its tet's corners' displacements with its shares as weights. One
    outside the mesh, where many a muscle begins, moves as the nearest point of the mesh does.
    """
    tree = igl.AABB()
    tree.init(vertices, tets)
    faces, owners, _ = igl.boundary_facets(tets)

    def bind(points: Floats) -> tuple[Ints, Floats]:
        points = np.ascontiguousarray(points)
        tet = np.array(igl.in_element(vertices, tets, points, tree), np.int64)
        shares = np.empty((len(points), 4))
        outside = tet < 0
        shares[~outside] = barycentric_in_tets(points[~outside], vertices[tets[tet[~outside]]])
        if outside.any():
            nearest = bind_outside(points[outside], vertices, tets, faces, owners)
            tet[outside], shares[outside], _ = nearest
        return tet, shares

    return bind


def rows_of(corners: Ints, shares: Floats, count: int) -> sp.csr_array:
    """Return CSR rows (n, count) with ``shares`` (n, k) in the columns ``corners`` (n, k)."""
    indptr = np.arange(0, corners.size + 1, corners.shape[1])
    parts = (shares.ravel(), corners.ravel(), indptr)
    rows = sp.csr_array(parts, shape=(len(corners), count), copy=True)
    rows.sort_indices()
    return rows


def shares_in_tets(points: Floats, vertices: Floats, corners: Ints, inside: Floats) -> Floats:
    """Return barycentric coordinates (n, 4) of points (n, 3) in given tetrahedra, bounded.

    ``corners`` (n, 4) are those of each point's tetrahedron in a mesh with ``vertices`` (p, 3), and
    ``inside`` (n, 4) are coordinates of a point in or on it. Where the point's own have one below
    :data:`LEAST_COORDINATE` they are drawn towards these: what is missed is an offset.
    """
    exact = barycentric_in_tets(points, vertices[corners])
    room = (inside - LEAST_COORDINATE) / np.maximum(inside - exact, 1e-12)
    part = np.minimum(np.where(exact < inside, room, 1.0).min(axis=1), 1.0)[:, None]
    return np.asarray(part * exact + (1.0 - part) * inside)


# Skin beyond the flesh, of ears, scalp and neck, and lashes: they follow the skin on flesh.
#
#     min_d  1/2 sum_ij (d_i - d_j)^2 + 1/2 sum_i A_i |d_i|^2 / l^2
#
# over the edges ij of the skin and the vertices i, of displacements d; those on flesh and on the
# jaw are given. So the chin's pull on the neck fades over the length l, and no edge opens where the
# flesh ends. From lashes and tear film an edge goes to the skin wherever they touch it.


TOUCH_MM = 1.0  # lashes hang on skin that is nearer


class LooseSkin:
    """The vertices ``ids`` (k,) of a model's skin that hang on flesh by edges, but lie on none.

    ``fade_mm`` is the length l: a mouth opened wide takes the neck along by centimetres.
    Vertices that are ``still`` are displaced by nothing.
    """

    def __init__(
        self, model: SubjectModel, *, fade_mm: float = 60.0, still: Ints | None = None
    ) -> None:
        skin = model.skin.vertices
        faces = model.skin.faces
        self._count = len(skin)
        edges = _edges(model)
        _, part = connected_components(edges, directed=False)
        hangs = np.isin(part, part[model.embedded])
        hangs[model.embedded] = hangs[model.attached_mandible] = False
        if still is not None:
            hangs[still] = False
        self.ids = np.flatnonzero(hangs)
        own = np.asarray(edges.sum(axis=1)) + vertex_areas(skin, faces) / fade_mm**2
        system = sp.csr_array(sp.diags_array(own) - edges)[self.ids]
        self._given = np.concatenate([model.embedded, model.attached_mandible])
        self._pull = -system[:, self._given]
        self._factor = splu(sp.csc_array(system[:, self.ids])) if len(self.ids) else None

    def follow(self, moved: Floats) -> Floats:
        """Return the displacements (k, 3) where the skin is displaced by ``moved`` (V, 3), in mm.

        Only ``moved`` on flesh and on the mandible counts. Several may lie side by side.
        """
        if self._factor is None:
            return np.empty((0, moved.shape[1]))
        return np.asarray(self._factor.solve(np.asarray(self._pull @ moved[self._given])))

    def resist(self, pulls: NDArray[np.bool_]) -> Floats:
        """Return how much skin resists where all that it hangs on moves by 1: (V,).

        It counts where loose skin ``pulls`` (k,), by the weights of the edges.
        """
        out = np.zeros(self._count)
        stays = 1.0 - self.follow(np.ones((self._count, 1)))[:, 0]
        out[self._given] = self._pull.T @ (pulls * stays)
        return out

    def adjoint(self, forces: Floats) -> Floats:
        """Return the transpose of :meth:`follow` applied to ``forces`` (k, 3): (V, 3)."""
        out = np.zeros((self._count, 3))
        if self._factor is not None:
            out[self._given] = self._pull.T @ self._factor.solve(np.ascontiguousarray(forces), "T")
        return out


def _edges(model: SubjectModel) -> sp.csr_array:
    """Return the graph (V, V) of the skin's edges, and of those by which lashes hang on it."""
    skin = model.skin.vertices
    faces = model.skin.faces
    of_lashes = skin_parts(model.skin).get("lashes", np.empty(0, np.int64))
    lashes = np.unique(faces[of_lashes])
    distance, near = cKDTree(skin[model.embedded]).query(skin[lashes])
    touch = distance < TOUCH_MM
    ends = lashes[touch], model.embedded[near[touch]]
    roots = sp.csr_array((np.ones(len(ends[0])), ends), shape=(len(skin),) * 2)
    return sp.csr_array(adjacency(faces, len(skin)) + roots + roots.T)
