"""Recruitment: which muscles a target calls for, and that fits leave the work to them."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from solver.fitting import activation
from solver.fitting.activation import ActivationOptions, unseen_regulariser
from solver.fitting.contraction import Contraction
from solver.fitting.drives.fibre_contraction import FibreContraction
from solver.fitting.face import Face
from solver.fitting.objective import Regulariser, SkinDistance, Target
from solver.fitting.recruitment import Effort, EvenSides, Recruitment, RecruitmentOptions, recruit
from solver.fitting.simplex import replace_values
from solver.fitting.stretches import determinants, fibre_tensors, isochoric_activation
from solver.model import Expressions
from solver.surface import vertex_normals
from tests.fixtures import small_model
from tests.solver.block import block_model, differences, divided_block, poses

NAMES = ("mouthSmileLeft", "browInnerUp", "jawOpen")


@pytest.fixture(scope="module")
def face():
    """A face whose expressions are bumps of 5 mm, each at a place of its own."""
    model = small_model()
    points = model.skin.vertices[model.face]
    far = points[[np.argmax(points[:, 0]), np.argmax(points[:, 1]), np.argmin(points[:, 1])]]
    bumps = 5.0 * np.exp(-np.sum((points - far[:, None]) ** 2, axis=2) / 800.0)
    motions = (bumps[:, :, None] * [[[0.5, 0.5, 0.7]]]).astype(np.float32)
    return Face(replace(model, expressions=Expressions(NAMES, motions)))


def target_of(face, amounts, normals=None):
    model = face.model
    rest = model.skin.vertices[model.face]
    return Target.from_points(
        rest + np.tensordot(amounts, model.expressions.motions, 1), normals=normals
    )


def test_what_a_target_calls_for_does_not_depend_on_the_one_before(face):
    plain = target_of(face, (0.5, 0.2, 0.0))
    weights = np.where(np.arange(len(plain.weights)) % 3, plain.weights, 0.0)
    targets = (
        plain,
        replace(plain, weights=weights),
        target_of(face, (0.1, 0.9, 0.3), normals=vertex_normals(face.model.skin)[face.model.face]),
        target_of(face, (0.0, 0.4, 0.8)),
    )
    kept = Recruitment.of_face(face)
    for target in (*targets, *targets[::-1]):
        for found, alone in zip(
            kept.amounts(target), Recruitment.of_face(face).amounts(target), strict=True
        ):
            np.testing.assert_allclose(found, alone, rtol=1e-12)


def price_of(face, found, muscle):
    (price,) = set(found.price[face.model.muscle_numbers(muscle), 0].tolist())
    return price


def expected(found):
    """Return the activations that are expected of muscles."""
    return found.priors.shortened(found.contraction)


def contraction_of(face, found, muscle):
    contraction = Contraction.of_face(face)(expected(found))
    return contraction[face.model.muscle_numbers(muscle)].mean()


@pytest.mark.parametrize("along_normals", [False, True])
def test_amounts_of_expressions_are_found_again(face, along_normals):
    count = len(face.model.face)
    normals = np.tile([0.0, 0.6, 0.8], (count, 1)) if along_normals else None
    target = target_of(face, [0.6, 0.0, 0.3], normals)
    unseen = np.where(np.arange(count) % 3 == 0, 0.0, target.weights)
    recruitment = Recruitment.of_face(face)
    amounts, explained = recruitment.amounts(replace(target, weights=unseen / unseen.sum()))
    # and none of what units would do that no expression shows
    np.testing.assert_allclose(amounts[:3], [0.6, 0.0, 0.3], atol=1e-4)
    np.testing.assert_allclose(amounts[3:], 0.0, atol=1e-4)
    assert explained == pytest.approx(1.0, abs=1e-6)


def test_muscles_that_are_named_contract_and_antagonists_pay_most(face):
    options = RecruitmentOptions(contraction=0.3, price=50.0, opposed=4.0)
    found = Recruitment.of_face(face, options).of_target(target_of(face, [1.0, 0.0, 1.0]))
    assert found.price.shape == (face.model.muscle_count, 1)
    assert contraction_of(face, found, "zygomaticus_major_l") == pytest.approx(0.3, abs=0.05)
    assert contraction_of(face, found, "zygomaticus_major_r") == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(determinants(expected(found)), 1.0)
    assert price_of(face, found, "zygomaticus_major_l") == pytest.approx(50.0, rel=1e-3)
    assert price_of(face, found, "zygomaticus_major_r") == pytest.approx(50.0, rel=1e-3)
    # against the smile on its own side, and against an open jaw on both
    assert price_of(face, found, "depressor_anguli_oris_l") == pytest.approx(200.0, rel=1e-3)
    assert price_of(face, found, "depressor_anguli_oris_r") == pytest.approx(50.0, rel=1e-3)
    assert price_of(face, found, "masseter_deep_r") == pytest.approx(200.0, rel=1e-3)


def test_a_part_of_an_expression_calls_for_a_part(face):
    options = RecruitmentOptions(contraction=0.3, price=50.0, opposed=4.0, called=0.5)
    found = Recruitment.of_face(face, options).of_target(target_of(face, [0.25, 0.0, 0.0]))
    assert contraction_of(face, found, "zygomaticus_major_l") == pytest.approx(0.075, abs=0.02)
    assert price_of(face, found, "depressor_anguli_oris_l") == pytest.approx(100.0, rel=1e-3)


def test_what_no_expression_explains_anybody_may_make(face):
    """A motion at right angles to all expressions, and a face at rest."""
    rest = face.model.skin.vertices[face.model.face]
    across = Target.from_points(rest + [[0.0, -0.7, 0.5]] * rest.shape[0])
    recruitment = Recruitment.of_face(face)
    assert recruitment.of_target(across).price.max() < 0.1 * recruitment.options.price
    still = recruitment.of_target(Target.from_points(rest))
    assert still.price.max() == 1.0
    np.testing.assert_array_equal(expected(still), face.rest_pose().a)


def test_nothing_is_known_without_expressions_and_of_muscles_without_shapes(face):
    target = target_of(face, [1.0, 0.0, 0.0])
    plain = Face(small_model())
    assert Recruitment.of_face(plain) is None
    assert recruit(plain, {"smile": target}) == {}
    assert unseen_regulariser(plain, target).w_a == activation.UNSEEN["w_a"]
    assert Recruitment.of_face(face.driven_by(FibreContraction(face.model))) is None
    assert np.max(unseen_regulariser(face, target).w_a) > 10.0 * activation.UNSEEN["w_a"]


def test_a_muscle_that_pays_leaves_the_work_to_the_other():
    face = Face(block_model())
    there = face.continuation(face.rest, poses(1)[0])
    data = SkinDistance(face, Target.from_points(face.face_points(there.x)))
    plain = Regulariser(1e-3, 1e-2, 1e-6, face.rest_pose())
    rest = plain.prior.a

    def used(w_a):
        found = activation.fit(
            face, data, replace(plain, w_a=w_a), face.rest, ActivationOptions(40, 1e-6)
        )
        return np.linalg.norm(found.state.pose.a - rest, axis=1)

    alike = used(1e-3)
    dear = used(np.array([[1e3], [1e-3]]))
    assert alike.min() > 0.02
    assert dear[0] < 0.2 * alike[0]
    assert dear[1] > 0.8 * alike[1]


def test_derivatives_of_priced_muscles():
    face = Face(block_model())
    here, other = poses(2)
    prior = Regulariser(np.array([[2.0], [0.1]]), 1e-2, 1e-3, face.rest_pose())
    q = here.vector()
    step = 1e-6

    def value(q):
        return prior.value(type(here).of(here.layout, q))

    slopes = [(value(q + e) - value(q - e)) / (2 * step) for e in step * np.eye(len(q))]
    found = prior.gradient(here)
    assert np.abs(found).max() > 1.0
    np.testing.assert_allclose(found, slopes, atol=1e-6 * np.abs(found).max())
    # a proximal term adds its square, but for a constant
    near = prior.with_proximal_term(other, 0.3)
    square = 0.5 * 0.3 * np.sum((here.a - other.a) ** 2)
    of = replace(near, w_b=0.0), replace(prior, w_b=0.0)
    gained = [each.value(here) - each.value(other) for each in of]
    assert gained[0] - gained[1] == pytest.approx(square, rel=1e-9)


def test_what_both_sides_do_otherwise_has_its_price(face):
    """That of what is no mirror image, and of contractions; derivatives are the value's."""
    sides = EvenSides.of_face(face)
    rng = np.random.default_rng(3)
    pose = face.rest_pose().add(0.1 * rng.standard_normal(face.layout.size))

    gradient = sides.gradient(pose)
    assert np.abs(gradient).max() > 1e-2
    np.testing.assert_allclose(gradient, differences(sides.value, pose), atol=1e-8)
    np.testing.assert_allclose(
        sides.gauss_newton(pose), differences(sides.gradient, pose), atol=1e-7
    )
    one, other = (face.model.muscle_numbers(f"zygomaticus_major_{side}")[0] for side in "lr")
    a = face.rest_pose().a
    a[one] = [1.1, 0.1, 0.2, 0.9, 0.3, 1.0]
    a[other] = [1.1, -0.1, -0.2, 0.9, 0.3, 1.0]
    contractions = Contraction.of_face(face)(a)
    uneven = 0.5 * (contractions[one] - contractions[other]) ** 2
    assert uneven > 1e-5  # the fibres of a mesh do not mirror each other
    assert sides.value(replace(pose, a=a)) == pytest.approx(uneven)
    sheared = a.copy()
    sheared[other, 1] = 0.1
    uneven = 0.5 * np.diff(Contraction.of_face(face)(sheared)[[one, other]]).item() ** 2
    price = sides.value(replace(pose, a=sheared))
    assert price == pytest.approx(uneven + 0.5 * 0.2**2)


def test_a_muscle_without_flesh_asks_nothing_of_its_twin(face):
    rates = face.contractions.rates.copy()
    rates[face.model.muscle_numbers("zygomaticus_major_l")[0]] = np.nan
    one_sided = SimpleNamespace(
        model=face.model, layout=face.layout, contractions=SimpleNamespace(rates=rates)
    )
    sides = EvenSides.of_face(one_sided)
    assert sides.value(face.rest_pose()) == pytest.approx(0.0, abs=1e-12)
    assert np.abs(sides.gradient(face.rest_pose())).max() < 1e-9


def test_only_muscles_that_are_called_for_alike_are_to_pull_alike(face):
    recruitment = Recruitment.of_face(face)
    full = RecruitmentOptions.even
    smile, *even = [recruitment.of_target(target_of(face, of)).even for of in np.eye(3)]
    np.testing.assert_allclose(smile, 0.0, atol=1e-6)  # of the left alone
    np.testing.assert_allclose(even, full, rtol=1e-3)
    # those of the brows are, whatever the smile does; what nothing calls for by the whole
    both = recruitment.of_target(target_of(face, [1.0, 1.0, 0.0]))
    pairs = recruitment.priors.sides.pairs
    called = both.contraction[pairs].max(axis=1) > 0.01
    uneven = both.contraction[pairs].min(axis=1) < 0.01
    for some in (called & uneven, called & ~uneven, ~called):
        assert some.any()
    np.testing.assert_allclose(both.even[called & uneven], 0.0, atol=1e-3)
    np.testing.assert_allclose(both.even[called & ~uneven], full, rtol=1e-3)
    np.testing.assert_allclose(both.even[~called], full * 0.5**RecruitmentOptions.strict, rtol=1e-3)


def test_effort_is_linear_in_contractions_and_its_parabola_is_above_it(face):
    rng = np.random.default_rng(5)
    small = 0.02
    free = Effort.of_face(face, small)
    effort = replace(free, weights=rng.uniform(0.5, 1.0, len(free.weights)))
    pose = face.rest_pose().add(0.05 * rng.standard_normal(face.layout.size))
    gradient = effort.gradient(pose)
    assert np.abs(gradient).max() > 0.1
    np.testing.assert_allclose(gradient, differences(effort.value, pose), atol=1e-7)
    curvature = effort.gauss_newton(pose)
    for size in (0.01, 0.1, 1.0):
        step = size * rng.standard_normal(face.layout.size)
        bound = effort.value(pose) + gradient @ step + 0.5 * step @ curvature @ step
        assert effort.value(pose.add(step)) <= bound
    a = face.rest_pose().a
    one = face.model.muscle_numbers("zygomaticus_major_l")[0]
    tensor = fibre_tensors(face.model, face.flesh.volumes, face.S)[one]
    a[one] = isochoric_activation(tensor, 0.7)
    by = Contraction.of_face(face)(a)[one]
    expected = effort.weights[one] * (np.hypot(by, small) - small)
    assert by > 0.2
    assert effort.value(replace(pose, a=a)) == pytest.approx(expected)


def test_effort_is_asked_of_those_alone_that_nobody_calls_for_or_knows(face):
    recruitment = Recruitment.of_face(face, RecruitmentOptions(effort=7.0))
    found = recruitment.of_target(target_of(face, [1.0, 0.0, 0.0]))
    named, other = (face.model.muscle_numbers(f"zygomaticus_major_{side}") for side in "lr")
    np.testing.assert_allclose(found.effort[named], 0.0)
    np.testing.assert_allclose(found.effort[other], 7.0, rtol=1e-3)
    spared = found.without(np.concatenate([named, other]))
    np.testing.assert_allclose(spared.effort[other], 0.0)
    np.testing.assert_allclose(spared.price[named], 1.0)
    assert contraction_of(face, spared, "zygomaticus_major_l") == pytest.approx(0.0, abs=1e-12)


def test_with_effort_fewer_muscles_make_the_same():
    face = Face(divided_block())
    tensors = fibre_tensors(face.model, face.flesh.volumes, face.S)
    a = face.rest_pose().a
    for muscle, stretch in ((0, 0.8), (1, 0.93)):
        a[muscle] = isochoric_activation(tensors[muscle], stretch)
    there = face.continuation(face.rest, replace(face.rest_pose(), a=a))
    data = SkinDistance(face, Target.from_points(face.face_points(there.x)))
    plain = Regulariser(1e-3, 1e-2, 1e-6, face.rest_pose())
    effort = replace(Effort.of_face(face, 0.01), weights=np.array([0.0, 1.0, 1.0, 1.0]))

    def others(*priors):
        options = ActivationOptions(60, 1e-6)
        found = activation.fit(face, data, replace(plain, others=priors), face.rest, options)
        return np.abs(Contraction.of_face(face)(found.state.pose.a))[1:].max()

    before = others()
    assert before > 0.05
    assert others(effort) < 0.2 * before


def test_what_is_expected_goes_by_the_fibres_of_the_newest_S(face):
    """S that fills a muscle otherwise changes the mean of its fibres."""
    found = Recruitment.of_face(face).of_target(target_of(face, [1.0, 0.0, 0.0]))
    S = face.S.toarray()
    S[:, 1:] *= np.random.default_rng(9).uniform(0.1, 1.0, (len(S), 1))
    S[:, 0] = 1.0 - S[:, 1:].sum(axis=1)
    rows = np.repeat(np.arange(len(S)), np.diff(face.S.indptr))
    other = face.with_weights(replace_values(face.S, S[rows, face.S.indices]))
    assert np.abs(other.contractions.rates - face.contractions.rates).max() > 1e-2
    moved = found.on(other)
    np.testing.assert_array_equal(moved.contraction, found.contraction)
    pulling = found.contraction > 0.1
    for one, at in ((found, face), (moved, other)):
        contraction = Contraction.of_face(at)(expected(one))
        np.testing.assert_allclose(contraction[pulling], found.contraction[pulling], rtol=0.3)
    assert np.abs(expected(moved) - expected(found))[pulling].max() > 1e-4
    np.testing.assert_array_equal(moved.priors.effort.rates, Effort.of_face(other, 0.02).rates)
