"""Frames of a recording that are fitted exactly: as dense points of the shapes' own skin."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from solver.animation import FrameChanges
from solver.animation.blendshapes import DrivenShapes, ShapedPose
from solver.errors import InputError, SolveError, quote_names
from solver.fitting.activation import unseen_regulariser
from solver.fitting.face import Face, Pose
from solver.fitting.interior_point import FeasibleSet
from solver.fitting.tracking import Tracker
from solver.fitting.tracking.dense import DensePoints, SeenPoints
from solver.mechanics.flesh import IDENTITY
from solver.surface import Floats


@dataclass(frozen=True)
class ShapesAtRest:
    """Shapes by ``names`` that move nothing: frames that are all fitted are played upon these."""

    names: tuple[str, ...]
    muscles: int

    def pose_of(self, _weights: Floats, _limits: FeasibleSet | None = None) -> ShapedPose:
        """Return the rest, whatever the weights are."""
        return ShapedPose(np.tile(IDENTITY, (self.muscles, 1)), np.zeros(5))


@dataclass(frozen=True)
class MixtureFitOptions:
    """When a mixture counts as fitted."""

    refit_above_mm: float = np.inf  # mean distance above which it is linearised anew and fitted on
    gained: float = 0.02  # part of that distance below which nothing more is to be gained
    rounds: int = 4  # of a frame's steps at most


class MixtureTracker:
    """Fits mixtures of shapes, ``motions`` (e, k, 3) of the face's points in mm, one after another.

    There is no contact in them: a simulation adds it. One mixture is further from the next than
    frames are, so that a frame's few steps are taken again until they gain no more. Where that ends
    far off, as where muscles are at their limits, sensitivities of other mixtures say too little of
    what is left to gain: those of where it has come to go on from there.
    """

    def __init__(
        self, face: Face, motions: Floats, options: MixtureFitOptions = MixtureFitOptions()
    ) -> None:
        self.face = face
        self._options = options
        self._motions = motions
        self._neutral = face.model.skin.vertices[face.model.face]
        self._everywhere = np.ones(len(face.model.face))
        self.tracker = Tracker(DensePoints(face, unseen_regulariser(face)))

    def fit(self, weights: Floats, begin: Pose | None = None) -> MixtureFit | None:
        """Return the fit of a mixture (e,); None if it cannot be fitted.

        It begins at a pose, activations and a free jaw, if there is one, else at the last fit.
        """
        if begin is not None:
            with suppress(SolveError):
                self.tracker.go_to(self.face.pose_of(begin.a, begin.b))
        points = self._neutral + np.tensordot(weights, self._motions, 1)
        found = self._settle(points)
        if found is not None and found.off_mm > self._options.refit_above_mm:
            self.tracker.solver.expire()
            again = self._settle(points)
            if again is not None and again.off_mm < found.off_mm:
                return again
        return found

    def _settle(self, points: Floats) -> MixtureFit | None:
        """Fit points (k, 3) until a frame's steps gain no more; None if they cannot be fitted."""
        given = self._options
        found = self._step(points)
        if found is None:
            return None
        for _ in range(given.rounds - 1):
            before = found
            again = self._step(points)
            if again is None:
                break
            found = min(before, again, key=lambda fit: fit.off_mm)
            if (1.0 + given.gained) * found.off_mm >= before.off_mm:
                break
        return found

    def _step(self, points: Floats) -> MixtureFit | None:
        fit = self.tracker.step(SeenPoints(points, self._everywhere))
        if fit.status != "fitted" or fit.target is None:
            return None
        face = self.face
        state = fit.state
        off = fit.target.distances(face.face_points(state.x))
        skin = face.whole_skin(state.x, state.pose.b)
        jaw = face.five_jaw_numbers(state.pose.b)
        return MixtureFit(state.pose.a, jaw, skin, float(off.mean()))


@dataclass(frozen=True, eq=False)
class MixtureFit:
    """A mixture, fitted: ``activations`` (m, 6), the free ``jaw`` (5,), and the ``skin`` (v, 3).

    ``off_mm`` is the mean distance of the face to what the shapes add up to.
    """

    activations: Floats
    jaw: Floats
    skin: Floats
    off_mm: float


def fit_frames(
    face: Face,
    shapes: DrivenShapes,
    motions: Mapping[str, Floats],
    weights: Floats,
    chosen: NDArray[np.bool_],
    limits: FeasibleSet | None = None,
    listen: Callable[[int], None] = lambda _count: None,
) -> tuple[FrameChanges, NDArray[np.bool_]]:
    """Fit the ``chosen`` (f,) of frames with ``weights`` (f, e) of ``shapes``.

    Return what that adds to the shapes' own poses, and which frames (f,) were fitted: the others
    stay as the shapes have them.

    ``motions`` are the shapes' (k, 3) on the face, mm; ``limits`` those within which the shapes'
    poses are played. A fit begins at the frame before where that
    was fitted as well, else at the shapes' own pose. ``listen`` hears of the number that are done.
    Raises :class:`InputError` (``controls.model``) for shapes that have no motion.
    """
    if strangers := [name for name in shapes.names if name not in motions]:
        names = ", ".join(quote_names(strangers))
        reason = f"the template has no {names}, which the controls were learned of"
        advice = "give that template, or learn the controls again"
        raise InputError("controls.model", f"{reason}: {advice}", found=strangers)
    tracker = MixtureTracker(face, np.array([motions[name] for name in shapes.names]))
    muscles = len(face.model.muscle_names)
    activations = np.zeros((len(weights), muscles, 6))
    jaws = np.zeros((len(weights), 5))
    fitted = np.zeros(len(weights), bool)
    for count, frame in enumerate(np.flatnonzero(chosen).tolist()):
        begin = shapes.pose_of(weights[frame], limits)
        follows = frame and fitted[frame - 1]
        found = tracker.fit(weights[frame], None if follows else Pose(begin.a, begin.jaw))
        if found is not None:
            fitted[frame] = True
            activations[frame] = found.activations - begin.a
            jaws[frame] = found.jaw - begin.jaw
        listen(count + 1)
    return FrameChanges(activations, jaws), fitted
