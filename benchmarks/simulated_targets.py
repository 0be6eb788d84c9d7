"""Targets of :mod:`benchmarks.systems` whose lips are known: clean ones, and those of muscles.

Muscles of a finer mesh, another law and contact make skins that no basis of shapes holds.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks import subjects
from solver.contact import contact_potentials
from solver.fitting.face import Face
from solver.fitting.simplex import mix_by_stiffness
from solver.fitting.stretches import IsochoricActivations, fibre_tensors
from solver.kinds.scene import STIFFNESS_PA
from solver.mechanics.boundary import JAW_FREEDOM
from solver.mechanics.flesh import IDENTITY as RELAXED
from solver.mechanics.flesh import LAWS
from solver.mechanics.linear import fastest
from solver.model import by_muscle
from solver.rig.report.systems import LipFlesh
from solver.similarity import IDENTITY
from solver.simulation import Simulator
from solver.simulation.forces import Drive
from solver.surface import Floats
from solver.tracks.basis import TrackOptions

BOTH = ("Left", "Right")
# stretches of muscles, those with * of both sides
SIMULATED: Mapping[str, Mapping[str, float]] = {
    "smile": {"zygomaticus_major_*": 0.55, "zygomaticus_minor_*": 0.7, "risorius_*": 0.7},
    "kiss": {"orbicularis_oris_upper_*": 0.65, "orbicularis_oris_lower_*": 0.65},
    "frown": {"depressor_anguli_oris_*": 0.55, "mentalis_*": 0.6, "corrugator_*": 0.65},
    "sneer": {"levator_labii_superioris_*": 0.55, "procerus": 0.7, "nasalis_transverse_*": 0.7},
    "crooked": {"zygomaticus_major_l": 0.55, "depressor_labii_inferioris_r": 0.6},
    "call": {"orbicularis_oris_lower_*": 0.8, "frontalis_*": 0.7},
}
OPEN = {"call": 0.18}  # of the jaw, rad

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Truths:
    """Clean targets by name, and the change of the lips' volume in them where it is not none."""

    skins: Mapping[str, Floats]
    lips: Mapping[str, float]


def simulated(options: argparse.Namespace, names: Sequence[str]) -> Truths:
    """Contract muscles of a subject's finer mesh, with contact."""
    subject = next(subjects.each(options, [options.subject], options.truth_edge_mm))
    model = subject.model
    S = mix_by_stiffness(model.weights, TrackOptions.firmness)
    material = LAWS[options.truth_law].in_pascal(STIFFNESS_PA)
    face = Face(model, S, material=material, linear=fastest())
    lips = LipFlesh.of(model)
    driven = fibre_tensors(model, face.flesh.volumes, S)
    with_fibres = np.isfinite(driven).all(axis=(1, 2))
    shortening = IsochoricActivations.of(driven[with_fibres])
    still = Drive(0.0, face.flesh.passive(), np.zeros(JAW_FREEDOM), IDENTITY)
    skins = {}
    changes = {}
    for name in names:
        given = by_muscle(both_sides(SIMULATED[name], "lr"), model.muscle_names)
        stretch = np.array([given.get(muscle, 1.0) for muscle in model.muscle_names])
        a = np.tile(RELAXED, (model.muscle_count, 1))
        a[with_fibres] = shortening(stretch[with_fibres])
        jaw = np.zeros(JAW_FREEDOM)
        jaw[0] = OPEN.get(name, 0.0)
        simulator = Simulator(
            face,
            contact_potentials(model, STIFFNESS_PA),
            [],
            dynamic=False,
            density=np.ones(len(model.tets)),
            linear=fastest(),
        )
        goal = Drive(1.0, face.flesh_controls(a), jaw, IDENTITY)
        x = simulator.step(simulator.rest(still), still, goal).motion.x
        skins[name] = face.whole_skin(x, jaw)
        changes[name] = 0.0 if lips is None else lips.change(x)
        moved = np.linalg.norm(skins[name] - model.skin.vertices, axis=1)[model.face]
        log.info("%s moves by %.2f mm, %.1f at most", name, moved.mean(), moved.max())
    return Truths(skins, changes)


def both_sides(mixture: Mapping[str, float], sides: Sequence[str] = BOTH) -> dict[str, float]:
    """Return values by name, those with * for both sides."""
    return {
        name.replace("*", side): weight
        for name, weight in mixture.items()
        for side in (sides if "*" in name else ("",))
    }
