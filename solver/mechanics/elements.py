"""Kernels over all tetrahedra: energy, nodal forces, Hessian blocks, and their derivatives by A.

Every kernel takes :class:`Elements`, positions ``x`` (p, 3) and mostly activations ``a`` (n, 6),
and fills an array with one entry per tet; sums are left to :mod:`solver.mechanics.assembly`. The
shape functions sum to one: what belongs to a tet's first vertex is minus the sum over the others.
"""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np

from solver.mechanics import laws
from solver.mechanics.linalg3 import Matrix, Symmetric, determinant, dot, symmetric_determinant
from solver.mechanics.materials import BARRIER_START, MOST_MODES, Modes, Moduli
from solver.surface import Floats, Ints

CHUNK = 512  # tets that share one scratch space: enough to make its allocation free


class Elements(NamedTuple):
    """Tetrahedra of one law, each with moduli of its own, the law's, in stress units."""

    tets: Ints  # (n, 4)
    N: Floats  # (n, 4, 3) gradients of the shape functions, 1/mm
    volume: Floats  # (n,) at rest, mm^3
    mu: Floats  # (n,)
    lam: Floats  # (n,)
    kappa: Floats  # (n,)
    barrier_weight: Floats  # (n,)
    law: int  # its number (:mod:`solver.mechanics.laws`)

    def take(self, some: Ints) -> Elements:
        """Return some of the tets."""
        return self._replace(**{name: getattr(self, name)[some] for name in self._fields[:-1]})


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def deformation_gradient(x: Floats, tet: Ints, N: Floats) -> Matrix:
    """Return F = sum_v x_v (grad N_v)^T of one tet."""
    o = tet[0]
    p = tet[1]
    q = tet[2]
    r = tet[3]
    ax = x[p, 0] - x[o, 0]
    ay = x[p, 1] - x[o, 1]
    az = x[p, 2] - x[o, 2]
    bx = x[q, 0] - x[o, 0]
    by = x[q, 1] - x[o, 1]
    bz = x[q, 2] - x[o, 2]
    cx = x[r, 0] - x[o, 0]
    cy = x[r, 1] - x[o, 1]
    cz = x[r, 2] - x[o, 2]
    return (
        ax * N[1, 0] + bx * N[2, 0] + cx * N[3, 0],
        ax * N[1, 1] + bx * N[2, 1] + cx * N[3, 1],
        ax * N[1, 2] + bx * N[2, 2] + cx * N[3, 2],
        ay * N[1, 0] + by * N[2, 0] + cy * N[3, 0],
        ay * N[1, 1] + by * N[2, 1] + cy * N[3, 1],
        ay * N[1, 2] + by * N[2, 2] + cy * N[3, 2],
        az * N[1, 0] + bz * N[2, 0] + cz * N[3, 0],
        az * N[1, 1] + bz * N[2, 1] + cz * N[3, 1],
        az * N[1, 2] + bz * N[2, 2] + cz * N[3, 2],
    )


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def activation(a: Floats) -> Symmetric:
    """Return S(a) of one tet."""
    return a[0], a[1], a[2], a[3], a[4], a[5]


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def moduli_of(mesh: Elements, e: int) -> Moduli:
    """Return the moduli of one tet."""
    return mesh.mu[e], mesh.lam[e], mesh.kappa[e], mesh.barrier_weight[e]


@nb.njit(cache=True, error_model="numpy")
def empty_modes() -> Modes:
    """Return room for the modes of one tet."""
    return Modes(np.empty((MOST_MODES, 9)), np.empty((MOST_MODES, 9)), np.empty((5, 3, 3)))


@nb.njit(cache=True, parallel=True, error_model="numpy")
def jacobians(mesh: Elements, x: Floats, out: Floats) -> None:
    """Fill ``out`` (n,) with det F."""
    for e in nb.prange(len(mesh.tets)):
        out[e] = determinant(deformation_gradient(x, mesh.tets[e], mesh.N[e]))


@nb.njit(cache=True, parallel=True, error_model="numpy")
def min_jacobian_ratio(mesh: Elements, x: Floats, y: Floats) -> float:
    """Return min J(y) / min(J(x), J0) over all elements, J0 being the barrier's start."""
    least = np.inf
    for e in nb.prange(len(mesh.tets)):
        before = min(determinant(deformation_gradient(x, mesh.tets[e], mesh.N[e])), BARRIER_START)
        after = determinant(deformation_gradient(y, mesh.tets[e], mesh.N[e]))
        least = min(least, after / before)
    return least


@nb.njit(cache=True, parallel=True, error_model="numpy")
def min_activated_volume(a: Floats) -> float:
    """Return the least det A of activations ``a`` (n, 6)."""
    least = np.inf
    for e in nb.prange(len(a)):
        least = min(least, symmetric_determinant(activation(a[e])))
    return least


@nb.njit(cache=True, parallel=True, error_model="numpy")
def energies(mesh: Elements, x: Floats, a: Floats, out: Floats) -> None:
    """Fill ``out`` (n,) with V psi; infinite where a tet is inverted."""
    for e in nb.prange(len(mesh.tets)):
        F = deformation_gradient(x, mesh.tets[e], mesh.N[e])
        psi = laws.density(mesh.law, F, activation(a[e]), moduli_of(mesh, e))
        out[e] = mesh.volume[e] * psi


@nb.njit(cache=True, parallel=True, error_model="numpy")
def forces(mesh: Elements, x: Floats, a: Floats, out: Floats) -> None:
    """Fill ``out`` (n, 4, 3) with the energy's gradient by the four vertices."""
    N = mesh.N
    for e in nb.prange(len(mesh.tets)):
        F = deformation_gradient(x, mesh.tets[e], N[e])
        P = laws.stress(mesh.law, F, activation(a[e]), moduli_of(mesh, e))
        for i in range(3):
            total = 0.0
            for v in range(1, 4):
                force = mesh.volume[e] * (
                    P[3 * i] * N[e, v, 0] + P[3 * i + 1] * N[e, v, 1] + P[3 * i + 2] * N[e, v, 2]
                )
                out[e, v, i] = force
                total += force
            out[e, 0, i] = -total


@nb.njit(cache=True, parallel=True, error_model="numpy")
def hessian_blocks(mesh: Elements, x: Floats, a: Floats, project: float, out: Floats) -> None:
    """Fill ``out`` (n, PAIRS, 3, 3) with the Hessian blocks of each pair of vertices.

    A mode W w^T of the Hessian by F contributes V (W grad N_u) (w grad N_v)^T; ``project`` says how
    far the modes are projected (:func:`solver.mechanics.laws.hessian_modes`).
    """
    n = len(mesh.tets)
    N = mesh.N
    for chunk in nb.prange((n + CHUNK - 1) // CHUNK):
        modes = empty_modes()
        left = modes.left
        right = modes.right
        p = np.empty((MOST_MODES, 9))
        q = np.empty((MOST_MODES, 9))
        K = np.empty((9, 9))
        for e in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            F = deformation_gradient(x, mesh.tets[e], N[e])
            count, B, H = laws.hessian_modes(
                mesh.law, F, activation(a[e]), moduli_of(mesh, e), project, modes
            )
            V = mesh.volume[e]
            for k in range(count):
                for v in range(3):
                    n0 = N[e, v + 1, 0]
                    n1 = N[e, v + 1, 1]
                    n2 = N[e, v + 1, 2]
                    for i in range(3):
                        j = 3 * i
                        p[k, 3 * v + i] = V * (
                            left[k, j] * n0 + left[k, j + 1] * n1 + left[k, j + 2] * n2
                        )
                        q[k, 3 * v + i] = (
                            right[k, j] * n0 + right[k, j + 1] * n1 + right[k, j + 2] * n2
                        )
            for r in range(9):
                for c in range(9):
                    K[r, c] = 0.0
                for k in range(count):
                    scale = p[k, r]
                    for c in range(9):
                        K[r, c] += scale * q[k, c]
            for v in range(3):
                n0 = V * N[e, v + 1, 0]
                n1 = V * N[e, v + 1, 1]
                n2 = V * N[e, v + 1, 2]
                b0 = B[0] * n0 + B[1] * n1 + B[2] * n2
                b1 = B[1] * n0 + B[3] * n1 + B[4] * n2
                b2 = B[2] * n0 + B[4] * n1 + B[5] * n2
                for u in range(v + 1):
                    value = N[e, u + 1, 0] * b0 + N[e, u + 1, 1] * b1 + N[e, u + 1, 2] * b2
                    for i in range(3):
                        K[3 * u + i, 3 * v + i] += value
            if dot(H, H) != 0.0:
                add_cofactor_derivative(H, N[e], V, K)
            spread(K, out[e])


@nb.njit(cache=True, error_model="numpy")
def add_cofactor_derivative(F: Matrix, N: Floats, scale: float, K: Floats) -> None:
    """Add scale d2(det F)/dx_u dx_v to the upper blocks of ``K`` (9, 9), vertices 1 to 3.

    It is linear in F. det F = f_0 . (f_1 x f_2) in its rows f_i, so d2/df_i df_j applied to
    (g_u, g_v) is +-f_k . (g_u x g_v) for the remaining row k.
    """
    for u in range(2):
        for v in range(u + 1, 3):
            g = N[u + 1]
            h = N[v + 1]
            x0 = g[1] * h[2] - g[2] * h[1]
            x1 = g[2] * h[0] - g[0] * h[2]
            x2 = g[0] * h[1] - g[1] * h[0]
            for k in range(3):
                value = scale * (F[3 * k] * x0 + F[3 * k + 1] * x1 + F[3 * k + 2] * x2)
                i = (k + 1) % 3
                j = (k + 2) % 3
                K[3 * u + i, 3 * v + j] += value
                K[3 * u + j, 3 * v + i] -= value


@nb.njit(cache=True, error_model="numpy")
def spread(K: Floats, out: Floats) -> None:
    """Write the blocks ``out`` (PAIRS, 3, 3) from the upper ones of vertices 1 to 3, (9, 9)."""
    for i in range(3):
        for j in range(3):
            b11 = K[i, j]
            b12 = K[i, 3 + j]
            b13 = K[i, 6 + j]
            b22 = K[3 + i, 3 + j]
            b23 = K[3 + i, 6 + j]
            b33 = K[6 + i, 6 + j]
            b21 = K[j, 3 + i]
            b31 = K[j, 6 + i]
            b32 = K[3 + j, 6 + i]
            b01 = -b11 - b21 - b31
            b02 = -b12 - b22 - b32
            b03 = -b13 - b23 - b33
            out[1, i, j] = b01
            out[2, i, j] = b02
            out[3, i, j] = b03
            out[4, i, j] = b11
            out[5, i, j] = b12
            out[6, i, j] = b13
            out[7, i, j] = b22
            out[8, i, j] = b23
            out[9, i, j] = b33
    for i in range(3):
        for j in range(3):
            # 00 = -(10 + 20 + 30), the transposes of 01, 02 and 03
            out[0, i, j] = -out[1, j, i] - out[2, j, i] - out[3, j, i]


@nb.njit(cache=True, parallel=True, error_model="numpy")
def forces_by_activation(mesh: Elements, x: Floats, a: Floats, out: Floats) -> None:
    """Fill ``out`` (n, 4, 3, 6): the nodal forces' derivative by the tet's activation a."""
    n = len(mesh.tets)
    N = mesh.N
    for chunk in nb.prange((n + CHUNK - 1) // CHUNK):
        modes = empty_modes()
        D = np.empty((6, 9))
        for e in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            F = deformation_gradient(x, mesh.tets[e], N[e])
            A = activation(a[e])
            moduli = moduli_of(mesh, e)
            laws.stress_by_activation(mesh.law, F, A, moduli, modes, D)
            for i in range(3):
                for q in range(6):
                    total = 0.0
                    for v in range(1, 4):
                        force = mesh.volume[e] * (
                            D[q, 3 * i] * N[e, v, 0]
                            + D[q, 3 * i + 1] * N[e, v, 1]
                            + D[q, 3 * i + 2] * N[e, v, 2]
                        )
                        out[e, v, i, q] = force
                        total += force
                    out[e, 0, i, q] = -total
