"""Head and jaw regressed from markers that a template's expressions move, at known amounts."""

from dataclasses import replace

import numpy as np
import pytest

from solver.anatomy.warp import spread
from solver.fitting.controls import jaw_on_tracks
from solver.fitting.face import Face
from solver.fitting.markers.shape_regression import ShapeRegression, outermost_teeth
from solver.fitting.markers.term import HeadPrior, MarkerPlaces, MarkerTerm
from solver.mechanics.jaw_tracks import JawTracks
from solver.scans.markers.places.marker_set import Marker
from solver.similarity import small_motion
from tests.fixtures import small_capture, small_model

TRACKS = JawTracks(small_model().jaw, 0.6, 60.0, 20.0, 0.9)
AMOUNTS = np.array([0.4, 0.6])  # of a smile, and of an open mouth
B = np.array([0.2, 4.0, 3.0])
HEAD = small_motion(np.array([0.05, -0.1, 0.02, 3.0, 1.0, -2.0]))


@pytest.fixture(scope="module")
def face():
    return Face(small_model()).with_joint(jaw_on_tracks(TRACKS))


@pytest.fixture(scope="module")
def shapes(face):
    """A smile, and an open mouth whose teeth go with the jaw."""
    skin = small_capture("neutral").vertices
    teeth = face.model.lower_teeth
    found = [small_capture(name).vertices - skin for name in ("smile", "ah")]
    found[1][teeth] = (TRACKS.move(skin[teeth], B) - skin[teeth]) / AMOUNTS[1]
    found[0][teeth] = 0.0
    return np.stack(found)


@pytest.fixture(scope="module")
def markers(face):
    model = face.model
    triangles = model.skin.faces[np.isin(model.skin.faces, model.face).all(axis=1)]
    chosen = triangles[spread(model.skin.vertices[triangles].mean(axis=1), 30)]
    return [Marker("", tuple(map(int, each)), (0.3, 0.3, 0.4), 0.0) for each in chosen]


def term_of(face, markers, shapes, amounts=AMOUNTS):
    """Markers on the skin as expressions move it, the head turned: seen to 0.2 mm."""
    places = MarkerPlaces(face.model, markers)
    skin = face.model.skin.vertices + np.tensordot(amounts, shapes, 1)
    corners = skin[[marker.vertices for marker in markers]]
    at = np.einsum("kc,kcx->kx", [marker.weights for marker in markers], corners)
    head = HeadPrior.diffuse(motion=small_motion(np.zeros(6)))
    return MarkerTerm(places, HEAD(at), np.full(at.shape, 0.2**-2), head)


def test_head_and_jaw_are_those_that_made_the_markers(face, markers, shapes):
    term = term_of(face, markers, shapes)
    found = ShapeRegression(face, term.places, shapes).regress(term, face.rest)
    assert found.head.motion.then(HEAD.inverse()).degrees < 0.1
    teeth = face.model.skin.vertices[outermost_teeth(face)]
    away = face.jaw.move(teeth, found.jaw.mean) - face.jaw.move(teeth, B)
    assert np.linalg.norm(away[0]) < 0.2  # by one step from the neutral face
    assert np.linalg.eigvalsh(found.jaw.precision).min() > 0.0
    assert np.linalg.norm(face.jaw.move(teeth, B) - teeth) > 5.0


def test_markers_that_no_expression_explains_tell_less(face, markers, shapes):
    term = term_of(face, markers, shapes)
    noise = 3.0 * np.random.default_rng(2).standard_normal(term.seen.shape)
    regression = ShapeRegression(face, term.places, shapes)
    clean, wrong = (
        regression.regress(each, face.rest)
        for each in (term, replace(term, seen=term.seen + noise))
    )
    assert np.diag(wrong.head.precision).min() < 0.2 * np.diag(clean.head.precision).min()
    assert np.trace(wrong.jaw.precision) < 0.5 * np.trace(clean.jaw.precision)


def test_what_was_not_seen_tells_nothing(face, markers, shapes):
    """By two markers the head may still turn about the line through them."""
    term = term_of(face, markers, shapes)
    few = np.zeros_like(term.precision)
    few[:2] = term.precision[:2]
    seen = np.where(few > 0.0, term.seen, np.nan)
    known = HeadPrior(HEAD, np.eye(6))
    term = replace(term, precision=few, seen=seen, head=known)
    found = ShapeRegression(face, term.places, shapes).regress(term, face.rest)
    least = np.linalg.eigvalsh(found.head.precision).min()
    assert least == pytest.approx(1.0, rel=0.05)


def test_a_free_jaw_and_one_with_markers_of_its_own_are_left(face, markers, shapes):
    free = Face(face.model)
    on_teeth = Marker("T", part="lower_teeth", place_mm=(0.0, -40.0, 100.0))
    for each, used in ((free, markers), (face, [*markers, on_teeth])):
        term = term_of(each, markers, shapes)
        extra = len(used) - len(markers)
        padded = np.vstack([term.seen, np.full((extra, 3), np.nan)])
        precision = np.vstack([term.precision, np.zeros((extra, 3))])
        places = MarkerPlaces(each.model, used)
        term = MarkerTerm(places, padded, precision, term.head)
        found = ShapeRegression(each, places, shapes).regress(term, each.rest)
        assert found.jaw is None
        assert found.head.motion.then(HEAD.inverse()).degrees < 0.1
