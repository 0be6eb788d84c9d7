"""Forces of muscles: the published law, and one with the usual curves, as kernels and for NumPy.

Both are f = a F(l, v) + P(l, v) with the activation a in [0, 1], the length l and rate v of the
path, f in N along it. A law is a table of numbers, a row a muscle.

``SPRINGS`` (Lee and Terzopoulos 2006, as published in 2021), with strain e = (l - l_0)/l_0:

    F = max(0, k_max (l - l_m)) max(0, 1 + min(v, 0)/v_m)
    P = max(0, k_s (exp(k_c e) - 1) + k_d e')

No constant is published. Ours follow from strength F_0, optimal fibre length l_o and path l_0 at
rest: l_m = l_0 - l_o/2, k_max = F_0/(l_0 - l_m), v_m = 10 l_o/s; P reaches F_0 where the fibres are
60 % longer, and F_0/100 at a rate of l_o/s.

``CURVES`` (Hill 1938; Zajac 1989; curves of Thelen 2003), a tendon that does not stretch and
fibres of constant width w = l_o sin(alpha_o) at its end: l_f = sqrt((l - l_t)^2 + w^2), cos alpha =
(l - l_t)/l_f, and with x = l_f/l_o, u = v cos(alpha)/(10 l_o)

    F = F_0 exp(-(x - 1)^2/0.45) g(u) cos alpha
    P = F_0 (exp(5 (x - 1)/0.6) - 1)/(e^5 - 1) cos alpha
    g = (1 + u)/(1 - 4 u) for u < 0, 1 + 0.4 (5 u)/(5 u + 0.4) else

F fades out from x = 0.45 to 0.2, where filaments do not overlap; P is a straight line from x = 1.6.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba as nb
import numpy as np

from solver.neck.anatomy import MM, Neck
from solver.surface import Floats

SPRINGS = 0  # the first law, by number for compiled loops
CURVES = 1  # the second
LAWS = {"springs": SPRINGS, "curves": CURVES}
Parts = tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class HillOptions:
    """Constants of both laws, which the module's head explains."""

    law: str = "curves"  # or "springs", as published
    fastest: float = 10.0  # optimal lengths a second, shortening
    width: float = 0.45  # gamma of the active curve
    lengthening: float = 1.4  # x F_0, the most that a lengthening muscle holds
    hill: float = 0.25  # curvature of Hill's hyperbola, a/F_0
    stretch: float = 0.6  # of fibres, at which P is F_0
    growth: float = 5.0  # exponent of the passive curve
    slack: float = 0.5  # optimal lengths under rest at which the published law has no force
    drag: float = 0.01  # k_d: x F_0, at a rate of one optimal length a second


@dataclass(frozen=True)
class Muscles:
    """A law with the numbers of a neck's muscles: ``table`` (m, 10) in N, m and s."""

    law: int
    table: Floats

    @classmethod
    def of(cls, neck: Neck, options: HillOptions = HillOptions()) -> Muscles:
        """Return the muscles of a neck."""
        law = LAWS[options.law]
        o = options
        rows = []
        for each in neck.muscles:
            fibre = each.fibre * MM
            rest = each.length * MM
            most = each.strength
            if law == SPRINGS:
                growth = o.growth * rest / (o.stretch * fibre)
                stiff = most / math.expm1(o.growth)
                per_m = most / (o.slack * fibre)
                drag = o.drag * most * rest / fibre
                row = [rest, stiff, growth, drag, per_m, rest - o.slack * fibre, o.fastest * fibre]
                rows.append([*row, 0.0, 0.0, 0.0])
            else:
                wide = fibre * math.sin(each.pennation)
                row = [most, fibre, each.tendon * MM, wide, o.fastest * fibre]
                rows.append([*row, o.width, o.hill, o.lengthening, o.stretch, o.growth])
        return cls(law, np.array(rows))

    def parts(self, lengths: Floats, rates: Floats) -> Floats:
        """Return F, dF/dl, dF/dv, P, dP/dl, dP/dv of each muscle (m, 6) in N, m and s."""
        made = np.empty((len(self.table), 6))
        all_parts(self.law, self.table, lengths, rates, made)
        return made

    def forces(self, activations: Floats, lengths: Floats, rates: Floats) -> Floats:
        """Return the muscles' pulls (m,) in N."""
        parts = self.parts(lengths, rates)
        return np.asarray(activations * parts[:, 0] + parts[:, 3])


@nb.njit(cache=True, error_model="numpy")
def all_parts(law: int, table: Floats, lengths: Floats, rates: Floats, made: Floats) -> None:
    """Write each muscle's F, P and their derivatives (m, 6), as :meth:`Muscles.parts` has them."""
    for k in range(len(table)):
        if law == SPRINGS:
            parts = springs(lengths[k], rates[k], table[k])
        else:
            parts = curves(lengths[k], rates[k], table[k])
        for j in range(6):
            made[k, j] = parts[j]


@nb.njit(cache=True, error_model="numpy")
def springs(length: float, v: float, row: Floats) -> Parts:
    """Return F, dF/dl, dF/dv, P, dP/dl, dP/dv of the published law."""
    rest, stiff, growth, drag, per_m, least, fastest = row[:7]
    power = growth * (length - rest) / rest
    grown = math.exp(min(power, 10.0))
    P = stiff * (grown - 1.0) + drag * v / rest
    P_l = stiff * grown * growth / rest
    P_v = drag / rest
    if power > 10.0:
        P += stiff * grown * (power - 10.0)
    if P <= 0.0:
        P = 0.0
        P_l = 0.0
        P_v = 0.0
    if length <= least or v <= -fastest:
        return 0.0, 0.0, 0.0, P, P_l, P_v
    g, g_v = (1.0 + v / fastest, 1.0 / fastest) if v < 0.0 else (1.0, 0.0)
    F_l = per_m * (length - least)
    return F_l * g, per_m * g, F_l * g_v, P, P_l, P_v


@nb.njit(cache=True, error_model="numpy")
def curves(length: float, v: float, row: Floats) -> Parts:
    """Return F, dF/dl, dF/dv, P, dP/dl, dP/dv of the law with the usual curves."""
    most, fibre, tendon, wide, fastest, gamma, hill, most_held, stretch, growth = row
    along = length - tendon
    if along <= 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    long = math.sqrt(along * along + wide * wide)
    c = along / long
    c_l = wide * wide / (long * long * long)
    x = long / fibre
    x_l = c / fibre
    u = v * c / fastest
    u_v = c / fastest
    u_l = v * c_l / fastest
    f = math.exp(-((x - 1.0) ** 2) / gamma)
    f_x = -2.0 * (x - 1.0) / gamma * f
    s = min(max((x - 0.2) / 0.25, 0.0), 1.0)
    fade = s * s * (3.0 - 2.0 * s)
    fade_x = 6.0 * s * (1.0 - s) / 0.25
    f, f_x = f * fade, f_x * fade + f * fade_x
    if u <= -1.0:
        g = 0.0
        g_u = 0.0
    elif u < 0.0:
        g = (1.0 + u) / (1.0 - u / hill)
        g_u = (1.0 + 1.0 / hill) / (1.0 - u / hill) ** 2
    else:
        rise = (1.0 + 1.0 / hill) * u
        top = most_held - 1.0
        g = 1.0 + top * rise / (rise + top)
        g_u = top * top * (1.0 + 1.0 / hill) / (rise + top) ** 2
    p = 0.0
    p_x = 0.0
    if x > 1.0:
        end = min(x - 1.0, stretch)
        grown = math.exp(growth * end / stretch)
        p_x = growth / stretch * grown / math.expm1(growth)
        p = (grown - 1.0) / math.expm1(growth) + p_x * (x - 1.0 - end)
    F = most * f * g * c
    F_l = most * (f_x * x_l * g * c + f * g_u * u_l * c + f * g * c_l)
    F_v = most * f * g_u * u_v * c
    return F, F_l, F_v, most * p * c, most * (p_x * x_l * c + p * c_l), 0.0
