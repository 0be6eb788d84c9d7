"""Sliders that follow markers: derivatives, values and head, wrong points and gaps."""

import numpy as np
import pytest

from solver.fitting.expression_basis import ExpressionBasis
from solver.fitting.face import Face, Pose, usual_layout
from solver.fitting.markers.term import MarkerPlaces
from solver.live.follow import ReducedPlaces
from solver.live.markers import LiveMarkers
from solver.mechanics.boundary import FreeJaw
from solver.rig.frames.skin_basis import ReducedSkin
from solver.rig.preview import PreviewOptions, make_live_preview
from solver.rig.preview.poses import ShapeSampleOptions
from solver.rig.preview.sliders import Control, Sliders
from solver.scans.markers.places.marker_set import Marker, MarkerSet
from solver.similarity import IDENTITY, Similarity, small_motion
from tests.fixtures import small_capture, small_model

NAMES = ("smile", "surprise", "ah")


@pytest.fixture(scope="module")
def preview():
    """Three sliders, each an expression of the small person, that bend each other a little."""
    model = small_model()
    neutral = small_capture("neutral").vertices
    basis = np.stack([small_capture(name).vertices - neutral for name in NAMES])
    quadratic = 0.1 * np.random.default_rng(1).standard_normal((3, 6))
    layout = usual_layout(model.muscle_count)
    directions = np.zeros((layout.size, 3))
    directions[layout["jaw"], 2] = [0.2, 0.0, 0.0, 2.0, 0.0]
    controls = tuple(Control(name, "expression", name) for name in NAMES)
    rest = Pose(*layout.split(layout.rest))
    sliders = Sliders(controls, rest, directions, {}, FreeJaw(model.jaw))
    return (
        model,
        sliders,
        ReducedSkin(basis.astype(np.float16), np.eye(3, dtype=np.float32), quadratic),
    )


@pytest.fixture(scope="module")
def markers(preview):
    model = preview[0]
    triangles = model.skin.faces[np.isin(model.skin.faces, model.face).all(axis=1)]
    chosen = np.random.default_rng(2).choice(len(triangles), 30, replace=False)
    corners = [tuple(map(int, triangles[number])) for number in chosen]
    skin = [Marker(f"S{n}", each, (0.2, 0.3, 0.5), 2.0) for n, each in enumerate(corners)]
    teeth = Marker("TEETH", part="lower_teeth", place_mm=(0.0, -60.0, 60.0), sigma_mm=0.2)
    head = Marker("HEAD", part="head", place_mm=(0.0, 90.0, 40.0), sigma_mm=0.2)
    session = Similarity(1.0, np.diag([1.0, 1.0, -1.0]), np.array([5.0, 6.0, 7.0]))
    return MarkerSet((*skin, teeth, head), session, model.sha256)


def test_places_derivative_matches_differences(preview, markers):
    places = ReducedPlaces(*preview, markers.markers)
    values = np.array([0.3, 0.5, 0.7])
    step = np.array([1.0, -0.5, 0.8])
    change = places.at(values + 1e-5 * step) - places.at(values - 1e-5 * step)
    assert np.linalg.norm(change / 2e-5, axis=1)[:31].min() > 0.01
    found = places.jacobian(values) @ step
    np.testing.assert_allclose(found, change.ravel() / 2e-5, atol=1e-5)


@pytest.mark.long
def test_sliders_and_head_are_followed(preview, markers):
    tracker = LiveMarkers(*preview, markers)
    places = tracker.places
    rng = np.random.default_rng(3)
    for time in np.linspace(0.0, 2.0, 90):
        values = 0.5 - 0.5 * np.cos(time * np.array([2.0, 3.0, 4.0]))
        head = small_motion(np.array([0.3 * np.sin(time), 0.2, 0.0, 9.0 * time, 0.0, 0.0]))
        points = head(places.at(values)) + 0.1 * rng.standard_normal((32, 3))
        points[4] += 15.0
        points[[7, 8]] = points[[8, 7]]
        points[9] = np.nan
        frame = tracker.follow(markers.session.inverse()(points), 1.0 / 60.0)
        assert np.abs(frame.values - values).max() < 0.1
        assert frame.head.then(head.inverse()).degrees < 0.3
        assert frame.states[[4, 9]].tolist() == ["outlier", "missing"]
        assert frame.states[[7, 8]].tolist() == ["swapped"] * 2
        assert np.sum(frame.states == "seen") == 28
    gone = [tracker.step(np.full((32, 3), np.nan), 1.0 / 60.0) for _ in range(60)][-1]
    np.testing.assert_allclose(gone.values, np.exp(-1.0) * frame.values, atol=1e-3)
    assert gone.is_held
    assert not gone.clues.any()


@pytest.mark.long
def test_simulated_flesh_is_followed_by_its_expressions(markers):
    """A pose between expressions that the flesh makes comes back from its markers."""
    face = Face(small_model())
    neutral = small_capture("neutral").vertices
    shapes = np.stack([0.5 * (small_capture(name).vertices - neutral) for name in NAMES])
    few = PreviewOptions(shape_samples=ShapeSampleOptions(learn=6, measure=2, shapes=(2, 3)))
    basis = ExpressionBasis.solve(face, shapes)
    made = make_live_preview(
        face, NAMES, basis, seed=1, seconds=120.0, listen=lambda *_: None, options=few
    )
    assert [control.name for control in made.controls.each] == [*NAMES]
    values = np.array([0.6, 0.0, 0.4])
    pose = made.controls.pose(values)
    state = face.continuation(face.rest, pose)
    skin = face.whole_skin(state.x, pose.b)
    skin_only = [each for each in markers.markers if each.label.startswith("S")]
    seen = MarkerPlaces(face.model, skin_only).at(state.x)
    still = MarkerSet(tuple(skin_only), IDENTITY, face.model.sha256)
    tracker = LiveMarkers(face.model, made.controls, made.skin, still)
    for _ in range(20):
        found = tracker.step(seen, 1.0 / 60.0)
    off = neutral + made.skin.motion(found.values) - skin
    moved = np.linalg.norm((skin - neutral)[face.model.face], axis=1).mean()
    assert np.linalg.norm(off[face.model.face], axis=1).mean() < 0.15 * moved
    np.testing.assert_allclose(found.values, values, atol=0.1)
