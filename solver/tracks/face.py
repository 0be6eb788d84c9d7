"""The face as a function of blendshape weights and jaw: flesh at rest under its muscle tracks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from solver.contact import contact_potentials
from solver.fitting.face import Face
from solver.kinds.scene import STIFFNESS_PA
from solver.mechanics.boundary import Potential
from solver.mechanics.flesh import LAWS
from solver.mechanics.linear import GrowingSolver
from solver.model import SubjectModel
from solver.similarity import IDENTITY
from solver.simulation import MOMENT, Simulator
from solver.simulation.forces import Drive, FleshMotion
from solver.surface import Floats
from solver.tracks.basis import MuscleTracks, TrackPose, TrackTargets
from solver.tracks.response import TrackResponse, TrackState
from solver.tracks.springs import TrackedFlesh


@dataclass(frozen=True)
class TrackContact:
    """Contact of flesh that tracks press harder than its own muscles would."""

    # times the stiffness that it has in other faces: lips go a third as deep, in fewer steps
    firmer: float = 10.0


def track_potentials(
    model: SubjectModel, stiffness_pa: float = STIFFNESS_PA, options: TrackContact = TrackContact()
) -> list[Potential]:
    """Return what a face under tracks touches: lips, teeth and eyes; raises as contact does."""
    return contact_potentials(model, options.firmer * stiffness_pa)


class TrackFace:
    """A person's face driven by tracks, and by nothing else.

    ``potentials`` are what the skin touches, of the same ``stiffness_pa``:
    :func:`track_potentials`. ``linear`` names the linear solver; states are
    solved to ``tolerance``, or until steps are shorter than ``settled_mm``, as
    :class:`~solver.mechanics.newton.NewtonOptions` say. Raises
    :class:`~solver.errors.InputError` (``tracks.model``) for tracks of another model.
    """

    def __init__(
        self,
        model: SubjectModel,
        tracks: MuscleTracks,
        potentials: Sequence[Potential] = (),
        *,
        stiffness_pa: float = STIFFNESS_PA,
        linear: str | None = None,
        tolerance: float = MOMENT.tolerance,
        settled_mm: float = MOMENT.settled_mm,
    ) -> None:
        tracks.check(model)
        self.model = model
        self.tracks = tracks
        self.potentials = potentials
        plain = Face(model, material=LAWS[tracks.law].in_pascal(stiffness_pa), linear=linear)
        springs = tracks.shares(model), tracks.stiffness, tracks.length_mm
        self.tracked = TrackedFlesh.of(plain.flesh, *springs)
        self.face = plain.with_flesh(self.tracked.flesh)
        self.targets = TrackTargets(model, tracks)
        self._simulator = Simulator(
            self.face,
            potentials,
            [],
            dynamic=False,
            density=np.ones(len(model.tets)),
            linear=linear,
            tolerance=tolerance,
            settled_mm=settled_mm,
        )

    @cached_property
    def exact_solver(self) -> GrowingSolver:
        """What factorises exact Hessians for derivatives, in double precision."""
        flesh = self.face.flesh
        return GrowingSolver(flesh.hessian(flesh.rest, flesh.passive()))

    def rest(self) -> TrackState:
        """Return the neutral face, all controls zero; raises as :meth:`move`."""
        q = np.zeros(self.tracks.size)
        pose = self.targets.at(q)
        drive = self._drive(0.0, pose)
        motion = self._simulator.rest(drive)
        inverted = self.face.flesh.count_inverted(motion.x)
        return TrackState(q, pose, drive, motion, 0.0, 0, inverted, 0.0)

    def move(self, state: TrackState, q: Floats) -> TrackState:
        """Go from a state to controls q (K + 5,); the shorter the way, the faster.

        Raises as ``MuscleTracks.check_controls``, and :class:`~solver.errors.SolveError`
        (``simulate.*``) where the flesh finds no way.
        """
        self.tracks.check_controls(q)
        pose = self.targets.at(q)
        goal = self._drive(state.drive.time + 1.0, pose)
        found = self._simulator.step(state.motion, state.drive, goal)
        told = found.residual, found.iterations, found.inverted, found.seconds
        return TrackState(q.copy(), pose, goal, found.motion, *told)

    def state_at(self, q: Floats, x: Floats) -> TrackState:
        """Return the state under q (K + 5,) whose flesh was found at x (p, 3) before.

        Nothing is solved for. Whether it is one its derivatives tell (``tracks.no_equilibrium``).
        """
        pose = self.targets.at(q)
        motion = FleshMotion(x, np.zeros_like(x), IDENTITY)
        inverted = self.face.flesh.count_inverted(x)
        return TrackState(q, pose, self._drive(0.0, pose), motion, np.nan, 0, inverted, 0.0)

    def skin(self, state: TrackState) -> Floats:
        """Return the whole skin (V, 3) of a state."""
        return self.face.whole_skin(state.x, state.drive.jaw)

    def columns(self, state: TrackState) -> Floats:
        """Return dx/dq (p, 3, K + 5); raises as :class:`~solver.tracks.response.TrackResponse`."""
        return TrackResponse(self, state).columns()

    def skin_columns(self, state: TrackState) -> Floats:
        """Return the derivatives (V, 3, K + 5) of the whole skin; raises as :meth:`columns`."""
        return TrackResponse(self, state).skin_columns()

    def _drive(self, time: float, pose: TrackPose) -> Drive:
        controls = self.tracked.controls(pose.activations, pose.target)
        return Drive(time, controls, pose.jaw, IDENTITY)
