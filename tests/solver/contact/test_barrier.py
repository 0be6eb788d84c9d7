"""The barrier: derivatives, no tunnelling, friction, and objects that a face cannot start with."""

from dataclasses import replace

import ipctk
import numpy as np
import pytest
import scipy.sparse as sp
import trimesh

from solver.anatomy.contact_regions import LOWER, UPPER
from solver.contact.barrier import (
    Barrier,
    BarrierOptions,
    ContactSurface,
    SurfaceOptions,
    collision_mesh,
    crossing_vertices,
    part_lips,
)
from solver.contact.crossing import crossing
from solver.contact.mouth import LIPS, Mouth, area_weighted_normals
from solver.errors import InputError
from solver.mechanics.boundary import Boundary, BoundaryRates
from solver.scene.places import check_objects
from solver.surface import Surface, own_numbers
from tests.fixtures import small_model
from tests.solver.ball import ball

GAP = 0.4 * BarrierOptions.distance_mm
STIFFNESS_PA = 3000.0


def on_itself(*parts):
    """Return a contact surface whose vertices are the flesh's own, of some surfaces."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    points = np.vstack([part.vertices for part in parts])
    faces = np.vstack([part.faces + start for part, start in zip(parts, starts, strict=False)])
    count = len(points)
    own = sp.eye_array(count, format="csr")
    crossed = np.zeros(count, dtype=bool)
    return ContactSurface(np.arange(count), faces, own, np.zeros((count, 3)), points, crossed)


def two_balls():
    """One ball of skin over another one, nearly touching, not vertex above vertex."""
    upper = ball([0.11, 5.0 + GAP / 2, 0.07], 5.0, 3)
    lower = ball([0.0, -5.0 - GAP / 2, 0.0], 5.0, 3)
    return on_itself(upper, lower), len(upper.vertices)


def place(barrier, x, *objects, seconds=0.1):
    here = Boundary(np.empty((0, 3)), np.zeros(5), objects)
    barrier.begin(x, here, seconds)
    barrier.place(here)


def check_derivatives(barrier, x, step):
    """Compare gradient and Hessian along a step with differences."""
    small = 1e-5 * step
    slope = (barrier.value(x + small) - barrier.value(x - small)) / 2e-5
    assert abs(slope) > 1e-2
    assert np.sum(barrier.gradient(x) * step) == pytest.approx(slope, rel=1e-4)
    change = np.sum(step * (barrier.gradient(x + small) - barrier.gradient(x - small))) / 2e-5
    curvature = barrier.hessian(x) @ step.ravel()
    # what is not convex has been left out
    assert step.ravel() @ curvature == pytest.approx(change, rel=0.1)
    exact = barrier.curvature(x) @ step.ravel()
    assert step.ravel() @ exact == pytest.approx(change, rel=1e-4)


def test_derivatives_match_differences():
    surface, upper = two_balls()
    barrier = Barrier(surface, STIFFNESS_PA)
    place(barrier, surface.rest)
    step = np.zeros_like(surface.rest)
    step[:upper] = [0.2, -1.0, 0.1]
    check_derivatives(barrier, surface.rest, step)
    force = barrier.gradient(surface.rest)
    assert force[:upper, 1].sum() < 0.0
    np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-9)
    hessian = barrier.hessian(surface.rest)
    touched = np.flatnonzero(abs(hessian).sum(axis=0))
    assert np.linalg.eigvalsh(hessian[touched][:, touched].toarray()).min() > -1e-6
    far = surface.rest.copy()
    far[:upper, 1] += BarrierOptions.distance_mm
    assert barrier.value(far) == 0.0


@pytest.mark.parametrize("moving", ["skin", "object"])
def test_nothing_tunnels(moving):
    surface, upper = two_balls()
    x = surface.rest
    y = surface.rest.copy()
    if moving == "skin":
        barrier = Barrier(surface, STIFFNESS_PA)
        objects = []
        goals = []
        # to the other side in one step
        y[:upper, 1] -= 40.0
    else:
        glass = ball([0.0, 20.0, 0.0], 3.0)
        barrier = Barrier(surface, STIFFNESS_PA, objects=[glass])
        objects = [glass.vertices]
        goals = [glass.vertices - [0.0, 60.0, 0.0]]
    place(barrier, x, *objects)
    goal = Boundary(np.empty((0, 3)), np.zeros(5), tuple(goals))
    part = barrier.max_step(x, y, goal)
    assert 0.0 < part < 0.25
    arrived = [a + part * (b - a) for a, b in zip(objects, goals, strict=True)]
    place(barrier, x + part * (y - x), *arrived)
    assert np.isfinite(barrier.value(x + part * (y - x)))


def test_an_object_pulls_before_it_arrives():
    surface, _ = two_balls()
    x = surface.rest
    top = x[:, 1].max()
    glass = ball([0.05, top + GAP + 3.0, 0.02], 3.0)
    barrier = Barrier(surface, STIFFNESS_PA, objects=[glass])
    place(barrier, x, glass.vertices)
    before = barrier.gradient(x)
    nearer = glass.vertices - [0.0, 1e-5, 0.0]
    pull = barrier.pull(x, Boundary(np.empty((0, 3)), np.zeros(5), (nearer,)))
    place(barrier, x, nearer)
    change = barrier.gradient(x) - before
    assert np.abs(change).max() > 1e-4
    # what is not convex has been left out
    np.testing.assert_allclose(pull, change, atol=0.3 * np.abs(change).max())
    place(barrier, x, glass.vertices)
    rate = np.broadcast_to(np.array([0.0, -1e-5, 0.0])[:, None], (*glass.vertices.shape, 1))
    rates = BoundaryRates(np.empty((0, 3, 1)), np.zeros((5, 1)), (rate,))
    exact = barrier.by_boundary(x, rates)[:, :, 0]
    np.testing.assert_allclose(exact, change, atol=1e-2 * np.abs(change).max())


def test_objects_alone_leave_skin_to_itself():
    surface, _ = two_balls()
    glass = ball([0.0, 20.0, 0.0], 3.0)
    barrier = Barrier(surface, STIFFNESS_PA, objects=[glass], itself=False)
    place(barrier, surface.rest, glass.vertices)
    assert barrier.value(surface.rest) == 0.0


def test_no_step_goes_metres():
    surface, upper = two_balls()
    barrier = Barrier(surface, STIFFNESS_PA)
    place(barrier, surface.rest)
    away = surface.rest.copy()
    away[:upper, 1] += 3000.0
    held = Boundary(np.empty((0, 3)), np.zeros(5))
    assert barrier.max_step(surface.rest, away, held) == pytest.approx(
        BarrierOptions.furthest_mm / 3000.0
    )
    away[:upper, 1] -= 6000.0
    part = barrier.max_step(surface.rest, away, held)
    assert 0.0 < part * 3000.0 < 2.0 * GAP


def test_friction_holds_back_and_obeys_coulomb():
    surface, upper = two_balls()
    x = surface.rest
    coefficient = 0.4
    still = Barrier(surface, STIFFNESS_PA, friction=coefficient)
    place(still, x)
    normal = np.abs(still.gradient(x)[:upper, 1].sum())
    moved = x.copy()
    moved[:upper, 0] += 0.01
    smooth = Barrier(surface, STIFFNESS_PA)
    place(smooth, x)
    # a tenth of a millimetre a second: slower than what slips
    place(still, x, seconds=0.1)
    slow = (still.gradient(moved) - smooth.gradient(moved))[:upper, 0].sum()
    place(still, x, seconds=0.001)
    fast = (still.gradient(moved) - smooth.gradient(moved))[:upper, 0].sum()
    assert 0.0 < slow < fast
    assert fast == pytest.approx(coefficient * normal, rel=0.05)
    # what is held does not creep by millimetres: at a quarter of one a second friction is all there
    place(still, x, seconds=0.04)
    creeping = (still.gradient(moved) - smooth.gradient(moved))[:upper, 0].sum()
    assert creeping == pytest.approx(fast, rel=0.05)
    place(still, x, seconds=0.1)
    step = np.zeros_like(x)
    step[:upper] = [1.0, 0.0, 0.3]
    check_derivatives(still, moved, step)


def test_crossing_triangles_are_found():
    upper = ball([0.0, 1.8, 0.0], 2.0, 2)
    lower = ball([0.05, -1.8, 0.03], 2.0, 2)
    both = on_itself(upper, lower)
    mesh = collision_mesh(Surface(both.rest, both.faces))
    found = crossing_vertices(mesh)
    assert ipctk.has_intersections(mesh, mesh.rest_positions)
    assert len(found) > 10
    assert np.abs(both.rest[found, 1]).max() < 1.0
    assert not len(crossing_vertices(collision_mesh(upper)))


def test_the_contact_surface_lies_under_the_skin_and_turns_with_it():
    model = small_model()
    faces = model.skin.faces[np.isin(model.skin.faces, model.embedded).all(axis=1)]
    surface = ContactSurface.of(model, faces)
    number = np.searchsorted(model.embedded, surface.skin)
    skin = (model.embedding @ model.rest + model.offset)[number]
    depth = np.linalg.norm(surface.rest - skin, axis=1)
    assert depth.min() == pytest.approx(SurfaceOptions.inset_mm, abs=1e-6)
    outward = area_weighted_normals(skin, own_numbers(faces)[1])
    assert np.median(np.einsum("nd,nd->n", surface.rest - skin, outward)) < 0.0
    np.testing.assert_allclose(surface.points(model.rest), surface.rest, atol=1e-9)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turned = surface.points(model.rest @ turn.T) - surface.offset
    np.testing.assert_allclose(turned, (surface.rest - surface.offset) @ turn.T, atol=1e-9)


def crumpled(count):
    """Return a face of which some skin vertices are thrown about, and its skin's triangles."""
    model = small_model()
    offset = model.offset.copy()
    offset[:count] += np.random.default_rng(0).normal(scale=2.0, size=(count, 3))
    faces = model.skin.faces[np.isin(model.skin.faces, model.embedded).all(axis=1)]
    return replace(model, offset=offset), faces


def test_skin_that_crosses_itself_does_not_meet_itself_but_objects():
    model, faces = crumpled(40)
    surface = ContactSurface.of(model, faces)
    assert 0 < surface.crossed.sum() < 0.2 * len(surface.skin)
    mesh = collision_mesh(Surface(surface.rest, surface.faces))
    assert ipctk.has_intersections(mesh, mesh.rest_positions)
    np.testing.assert_allclose(surface.points(model.rest), surface.rest, atol=1e-9)
    # a small ball just over a vertex that crosses
    over = surface.rest[surface.crossed][0] + [0.0, 0.0, 1.0 + GAP]
    thing = ball(over, 1.0, 2)
    barrier = Barrier(surface, STIFFNESS_PA, objects=[thing])
    held = Boundary(np.empty((0, 3)), np.zeros(5), (thing.vertices,))
    barrier.begin(model.rest, held, 1.0)
    alone = Barrier(surface, STIFFNESS_PA)
    nothing = Boundary(np.empty((0, 3)), np.zeros(5))
    alone.begin(model.rest, nothing, 1.0)
    assert 0.0 <= alone.value(model.rest) < barrier.value(model.rest) < np.inf
    assert alone.max_step(model.rest, model.rest + 0.01, nothing) == 1.0


def test_lips_that_cross_are_moved_apart_and_meet():
    """Half of the depth each: the contact surfaces of two balls touch where the skins cross."""
    deep = 0.3
    upper = ball([0.0, 5.0 - deep / 2, 0.0], 5.0, 4)
    lower = ball([0.0, deep / 2 - 5.0, 0.0], 5.0, 4)
    both = on_itself(upper, lower)
    count = len(both.rest)
    own = sp.eye_array(count, format="csr")
    side = np.repeat([UPPER, LOWER], [len(upper.vertices), len(lower.vertices)])
    mouth = Mouth(both.skin, np.full(count, LIPS), both.faces, own, np.zeros((count, 3)), side)
    assert crossing(mouth, both.rest).lips == pytest.approx(deep, abs=0.05)
    apart = part_lips(mouth, both.rest)
    assert crossing(mouth, apart).lips == 0.0
    mesh = collision_mesh(Surface(apart, both.faces))
    assert not ipctk.has_intersections(mesh, mesh.rest_positions)
    moved = apart - both.rest
    assert np.abs(moved).max() < deep
    top = moved[: len(upper.vertices), 1]
    assert top.max() == pytest.approx(-moved[len(upper.vertices) :, 1].min(), rel=0.2)
    far = np.abs(both.rest[:, 1]) > 3.0
    assert not moved[far].any()


def test_a_neutral_that_crosses_itself_widely_is_refused():
    with pytest.raises(InputError, match="crosses itself widely"):
        ContactSurface.of(*crumpled(1200))


def test_objects_that_contact_can_not_begin_with_are_refused():
    model = small_model()
    front = model.skin.vertices[model.face, 2].max()
    box = trimesh.creation.box([40.0, 40.0, 2.0])

    def glass(z):
        return Surface(np.array([0.0, 0.0, z]) + box.vertices, np.asarray(box.faces, np.int64))

    check_objects(model, {"glass": glass(front + 3.0)})
    for z in (front - 2.0, 20.0):  # across the skin, and in the head, where no flesh is near
        with pytest.raises(InputError, match="glass begins in the face") as error:
            check_objects(model, {"glass": glass(z)})
        assert error.value.code == "scene.object_inside"
    whole = glass(front + 3.0)
    for faces in (whole.faces[1:], whole.faces[:, ::-1]):
        with pytest.raises(InputError, match="not a closed surface"):
            check_objects(model, {"glass": Surface(whole.vertices, faces)})


def test_parts_of_an_object_may_cross_each_other():
    model = small_model()
    skin = model.skin.vertices[model.face]
    tip = skin[skin[:, 2].argmax()]
    parts = [ball(tip + np.array([shift, 0.0, 15.0]), 8.0) for shift in (0.0, 6.0)]
    faces = np.vstack([parts[0].faces, parts[1].faces + len(parts[0].vertices)])
    check_objects(model, {"two": Surface(np.vstack([each.vertices for each in parts]), faces)})
