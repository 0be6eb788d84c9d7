"""Kernels over all tetrahedra: energy, nodal forces, stiffness blocks, and their derivatives by A.

Every kernel takes positions ``x`` (p, 3), ``tets`` (n, 4), shape-function gradients ``N``
(n, 4, 3), rest volumes ``volume`` (n,), activations ``a`` (n, 6), the material arrays ``mu``,
``lam``, ``kappa`` and ``stiffness`` (n,), and fills an array with one entry per tet. Scattering is
left to the caller, so tets are independent and the loops run on all threads.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from solver.mechanics.material import (
    MODES,
    density,
    hessian_modes,
    stress,
    stress_by_activation,
    symmetric,
)
from solver.surface import Floats, Ints

CHUNK = 512
"""Tets that share one scratch space; large enough to make its allocation free."""


@nb.njit(cache=True, error_model="numpy")
def deformation_gradient(x: Floats, tet: Ints, N: Floats, F: Floats) -> None:
    """Write F = sum_a x_a (grad N_a)^T, (3, 3), of one tet."""
    for i in range(3):
        for j in range(3):
            F[i, j] = (
                x[tet[0], i] * N[0, j]
                + x[tet[1], i] * N[1, j]
                + x[tet[2], i] * N[2, j]
                + x[tet[3], i] * N[3, j]
            )


@nb.njit(cache=True, parallel=True, error_model="numpy")
def deformation_gradients(x: Floats, tets: Ints, N: Floats, out: Floats) -> None:
    """Fill ``out`` (n, 3, 3) with the deformation gradients."""
    for e in nb.prange(len(tets)):
        deformation_gradient(x, tets[e], N[e], out[e])


@nb.njit(cache=True, parallel=True, error_model="numpy")
def energies(
    x: Floats,
    tets: Ints,
    N: Floats,
    volume: Floats,
    a: Floats,
    mu: Floats,
    lam: Floats,
    kappa: Floats,
    stiffness: Floats,
    out: Floats,
) -> None:
    """Fill ``out`` (n,) with V psi; infinite where a tet is inverted."""
    n = len(tets)
    for chunk in nb.prange((n + CHUNK - 1) // CHUNK):
        work = np.empty((6, 3, 3))
        F = np.empty((3, 3))
        A = np.empty((3, 3))
        for e in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            deformation_gradient(x, tets[e], N[e], F)
            symmetric(a[e], A)
            out[e] = volume[e] * density(F, A, mu[e], lam[e], kappa[e], stiffness[e], work)


@nb.njit(cache=True, parallel=True, error_model="numpy")
def forces(
    x: Floats,
    tets: Ints,
    N: Floats,
    volume: Floats,
    a: Floats,
    mu: Floats,
    lam: Floats,
    kappa: Floats,
    stiffness: Floats,
    out: Floats,
) -> None:
    """Fill ``out`` (n, 4, 3) with the energy's gradient by the four vertices."""
    n = len(tets)
    for chunk in nb.prange((n + CHUNK - 1) // CHUNK):
        work = np.empty((6, 3, 3))
        F = np.empty((3, 3))
        A = np.empty((3, 3))
        P = np.empty((3, 3))
        for e in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            deformation_gradient(x, tets[e], N[e], F)
            symmetric(a[e], A)
            stress(F, A, mu[e], lam[e], kappa[e], stiffness[e], work, P)
            for v in range(4):
                for i in range(3):
                    out[e, v, i] = volume[e] * (
                        P[i, 0] * N[e, v, 0] + P[i, 1] * N[e, v, 1] + P[i, 2] * N[e, v, 2]
                    )


@nb.njit(cache=True, parallel=True, error_model="numpy")
def stiffness_blocks(
    x: Floats,
    tets: Ints,
    N: Floats,
    volume: Floats,
    a: Floats,
    mu: Floats,
    lam: Floats,
    kappa: Floats,
    stiffness: Floats,
    project: bool,
    out: Floats,
) -> None:
    """Fill ``out`` (n, 4, 4, 3, 3) with the Hessian blocks of each pair of vertices.

    A mode W contributes V c (W grad N_a) (W grad N_b)^T, so the 12x12 element matrix is a handful
    of outer products. The curvature of det F, needed where the barrier acts, is the skew matrix of
    F's action: d2(det F) couples rows i and j of F by the third.
    """
    n = len(tets)
    for chunk in nb.prange((n + CHUNK - 1) // CHUNK):
        work = np.empty((6, 3, 3))
        F = np.empty((3, 3))
        A = np.empty((3, 3))
        c = np.empty(MODES)
        W = np.empty((MODES, 3, 3))
        p = np.empty((4, 3))
        for e in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            K = out[e]
            deformation_gradient(x, tets[e], N[e], F)
            symmetric(a[e], A)
            count, curvature = hessian_modes(
                F, A, mu[e], lam[e], kappa[e], stiffness[e], project, work, c, W
            )
            for u in range(4):
                for v in range(u, 4):
                    dot = N[e, u, 0] * N[e, v, 0] + N[e, u, 1] * N[e, v, 1]
                    dot += N[e, u, 2] * N[e, v, 2]
                    for i in range(3):
                        for j in range(3):
                            K[u, v, i, j] = 0.0
                        K[u, v, i, i] = 2.0 * mu[e] * dot
            for k in range(count):
                for u in range(4):
                    for i in range(3):
                        p[u, i] = (
                            W[k, i, 0] * N[e, u, 0]
                            + W[k, i, 1] * N[e, u, 1]
                            + W[k, i, 2] * N[e, u, 2]
                        )
                for u in range(4):
                    for v in range(u, 4):
                        for i in range(3):
                            scaled = c[k] * p[u, i]
                            for j in range(3):
                                K[u, v, i, j] += scaled * p[v, j]
            if curvature != 0.0:
                add_determinant_curvature(F, N[e], curvature, K)
            for u in range(4):
                for v in range(u, 4):
                    for i in range(3):
                        for j in range(3):
                            K[u, v, i, j] *= volume[e]
                            if v > u:
                                K[v, u, j, i] = K[u, v, i, j]


@nb.njit(cache=True, error_model="numpy")
def add_determinant_curvature(F: Floats, N: Floats, scale: float, K: Floats) -> None:
    """Add scale d2(det F)/dx_u dx_v to the upper blocks of ``K`` (4, 4, 3, 3).

    det F = f_0 . (f_1 x f_2) in its rows f_i, so d2/df_i df_j applied to (g_u, g_v) is
    +-f_k . (g_u x g_v) for the remaining row k.
    """
    for u in range(4):
        for v in range(u + 1, 4):
            x0 = N[u, 1] * N[v, 2] - N[u, 2] * N[v, 1]
            x1 = N[u, 2] * N[v, 0] - N[u, 0] * N[v, 2]
            x2 = N[u, 0] * N[v, 1] - N[u, 1] * N[v, 0]
            for k in range(3):
                value = scale * (F[k, 0] * x0 + F[k, 1] * x1 + F[k, 2] * x2)
                i, j = (k + 1) % 3, (k + 2) % 3
                K[u, v, i, j] += value
                K[u, v, j, i] -= value


@nb.njit(cache=True, parallel=True, error_model="numpy")
def forces_by_activation(
    x: Floats,
    tets: Ints,
    N: Floats,
    volume: Floats,
    a: Floats,
    mu: Floats,
    kappa: Floats,
    out: Floats,
) -> None:
    """Fill ``out`` (n, 4, 3, 6): the nodal forces' derivative by the tet's activation a."""
    n = len(tets)
    for chunk in nb.prange((n + CHUNK - 1) // CHUNK):
        work = np.empty((6, 3, 3))
        F = np.empty((3, 3))
        A = np.empty((3, 3))
        D = np.empty((3, 3, 6))
        for e in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            deformation_gradient(x, tets[e], N[e], F)
            symmetric(a[e], A)
            stress_by_activation(F, A, mu[e], kappa[e], work, D)
            for v in range(4):
                for i in range(3):
                    for q in range(6):
                        out[e, v, i, q] = volume[e] * (
                            D[i, 0, q] * N[e, v, 0]
                            + D[i, 1, q] * N[e, v, 1]
                            + D[i, 2, q] * N[e, v, 2]
                        )


@nb.njit(cache=True)
def scatter_blocks(blocks: Floats, slots: Ints, row_length: Ints, data: Floats) -> None:
    """Add element blocks (n, 4, 4, 3, 3) into CSR ``data``.

    ``slots`` (n, 4, 4) is where a block's first entry goes, or -1 where a vertex is held fixed;
    ``row_length`` (n, 4) how many entries the rows of a tet's vertex have.
    """
    data[:] = 0.0
    for e in range(len(blocks)):
        for u in range(4):
            length = row_length[e, u]
            for v in range(4):
                slot = slots[e, u, v]
                if slot < 0:
                    continue
                for i in range(3):
                    start = slot + i * length
                    for j in range(3):
                        data[start + j] += blocks[e, u, v, i, j]
