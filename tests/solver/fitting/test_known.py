"""Known contractions: the term's derivatives, whose place they take, and that they are kept to."""

from dataclasses import replace

import numpy as np
import pytest

from solver.errors import InputError
from solver.fitting import activation
from solver.fitting.activation import UNSEEN_STOP, unseen_regulariser
from solver.fitting.calibration import fibre_muscles, with_fibres
from solver.fitting.contraction import Contraction
from solver.fitting.drives.admissible import Admissible
from solver.fitting.drives.fibre_contraction import FibreContraction
from solver.fitting.face import Face
from solver.fitting.jaw_closers import CloserOptions
from solver.fitting.known import FaceMuscles, KnownFit, compare_frames, find_disagreements
from solver.fitting.objective import Regulariser, SkinDistance, Target
from solver.fitting.per_tet.tissue import of_face
from solver.fitting.recruitment import FibrePriors, Recruited
from solver.fitting.simplex import mix_by_stiffness
from solver.fitting.stretches import isochoric_activation
from solver.scans.known_activations import KnownMuscles
from tests.fixtures import small_model
from tests.solver.block import differences, divided_block


@pytest.fixture(scope="module")
def face():
    """The block, a left and a right muscle in a lower and an upper compartment each."""
    return Face(divided_block())


def known_of(*rows):
    names, values, sd = zip(*rows, strict=True)
    return KnownMuscles(names, np.array(values), np.array(sd))


KNOWN = known_of(("left", 0.3, 0.05), ("right.upper", 0.1, 0.2))


def test_the_term_s_derivatives_are_those_of_its_value(face):
    plain = Regulariser(1e-3, 1e-2, 1e-6, face.rest_pose())
    found = FaceMuscles.of(face).regularise(KNOWN, plain)
    rng = np.random.default_rng(5)
    pose = face.rest_pose().add(0.1 * rng.standard_normal(face.layout.size))
    gradient = found.others[-1].gradient(pose)
    assert np.abs(gradient).max() > 1e-3
    np.testing.assert_allclose(gradient, differences(found.others[-1].value, pose), atol=1e-8)
    np.testing.assert_allclose(found.gradient(pose), differences(found.value, pose), atol=1e-7)
    hessian = found.others[-1].gauss_newton(pose)
    np.testing.assert_allclose(hessian, differences(found.others[-1].gradient, pose), atol=1e-8)
    assert np.linalg.matrix_rank(hessian) == len(KNOWN)
    more = found.gauss_newton(pose) - replace(found, others=()).gauss_newton(pose)
    np.testing.assert_allclose(more, hessian, atol=1e-12)
    # a whole muscle joins its compartments, of which IPOPT has the blocks alone
    blocks = found.curvature(pose)[0]
    muscles = face.layout.muscles
    whole = found.gauss_newton(pose)[muscles[:, :, None], muscles[:, None, :]]
    np.testing.assert_allclose(blocks, whole, atol=1e-12)
    assert np.abs(hessian[np.ix_(muscles[0], muscles[1])]).max() > 1e-3


def test_a_whole_muscle_contracts_by_the_mean_over_its_compartments(face):
    contraction = Contraction.of_face(face)
    a = face.rest_pose().a.copy()
    a[0] = isochoric_activation(contraction.tensors[0], 0.6)
    whole, upper = FaceMuscles.of(face).contractions(
        known_of(("left", 0, 1), ("left.upper", 0, 1)), a
    )
    sizes = face.S.multiply(face.flesh.volumes[:, None]).sum(axis=0)[1:3]
    assert whole == pytest.approx(float(contraction(a)[:2] @ sizes / sizes.sum()))
    assert 0.1 < whole < 0.3
    assert upper == pytest.approx(contraction(a)[1])


def test_what_is_known_takes_the_place_of_what_is_expected(face):
    priors = FibrePriors.of_face(face, 0.02, CloserOptions())
    expected = Recruited(
        np.full((4, 1), 30.0), np.full(4, 0.1), np.full(2, 20.0), np.ones(4), priors
    )
    plain = Regulariser(1e-3, 1e-2, 1e-6, face.rest_pose())
    muscles = FaceMuscles.of(face)
    np.testing.assert_array_equal(muscles.numbers(KNOWN), [0, 1, 3])
    recruited = expected.without(muscles.numbers(KNOWN)).regularise(plain)
    found = muscles.regularise(KNOWN, recruited)
    np.testing.assert_allclose(found.w_a[:, 0], [1e-3, 1e-3, 0.03, 1e-3])
    assert Contraction.of_face(face)(found.prior.a)[2] == pytest.approx(0.1, rel=0.2)
    np.testing.assert_array_equal(expected.without(np.arange(3)).contraction, [0, 0, 0, 0.1])
    values = muscles.contractions(KNOWN, found.prior.a)
    np.testing.assert_allclose(values, KNOWN.values)
    assert found.others[-1].value(replace(face.rest_pose(), a=found.prior.a)) == pytest.approx(0.0)
    nothing = KnownMuscles((), np.zeros(0), np.zeros(0))
    assert muscles.regularise(nothing, recruited) is recruited
    assert len(muscles.numbers(nothing)) == 0


def test_muscles_of_one_number_are_known_by_it(face):
    along = face.driven_by(FibreContraction(face.model))
    gamma = np.array([0.7, 0.7, 1.0, 0.9])
    np.testing.assert_allclose(FaceMuscles.of(along).contractions(KNOWN, gamma), [0.3, 0.1])
    plain = Regulariser(1e-3, 0.0, 1e-6, along.rest_pose())
    found = FaceMuscles.of(along).regularise(KNOWN, plain)
    np.testing.assert_allclose(found.prior.a, [0.7, 0.7, 1.0, 0.9])
    fibres = with_fibres(face, fibre_muscles(face))
    pulled = np.array([0.3, 0.3, 0.0, 0.1])
    np.testing.assert_allclose(FaceMuscles.of(fibres).contractions(KNOWN, pulled), [0.3, 0.1])


def test_muscles_without_fibres_and_tets_by_themselves_have_no_contraction(face):
    bare = Face(replace(face.model, fibres=0.0 * face.model.fibres))
    with pytest.raises(InputError, match="left has no fibres") as told:
        FaceMuscles.of(bare).check(KNOWN.names)
    assert told.value.code == "activations.fibres"
    tissue = of_face(face).face
    with pytest.raises(InputError) as told:
        FaceMuscles.of(tissue).term(KNOWN)
    assert told.value.code == "activations.drive"


def test_disagreements_are_told_beyond_two_standard_deviations():
    close = KnownFit("procerus", 0.3, 0.1, 0.2)
    far = KnownFit("frontalis_l", 0.5, 0.05, 0.02)
    (finding,) = find_disagreements("frown", (close, far))
    assert finding.code == "activations.disagree"
    assert "frown: frontalis_l contracts by 0.02" in finding.message
    assert finding.context["off_sd"] == pytest.approx(-9.6)
    frames = [(number, (close, far) if number < 2 else (close,)) for number in range(40)]
    figures, (finding,) = compare_frames(frames)
    assert finding.context == {"muscle": "frontalis_l", "frame": 0}
    assert figures["frontalis_l"]["frames"] == 2
    assert figures["procerus"]["beyond"] == 0.0
    assert figures["procerus"]["rms"] == pytest.approx(0.1)


def test_a_face_that_does_not_move_is_left_where_it_is_and_told():
    """As of a palsy: the table says that a muscle pulls, the skin that nothing does."""
    model = small_model()
    face = Face(model, mix_by_stiffness(model.weights, 30.0)).driven_by(Admissible())
    rest = face.face_points(face.rest.x)
    known = known_of(("frontalis_l", 0.5, 0.1))
    target = Target.from_points(rest)
    prior = unseen_regulariser(face, target, known)
    found = activation.fit(face, SkinDistance(face, target), prior, options=UNSEEN_STOP).state
    assert np.linalg.norm(face.face_points(found.x) - rest, axis=1).max() < 0.5
    (fit,) = FaceMuscles.of(face).compare(known, found.pose.a)
    assert 0.0 < fit.contraction < 0.25
    assert len(find_disagreements("still", (fit,))) == 1


@pytest.mark.long
def test_known_muscles_are_kept_to_and_more_is_found_again():
    """Of 40 points with 0.2 mm of noise; EMG of six muscles with a standard deviation of 0.1."""
    rng = np.random.default_rng(12)
    model = small_model()
    face = Face(model, mix_by_stiffness(model.weights, 30.0)).driven_by(Admissible())
    contraction = Contraction.of_face(face)
    names = face.model.muscle_names
    a = face.rest_pose().a.copy()
    pulled = [
        names.index(f"{name}_{side}")
        for name in ("zygomaticus_major", "risorius", "levator_labii_superioris", "frontalis")
        for side in "lr"
    ]
    for muscle, part in zip(pulled, rng.uniform(0.1, 0.4, len(pulled)), strict=True):
        a[muscle] = isochoric_activation(contraction.tensors[muscle], 1.0 - part)
    true = contraction(a)
    there = face.continuation(face.rest, replace(face.rest_pose(), a=a))
    points = face.face_points(there.x)
    points += 0.2 * rng.standard_normal(points.shape)
    seen = np.zeros(len(points))
    seen[rng.choice(len(points), 40, replace=False)] = 1.0
    target = Target.from_points(points, seen)
    sd = 0.1
    chosen = pulled[:6]
    measured = true[chosen] + sd * rng.standard_normal(len(chosen))
    known = known_of(*((names[j], value, sd) for j, value in zip(chosen, measured, strict=True)))

    def fit(*given):
        data = SkinDistance(face, target)
        prior = unseen_regulariser(face, target, *given)
        return contraction(activation.fit(face, data, prior, options=UNSEEN_STOP).state.pose.a)

    without = fit()
    with_table = fit(known)
    assert np.abs(with_table[chosen] - measured).max() < 1.2 * sd
    before, after = (np.corrcoef(each, true)[0, 1] for each in (without, with_table))
    assert after > before + 0.15
