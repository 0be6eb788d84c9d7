"""Skin of a neck between a head that moves and a torso that stands still.

On the skin u solves Laplace's equation, 0 at the open rim and 1 where skin lies on the skull; in
the flesh it does likewise, 1 at the bones and as on the skin at the skin. A place s(u) from 0 to 8
along torso, C7 ... C1, head (:data:`~solver.neck.anatomy.BODIES`) is one between two of these, with
which a point goes:

    x = ((1 - f) M_k + f M_(k+1)) p,    k + f = s

(linear blend skinning with two bones a point, as glTF has it). So the rim is still, the head is
rigid, and what lies between turns by the vertebrae beside it. A joint that takes a greater share of
the head's turns has a wider part of the skin: with s = 8 u half of a turn to the side, that of C1
on C2, would be wrung out of an eighth of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from solver.anatomy.embedding import LooseSkin
from solver.mechanics.flesh import shape_gradients
from solver.mechanics.harmonic import HarmonicExtension, laplacian
from solver.model import SubjectModel
from solver.neck.anatomy import JOINTS, Neck
from solver.similarity import move_each, move_each_back
from solver.surface import Floats, Ints, adjacency


@dataclass(frozen=True)
class NeckSkinOptions:
    """Where skin is the skull's, and how near the flesh comes to the skin's places."""

    under_bone_mm: float = 8.0  # skin so far below the jaw's border is still the skull's
    back_part: float = 0.3  # of the mandible, by its length, that has its angles
    nape_above_mm: float = 20.0  # of the nape's border, where muscles end, above the head's joint
    # of skin, 2 mm thick: 0.5 MPa, between the 0.42 and 0.85 of Agache and others (1980)
    membrane_pa_mm: float = 1e6
    skin_weight: float = 1e3  # of the flesh's places at the skin, by the mean diagonal


@dataclass(frozen=True, eq=False)
class NeckSkin:
    """Places along the bodies, from 0 (torso) to 8 (head), of what a person's neck is made of."""

    model: SubjectModel
    rim: Ints  # (k,) skin vertices that stand still
    places: Floats  # (V,) of the skin
    flesh: Floats  # (p,) of the flesh's vertices
    loose: LooseSkin  # how skin beyond the flesh follows it: the rim does not

    @classmethod
    def of(
        cls,
        model: SubjectModel,
        neck: Neck,
        rim: Ints,
        options: NeckSkinOptions = NeckSkinOptions(),
    ) -> NeckSkin:
        """Return the places of a person, whose skin ends in a ``rim``, around a placed ``neck``.

        See :mod:`solver.neck.place`.
        """
        skull = on_skull(model, neck.centres[-1], options)
        skull[rim] = False
        u = _on_skin(model, rim, skull)
        widths = neck.shares.mean(axis=1)  # wider where a joint turns more
        knots = np.concatenate([[0.0], np.cumsum(widths[:-1]), [1.0]])
        skin, flesh = (
            np.interp(each, knots, np.arange(JOINTS + 1.0))
            for each in (u, _in_flesh(model, u, options))
        )
        return cls(model, rim, skin, flesh, LooseSkin(model, still=rim))

    def blends(self, matrices: Floats, places: Floats) -> Floats:
        """Return what takes rest points at ``places`` (n,) along, (n, 4, 4), by (9, 4, 4)."""
        bones, weights = two_bones(places)
        return np.asarray(np.einsum("nk,nkij->nij", weights, matrices[bones]))

    def skin(self, matrices: Floats) -> Floats:
        """Return the skin (V, 3) as the bodies alone have it, by their ``matrices`` (9, 4, 4)."""
        return move_each(self.blends(matrices, self.places), self.model.skin.vertices)

    def carry_flesh(self, matrices: Floats) -> Floats:
        """Return the flesh's vertices (p, 3) as the bodies alone have them."""
        return move_each(self.blends(matrices, self.flesh), self.model.rest)

    def pull(self, options: NeckSkinOptions = NeckSkinOptions()) -> Floats:
        """Return how stiffly the neck's skin pulls each vertex of the flesh (p,), in Pa mm.

        It is the skin that follows the flesh (:class:`LooseSkin`), as a membrane: so it pulls most
        at tips of the flesh, which have much of it around them.
        """
        model = self.model
        pulls = self.loose.resist(self.places[self.loose.ids] < JOINTS)
        shared = model.embedding.T @ pulls[model.embedded]
        return np.asarray(options.membrane_pa_mm * np.maximum(shared, 0.0))

    def unposed(self, matrices: Floats, skin: Floats) -> Floats:
        """Return the skin (V, 3) at rest of which the bodies make ``skin`` (V, 3)."""
        return move_each_back(self.blends(matrices, self.places), skin)


def two_bones(places: Floats) -> tuple[Ints, Floats]:
    """Return the bodies (n, 2) beside ``places`` (n,) from 0 to 8, and their weights (n, 2)."""
    under = np.minimum(places.astype(np.int64), JOINTS - 1)
    part = places - under
    return np.stack([under, under + 1], axis=1), np.stack([1.0 - part, part], axis=1)


def on_skull(
    model: SubjectModel, joint: Floats, options: NeckSkinOptions = NeckSkinOptions()
) -> NDArray[np.bool_]:
    """Tell which skin vertices (V,) are the skull's: above chin, angles of the jaw, and nape.

    From the side, the border is a line from the lowest point of the chin over the angles of the
    jaw, a little lower as flesh lies there, to the nape a little above the head's ``joint``.
    """
    skin = model.skin.vertices
    bone = model.rest[model.mandible]
    if "mandible" in model.bones:
        bone = model.bones["mandible"].vertices
    near = bone[:, 2].min()
    far = bone[:, 2].max()
    back = bone[bone[:, 2] < near + options.back_part * (far - near)]
    angle = back[back[:, 1].argmin()]
    chin = bone[bone[:, 1].argmin()]
    lower = np.array([0.0, options.under_bone_mm, 0.0])
    nape = np.array([0.0, joint[1] + options.nape_above_mm, skin[:, 2].min()])
    line = np.array([nape, angle - lower, chin - lower])
    height = np.interp(skin[:, 2], line[:, 2], line[:, 1])
    return np.asarray(skin[:, 1] >= height)


def _on_skin(model: SubjectModel, rim: Ints, skull: NDArray[np.bool_]) -> Floats:
    """Return u (V,): harmonic between the ``rim`` and ``skull``, 1 on what hangs on neither."""
    skin = model.skin
    count = len(model.skin.vertices)
    _, part = connected_components(adjacency(skin.faces, count), directed=False)
    given = skull | (part != part[rim[0]])
    values = given.astype(np.float64)
    given[rim] = True
    matrix = sp.csr_array(-igl.cotmatrix(skin.vertices, skin.faces))
    field = HarmonicExtension(matrix, given)(values)
    # at obtuse triangles the discrete field may leave the values that it lies between
    return np.clip(field, 0.0, 1.0)


def _in_flesh(model: SubjectModel, u: Floats, options: NeckSkinOptions) -> Floats:
    """Return u (p,) in the flesh: harmonic between bones and skin, which has ``u`` (V,)."""
    gradients, volumes = shape_gradients(model.rest, model.tets)
    matrix = laplacian(gradients, volumes, model.tets, len(model.rest))
    given = np.zeros(len(model.rest), bool)
    for bone in (model.cranium, model.mandible, model.sliding):
        given[bone] = True
    weights = np.full(len(model.embedded), options.skin_weight * matrix.diagonal().mean())
    extend = HarmonicExtension(matrix, given, model.embedding, weights)
    # of u - 1, which is zero at the bones
    return np.clip(1.0 + extend(targets=u[model.embedded] - 1.0), 0.0, 1.0)
