"""Terms and weights that jobs and benchmarks fit by default."""

from __future__ import annotations

from collections.abc import Mapping

from solver.contact.mouth import Mouth
from solver.fitting.activation import ActivationOptions
from solver.fitting.contact import Contact, Teeth
from solver.fitting.face import Face
from solver.fitting.objective import Regulariser, SkinDistance, SumTerm, Target, Term

# for an expression that S was not fitted to: w_a low from the start
UNSEEN = {"w_a": 1e-3, "w_v": 1e-2, "w_b": 1e-6}

UNSEEN_STOP = ActivationOptions(max_iterations=25, tolerance=1e-3)


def distances(face: Face, targets: Mapping[str, Target]) -> dict[str, Term]:
    """Return the distance of every expression, without contact: what a fit of S begins with."""
    return {name: SkinDistance(face, target) for name, target in targets.items()}


def terms(face: Face, targets: Mapping[str, Target]) -> dict[str, Term]:
    """Return the terms of every expression: the distance, and contact if the model has lips."""
    mouth = Mouth.of(face.model)
    data = distances(face, targets)
    if mouth is None:
        return data
    teeth = Teeth(face.model, mouth)
    return {name: SumTerm((term, Contact(face.model, mouth, teeth))) for name, term in data.items()}


def unseen_regulariser(face: Face) -> Regulariser:
    """Return the regulariser of an expression that S was not fitted to, around the resting face."""
    return Regulariser(**UNSEEN, prior=face.rest_pose())
