"""Lips and teeth as one small mesh that moves with the tets: what contact is measured and kept on.

Which lip a vertex belongs to is read off the skin itself (:mod:`solver.anatomy.contact_regions`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import igl
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from solver.anatomy.contact_regions import LOWER, UPPER, lip_sides
from solver.anatomy.embedding import rows_of
from solver.model import SubjectModel
from solver.surface import Floats, Ints


def area_weighted_normals(points: Floats, faces: Ints) -> Floats:
    """Return outward unit normals (s, 3), zero where a vertex's triangles have none."""
    area = igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_AREA
    normals: Floats = igl.per_vertex_normals(points, faces, area)
    return np.where(np.isfinite(normals), normals, 0.0)


@dataclass(frozen=True)
class Mandible:
    """Four vertices ``corners`` (4,) that span the mandible, and where they are at ``rest`` (4, 3).

    What rides on it needs only x, not b: p = sum_k w_k x_k, with affine shares w that stay.
    """

    corners: Ints
    rest: Floats

    @classmethod
    def of(cls, model: SubjectModel) -> Mandible:
        """Choose vertices that are far apart: each the farthest from the span of those before."""
        points = model.rest[model.mandible]
        span = points - points.mean(axis=0)
        chosen = [int(np.argmax(np.linalg.norm(span, axis=1)))]
        span = points - points[chosen[0]]
        for _ in range(3):
            distance = np.linalg.norm(span, axis=1)
            chosen.append(int(np.argmax(distance)))
            along = span[chosen[-1]] / distance[chosen[-1]]
            span = span - np.outer(span @ along, along)
        corners: Ints = model.mandible[chosen]
        return cls(corners, model.rest[corners])

    def shares(self, points: Floats) -> Floats:
        """Return the shares w (k, 4) of points (k, 3), the mandible being at rest."""
        return _affine(points, self.rest)[0]

    def seen(self, points: Floats, x: Floats) -> tuple[Floats, Floats, Floats]:
        """See points (k, 3) of the head from the mandible, the vertices being at x (p, 3).

        Returns where they were with the mandible at rest (k, 3); their shares w (k, 4); and the
        matrix (3, 3) that takes a step of a point, or of it off its place on the mandible,
        dp - sum_k w_k dx_k, to that of the first.
        """
        shares, by_point = _affine(points, x[self.corners])
        return shares @ self.rest, shares, self.rest.T @ by_point


def _affine(points: Floats, corners: Floats) -> tuple[Floats, Floats]:
    """Return the shares (k, 4) of points in a tet's corners (4, 3), and dw/dp (4, 3)."""
    inverse = np.linalg.inv(np.vstack([corners.T, np.ones(4)]))
    return points @ inverse[:, :3].T + inverse[:, 3], inverse[:, :3]


@dataclass(frozen=True)
class MouthOptions:
    """Distances in the neutral face by which skin belongs to a mouth."""

    reach_mm: float = 12.0  # skin takes part that is this near to the other lip
    teeth_reach_mm: float = 6.0  # or to teeth,
    lips_mm: float = 8.0  # and to a region that is named a lip
    around_mm: float = 20.0  # skin this near to the lips says what is inside them
    middle: float = 0.2  # part of a lip's half width, from its middle, that says which lip it is


LIPS, AROUND, UPPER_TEETH, LOWER_TEETH = range(4)


@dataclass(frozen=True)
class Mouth:
    """The parts of a model's skin that touch where the mouth closes, numbered on their own.

    Positions are ``rows @ x + offset`` at the tets' vertices x. Lower teeth are affine combinations
    of four mandible vertices; upper teeth stay.
    """

    skin: Ints  # (m,) skin vertices, sorted
    label: Ints  # (m,) LIPS, the skin AROUND them, UPPER_TEETH or LOWER_TEETH
    faces: Ints  # (f, 3) triangles between them; those of flesh and of teeth share no vertex
    rows: sp.csr_array  # (m, p)
    offset: Floats  # (m, 3)
    side: Ints  # (m,) the lip that a vertex belongs to, UPPER or LOWER; 0 is neither

    @classmethod
    def of(cls, model: SubjectModel, options: MouthOptions = MouthOptions()) -> Mouth | None:
        """Find the mouth of a model; None if its regions do not name both lips, on its flesh."""
        named = [model.region(f"{lip}_lip") for lip in ("upper", "lower")]
        if not all(np.isin(lip, model.embedded).any() for lip in named):
            return None
        vertices = model.skin.vertices
        faces = model.skin.faces
        flesh = model.flesh_faces
        teeth = [model.region(f"{jaw}_teeth") for jaw in ("upper", "lower")]
        lips, side = _lips(model, flesh, np.concatenate(teeth), options)
        around = np.intersect1d(flesh, np.flatnonzero(_within(vertices, lips, options.around_mm)))
        label = np.full(len(vertices), -1)
        label[around] = AROUND
        label[lips] = LIPS
        label[teeth[0]] = UPPER_TEETH
        label[teeth[1]] = LOWER_TEETH
        skin = np.flatnonzero(label >= 0)
        own = np.vstack([flesh, faces[(label[faces] >= UPPER_TEETH).all(axis=1)]])
        own = np.searchsorted(skin, own[(label[own] >= 0).all(axis=1)])
        side = np.where(label[skin] == LIPS, side[skin], 0)
        return cls(skin, label[skin], own, *_following(model, skin), side)

    def points(self, x: Floats) -> Floats:
        """Return the positions (m, 3) at the tets' vertices x (p, 3)."""
        return np.asarray(self.rows @ x + self.offset)

    def normals(self, points: Floats) -> Floats:
        """Return outward unit normals (m, 3), zero at a vertex without triangles."""
        return area_weighted_normals(points, self.faces)

    @cached_property
    def flesh(self) -> Ints:
        """Return the triangles of lips and skin, (f, 3)."""
        return self.faces_of(LIPS, AROUND)

    @cached_property
    def rings(self) -> tuple[Ints, Ints]:
        """Return the triangles of ``flesh`` around each vertex: CSR (m + 1,) and (3 f,)."""
        order = np.argsort(self.flesh, axis=None, kind="stable")
        count = len(self.label)
        return np.searchsorted(self.flesh.ravel()[order], np.arange(count + 1)), order // 3

    def faces_of(self, *labels: int) -> Ints:
        """Return the triangles of some of the parts, (f, 3)."""
        return np.ascontiguousarray(self.faces[np.isin(self.label[self.faces], labels).all(axis=1)])


def _lips(
    model: SubjectModel, flesh: Ints, teeth: Ints, options: MouthOptions
) -> tuple[Ints, Ints]:
    """Return the skin vertices of the flesh's triangles (g, 3) that may touch a lip or teeth.

    And which lip each of the skin's vertices (V,) belongs to.
    """
    skin = model.skin.vertices
    upper = _middle(model, "upper_lip", 1.0, options.middle)
    side = lip_sides(skin, flesh, upper, _middle(model, "lower_lip", -1.0, options.middle))
    near = _within(skin, teeth, options.teeth_reach_mm)
    for own in (UPPER, LOWER):
        near |= (side == own) & _within(skin, np.flatnonzero(side == -own), options.reach_mm)
    named = np.concatenate([model.regions["upper_lip"], model.regions["lower_lip"]])
    lips = np.intersect1d(flesh, np.flatnonzero(near & _within(skin, named, options.lips_mm)))
    return lips, side


def _middle(model: SubjectModel, lip: str, up: float, width: float) -> Ints:
    """Return vertices on the middle of a lip, on its half that is away from the other one."""
    ids: Ints = np.intersect1d(model.regions[lip], model.embedded)
    skin = model.skin.vertices[ids]
    across = np.abs(skin[:, 0] - model.jaw.origin[0])
    inner = across <= max(width * across.max(), across.min())
    height = up * skin[:, 1]
    return np.asarray(ids[inner & (height >= np.median(height[inner]))])


def _within(skin: Floats, ids: Ints, reach: float) -> NDArray[np.bool_]:
    """Tell which skin vertices lie nearer than ``reach`` to the given ones."""
    return np.asarray(cKDTree(skin[ids]).query(skin, distance_upper_bound=reach)[0] < reach)


def _following(model: SubjectModel, skin: Ints) -> tuple[sp.csr_array, Floats]:
    """Return the rows and offsets by which skin vertices follow flesh, mandible or cranium."""
    in_flesh = np.isin(skin, model.embedded)
    on_jaw = np.isin(skin, model.attached_mandible)
    offset = model.skin.vertices[skin].copy()
    mandible = Mandible.of(model)
    shares = mandible.shares(offset[on_jaw])
    rigid = rows_of(np.tile(mandible.corners, (len(shares), 1)), shares, len(model.rest))
    number = np.searchsorted(model.embedded, skin[in_flesh])
    offset[on_jaw] = 0.0
    offset[in_flesh] = model.offset[number]
    moving = np.concatenate([np.flatnonzero(in_flesh), np.flatnonzero(on_jaw)])
    put = rows_of(moving[:, None], np.ones((len(moving), 1)), len(skin)).T
    return sp.csr_array(put @ sp.vstack([model.embedding[number], rigid])), offset
