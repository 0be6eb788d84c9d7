"""Edits of a face, one after the other."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

import scipy.sparse as sp

from solver.edits.edited import Edited
from solver.model import SubjectModel


class Edit(Protocol):
    """A change of a person's anatomy, by what it does to all edits before it."""

    def __call__(self, before: Edited) -> Edited:
        """Return what it makes of ``before``.

        Raises :class:`~solver.errors.InputError` (``scene.*``) if it does not fit the person.
        """


def apply(edits: Iterable[Edit], model: SubjectModel, S: sp.csr_array) -> Edited:
    """Return what all ``edits``, in their order, make of a person with the S (n, m + 1)."""
    edited = Edited.nothing(model, S)
    for edit in edits:
        edited = edit(edited)
    return edited
