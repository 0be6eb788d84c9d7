"""Fibre muscles: one activation in [0, 1] each, a force-length curve, and flesh around them.

    E = sum_ij V_i s_ij sigma_j [ Wp(L) + a_j Wa(L) ],   L = |F_i f_ij|

over tets i and muscles j, f_ij their unit fibres at rest, s_ij fractions of the volumes and sigma_j
strengths. Forces along a fibre are dWp/dL = fp, which acts in every pose, and dWa/dL = fa (Blemker,
Pinsky, Delp 2005 after Zajac 1989), with L = 1 the length of most force:

    fp = 0 to 1, 0.05 (e^{6.6 (L - 1)} - 1) to 1.4, straight from there with the same slope
    fa = 1 - 4 d^2 to d = 0.4, 9 (d - 0.6)^2 to 0.6, else 0;   d = |L - 1|

Where their slopes jump, at L = 1 and d = 0.4, a cubic joins the curves (:class:`Curve`). With
y = F f and n = y / L the stress is s sigma f(L) n f^T, f = fp + a fa, and its derivative
s sigma [f' n n^T + f/L (I - n n^T)] (x) f f^T, whose only negative part is f' < 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numba as nb
import numpy as np
import scipy.sparse as sp
from typing_extensions import override

from solver.errors import InputError
from solver.mechanics.assembly import PAIRS
from solver.mechanics.flesh import Flesh
from solver.mechanics.terms import EnergyTerm, KeptArrays, RestingTerm, force_columns
from solver.model import SubjectModel
from solver.surface import Floats, Ints


class Curve(NamedTuple):
    """The force-length curve of all muscles, forces over a muscle's strength."""

    passive: float = 0.05
    growth: float = 6.6  # of the passive force, by stretch
    straight: float = 1.4  # stretch from which it grows evenly
    toe: float = 0.05  # stretch beyond 1 over which the passive force's slope begins
    bend: float = 0.05  # on both sides of d = 0.4, where the active force's slope is smoothed


CURVE = Curve()


class Force(NamedTuple):
    """A force along a fibre at one length: its energy, itself and its slope, by the length."""

    energy: float
    force: float
    slope: float


@nb.njit(cache=True, error_model="numpy")
def passive_force(L: float, curve: Curve) -> Force:
    """Return Wp, fp and its slope."""
    if L <= 1.0:
        return Force(0.0, 0.0, 0.0)
    d = L - 1.0
    k = curve.growth
    end = math.exp(k * curve.toe)
    force = curve.passive * (end - 1.0)
    slope = curve.passive * k * end
    toe = _join(min(d, curve.toe), curve.toe, 0.0, 0.0, force, slope)
    if d <= curve.toe:
        return toe
    top = min(d, curve.straight - 1.0)
    grown = math.exp(k * top)
    energy = toe.energy + curve.passive * ((grown - end) / k - (top - curve.toe))
    force = curve.passive * (grown - 1.0)
    slope = curve.passive * k * grown
    beyond = d - top
    return Force(
        energy + force * beyond + 0.5 * slope * beyond * beyond, force + slope * beyond, slope
    )


@nb.njit(cache=True, error_model="numpy")
def active_force(L: float, curve: Curve) -> Force:
    """Return Wa, fa and its slope; Wa is zero at L = 1."""
    d = abs(L - 1.0)
    sign = 1.0 if L >= 1.0 else -1.0
    first = 0.4 - curve.bend
    last = 0.4 + curve.bend
    near = min(d, first)
    energy = near - 4.0 / 3.0 * near**3
    if d <= first:
        return Force(sign * energy, 1.0 - 4.0 * d * d, -8.0 * sign * d)
    ends = 1.0 - 4.0 * first**2, 9.0 * (last - 0.6) ** 2
    slopes = -8.0 * first, 18.0 * (last - 0.6)
    along = min(d, last) - first
    bend = _join(along, 2.0 * curve.bend, ends[0], slopes[0], ends[1], slopes[1])
    energy += bend.energy
    if d <= last:
        return Force(sign * energy, bend.force, sign * bend.slope)
    far = min(d, 0.6) - 0.6
    energy += 3.0 * (far**3 - (last - 0.6) ** 3)
    return Force(sign * energy, 9.0 * far * far, 18.0 * sign * far)


@nb.njit(cache=True, error_model="numpy")
def _join(x: float, width: float, f0: float, s0: float, f1: float, s1: float) -> Force:
    """Return the cubic on [0, width] with these ends and slopes, its integral from 0 as energy."""
    rise = (f1 - f0) / width
    second = (3.0 * rise - 2.0 * s0 - s1) / width
    third = (s0 + s1 - 2.0 * rise) / width**2
    energy = x * (f0 + x * (s0 / 2.0 + x * (second / 3.0 + x * third / 4.0)))
    force = f0 + x * (s0 + x * (second + x * third))
    return Force(energy, force, s0 + x * (2.0 * second + 3.0 * x * third))


class _Entries(NamedTuple):
    """Fibres tet by tet, as kernels take them: entries first[k] to first[k + 1] are of tet k."""

    vertices: Ints  # (t, 4) of the tets with muscle
    first: Ints  # (t + 1,)
    muscles: Ints  # (e,)
    along: Floats  # (e, 4) 1/mm: F f = sum_v along_v x_v
    volumes: Floats  # (e,) mm^3, times the fractions
    strengths: Floats  # (m,)


@dataclass(frozen=True)
class FibreMuscles:
    """Fibre muscles in their tets: e entries, sorted by tet, of m muscles."""

    tets: Ints  # (e,)
    muscles: Ints  # (e,)
    fractions: Floats  # (e,) of the tets' volumes
    fibres: Floats  # (e, 3) of unit length
    strengths: Floats  # (m,) stresses, in the units of the flesh's mu
    sources: Ints  # (m,) the model's muscle that each one is, or is a strip of

    @classmethod
    def of(cls, model: SubjectModel, S: sp.csr_array, strengths: Floats) -> FibreMuscles:
        """Return the muscles of a model with weights ``S`` (n, m + 1) of its own pattern.

        Raises :class:`InputError` (``model.fibres``) for a model without fibres.
        """
        if model.fibres is None or len(model.fibres) != S.nnz:
            message = "the model has no fibre directions: build it again to use fibre muscles"
            raise InputError("model.fibres", message)
        tets, columns = S.tocoo().coords
        pulls = np.flatnonzero((columns > 0) & model.fibres.any(axis=1))
        kept = tets[pulls].astype(np.int64), columns[pulls].astype(np.int64) - 1
        each = np.arange(len(strengths))
        return cls(*kept, S.data[pulls], model.fibres[pulls], strengths, each)

    def scale(self, factor: Floats | float) -> FibreMuscles:
        """Return the muscles with their whole curves times ``factor``, of each (m,) or of all."""
        return replace(self, strengths=self.strengths * factor)


class FibreTerm(EnergyTerm):
    """The energy of fibre muscles by a (m,); its entries are the tets with muscle."""

    def __init__(self, flesh: Flesh, muscles: FibreMuscles, curve: Curve = CURVE) -> None:
        self.muscles = muscles
        self.curve = curve
        self.tets, first = np.unique(muscles.tets, return_index=True)
        self._gradients = flesh.gradients[muscles.tets]
        self._whole = flesh.volumes[muscles.tets]
        self._size = flesh.rest.size
        self._entries = _Entries(
            np.ascontiguousarray(flesh.tets[self.tets]),
            np.append(first, len(muscles.tets)),
            muscles.muscles,
            np.einsum("evi,ei->ev", self._gradients, muscles.fibres),
            self._whole * muscles.fractions,
            np.ascontiguousarray(muscles.strengths, dtype=np.float64),
        )
        self.vertices = self._entries.vertices

    def stretches(self, x: Floats) -> Floats:
        """Return L of every entry, (e,)."""
        return self._at(x).L

    @override
    def energy(self, x: Floats, controls: Floats) -> float:
        out = np.empty(len(self.tets))
        _energies(self._entries, np.ascontiguousarray(x), controls, self.curve, out)
        return float(out.sum())

    @override
    def forces(self, x: Floats, controls: Floats) -> Floats:
        out = self._kept.forces
        _forces(self._entries, np.ascontiguousarray(x), controls, self.curve, out)
        return out

    @override
    def blocks(
        self, x: Floats, controls: Floats, *, project: float = 0.0, some: Ints | None = None
    ) -> Floats:
        which = np.arange(len(self.tets)) if some is None else some
        out = np.empty((len(which), PAIRS, 3, 3))
        at = np.ascontiguousarray(x), controls, self.curve
        _blocks(self._entries, *at, float(project), which, out)
        return out

    @override
    def forces_by_control(self, x: Floats, controls: Floats) -> sp.csc_array:
        """Return (3 p, m) by the activations."""
        at = self._at(x)
        return self._columns(at, self._strengths * at.active) @ self._by_muscle

    def forces_by_strength(self, x: Floats, controls: Floats) -> sp.csc_array:
        """Return the gradient's derivative by the muscles' strengths, (3 p, m)."""
        at = self._at(x)
        return self._columns(at, at.total(controls[self.muscles.muscles])) @ self._by_muscle

    def forces_by_fraction(self, x: Floats, controls: Floats) -> sp.csc_array:
        """Return the gradient's derivative by the entries' fractions, (3 p, e)."""
        at = self._at(x)
        total = self._strengths * at.total(controls[self.muscles.muscles])
        return self._columns(at, total, self._whole)

    def forces_by_rotation(self, x: Floats, controls: Floats) -> sp.csc_array:
        """Return the gradient's derivative by rotation vectors w of tets with muscle, (3 p, 3 t).

        All fibres of a tet turn, f to f + w x f; column 3 k + i is entry i of tet k's w.
        """
        at = self._at(x)
        a = controls[self.muscles.muscles]
        force = at.total(a)
        slope = at.passive_slope + a * at.active_slope
        # df = e_i x f, and dy = F df
        df = np.cross(np.eye(3)[None], self.muscles.fibres[:, None])
        dN = np.einsum("evk,eik->eiv", self._gradients, df)
        dy = np.einsum("eiv,evd->eid", dN, x[self._vertices])
        by_length = np.divide(force, at.L, out=np.zeros_like(force), where=at.L > 0.0)
        stretched = np.einsum("eid,ed->ei", dy, at.n)[:, :, None] * at.n[:, None]
        pull = by_length[:, None, None] * dy
        pull += (slope - by_length)[:, None, None] * stretched
        turned = (force[:, None] * at.n)[:, None, None] * dN[..., None]
        turned += self._entries.along[:, None, :, None] * pull[:, :, None]
        turned *= (self._entries.volumes * self._strengths)[:, None, None, None]
        places = np.repeat(np.arange(len(self.tets)), np.diff(self._entries.first))
        columns = (3 * places[:, None] + np.arange(3)).ravel()
        vertices = np.repeat(self._vertices, 3, axis=0)
        entries = force_columns(turned.reshape(-1, 4, 3), vertices, x.size)
        return entries @ _selection(columns, 3 * len(self.tets))

    def _at(self, x: Floats) -> _Measured:
        """Return what the fibres do at x (p, 3)."""
        y = np.einsum("ev,evd->ed", self._entries.along, x[self._vertices])
        L = np.linalg.norm(y, axis=1)
        curves = np.empty((4, len(y)))
        _fill_curves(L, self.curve, curves)
        n = np.divide(y, L[:, None], out=np.zeros_like(y), where=L[:, None] > 0.0)
        return _Measured(L, n, *curves)

    def _columns(self, at: _Measured, force: Floats, volumes: Floats | None = None) -> sp.csc_array:
        """Return the nodal forces (3 p, e) of every entry pulling with ``force`` (e,)."""
        volumes = self._entries.volumes if volumes is None else volumes
        pull = (volumes * force)[:, None] * at.n
        forces = self._entries.along[:, :, None] * pull[:, None]
        return force_columns(forces, self._vertices, self._size)

    @cached_property
    def _vertices(self) -> Ints:
        """The vertices (e, 4) of every entry."""
        return np.repeat(self._entries.vertices, np.diff(self._entries.first), axis=0)

    @cached_property
    def _strengths(self) -> Floats:
        """Every entry's strength, (e,)."""
        return np.asarray(self.muscles.strengths[self.muscles.muscles])

    @cached_property
    def _by_muscle(self) -> sp.csr_array:
        return _selection(self.muscles.muscles, len(self.muscles.strengths))

    @cached_property
    def _kept(self) -> KeptArrays:
        return KeptArrays(len(self.tets))


class _Measured(NamedTuple):
    """Lengths L (e,), directions n (e, 3), and curves (e,) of all entries at one state."""

    L: Floats
    n: Floats
    passive: Floats
    passive_slope: Floats
    active: Floats
    active_slope: Floats

    def total(self, a: Floats) -> Floats:
        """Return the force over the strength for the entries' activations (e,)."""
        return np.asarray(self.passive + a * self.active)


def driven_by_muscles(flesh: Flesh, muscles: FibreMuscles, curve: Curve = CURVE) -> Flesh:
    """Return a flesh whose controls are the activations (m,) of fibre muscles, zero at rest."""
    relaxed = RestingTerm(flesh.elastic, flesh.passive())
    passive = np.zeros(len(muscles.strengths))
    return flesh.driven_by(relaxed, passive).plus(FibreTerm(flesh, muscles, curve))


def _selection(columns: Ints, count: int) -> sp.csr_array:
    """Return (e, count) with a one in each row, at ``columns`` (e,)."""
    entries = np.arange(len(columns))
    return sp.csr_array((np.ones(len(columns)), (entries, columns)), (len(columns), count))


@nb.njit(cache=True, error_model="numpy")
def _fill_curves(L: Floats, curve: Curve, out: Floats) -> None:
    """Fill ``out`` (4, e) with fp, its slope, fa and its slope."""
    for e in range(len(L)):
        passive = passive_force(L[e], curve)
        active = active_force(L[e], curve)
        out[0, e] = passive.force
        out[1, e] = passive.slope
        out[2, e] = active.force
        out[3, e] = active.slope


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _deform(x: Floats, tet: Ints, along: Floats) -> tuple[float, float, float, float]:
    """Return y = F f of one entry, and its length."""
    y0 = 0.0
    y1 = 0.0
    y2 = 0.0
    for v in range(4):
        y0 += along[v] * x[tet[v], 0]
        y1 += along[v] * x[tet[v], 1]
        y2 += along[v] * x[tet[v], 2]
    return y0, y1, y2, math.sqrt(y0 * y0 + y1 * y1 + y2 * y2)


@nb.njit(cache=True, parallel=True, error_model="numpy")
def _energies(entries: _Entries, x: Floats, a: Floats, curve: Curve, out: Floats) -> None:
    """Fill ``out`` (t,) with the energy of each tet's fibres."""
    for t in nb.prange(len(entries.vertices)):
        total = 0.0
        for e in range(entries.first[t], entries.first[t + 1]):
            _, _, _, L = _deform(x, entries.vertices[t], entries.along[e])
            j = entries.muscles[e]
            energy = passive_force(L, curve).energy + a[j] * active_force(L, curve).energy
            total += entries.volumes[e] * entries.strengths[j] * energy
        out[t] = total


@nb.njit(cache=True, parallel=True, error_model="numpy")
def _forces(entries: _Entries, x: Floats, a: Floats, curve: Curve, out: Floats) -> None:
    """Fill ``out`` (t, 4, 3) with the gradient by each tet's vertices."""
    for t in nb.prange(len(entries.vertices)):
        for v in range(4):
            for i in range(3):
                out[t, v, i] = 0.0
        for e in range(entries.first[t], entries.first[t + 1]):
            y0, y1, y2, L = _deform(x, entries.vertices[t], entries.along[e])
            j = entries.muscles[e]
            force = passive_force(L, curve).force + a[j] * active_force(L, curve).force
            if force == 0.0 or L == 0.0:
                continue
            pull = entries.volumes[e] * entries.strengths[j] * force / L
            for v in range(4):
                part = pull * entries.along[e, v]
                out[t, v, 0] += part * y0
                out[t, v, 1] += part * y1
                out[t, v, 2] += part * y2


@nb.njit(cache=True, parallel=True, error_model="numpy")
def _blocks(
    entries: _Entries, x: Floats, a: Floats, curve: Curve, project: float, which: Ints, out: Floats
) -> None:
    """Fill ``out`` (k, PAIRS, 3, 3) with the Hessian blocks of the tets ``which`` (k,)."""
    for k in nb.prange(len(which)):
        t = which[k]
        out[k] = 0.0
        for e in range(entries.first[t], entries.first[t + 1]):
            y0, y1, y2, L = _deform(x, entries.vertices[t], entries.along[e])
            if L == 0.0:
                continue
            j = entries.muscles[e]
            passive = passive_force(L, curve)
            active = active_force(L, curve)
            across = (passive.force + a[j] * active.force) / L
            along = passive.slope + a[j] * active.slope
            if across < 0.0:
                across *= 1.0 - project
            if along < 0.0:
                along *= 1.0 - project
            w = entries.volumes[e] * entries.strengths[j]
            n = (y0 / L, y1 / L, y2 / L)
            pair = 0
            for u in range(4):
                for v in range(u, 4):
                    part = w * entries.along[e, u] * entries.along[e, v]
                    for r in range(3):
                        out[k, pair, r, r] += part * across
                        for c in range(3):
                            out[k, pair, r, c] += part * (along - across) * n[r] * n[c]
                    pair += 1
