"""Active and passive tissue of a face, for the per-tetrahedron activation model.

    E = sum_i V_i [f_i psi(F_i, S(a_i)) + (1 - f_i) psi(F_i, I)]

f_i is the volume fraction of muscle in tet i, sampled when the model was built (Ichim et al. 2017,
eq. 1 and 2, whose W_i are the volumes f_i V_i and (1 - f_i) V_i). A tet of both tissues is two
elements with the same vertices, so that the mechanics know nothing of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from solver.errors import InputError
from solver.fitting.drives.six_numbers import SixNumbers
from solver.fitting.face import Face
from solver.mechanics.flesh import Flesh
from solver.surface import Floats, Ints

LEAST_FRACTION = 0.05  # of a tet: with less muscle it is passive


@dataclass(frozen=True)
class Tissue:
    """A face whose active tets have activations of their own.

    The flesh of ``face`` has first all tets, those with muscle standing for their fraction of it,
    then the passive rest of these. Its S (elements, n_active + 1) has one 1 a row: every active tet
    is a muscle by itself.
    """

    face: Face
    active: Ints  # (n_active,) the tets with muscle
    # (n_active, m): v_im, the part of all muscle volume that is muscle m in tet i; the sum is one
    fractions: sp.csr_array
    fibres: Floats  # (nnz, 3) unit directions, one for each stored entry of ``fractions``

    @property
    def volumes(self) -> Floats:
        """Return v_i (n_active,), each active tet's part of all muscle volume."""
        return np.asarray(self.fractions.sum(axis=1))


def of_face(face: Face) -> Tissue:
    """Divide a face's tets by the model's initial weights.

    Raises :class:`InputError` (``model.no_fibres``, ``model.no_muscle``).
    """
    model = face.model
    if model.fibres is None:
        raise InputError("model.no_fibres", "the model has no fibres: build it again")
    tets = len(model.tets)
    row = np.repeat(np.arange(tets), np.diff(model.weights.indptr))
    muscle = (model.weights.indices > 0) & (model.weights.data > 0.0)
    fraction = np.bincount(row[muscle], model.weights.data[muscle], tets)
    is_active = fraction >= LEAST_FRACTION
    if not is_active.any():
        raise InputError("model.no_muscle", "no tetrahedron of the model has a muscle")
    active = np.flatnonzero(is_active)
    fraction = np.where(is_active, np.minimum(fraction, 1.0), 1.0)
    mixed = np.flatnonzero(fraction < 1.0)

    flesh = Flesh(
        model.rest,
        np.concatenate([model.tets, model.tets[mixed]]),
        np.flatnonzero(face.flesh.free_numbers < 0),
        face.flesh.material,
        np.concatenate([fraction, 1.0 - fraction[mixed]]),
        face.flesh.sliding,
    )
    column = np.zeros(len(flesh.tets), dtype=np.int64)
    column[active] = 1 + np.arange(len(active))
    one = np.ones(len(column)), column, np.arange(len(column) + 1)
    selection = sp.csr_array(one, shape=(len(column), len(active) + 1))

    kept = muscle & is_active[row]
    volumes = model.weights.data[kept] * face.flesh.volumes[row[kept]]
    ends = np.cumsum(np.bincount(row[kept], minlength=tets)[active])
    places = model.weights.indices[kept] - 1, np.concatenate([[0], ends])
    entries = volumes / volumes.sum(), *places
    fractions = sp.csr_array(entries, shape=(len(active), model.muscle_count))
    divided = face.driven_by(SixNumbers()).with_flesh(flesh).with_unchecked_weights(selection)
    return Tissue(divided, active, fractions, model.fibres[kept])
