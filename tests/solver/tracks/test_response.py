"""dx/dq of faces under tracks against differences of states, with contact and without."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp

from solver.contact.obstacles import Eyeball
from solver.contact.one_sided import OneSided
from solver.errors import SolveError
from solver.mechanics.boundary import move_jaw_back
from solver.similarity import Similarity, small_motion
from solver.tracks.basis import MuscleTracks
from solver.tracks.face import TrackFace
from solver.tracks.response import TrackResponse
from tests.solver.tracks.block import OPEN, block_shapes, tracked_block

STEP = 1e-4
EXACT = {"stiffness_pa": 1.0, "tolerance": 1e-12, "settled_mm": 0.0}
Q = {"aside": 0.7, "bulge": 0.8, "open": 0.6}
JAW = np.array([0.02, 0.01, 0.2, -0.1, 0.1])


def ball_on(model, free):
    """Return a ball that moves with the jaw and presses on the skin of a face at rest there."""
    front = np.flatnonzero(model.rest[:, 2] == 15.0)
    state = free.move(free.rest(), free.tracks.controls(Q, JAW))
    pressed = state.x[np.abs(model.rest - [20.0, 20.0, 15.0]).sum(axis=1).argmin()]
    centre = move_jaw_back(model.jaw, pressed[None] + [0.5, 0.2, 8.0], state.drive.jaw)[0]
    rows = sp.csr_array(sp.eye_array(len(model.rest)))[front]
    nothing = np.zeros((len(front), 3)), np.full(len(front), -0.1)
    return OneSided(Eyeball(centre, 8.5), rows, *nothing, np.full(len(front), 50.0), model.jaw)


@pytest.fixture(scope="module", params=[False, True], ids=["flesh", "contact"])
def settled(request):
    """Return a face, controls of it, its state there and the derivatives."""
    model = tracked_block()
    tracks = MuscleTracks.of(model, block_shapes(model))
    face = TrackFace(model, tracks, **EXACT)
    if request.param:
        face = TrackFace(model, tracks, [ball_on(model, face)], **EXACT)
    q = tracks.controls(Q, JAW)
    state = face.move(face.rest(), q)
    if request.param:
        assert face.potentials[0].value(state.x) > 1e-3
    return face, state, TrackResponse(face, state)


def test_columns_are_the_differences_of_states(settled):
    face, state, response = settled
    motions = response.columns()
    skin = response.skin_columns()
    assert response.minimum
    for number in range(face.tracks.size):
        change = STEP * np.eye(face.tracks.size)[number]
        ahead, behind = (face.move(state, state.q + sign * change) for sign in (1, -1))
        expected = (ahead.x - behind.x) / (2.0 * STEP)
        size = np.abs(expected).max()
        assert size > 0.3
        np.testing.assert_allclose(motions[:, :, number], expected, atol=2e-6 * size)
        of_skin = (face.skin(ahead) - face.skin(behind)) / (2.0 * STEP)
        np.testing.assert_allclose(skin[:, :, number], of_skin, atol=2e-6 * size)


@pytest.mark.parametrize("settled", [True], ids=["contact"], indirect=True)
def test_contact_has_a_say(settled):
    face, state, response = settled
    free = TrackFace(face.model, face.tracks, **EXACT)
    without = TrackResponse(free, free.move(free.rest(), state.q)).columns()
    assert np.abs(response.columns() - without).max() > 0.05


def test_products_and_adjoints_agree_with_the_columns(settled):
    face, _, response = settled
    random = np.random.default_rng(4)
    change = random.standard_normal(face.tracks.size)
    for product, adjoint, columns in (
        (response.product, response.adjoint, response.columns()),
        (response.skin_product, response.skin_adjoint, response.skin_columns()),
    ):
        moved = product(change)
        np.testing.assert_allclose(moved, columns @ change, atol=1e-10 * np.abs(moved).max())
        gradient = random.standard_normal(moved.shape)
        pulled = adjoint(gradient)
        assert np.abs(pulled).min() > 1e-3
        # <g, J dq> = <J^T g, dq>
        gap = abs((gradient * moved).sum() - pulled @ change)
        assert gap <= 1e-10 * np.linalg.norm(gradient) * np.linalg.norm(moved)


def test_a_head_adds_its_six(settled):
    face, state, response = settled
    head = Similarity(
        1.1, small_motion(np.array([0.3, -0.5, 0.2, 0, 0, 0])).rotation, 30.0 * JAW[:3]
    )
    placed = response.placed(head)
    skin = head(face.skin(state))
    columns = placed.columns()
    assert columns.shape == (*skin.shape, face.tracks.size + 6)
    expected = np.einsum("ij,vjk->vik", 1.1 * head.rotation, response.skin_columns())
    np.testing.assert_allclose(columns[:, :, :-6], expected, atol=1e-12 * np.abs(expected).max())
    for number, twist in enumerate(STEP * np.eye(6)):
        ahead, behind = (small_motion(sign * twist)(skin) for sign in (1, -1))
        by_head = (ahead - behind) / (2.0 * STEP)
        np.testing.assert_allclose(columns[:, :, number - 6], by_head, atol=1e-6)
    random = np.random.default_rng(5)
    change = random.standard_normal(columns.shape[2])
    gradient = random.standard_normal(skin.shape)
    moved = placed.product(change)
    pulled = placed.adjoint(gradient)
    np.testing.assert_allclose(moved, columns @ change, atol=1e-10 * np.abs(moved).max())
    expected = np.einsum("vik,vi->k", columns, gradient)
    np.testing.assert_allclose(pulled, expected, atol=1e-10 * np.abs(expected).max())


def test_a_step_by_the_derivative_is_off_by_its_square(settled):
    face, state, response = settled
    way = np.random.default_rng(7).standard_normal(face.tracks.size)
    rate = response.product(way)
    off = []
    for length in (2e-3, 1e-3):
        end = face.move(state, state.q + length * way)
        off.append(np.linalg.norm(end.x - state.x - length * rate))
    assert np.log2(off[0] / off[1]) > 1.9


def test_a_state_that_is_no_equilibrium_has_no_derivative(settled):
    face, state, _ = settled
    aside = replace(state.motion, x=state.x + 0.1 * np.sin(np.arange(state.x.size)).reshape(-1, 3))
    with pytest.raises(SolveError) as error:
        TrackResponse(face, replace(state, motion=aside))
    assert error.value.code == "tracks.no_equilibrium"


def test_older_states_keep_their_derivatives(settled):
    face, state, response = settled
    face.move(state, face.tracks.controls({}, OPEN))
    again = TrackResponse(face, state)
    assert np.allclose(again.columns(), response.columns(), atol=1e-9)
