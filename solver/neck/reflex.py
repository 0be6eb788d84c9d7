"""The reflex layer: at every time step, muscles that are longer than planned are excited more.

The voluntary layer leaves a plan for each muscle: length l_0, rate l_1 and its change l_2 at the
start of its tick, and an excitation u_0. At the time s after that

    u = u_0 + g_l (l - l_p(s))/l_r + g_v (v - l_p'(s))/l_r,   l_p = l_0 + l_1 s + l_2 s^2/2

within [0, 1], with l_r the path at rest: errors of strain and strain rate, by ``delay_s`` late. The
activation follows with a lag, da/dt = (u - a)/tau, which is shorter where it rises.

With a delay, gains must be smaller for the loop to stay stable: they go down as 1/(1 + delay/
``patience_s``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb

from solver.surface import Floats


@dataclass(frozen=True)
class ReflexOptions:
    """Gains of strain and strain rate, their delay, and the lag of activation."""

    rate_hz: float = 4000.0  # the time step is 1 of it
    strain: float = 10.0  # activation a strain of 1; 0 is no reflex
    strain_rate: float = 2.0  # activation a strain rate of 1/s
    delay_s: float = 0.0  # as published; tens of ms in people
    patience_s: float = 0.0006  # a delay by which the gains are halved
    rise_s: float = 0.010  # tau of activation
    fall_s: float = 0.040

    @property
    def step_s(self) -> float:
        """Return the time step."""
        return 1.0 / self.rate_hz

    @property
    def delay_steps(self) -> int:
        """Return the delay in whole steps."""
        return round(self.delay_s * self.rate_hz)

    @property
    def gains(self) -> tuple[float, float]:
        """Return the gains of strain and strain rate that the delay leaves."""
        kept = 1.0 / (1.0 + self.delay_s / self.patience_s)
        return self.strain * kept, self.strain_rate * kept


@nb.njit(cache=True, error_model="numpy")
def excite(
    plan: Floats,
    since: float,
    lengths: Floats,
    rates: Floats,
    late: Floats,
    place: int,
    gains: tuple[float, float],
    lags: tuple[float, float],
    step: float,
    a: Floats,
) -> None:
    """Move activations ``a`` (m,) on by a ``step``.

    ``plan`` (m, 5) has u_0, l_0, l_1, l_2 and l_r, ``since`` is s. ``late`` (d + 1, m) is the ring
    of the last reflexes, of which ``place`` is written and the next one, the oldest, read.
    """
    rows = len(late)
    for k in range(len(a)):
        u_0 = plan[k, 0]
        l_0 = plan[k, 1]
        l_1 = plan[k, 2]
        l_2 = plan[k, 3]
        rest = plan[k, 4]
        long = lengths[k] - (l_0 + l_1 * since + 0.5 * l_2 * since * since)
        fast = rates[k] - (l_1 + l_2 * since)
        late[place, k] = (gains[0] * long + gains[1] * fast) / rest
        u = min(max(u_0 + late[(place + 1) % rows, k], 0.0), 1.0)
        a[k] += step * (u - a[k]) / (lags[0] if u > a[k] else lags[1])
