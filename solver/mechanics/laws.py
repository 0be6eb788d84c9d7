"""The law of a flesh as a number that kernels branch on: one branch a law in each function.

A law is a module of :mod:`solver.mechanics.materials` with the four functions that are asked for
here, so that whatever can be simulated can be fitted too. All are of one tet: F and A are tuples
(:mod:`solver.mechanics.linalg3`), the moduli mu, lambda, kappa and the barrier's weight. A number
and a switch are cached on disk, which functions that are passed as arguments never are.
"""

from __future__ import annotations

from typing import Literal, get_args

import numba as nb

from solver.errors import InputError, quote
from solver.mechanics.linalg3 import Matrix, Symmetric
from solver.mechanics.materials import Modes, Moduli, corotated, mooney_rivlin, neo_hookean
from solver.surface import Floats

Law = Literal["corotated", "neo_hookean", "mooney_rivlin"]

# places in Law, as kernels know them
COROTATED = get_args(Law).index("corotated")
NEO_HOOKEAN = get_args(Law).index("neo_hookean")
MOONEY_RIVLIN = get_args(Law).index("mooney_rivlin")


def number(law: Law) -> int:
    """Return the number of a law; raises :class:`InputError` (``material.law``) for another."""
    if law not in get_args(Law):
        message = f"there is no law {quote(law)!r}; there are {', '.join(get_args(Law))}"
        raise InputError("material.law", message)
    return get_args(Law).index(law)


def own_moduli(law: Law, mu: Floats, lam: Floats) -> tuple[Floats, Floats]:
    """Return a law's own mu and lambda (n,) for Lame's constants at small strain."""
    if law == "mooney_rivlin":
        return mooney_rivlin.from_lame(mu, lam)
    return neo_hookean.from_lame(mu, lam) if law == "neo_hookean" else (mu, lam)


def needs_volume(law: int) -> bool:
    """Tell whether the law is undefined for activations with det A <= 0."""
    return law in (NEO_HOOKEAN, MOONEY_RIVLIN)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def density(law: int, F: Matrix, A: Symmetric, moduli: Moduli) -> float:
    """Return psi(F, A), infinite where the tet is inverted."""
    if law == COROTATED:
        return corotated.density(F, A, moduli)
    if law == MOONEY_RIVLIN:
        return mooney_rivlin.density(F, A, moduli)
    return neo_hookean.density(F, A, moduli)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def stress(law: int, F: Matrix, A: Symmetric, moduli: Moduli) -> Matrix:
    """Return d psi/dF, the first Piola-Kirchhoff stress."""
    if law == COROTATED:
        return corotated.stress(F, A, moduli)
    if law == MOONEY_RIVLIN:
        return mooney_rivlin.stress(F, A, moduli)
    return neo_hookean.stress(F, A, moduli)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def hessian_modes(
    law: int, F: Matrix, A: Symmetric, moduli: Moduli, project: float, modes: Modes
) -> tuple[int, Symmetric, Matrix]:
    """Write the modes of d2 psi/dF2 = I (x) B + sum_k left_k right_k^T + d(cof F)/dF [H].

    ``modes`` are filled; their sum is symmetric. Returned are their number, B, for <dF, dF B>, and
    H, for the cofactor's derivative with H in the place of F (a law of det F alone has H = g F).
    ``project`` goes from 0, the Hessian itself, to 1, where each part is projected by itself, the
    sum is positive semi-definite and H is zero.
    """
    if law == COROTATED:
        return corotated.hessian_modes(F, A, moduli, project, modes)
    if law == MOONEY_RIVLIN:
        return mooney_rivlin.hessian_modes(F, A, moduli, project, modes)
    return neo_hookean.hessian_modes(F, A, moduli, project, modes)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def stress_by_activation(
    law: int, F: Matrix, A: Symmetric, moduli: Moduli, modes: Modes, out: Floats
) -> None:
    """Write d(stress)/da, shape (6, 9): the change by each entry of a in A = S(a).

    ``modes`` are scratch.
    """
    if law == COROTATED:
        corotated.stress_by_activation(F, A, moduli, modes, out)
    elif law == MOONEY_RIVLIN:
        mooney_rivlin.stress_by_activation(F, A, moduli, modes, out)
    else:
        neo_hookean.stress_by_activation(F, A, moduli, modes, out)
