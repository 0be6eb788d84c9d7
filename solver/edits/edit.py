"""Edits of a face, one after the other."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

import scipy.sparse as sp

from solver.edits.edited import Edited
from solver.errors import InputError
from solver.model import SubjectModel

LEAST_GROWTH, MOST_GROWTH = 0.5, 1.8
"""Lengths over those at rest that flesh may have with all edits: flesh that grows more finds no
rest."""


class Edit(Protocol):
    """A change of a person's anatomy, by what it does to all edits before it."""

    def __call__(self, before: Edited) -> Edited:
        """Return what it makes of ``before``.

        Raises :class:`~solver.errors.InputError` (``scene.*``) if it does not fit the person.
        """


def apply(edits: Iterable[Edit], model: SubjectModel, S: sp.csr_array) -> Edited:
    """Return what all ``edits``, in their order, make of a person with the S (n, m + 1).

    Raises :class:`~solver.errors.InputError` as they do, and ``scene.growth`` where together they
    make flesh grow or shrink out of all measure.
    """
    edited = Edited.nothing(model, S)
    for edit in edits:
        edited = edit(edited)
        least, most = float(edited.growth.min()), float(edited.growth.max())
        if least < LEAST_GROWTH or most > MOST_GROWTH:
            found = least if least < LEAST_GROWTH else most
            raise InputError(
                "scene.growth",
                f"the edits together make flesh grow to {found:.2f} of its length: it can be "
                f"{LEAST_GROWTH} to {MOST_GROWTH}",
                found=round(found, 3),
            )
    return edited
