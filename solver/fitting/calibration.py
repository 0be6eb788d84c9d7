"""Fibre muscles of a face, and their calibration to its scans."""

from __future__ import annotations

import numpy as np

from solver.fitting.controls import fibre_block
from solver.fitting.face import Face
from solver.mechanics.fibre_muscle import CURVE, Curve, FibreMuscles, driven_by_muscles
from solver.surface import Floats

# 90 kPa in flesh of 3 kPa: published activations move the skin as far as faces do
STRENGTH = 30.0


def fibre_muscles(face: Face, strength: Floats | float = STRENGTH) -> FibreMuscles:
    """Return the muscles of a face's model by its S, of so many times the flesh's mu.

    Raises :class:`~solver.errors.InputError` (``model.fibres``) for a model without fibres.
    """
    strengths = np.broadcast_to(face.flesh.material.mu * strength, face.model.muscle_count)
    return FibreMuscles.of(face.model, face.S, np.array(strengths))


def with_fibres(face: Face, muscles: FibreMuscles, curve: Curve = CURVE) -> Face:
    """Return a face driven by the activations (m,) of fibre muscles, in [0, 1]."""
    flesh = driven_by_muscles(face.flesh, muscles, curve)
    return face.driven_by(flesh, fibre_block(len(muscles.strengths)))
