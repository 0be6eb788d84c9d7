"""Tracking: a face frame after frame, each from the one before.

One :class:`Tracker` holds the state and what a frame leaves to the next; an observation
says what is seen of the face, where the head is in it, and how one frame of it is fitted:
:mod:`.dense` points in the order of the face's, and labelled points of a marker system
(:mod:`solver.fitting.markers.observation`). :mod:`.frame_solver` takes the steps.
"""

from __future__ import annotations

from typing import Generic, Protocol, TypeVar

from solver.fitting.face import Face, Pose, PosedFace
from solver.fitting.tracking.frame_solver import FrameSolver, TrackingOptions

SeenT = TypeVar("SeenT")
SeenT_contra = TypeVar("SeenT_contra", contravariant=True)
MemoryT = TypeVar("MemoryT")
FitT = TypeVar("FitT")
FitT_co = TypeVar("FitT_co", covariant=True)


class Observation(Protocol[SeenT_contra, MemoryT, FitT_co]):
    """A kind of thing that is seen of a face, and the fit of one frame of it."""

    face: Face  # that is seen
    tracking: TrackingOptions  # the steps of a frame

    def begin(self, solver: FrameSolver) -> None:
        """Prepare for frames that follow on the ``solver``'s state."""

    def fit(
        self, seen: SeenT_contra, solver: FrameSolver, memory: MemoryT | None
    ) -> tuple[FitT_co, MemoryT]:
        """Fit a frame and return it with what it leaves to the next.

        ``memory`` is what the frame before left, None at the first. A frame that cannot be fitted
        leaves the ``solver`` where it was.
        """


class Tracker(Generic[SeenT, MemoryT, FitT]):
    """Fits frames in their order: ``memory`` is what the last one left, None before the first."""

    def __init__(self, observation: Observation[SeenT, MemoryT, FitT]) -> None:
        self.observation = observation
        self.face = observation.face
        self.begin(self.face.rest)

    def begin(self, state: PosedFace, memory: MemoryT | None = None) -> None:
        """Go on from a frame: its state and what it left."""
        self.solver = FrameSolver(self.face, state, self.observation.tracking)
        self.memory = memory
        self.observation.begin(self.solver)

    @property
    def state(self) -> PosedFace:
        """The face as it is in the last frame."""
        return self.solver.state

    def step(self, seen: SeenT) -> FitT:
        """Fit the next frame."""
        fit, self.memory = self.observation.fit(seen, self.solver, self.memory)
        return fit

    def go_to(self, pose: Pose) -> None:
        """Go to a pose, as of a frame that was fitted before.

        Raises :class:`SolveError` if it cannot be reached; the state stays what it was.
        """
        self.solver.go_to(pose)
