"""Another actor's motion on the small person: carried to its places, or refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from solver.errors import InputError, judge_findings
from solver.scans.markers.check import check_take
from solver.scans.markers.places.actor import ACTOR, CarriedTake, carry
from solver.scans.markers.places.bind import Reference, model_face, place_on, rest_places
from solver.scans.markers.places.marker_set import Marker, MarkerSet
from solver.scans.markers.prepare import bind, split_moved
from solver.scans.markers.readers.take import Take
from solver.scans.markers.signal.faults import find_faults
from solver.similarity import Similarity, fit_similarity, small_motion, weighted_motion
from solver.surface import Floats
from tests.fixtures import small_model
from tests.solver.scans.markers.made_actor import SIZE, to_actor
from tests.solver.scans.markers.made_take import (
    AWAY,
    LABELS,
    RATE,
    made_positions,
    made_take,
    on_skin,
)

FRAMES = 420  # two seconds at rest, then expressions
REST = (0, 80)
LIPS = [n for n, label in enumerate(LABELS) if "Lip" in label or "Mouth" in label]
SKIN = model_face(small_model())
TURN = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])  # into the person's axes


@pytest.fixture(scope="module")
def markers() -> MarkerSet:
    """The person's own set."""
    at = on_skin("neutral")
    placed = [place_on(Marker(label, sigma_mm=0.5), at[n], SKIN) for n, label in enumerate(LABELS)]
    return MarkerSet(tuple(placed), Similarity(1.0, TURN, np.zeros(3)), small_model().sha256)


@pytest.fixture(scope="module")
def still(markers: MarkerSet) -> Floats:
    """The person's markers over time, with the head still."""
    rest = on_skin("neutral")
    positions = made_positions(FRAMES, noise=0.0) - AWAY
    weights = head_weights()
    face = [weighted_motion(each, rest, weights)(each) for each in positions]
    return np.array(face) - rest + rest_places(markers, SKIN)


def head_weights() -> Floats:
    """Return which markers hardly move on the made face."""
    shown = [on_skin(name) - on_skin("neutral") for name in ("smile", "surprise", "ah")]
    return np.exp(-4.0 * np.max([np.linalg.norm(each, axis=1) for each in shown], axis=0))


def heads(count: int) -> list[Similarity]:
    time = np.maximum(np.arange(count) / RATE - 1.5, 0.0)
    return [
        small_motion(np.array([0.15 * np.sin(t), 0.2 * np.sin(0.7 * t), 0.1 * t, 6 * t, 3 * t, t]))
        for t in time
    ]


def as_take(still: Floats, seed: int = 3, **more) -> Take:
    """Return an actor's take, in other axes than the person's, somewhere in a studio."""
    moved = np.array([head(face) for head, face in zip(heads(len(still)), still, strict=True)])
    noise = 0.05 * np.random.default_rng(seed).standard_normal(moved.shape)
    return made_take(moved @ TURN + AWAY + noise, first=101, **more)


@pytest.fixture(scope="module")
def actor(still: Floats) -> Take:
    return as_take(to_actor(still))


@pytest.fixture(scope="module")
def carried(actor: Take, markers: MarkerSet) -> CarriedTake:
    return carry(actor, markers, SKIN, RATE, REST)


def off_face(positions: Floats, still: Floats, chosen: list[int] | slice = slice(None)) -> float:
    """Return how far markers are from the person's, mm rms, the head being placed by all."""
    even = np.ones(still.shape[1])
    placed = np.array(
        [weighted_motion(seen, own, even)(seen) for seen, own in zip(positions, still, strict=True)]
    )
    return float(np.sqrt(np.mean(np.sum((placed - still)[:, chosen] ** 2, axis=-1))))


@pytest.mark.long
def test_motion_is_carried_by_the_local_jacobian(
    carried: CarriedTake, actor: Take, markers: MarkerSet, still: Floats
) -> None:
    similar = fit_similarity(actor.positions[0], still[0])
    one = similar(actor.positions.reshape(-1, 3)).reshape(still.shape)
    rigid = carry(actor, markers, SKIN, RATE, REST, replace(ACTOR, smoothing=1e9))
    by_warp = off_face(carried.take.positions, still, LIPS)
    assert by_warp < 1.0
    assert by_warp < 0.2 * off_face(one, still, LIPS)
    assert by_warp < 0.5 * off_face(rigid.take.positions, still, LIPS)
    report = carried.report
    assert report["scale"] == pytest.approx(similar.scale, rel=0.02)
    assert report["left_mm"] < 0.4 * report["missed_mm"]
    assert report["neutral"] == [101, 181]
    assert carried.notices == ()
    low, high = report["markers"]["Mouth_Lend"]["stretch"]
    assert low < 1.0 < 1.1 < high


@pytest.mark.long
@pytest.mark.parametrize("size", [0.7, 1.0, 1.4])
def test_a_person_of_another_size_is_carried_exactly(
    size: float, still: Floats, markers: MarkerSet
) -> None:
    take = as_take(size * still, seed=8)
    found = carry(take, markers, SKIN, RATE, REST)
    expected = np.array(
        [head(face) for head, face in zip(heads(FRAMES), size * still, strict=True)]
    )
    assert off_face(found.take.positions, still) < 0.12 / size
    assert found.report["scale"] == pytest.approx(1 / size, rel=0.003)
    # the head is put back, in the person's size
    for row in (0, 200, FRAMES - 1):
        seen = found.take.positions[row]
        np.testing.assert_allclose(seen, expected[row] / size, atol=0.6 / size)


def test_what_rides_on_bone_follows_by_size_alone(still: Floats, markers: MarkerSet) -> None:
    """The actor's headband sits elsewhere than the person's, and the take has the body as well."""
    band = np.array([[40.0, 90.0, 10.0], [-40.0, 90.0, 10.0], [0.0, 110.0, 0.0], [60.0, 60.0, -40]])
    teeth = np.array([[0.0, -40.0, 10.0]])
    on_bone = np.vstack([band, teeth])
    labels = ("head1", "head2", "head3", "head4", "lower_teeth1")
    parts = (*4 * ("head",), "lower_teeth")
    further = [
        Marker(label, part=part, sigma_mm=0.2, place_mm=tuple(place))
        for label, part, place in zip(
            labels, parts, np.add(on_bone, [0.0, 15.0, 5.0]).tolist(), strict=True
        )
    ]
    both = replace(markers, markers=(*markers.markers, *further))
    rides = np.repeat(to_actor(on_bone)[None], FRAMES, axis=0)
    drop = 12.0 * np.clip(np.arange(FRAMES) / RATE - 3.0, 0.0, 1.0)
    rides[:, -1, 1] -= drop
    body = np.random.default_rng(6).normal(0.0, 300.0, (30, 3)) - [0.0, 1000.0, 0.0]
    sway = 80.0 * np.sin(np.arange(FRAMES) / 40.0)[:, None, None] * np.ones((1, 30, 3))
    all_ = np.concatenate([to_actor(still), rides, body + sway], axis=1)
    names = (*LABELS, *labels, *(f"Body{n}" for n in range(30)))
    found = carry(as_take(all_, labels=names), both, SKIN, RATE, REST)
    assert found.take.labels == (*LABELS, *labels)
    carried = found.take.positions[:, len(LABELS) :]
    scale = found.report["scale"]
    rigid = weighted_motion(carried[300, :4], carried[0, :4], np.ones(4))
    np.testing.assert_allclose(rigid(carried[300, :4]), carried[0, :4], atol=0.3)
    places = np.array([marker.place_mm for marker in further])
    np.testing.assert_allclose(carried[0], places, atol=0.5)
    sunk = rigid(carried[[300], 4])[0] - carried[0, 4]
    np.testing.assert_allclose(sunk, [0.0, -scale * drop[300], 0.0], atol=0.7)


def test_left_handed_axes_of_the_session_stay(
    actor: Take, carried: CarriedTake, markers: MarkerSet
) -> None:
    flip = np.diag([-1.0, 1.0, 1.0])
    take = replace(actor, positions=actor.positions @ flip)
    session = Similarity(1.0, TURN @ flip, np.zeros(3))
    found = carry(take, replace(markers, session=session), SKIN, RATE, REST)
    np.testing.assert_allclose(found.take.positions, carried.take.positions, atol=0.01)


def test_swapped_and_unlabelled_points_come_to_where_they_belong(
    actor: Take, carried: CarriedTake, markers: MarkerSet
) -> None:
    one, other, gone = (LABELS.index(name) for name in ("LowerLip_L", "LowerLip_R", "Chin"))
    span = slice(240, 270)
    positions = actor.positions.copy()
    positions[span, [one, other]] = positions[span, [other, one]]
    free = np.full((FRAMES, 1, 3), np.nan)
    free[span, 0] = positions[span, gone]
    positions[span, gone] = np.nan
    sigma = np.full_like(positions, 0.5)
    take = replace(
        actor, positions=positions, unlabelled=free, unlabelled_names=("*1",), sigma=sigma
    )
    found = carry(take, markers, SKIN, RATE, REST)
    right = carried.take.positions
    seen = found.take.positions
    np.testing.assert_allclose(seen[span, one], right[span, other], atol=0.5)
    np.testing.assert_allclose(seen[span, other], right[span, one], atol=0.5)
    np.testing.assert_allclose(found.take.unlabelled[span, 0], right[span, gone], atol=0.5)
    assert found.take.sigma is not None
    brow = LABELS.index("Forehead_M")
    assert found.take.sigma[0, brow].mean() == pytest.approx(0.5 * found.report["scale"], rel=0.1)


def test_a_marker_that_moves_is_split_on_the_person(
    actor: Take, still: Floats, markers: MarkerSet
) -> None:
    moved = LABELS.index("Forehead_L")
    start = 300
    step = np.array([[7.0, 0.0, -1.5]])
    turned = np.array([head.turn(step)[0] for head in heads(FRAMES)])[start:]

    def split_step(take: Take, carry_it: bool) -> float:
        positions = take.positions.copy()
        positions[start:, moved] += turned @ TURN
        take = replace(take, positions=positions)
        used = markers
        if carry_it:
            carried = carry(take, markers, SKIN, RATE, REST)
            take = carried.take
            used = carried.markers
        take, split = split_moved(take, used, find_faults(take.positions, RATE), SKIN)
        assert take.labels[-1] == f"Forehead_L@{101 + start}"
        now, then = rest_places(split, SKIN)[[moved, -1]]
        return float(np.linalg.norm(then - now))

    own = split_step(as_take(still), carry_it=False)
    assert own > 4.0
    assert split_step(actor, carry_it=True) == pytest.approx(own / SIZE, rel=0.1)


@pytest.mark.parametrize("fault", ["mirrored", "shuffled", "few", "small"])
def test_nonsense_is_refused(fault: str, actor: Take, markers: MarkerSet) -> None:
    take = actor
    code = "markers.other_person"
    if fault == "mirrored":
        take = replace(actor, positions=actor.positions * [-1.0, 1.0, 1.0])
        code = "markers.mirrored"
    elif fault == "shuffled":
        order = np.random.default_rng(2).permutation(len(LABELS))
        take = replace(actor, positions=actor.positions[:, order])
    elif fault == "few":
        take = actor.pick(range(5))
        code = "markers.few"
    else:
        take = replace(actor, positions=0.5 * actor.positions)
    with pytest.raises(InputError) as caught:
        carry(take, markers, SKIN, RATE, REST)
    assert caught.value.code == code


def test_what_is_not_carried_is_told(actor: Take, markers: MarkerSet) -> None:
    """A label is bound on the wrong brow, and one goes where no face is."""
    positions = actor.positions.copy()
    thrown = LABELS.index("Chin_R2")
    positions[200:230, thrown] += 90.0
    wrong = list(markers.markers)
    one, other = (LABELS.index(name) for name in ("LBrow_In", "RBrow_In"))
    wrong[one] = replace(wrong[other], label=LABELS[one])
    found = carry(
        replace(actor, positions=positions),
        replace(markers, markers=tuple(wrong)),
        SKIN,
        RATE,
        REST,
        replace(ACTOR, smoothing=0.1),
    )
    told = {notice.code: notice.context["labels"] for notice in found.notices}
    assert told["markers.off_face"] == ["Chin_R2"]
    assert set(told["markers.carried"]) <= {label for label in LABELS if "row" in label}
    assert found.report["markers"]["LBrow_In"]["missed_mm"] > 20.0


@pytest.mark.long
def test_an_actor_is_bound_by_names_in_the_person_s_size(actor: Take, markers: MarkerSet) -> None:
    places = on_skin("neutral")

    def off(found: MarkerSet) -> float:
        away = rest_places(found, SKIN) - places
        return float(np.sqrt(np.mean(np.sum(away**2, axis=1))))

    own = bind(actor, small_model(), REST)
    scaled = bind(actor, small_model(), REST, actor=True)
    assert off(scaled.markers) < 0.6 * off(own.markers)
    assert set(scaled.markers.heights) == {2.0}
    found = carry(actor, scaled.markers, SKIN, RATE, REST)
    similar = fit_similarity(actor.positions[0], rest_places(markers, SKIN))
    assert found.report["scale"] == pytest.approx(similar.scale, rel=0.05)


@pytest.mark.long
def test_markers_of_the_orbit_are_proposed_on_its_rim(actor: Take) -> None:
    """The names of the made take put the upper ones on the lids."""
    model = small_model()
    found = bind(actor, model, REST, actor=True).markers
    lids = np.concatenate([each for name, each in model.regions.items() if name.endswith("_lid")])
    eyes = [each for each in found.markers if each.label[1:4] == "Eye"]
    assert len(eyes) == 6
    assert [each.label for each in eyes if np.isin(each.vertices, lids).any()] == []
    own = bind(made_take(made_positions(240)), model, REST).markers  # where they were seen
    assert np.isin(own.vertices[own.labels.index("LEye_Up")], lids).any()


# The check goes the way of the fit.


@pytest.mark.long
def test_the_check_of_an_actor_agrees_with_the_fit(actor: Take, markers: MarkerSet) -> None:
    person = Reference(SKIN, small_model().sha256, markers)
    check = check_take(actor, person, REST, actor=True)
    assert judge_findings(check.findings) == "good"
    (told,) = (each for each in check.findings if each.code == "markers.actor")
    carried = carry(actor, markers, SKIN, RATE, REST).report
    assert told.context["scale"] == pytest.approx(carried["scale"], rel=0.01)
    assert "--actor" not in told.advice
    check = check_take(actor, person, REST)
    assert judge_findings(check.findings) == "usable"
    (told,) = (each for each in check.findings if each.code == "markers.other_person")
    assert "--actor" in told.advice
    order = np.random.default_rng(2).permutation(len(LABELS))
    shuffled = replace(actor, positions=actor.positions[:, order])
    for given in (False, True):
        check = check_take(shuffled, person, REST, actor=given)
        assert judge_findings(check.findings) == "bad"


@pytest.mark.long
@pytest.mark.parametrize("shape", ["line", "plane"])
def test_markers_on_a_line_or_in_a_plane_are_refused(shape: str, markers: MarkerSet) -> None:
    rng = np.random.default_rng(5)
    spread = [60.0, 0.0, 0.0] if shape == "line" else [60.0, 50.0, 0.0]
    points = rng.uniform(-1.0, 1.0, (len(LABELS), 3)) * spread
    take = made_take(np.repeat(points[None], 90, axis=0))
    person = Reference(SKIN, small_model().sha256, markers)
    for given in (False, True):
        check = check_take(take, person, actor=given)
        assert "markers.flat" in [each.code for each in check.findings]
        assert judge_findings(check.findings) == "bad"
    with pytest.raises(InputError) as caught:
        carry(take, markers, SKIN, RATE)
    assert caught.value.code == "markers.flat"


def test_a_take_in_which_nothing_moves_is_told(markers: MarkerSet) -> None:
    person = Reference(SKIN, small_model().sha256, markers)
    noise = 0.03 * np.random.default_rng(5).standard_normal((90, len(LABELS), 3))
    take = made_take((on_skin("neutral") + noise) @ TURN)
    found = [each.code for each in check_take(take, person, actor=True).findings]
    assert "markers.motionless" in found
