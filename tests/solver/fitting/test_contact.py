"""Lips and teeth: how deep they cross, and the term that pushes them apart."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp

from solver.anatomy.contact_regions import LOWER, UPPER
from solver.contact.crossing import crossing
from solver.contact.mouth import AROUND, LIPS, LOWER_TEETH, UPPER_TEETH, Mouth
from solver.errors import InputError, SolveError
from solver.fitting.contact import Contact, LipContactOptions, NearContact, Teeth
from solver.mechanics.boundary import move_jaw, move_jaw_back
from solver.model import JawFrame
from solver.surface import Surface
from tests.solver.ball import ball
from tests.solver.block import block_model
from tests.solver.builtin_head import builtin_head
from tests.solver.teeth import HEIGHT, RADIUS, fan, row_of_teeth

OVERLAP = 1.5


def balls():
    """Two lips, one on the other and OVERLAP deep in it, and teeth as deep in the upper."""
    parts = [
        ball([0.0, 10.0 - OVERLAP / 2, 0.0], 10.0, 4),
        ball([0.0, OVERLAP / 2 - 10.0, 0.0], 10.0, 4),
        row_of_teeth((0.0, 10.0, OVERLAP - 10.0 - RADIUS)),
    ]
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    points = np.vstack([part.vertices for part in parts])
    faces = np.vstack([part.faces + start for part, start in zip(parts, starts, strict=False)])
    count = len(points)
    label = np.where(np.arange(count) < starts[2], LIPS, UPPER_TEETH)
    side = np.where(label == LIPS, np.where(np.arange(count) < starts[1], UPPER, LOWER), 0)
    rows = sp.eye_array(count, format="csr")
    mouth = Mouth(np.arange(count), label, faces, rows, np.zeros((count, 3)), side)
    rest = points.copy()
    rest[: starts[1], 2] += 2.0 * OVERLAP
    model = replace(block_model(), rest=rest, skin=Surface(points, faces))
    return model, mouth, points, starts


def contact(model, mouth):
    return Contact(model, mouth, Teeth(model, mouth))


def test_crossing_is_as_deep_as_balls_overlap():
    _, mouth, points, starts = balls()
    found = crossing(mouth, points)
    assert found.lips == pytest.approx(OVERLAP, abs=0.1)
    assert abs(points[found.vertex, 1]) < 1.0
    assert found.upper_teeth == pytest.approx(OVERLAP, abs=0.1)
    assert found.lower_teeth is None
    assert found.bite is None
    apart = points.copy()
    apart[: starts[1]] += [0.0, OVERLAP + 0.1, 2.0 * OVERLAP]
    nothing = crossing(mouth, apart)
    assert (nothing.lips, nothing.vertex, nothing.upper_teeth) == (0.0, None, 0.0)


def test_what_is_not_finite_is_refused():
    model, mouth, points, _ = balls()
    spoilt = points.copy()
    spoilt[7, 1] = np.nan
    with pytest.raises(InputError, match="vertex 7"):
        crossing(mouth, spoilt)
    with pytest.raises(SolveError):
        contact(model, mouth).value(spoilt)


def test_contact_pushes_lips_apart_and_off_the_teeth():
    model, mouth, points, starts = balls()
    term = contact(model, mouth)
    gradient = term.gradient(points)
    upper = gradient[: starts[1]].sum(axis=0)
    lower = gradient[starts[1] : starts[2]].sum(axis=0)
    assert upper[1] < -1e-3
    assert lower[1] > 1e-3
    assert upper[2] < -1e-3
    np.testing.assert_allclose((upper + lower)[:2], 0.0, atol=1e-3)
    apart = points.copy()
    apart[: starts[1]] += [
        0.0,
        OVERLAP - LipContactOptions.lips_slack_mm / 2,
        OVERLAP - LipContactOptions.teeth_slack_mm / 2,
    ]
    assert term.value(apart) == 0.0
    assert not term.gradient(apart).any()


def check_derivatives(term, x, step):
    """Compare gradient and curvature along a step with differences."""
    slope = (term.value(x + 1e-4 * step) - term.value(x - 1e-4 * step)) / 2e-4
    assert abs(slope) > 1e-4
    assert np.sum(term.gradient(x) * step) == pytest.approx(slope, rel=1e-4)
    change = (term.gradient(x + 1e-4 * step) - term.gradient(x - 1e-4 * step)) / 2e-4
    curvature = (term.curvature(x) @ step.ravel()).reshape(x.shape)
    along = np.sum(step * curvature)
    assert along > 1e-4
    # Gauss-Newton: without the turning of the ways out
    assert along == pytest.approx(np.sum(step * change), rel=0.2)


def test_derivatives_match_differences():
    model, mouth, points, starts = balls()
    # not vertex above vertex, where what is nearest changes at once
    points[: starts[1]] += [0.13, 0.0, 0.07]
    step = np.zeros_like(points)
    step[: starts[1]] = [0.1, 1.0, 0.3]
    check_derivatives(contact(model, mouth), points, step)


JAW = JawFrame(np.array([0.0, 30.0, -60.0]), np.eye(3))
B = np.array([0.08, 0.02, 0.4, -0.3, 0.2])


def behind(deep):
    """Return lips so deep behind the lower of two rows of teeth, the jaw at B; x, and how many."""
    lips = fan(RADIUS - deep)
    # the neutral's are before the teeth
    neutral = fan(RADIUS + 1.0)
    far = ball([0.0, 0.0, 200.0], 5.0)
    walls = [row_of_teeth((0.0, up, 0.0)) for up in (HEIGHT + 2.0, 0.0)]
    mandible = np.array([[0.0, 0.0, 0.0], [40.0, 0.0, 0.0], [0.0, 0.0, 50.0], [0.0, 30.0, 5.0]])
    parts = [neutral, far.vertices, *(wall.vertices for wall in walls), mandible]
    starts = np.cumsum([0, *(len(part) for part in parts)])
    points = np.vstack(parts)
    count = starts[4]
    label = np.repeat([LIPS, AROUND, UPPER_TEETH, LOWER_TEETH], np.diff(starts[:5]))
    surfaces = zip((far, *walls), starts[1:], strict=False)
    faces = np.vstack([surface.faces + start for surface, start in surfaces])
    rows = sp.eye_array(count, len(points), format="csr")
    side = np.where(label == LIPS, LOWER, 0)
    mouth = Mouth(np.arange(count), label, faces, rows, np.zeros((count, 3)), side)
    model = replace(block_model(), rest=points, mandible=np.arange(count, len(points)), jaw=JAW)
    x = points.copy()
    x[: len(lips)] = move_jaw(JAW, lips, B)
    x[count:] = move_jaw(JAW, mandible, B)
    return contact(model, mouth), x, len(lips)


@pytest.mark.parametrize("deep", [3.0, 8.0])
def test_a_lip_behind_the_teeth_of_a_moved_jaw_comes_out_to_the_front(deep):
    term, x, count = behind(deep)
    assert term.value(x) > 0.0
    stiffness = term.curvature(x).diagonal().max()
    for _ in range(100):
        gradient = term.gradient(x)
        gradient[count:] = 0.0
        x = x - gradient / stiffness
    seen = move_jaw_back(JAW, x[:count], B)
    radius = np.hypot(seen[:, 0], seen[:, 2])
    assert np.all((radius > RADIUS - LipContactOptions.teeth_slack_mm - 0.2) & (radius < RADIUS))


def test_derivatives_behind_teeth_match_differences():
    """By the lips, and by the jaw's vertices in any way."""
    term, x, count = behind(1.5)
    step = np.random.default_rng(2).normal(size=x.shape) - [0.0, 0.0, 1.0]
    check_derivatives(term, x, step)
    step[:count] = 0.0
    check_derivatives(term, x, step)


@pytest.fixture(scope="module")
def head():
    return builtin_head()


def closed(model, angle):
    """Turn mandible and lower face by b; the flesh above the lower lip's middle stays."""
    b = np.array([angle, 0.02, 0.3, -0.2, 0.1])
    skin = model.skin.vertices
    line = skin[model.regions["lower_lip"], 1].max()
    moving = (model.rest[:, 1] < line) | (np.arange(len(model.rest)) >= len(model.embedded))
    x = model.rest.copy()
    x[moving] = move_jaw(model.jaw, model.rest[moving], b)
    whole = skin.copy()
    whole[model.attached_mandible] = move_jaw(model.jaw, skin[model.attached_mandible], b)
    whole[model.embedded] = x[: len(model.embedded)]
    return x, whole


def test_mouth_of_a_head_moves_with_flesh_and_jaw(head):
    mouth = Mouth.of(head)
    assert len(np.unique(mouth.label)) == 4
    lips = mouth.skin[mouth.label == LIPS]
    assert np.isin(lips, head.embedded).all()
    for region in ("upper_lip", "lower_lip"):
        assert np.isin(head.regions[region], lips).mean() > 0.3
    x, skin = closed(head, -0.1)
    np.testing.assert_allclose(mouth.points(x), skin[mouth.skin], atol=1e-9)
    assert crossing(mouth, head.skin.vertices).lips < 0.5
    assert crossing(mouth, skin).lips > 1.0


def test_contact_of_a_head_matches_differences(head):
    x, _ = closed(head, -0.06)
    y, _ = closed(head, -0.07)
    check_derivatives(contact(head, Mouth.of(head)), x, (y - x) / np.abs(y - x).max())


def near(model, mouth):
    return NearContact(model, mouth, weight=2.0, slack_mm=0.2)


def test_near_lips_of_balls_are_as_deep_and_pushed_apart():
    model, mouth, points, starts = balls()
    model = replace(model, rest=points)
    term = near(model, mouth)
    depth = term.touching(points).depth.max() + 0.2
    assert depth == pytest.approx(OVERLAP, abs=0.1)
    points[: starts[1]] += [0.13, 0.0, 0.07]
    # a lip that is only shifted keeps its normals
    step = np.zeros_like(points)
    step[: starts[1]] = [0.1, 1.0, 0.3]
    slope = (term.value(points + 1e-5 * step) - term.value(points - 1e-5 * step)) / 2e-5
    assert slope < -1.0
    assert np.sum(term.gradient(points) * step) == pytest.approx(slope, rel=1e-3)
    assert step.ravel() @ (term.curvature(points) @ step.ravel()) > 1.0
    apart = points.copy()
    apart[: starts[1]] += [0.0, OVERLAP, 0.0]
    assert term.value(apart) == 0.0
    assert not term.gradient(apart).any()


def test_near_lips_of_a_head_cross_where_all_of_them_do(head):
    mouth = Mouth.of(head)
    term = near(head, mouth)
    assert term.value(head.rest) == 0.0
    for angle in (-0.04, -0.1):
        x, skin = closed(head, angle)
        depth = term.touching(x).depth.max(initial=0.0) + 0.2
        assert depth == pytest.approx(crossing(mouth, skin).lips, rel=0.3)


def test_a_lip_that_is_folded_is_in_itself_and_not_in_the_other():
    _, mouth, points, _ = balls()
    folded = replace(mouth, side=np.where(mouth.label == LIPS, LOWER, 0))
    assert crossing(mouth, points).lips > 1.0
    assert crossing(folded, points).lips == 0.0


def test_no_mouth_without_named_lips(head):
    assert Mouth.of(replace(head, regions={})) is None
