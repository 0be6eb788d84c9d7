"""Equilibria of the sliders' poses, each from the nearest one that is known."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from solver.errors import SolveError
from solver.fitting.face import Face, State
from solver.mechanics.equilibrium import Equilibrium, Stiffness
from solver.rig.preview.controls import Controls
from solver.rig.preview.poses import Slid
from solver.surface import Floats


@dataclass(frozen=True)
class Sample:
    """A pose of the sliders with its equilibrium: vertices x (p, 3) and the skin (n, 3)."""

    slid: Slid
    x: Floats
    skin: Floats


Listener = Callable[[int], None]
"""Called with the number of poses that have been tried."""


class Simulator:
    """Finds equilibria of a face's sliders; ``fitted`` (p, 3) are those of whole expressions."""

    def __init__(
        self,
        face: Face,
        S: sp.csr_array,
        controls: Controls,
        rest: State,
        fitted: Mapping[str, Floats],
    ) -> None:
        self._face = face
        self._S = S
        self._controls = controls
        self._last, self._last_values = rest, np.zeros(len(controls))
        self._known = [(self._last_values, rest.x)]
        self._known += [(controls.presets[name], x) for name, x in fitted.items()]

    def solve(self, poses: Sequence[Slid], deadline: float, listen: Listener) -> list[Sample]:
        """Return the samples of ``poses``, but of those that are out of reach.

        Those that are not begun at the ``deadline`` (of :func:`time.monotonic`) are left out too.
        """
        samples = []
        for number, slid in enumerate(poses):
            if time.monotonic() > deadline:
                break
            try:
                state = self._move(slid.values)
            except SolveError:
                pass
            else:
                skin = self._face.whole_skin(state.x, state.pose.b)
                samples.append(Sample(slid, state.x, skin))
                self._known.append((slid.values, state.x))
            listen(number + 1)
        return samples

    def _move(self, values: Floats) -> State:
        self._last = self._face.move(self._S, self._near(values), self._controls.pose(values))
        self._last_values = values
        return self._last

    def _near(self, values: Floats) -> State:
        """Return the nearest state; only the last one still has its factorised stiffness."""
        distances = [float(np.linalg.norm(values - known)) for known, _ in self._known]
        nearest, x = self._known[int(np.argmin(distances))]
        if nearest is self._last_values:
            return self._last
        return state_at(self._face, self._S, self._controls, nearest, x)


def state_at(face: Face, S: sp.csr_array, controls: Controls, values: Floats, x: Floats) -> State:
    """Return the state of slider ``values`` (k,) with its equilibrium ``x`` (p, 3)."""
    pose = controls.pose(values)
    stiffness = Stiffness(face.flesh, face.linear, x, face.tet_activations(S, pose.a))
    return State(pose, Equilibrium(x, x, stiffness, 0.0, 0))
