"""From one equilibrium of a per-tet model to the next, along a Gauss-Newton step."""

from __future__ import annotations

from dataclasses import dataclass

from solver.errors import SolveError
from solver.fitting import stretches
from solver.fitting.face import Pose, State
from solver.fitting.per_tet.damping import Damping
from solver.fitting.per_tet.objective import Objective
from solver.fitting.per_tet.saddle import Quadratic, SaddleSolver
from solver.fitting.per_tet.tissue import Tissue
from solver.surface import Floats

CORRECTIONS = 8
"""Newton steps to an equilibrium nearby."""


@dataclass(frozen=True)
class Step:
    """A step (a, b) from a state where f is ``value``, and the damping if it is taken as it is."""

    state: State
    value: float
    model: Quadratic
    a: Floats
    b: Floats
    lowered: Damping

    @classmethod
    def of(
        cls,
        objective: Objective,
        solver: SaddleSolver,
        state: State,
        value: float,
        damping: Damping,
    ) -> Step:
        """Minimise the damped Gauss-Newton model at a state."""
        model = objective.quadratic(state, damping)
        return cls(state, value, model, *damping.limited(state.pose.a, *solver.step(model, state)))

    def pose(self, part: float = 1.0) -> Pose:
        """Return the pose that a part of the step leads to."""
        before = self.state.pose
        return Pose(stretches.moved(before.a, part * self.a), before.b + part * self.b)

    def descend(self, objective: Objective, tries: int) -> tuple[State, Damping] | None:
        """Return the first state along the step, halved and halved, with a lower f, and a damping.

        None if there is none in so many ``tries``.
        """
        for halving in range(tries):
            try:
                trial = self._reach(objective.tissue, self.pose(0.5**halving))
            except SolveError:
                continue
            if trial.equilibrium.minimum and objective.value(trial) < self.value:
                return trial, self.lowered.raised(2.0**halving)
        return None

    def _reach(self, tissue: Tissue, pose: Pose) -> State:
        """Go to the equilibrium of a pose nearby; raises :class:`SolveError`.

        Approaching is not enough here: single tets are so soft that the flesh may buckle on the
        rest of the way, and the derivatives would be those of another equilibrium.
        """
        before = self.state.pose
        motion = self.model.response.motion(pose.a - before.a, pose.b - before.b)
        free = motion[self.model.response.free]
        near = tissue.face.approach(tissue.selection, self.state, free, pose)
        return tissue.face.settle(tissue.selection, pose, near.x, max_iterations=CORRECTIONS)
