"""Another actor than the small person: smaller, with a wide flat mouth, high brows, a long nose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from solver.model import SubjectModel
from solver.registration.search import nose_tip
from solver.scans.markers.places.bind import model_face
from solver.surface import Floats
from tests.fixtures import small_model

SIZE = 0.85  # of the actor, by the person


def to_actor(points: Floats) -> Floats:
    """Return a person's points on an actor: small, with a wide mouth, high brows, a long nose."""
    out = points - nose_tip(model_face(small_model()))
    bumps = [
        # where, how wide, growth along axes, shift
        ((0.0, -45.0, -8.0), 40.0, (0.5, -0.3, 0.0), (0.0, 0.0, 0.0)),
        ((28.0, 45.0, -12.0), 22.0, (0.0, 0.3, 0.0), (0.0, 5.0, 3.0)),
        ((-28.0, 45.0, -12.0), 22.0, (0.0, 0.3, 0.0), (0.0, 5.0, 3.0)),
        ((0.0, 0.0, 0.0), 20.0, (0.0, 0.0, 0.0), (0.0, -2.0, 6.0)),
    ]
    moved = out.copy()
    for centre, radius, growth, shift in bumps:
        arm = out - np.array(centre)
        near = np.exp(-np.sum(arm**2, axis=-1, keepdims=True) / (2 * radius**2))
        moved += near * (arm * np.array(growth) + np.array(shift))
    return np.asarray(SIZE * moved)


def actor_model(model: SubjectModel) -> SubjectModel:
    """Return the actor's flesh, bones and muscles: those of a person, moved."""
    rest = to_actor(model.rest)
    skin = model.skin.with_vertices(to_actor(model.skin.vertices))
    offset = skin.vertices[model.embedded] - model.embedding @ rest
    jaw = replace(model.jaw, origin=to_actor(model.jaw.origin[None])[0])
    return replace(model, rest=rest, skin=skin, offset=offset, jaw=jaw)
