"""A person who plays recordings in benchmarks: rig, learned controls, the template's own shapes."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import scipy.sparse as sp

from benchmarks import subject_fits, subjects
from solver.anatomy.skin_points import SkinPoints
from solver.animation.blendshapes import driven_motions
from solver.animation.controls import Controls
from solver.animation.controls.learn import LEAST_PAIRS, LearnOptions, learn
from solver.animation.controls.maps import ShapeSizes
from solver.animation.controls.mixtures import Mixtures
from solver.animation.controls.pairs import Walks, solve_pairs
from solver.fitting.activation import UNSEEN_STOP, fit, unseen_regulariser
from solver.fitting.face import Face, PosedFace
from solver.fitting.objective import SkinDistance, Target
from solver.landmarker import landmarker_file
from solver.rig import Rig
from solver.surface import Floats


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that say who plays."""
    subjects.add_options(parser)
    subjects.add_controls(parser)
    parser.add_argument("--rig", type=Path, help="rig.npz: read if there, else left in it")
    parser.add_argument("--learned", type=Path, help="controls.npz of the rig, likewise")


SKIPPED = {"skipped": "no MediaPipe, or no MYOFACE_FACE_LANDMARKER"}


def detector_file() -> Path | None:
    """Return the file of MediaPipe's landmarker; None where it or MediaPipe is not there."""
    return landmarker_file() if find_spec("mediapipe") else None


def exact_fit(face: Face, motions: Floats, weights: Floats) -> PosedFace:
    """Return the exact fit of a mixture (e,) of ``motions`` (e, k, 3), from the neutral face."""
    neutral = face.model.skin.vertices[face.model.face]
    target = Target.from_points(neutral + np.tensordot(weights, motions, 1))
    prior = unseen_regulariser(face, target)
    return fit(face, SkinDistance(face, target), prior, None, UNSEEN_STOP).state


@dataclass(frozen=True)
class PlayedPerson:
    """A person with the template's shapes ``names`` (e,), as ``motions`` (e, k, 3) of the face.

    ``deltas`` (e, v, 3) are those of the whole skin, eyeballs included.
    """

    face: Face
    S: sp.csr_array
    names: tuple[str, ...]
    motions: Floats
    deltas: Floats
    points: SkinPoints
    rig: Path | None
    learned: Path | None
    options: argparse.Namespace

    @classmethod
    def of(cls, options: argparse.Namespace) -> PlayedPerson:
        """Return the person of the options."""
        face = subject_fits.face_of_rig(options, options.rig)
        if options.rig is not None:  # kept to the limits that its controls were learned in
            face = Rig.load(options.rig).face()
        edge = subjects.COARSE_EDGE_MM if options.quick else subjects.EDGE_MM
        template = subjects.chosen_template(options, edge)
        if template.points is None:
            raise SystemExit("the template has no points of a detector: myoface template points")
        shapes = subjects.shapes(options)
        motions = driven_motions(face.model, shapes)
        rows = [shapes.expression_names.index(name) for name in motions]
        files = options.rig, options.learned
        arrays = np.array([*motions.values()]), np.asarray(shapes.expressions[rows], np.float64)
        return cls(face, face.S, tuple(motions), *arrays, template.points, *files, options)

    def controls(self) -> Controls:
        """Return the person's learned controls: those of the file, else of a few pairs."""
        if self.learned is not None and self.learned.is_file():
            return Controls.load(self.learned, self.face.model, self.S)
        mixtures = Mixtures(self.names)
        if self.options.quick:
            mixtures = replace(mixtures, options=replace(mixtures.options, stops=80))
        walks = Walks(self.face, mixtures, self.motions)
        pairs = solve_pairs(walks, LEAST_PAIRS if self.options.quick else 6000)
        learning = LearnOptions()
        if self.options.quick:
            learning = replace(learning, network=replace(learning.network, epochs=5))
        found = learn(self.face, pairs, ShapeSizes.of(self.motions), options=learning).controls
        if self.learned is not None:
            found.save(self.learned, self.face.model, self.S)
        return found

    def shaped(self, weights: Floats) -> Floats:
        """Return the skin (v, 3) of the template's own shapes by weights (e,), mm."""
        return np.asarray(self.face.model.skin.vertices + np.tensordot(weights, self.deltas, 1))

    def exact(self, weights: Floats) -> Floats:
        """Return the whole skin (v, 3) of the exact fit of a mixture (e,)."""
        state = exact_fit(self.face, self.motions, weights)
        return self.face.whole_skin(state.x, state.pose.b)
