"""Weights of shapes frame after frame of a performance, each fitted from the one before.

Frames are seen, and the head is told from the face, as muscles' are
(:class:`solver.fitting.tracking.dense.HeadAndFace`). What lags behind there does not here: flesh
under tracks has exact derivatives by its few controls for the price of a step.
"""

from __future__ import annotations

from typing import Generic

import numpy as np

from solver.errors import SolveError
from solver.fitting.objective import SkinDistance, Target
from solver.fitting.tracking.dense import DenseFit, HeadAndFace, SeenPoints, coverage_of
from solver.similarity import IDENTITY, Similarity
from solver.surface import Floats
from solver.tracks.fit import ShapeFace, State, TrackFitOptions, fit


class ShapeTracker(Generic[State]):
    """Fits frames in their order; ``state`` and ``head`` are those of the last one."""

    def __init__(
        self, face: ShapeFace[State], points: HeadAndFace, options: TrackFitOptions
    ) -> None:
        self.face = face
        self._points = points
        self._options = options
        self.state = face.rest()
        self.head = IDENTITY

    def begin(self, q: Floats, head: Similarity) -> None:
        """Go on from the controls q (K + 5,) and the head of a frame that was fitted before.

        Raises :class:`SolveError` if they cannot be reached; the face stays what it was.
        """
        self.head = head
        self.state = self.face.move(self.state, q)

    def step(self, seen: SeenPoints) -> DenseFit[State]:
        """Fit the next frame; one that cannot be keeps what the frame before had."""
        before = self.state
        coverage = coverage_of(seen)
        if not self._points.sees(seen):
            return DenseFit(before, self.head, "unseen", coverage)

        def points() -> Floats:
            return self.face.face.face_points(self.state.x)

        def go(target: Target) -> int:
            data = SkinDistance(self.face.face, target)
            found = fit(self.face, data, self.state, self._options, before=before.q)
            self.state = found.point
            return found.steps

        try:
            target, self.head, steps = self._points.fit(seen, self.head, points, go)
        except (SolveError, np.linalg.LinAlgError):
            self.state = before
            return DenseFit(before, self.head, "kept", coverage)
        return DenseFit(self.state, self.head, "fitted", coverage, steps, target)
