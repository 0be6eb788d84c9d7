"""Patterns of contraction: learned from fits, and never beyond what muscles can do."""

from dataclasses import replace

import numpy as np
import pytest

from solver.fitting.contraction import Contraction
from solver.fitting.drives.admissible import Admissible
from solver.fitting.face import Face
from solver.fitting.stretches import IsochoricActivations, determinants, map_stretches
from solver.mechanics.flesh import IDENTITY
from solver.rig.preview.patterns import contract_in_full
from tests.solver.simulation.test_fibres import fibred_block

STRETCH = 0.6


@pytest.fixture(scope="module")
def face():
    return Face(fibred_block())


def along_fibres(face):
    tensors = Contraction.of_face(face).tensors
    return IsochoricActivations.of(tensors)(np.full(len(tensors), STRETCH))


def fits(pattern, amounts):
    """Return activations (e, 2, 6) of the first muscle by a pattern (6,), the other at rest."""
    made = [map_stretches((amount * pattern)[None], np.exp)[0] for amount in amounts]
    return np.stack([[one, IDENTITY] for one in made])


def test_a_muscle_thickens_as_it_does_in_the_fits(face):
    pattern = np.array([-1.0, 0.1, 0.0, 0.8, 0.0, 0.2])  # to one side, and it shears
    full = contract_in_full(Contraction.of_face(face), fits(pattern, [0.1, 0.2, 0.3]), STRETCH)
    contraction = Contraction.of_face(face)
    assert contraction(full)[0] == pytest.approx(1.0 - STRETCH)
    np.testing.assert_allclose(determinants(full), 1.0)
    found = map_stretches(full[:1], np.log)[0]
    found *= pattern[0] / found[0]
    np.testing.assert_allclose(found, pattern, atol=0.15)
    assert found[3] > 3.0 * found[5]
    # of the other nothing is known
    np.testing.assert_allclose(full[1], along_fibres(face)[1])


def test_without_fits_fibres_say_all(face):
    np.testing.assert_allclose(
        contract_in_full(Contraction.of_face(face), [], STRETCH), along_fibres(face)
    )
    at_rest = np.tile(IDENTITY, (1, 2, 1))
    np.testing.assert_allclose(
        contract_in_full(Contraction.of_face(face), at_rest, STRETCH), along_fibres(face)
    )


@pytest.mark.parametrize(
    "pattern",
    [
        [-1.0, 0.0, 0.0, 3.0, 0.0, -2.0],  # far thicker than muscles get
        [-0.02, 0.0, 0.0, 1.0, 0.0, -0.98],  # that hardly contracts
        [-1.0, 2.0, 0.0, 0.5, 0.0, 0.5],
    ],
)
def test_a_pattern_is_followed_as_far_as_muscles_can(face, pattern):
    full = contract_in_full(
        Contraction.of_face(face), fits(np.array(pattern), [0.05, 0.3]), STRETCH
    )
    limits = Admissible().feasible(face.model, face.flesh.volumes, face.S)
    for part in (0.3, 0.6, 1.0):
        assert limits.contains(IDENTITY + part * (full - IDENTITY))
    assert Contraction.of_face(face)(full)[0] == pytest.approx(1.0 - STRETCH)


def test_a_fit_that_turns_a_muscle_inside_out_does_no_harm(face):
    inside_out = np.stack([IDENTITY, IDENTITY])[None] * 1.0
    inside_out[0, 0] = [0.5, 0.0, 0.0, 1.2, 0.0, -0.3]
    full = contract_in_full(Contraction.of_face(face), inside_out, STRETCH)
    assert np.isfinite(full).all()
    assert Admissible().feasible(face.model, face.flesh.volumes, face.S).contains(full)


def test_muscles_without_fibres_stay_at_rest(face):
    model = face.model
    bare = Face(replace(model, fibres=0.0 * model.fibres))
    np.testing.assert_allclose(
        contract_in_full(Contraction.of_face(bare), [], STRETCH), np.tile(IDENTITY, (2, 1))
    )
