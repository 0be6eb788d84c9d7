"""One direction of contraction per muscle, as several fitted expressions use it.

A fit has six numbers a muscle, a slider one. So the fitted activations A_e (m, 6), as differences
from rest, are replaced by c_ej D_j with c_ej >= 0, muscle by muscle of rank one:

    min over c, D of sum_e |c_e D - A_e|^2 in the norm J^T J + w I,

J being the skin's linear response at rest: what matters of an activation is what is seen of it. The
small w keeps what is hardly seen near the fits too.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg
import scipy.optimize

from solver.fitting.stretches import FROBENIUS
from solver.surface import Floats

ROUNDS = 30
"""Alternating solves for c and D."""

UNSEEN = 1e-2
"""The weight w, mm^2."""

JITTER = 1e-9
"""Part of the mean diagonal that makes a Gram matrix definite."""


def used_directions(activations: Floats, seen: Floats) -> tuple[Floats, Floats]:
    """Return directions D (m, 6) of unit Frobenius norm and amounts c (e, m) of 0 or more.

    ``activations`` (e, m, 6) are the fits' differences from rest, ``seen`` (6 m, 6 m) is J^T J in
    mm^2. A muscle that no expression uses has amounts of zero.
    """
    count, muscles, _ = activations.shape
    norm = seen + UNSEEN * np.diag(np.tile(FROBENIUS, muscles))
    directions, amounts = _principal(activations)
    for _ in range(ROUNDS):
        directions = _directions(activations, amounts, norm)
        size = np.sqrt((FROBENIUS * directions**2).sum(axis=1))
        directions /= np.where(size > 0.0, size, 1.0)[:, None]
        amounts = np.array([_amounts(activations[e], directions, norm) for e in range(count)])
    return directions, amounts


def _principal(activations: Floats) -> tuple[Floats, Floats]:
    """Return the main direction of every muscle by itself, and how far the fits go along it."""
    units = np.sqrt(FROBENIUS)
    axes = np.linalg.svd((activations * units).transpose(1, 0, 2), full_matrices=False)[2][:, 0]
    along = np.einsum("ejq,jq->ej", activations * units, axes)
    signs = np.where(along.sum(axis=0) < 0.0, -1.0, 1.0)
    return axes * signs[:, None] / units, np.maximum(along * signs, 0.0)


def _directions(activations: Floats, amounts: Floats, norm: Floats) -> Floats:
    """Return the best D (m, 6) for amounts (e, m); zero where none is used."""
    scales = np.repeat(amounts, 6, axis=1)
    gram = norm * (scales.T @ scales)
    right = sum(
        scale * (norm @ each.ravel()) for scale, each in zip(scales, activations, strict=True)
    )
    return _solved(gram, np.asarray(right)).reshape(-1, 6)


def _amounts(activation: Floats, directions: Floats, norm: Floats) -> Floats:
    """Return the best amounts (m,) of at least zero of one expression's activations (m, 6)."""
    columns = scipy.linalg.block_diag(*directions[:, :, None])
    gram = columns.T @ norm @ columns
    root = np.linalg.cholesky(gram + _jitter(gram)).T
    right = scipy.linalg.solve_triangular(root, columns.T @ (norm @ activation.ravel()), trans="T")
    return np.asarray(scipy.optimize.nnls(root, right)[0])


def _solved(gram: Floats, right: Floats) -> Floats:
    return np.asarray(scipy.linalg.solve(gram + _jitter(gram), right, assume_a="pos"))


def _jitter(gram: Floats) -> Floats:
    return np.eye(len(gram)) * JITTER * max(float(np.trace(gram)) / len(gram), JITTER)
