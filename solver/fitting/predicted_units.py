"""Action units that no expression of a template shows: the skin that flesh makes of them.

A template shows some units of FACS; people make others, too. What such a unit does to the skin
follows from who makes it (:mod:`solver.anatomy.action_units`): it is the flesh's linear response at
rest to the contraction of its muscles,

    motion = M dx/da (S^-1(contracted) - I),    dx/da = -H^-1 d(grad_x E)/da,

S(a) being that of activations a, and the volume fractions of anatomy in the place of the muscle
geometry that was fitted. Its direction is to be
trusted, its size is not, as volume fractions do not tell how far a muscle pulls: the motion is
scaled to that of a usual expression.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import product
from weakref import WeakKeyDictionary

import numpy as np

from solver.anatomy.action_units import (
    SIDES,
    ActionUnit,
    action_units,
    actions_of,
    find_called,
    units_of,
)
from solver.errors import SolveError
from solver.fitting.face import Face
from solver.fitting.sensitivity import Sensitivity
from solver.fitting.stretches import fibre_tensors, isochoric_activation
from solver.mechanics.flesh import IDENTITY, Flesh
from solver.model import Expressions, SubjectModel
from solver.surface import Floats


@dataclass(frozen=True)
class PredictionOptions:
    """What a unit at full strength is."""

    contraction: float = 0.25  # of its muscles
    full_mm: float = 6.0  # greatest motion of the skin


_PREDICTED: WeakKeyDictionary[Flesh, Expressions] = WeakKeyDictionary()


def predict_units(face: Face) -> Expressions:
    """Return the motions of the units that no expression of a face's model has, by side.

    They are named as ``AU15Left``, and made once for a flesh, whatever S blends its muscles: by a
    factorisation, and a solve each. There are none where it does not come to rest.
    """
    if face.flesh not in _PREDICTED:
        found = {}
        with suppress(SolveError):
            found = dict(_motions(face, PredictionOptions()))
        motions = np.array(list(found.values()), np.float32).reshape(-1, len(face.model.face), 3)
        _PREDICTED[face.flesh] = Expressions(tuple(found), motions)
    return _PREDICTED[face.flesh]


def unshown_units(model: SubjectModel) -> list[ActionUnit]:
    """Return the units that no expression of a model has, of those that muscles make.

    Of several units of the same muscles it is the first.
    """
    names = () if model.expressions is None else model.expressions.names
    shown = {action.unit for name in names for action in actions_of(name)}
    found: dict[tuple[str, ...], ActionUnit] = {}
    for code, unit in action_units().items():
        # a descriptor, as AD 29, is no expression's name
        if unit not in shown and unit.muscles and not unit.by_relaxing and units_of(code):
            found.setdefault(unit.muscles, unit)
    return list(found.values())


def _motions(face: Face, options: PredictionOptions) -> Iterator[tuple[str, Floats]]:
    """Yield name and motion (k, 3) of each unit that a face's muscles can make, by side."""
    model = face.model
    units = unshown_units(model)
    if not units:
        return
    anatomical = face.with_weights(model.weights)
    tensors = fibre_tensors(model, face.flesh.volumes, model.weights)
    pulled = np.asarray(np.isfinite(tensors).all(axis=(1, 2)))
    rest = anatomical.rest
    sensitivity = Sensitivity(anatomical, rest)
    for unit, side in product(units, SIDES):
        name = f"{unit.code}{side.capitalize()}".replace(" ", "")
        change = np.zeros_like(rest.pose.a)
        named = np.array(find_called(model.muscle_names, name)[0])
        for muscle in np.flatnonzero(named & pulled):
            short = isochoric_activation(tensors[muscle], 1.0 - options.contraction)
            change[muscle] = short - IDENTITY
        controls = rest.pose.layout.join([change, np.zeros_like(rest.pose.b)])
        x = sensitivity.response.product(sensitivity.pose, controls)
        motion = anatomical.face_embedding @ x
        most = float(np.linalg.norm(motion, axis=1).max())
        if most > 0.0:
            yield name, options.full_mm / most * motion
