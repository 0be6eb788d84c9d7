"""What a head of other vertices takes from a template that lies on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from solver.registration.correspondence import correspond
from solver.surface import Surface, join_surfaces
from tests.ball_head import ball, ball_head


def shuffled(surface: Surface) -> Surface:
    order = np.random.default_rng(1).permutation(len(surface.vertices))
    place = np.argsort(order)
    return Surface(surface.vertices[order], place[surface.faces])


def test_values_places_and_landmarks_go_to_a_finer_head() -> None:
    person = ball_head()
    head = shuffled(ball((0, 0, 0), 100.0, 4))
    found = correspond(head, person)
    assert found.near.all()
    carry = found.carrier(len(person.skin.vertices))
    off = np.linalg.norm(carry(person.skin.vertices) - head.vertices, axis=1)
    assert off.max() < 1.0  # the finer ball stands out from the coarser by so much
    landmarks = found.landmarks(head, person)
    assert landmarks.keys() == person.landmarks.keys()
    for name, vertex in landmarks.items():
        place = person.skin.vertices[person.landmarks[name]]
        assert np.linalg.norm(head.vertices[vertex] - place) < 1e-6
    front = found.among(person.face_vertices)
    assert (head.vertices[front, 2] > 0).all()
    assert (head.vertices[~front, 2] < 12).all()


def test_skin_that_the_template_lacks_follows_smoothly() -> None:
    person = ball_head()
    tops = person.skin.vertices[person.skin.faces, 1].mean(axis=1)
    person = replace(person, flesh_faces=np.flatnonzero(tops < 60))  # no crown
    head = ball((0, 0, 0), 100.0, 4)
    found = correspond(head, person)
    crown = head.vertices[:, 1] > 75
    assert not found.near[crown].any()
    value = found.carrier(len(person.skin.vertices))(person.skin.vertices)
    edges = head.faces[:, :2]
    jump = np.linalg.norm(value[edges[:, 0]] - value[edges[:, 1]], axis=1)
    length = np.linalg.norm(head.vertices[edges[:, 0]] - head.vertices[edges[:, 1]], axis=1)
    assert (jump < 2 * length).all()
    # the crown lies level between its rim, as a skin drawn over it
    assert np.ptp(value[crown, 1]) < 20


def test_loose_parts_are_told_by_shape_and_place() -> None:
    person = ball_head()
    tooth = ball((0, -70, 60), 4.0, 1)  # by the mandible
    eye = ball((30, 20, 70), 12.0, 2)
    other = ball((0, 20, 80), 4.0, 1)  # by the cranium
    skin = ball((0, 0, 0), 100.0, 4)
    head = join_surfaces([skin, eye, tooth, other])
    parts = correspond(head, person).parts
    ends = np.cumsum([len(part.vertices) for part in (skin, eye, tooth, other)])
    assert np.array_equal(np.flatnonzero(parts.skin), np.arange(ends[0]))
    assert np.array_equal(np.flatnonzero(parts.eyes), np.arange(ends[0], ends[1]))
    assert np.array_equal(np.flatnonzero(parts.lower), np.arange(ends[1], ends[2]))
    assert parts.teeth[ends[1] :].all()
