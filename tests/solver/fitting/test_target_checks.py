"""Odd targets are told by name, region and vertex; good ones are left in peace."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.spatial.transform import Rotation

from solver.errors import InputError
from solver.fitting import target_checks
from solver.fitting.face import Face
from solver.fitting.simplex import replace_values
from solver.fitting.target_checks import check_held, idle_muscles
from solver.meshio.registered import RegisteredScan
from solver.surface import Surface, vertex_normals
from tests.solver.block import head_block

MODEL = head_block()
NEUTRAL = MODEL.skin.vertices


def scan(vertices, confidence=1.0):
    return RegisteredScan(vertices, np.full(len(vertices), confidence))


def expression(size=4.0):
    """Return a skin that moves by some mm where x is great, and lies still elsewhere."""
    moved = NEUTRAL.copy()
    moved[:, 2] += size * np.clip(NEUTRAL[:, 0] / 75.0 - 1.0, 0.0, None)
    return moved


def codes(**vertices):
    return [
        (notice.code, notice.context["expression"])
        for notice in target_checks.before_fit(
            MODEL, {name: scan(points) for name, points in vertices.items()}
        )
    ]


def test_good_scans_are_left_in_peace():
    assert codes(smile=expression(4.0), frown=expression(-4.0)) == []


def test_a_scan_that_was_sent_twice_or_is_the_neutral():
    assert codes(smile=expression(), grin=expression(), rest=NEUTRAL) == [
        ("target.repeated", "grin"),
        ("target.repeated", "rest"),
    ]


def test_a_hole_where_the_mouth_is():
    regions = {"upper_lip": np.arange(10, 14), "lower_lip": np.arange(14, 18)}
    model = replace(MODEL, regions=regions)
    seen = np.ones(len(NEUTRAL))
    seen[10:18] = 0.0
    hole = {"smile": RegisteredScan(expression(), seen)}
    (notice,) = target_checks.before_fit(model, hole)
    assert (notice.code, notice.context["region"]) == ("target.mouth", "lips")
    seen[12] = 0.5
    assert target_checks.before_fit(model, hole) == []


def test_a_scan_that_a_rig_has_under_another_name():
    known = expression().astype(np.float32)
    known[::7] = np.nan  # holes of the scan then
    check = target_checks.check_repeated
    (notice,) = check(MODEL, "mine", scan(expression()), {"frown": NEUTRAL, "smile": known})
    assert (notice.code, notice.context["other"]) == ("target.repeated", "smile")
    assert check(MODEL, "mine", scan(expression(4.5)), {"smile": known}) == []


def test_one_name_for_two_faces():
    (notice,) = target_checks.before_fit(
        MODEL, {"smile_1": scan(expression(6.0)), "Smile 1": scan(expression(-6.0))}
    )
    assert notice.code == "target.conflict"
    assert notice.context == {
        "expression": "Smile 1", "region": "left", "vertex": 56, "mm": 12.0, "other": "smile_1"
    }  # fmt: skip


def test_a_turned_head():
    turn = Rotation.from_euler("y", 7.0, degrees=True)
    centre = NEUTRAL.mean(axis=0)
    (notice,) = target_checks.before_fit(
        MODEL, {"smile": scan(turn.apply(expression() - centre) + centre + [0.0, 6.0, 0.0])}
    )
    assert notice.code == "target.turned"
    assert notice.context["degrees"] == pytest.approx(7.0, abs=1.5)
    assert notice.context["mm"] == pytest.approx(6.0, abs=1.0)


def test_a_spike_is_no_skin():
    spiked = expression()
    spiked[10, 2] += 90.0
    (notice,) = target_checks.before_fit(MODEL, {"smile": scan(spiked)})
    assert notice.code == "target.stretched"
    assert (notice.context["vertex"], notice.context["region"]) == (10, "right")


def test_a_scan_of_little_of_the_face():
    confidence = np.zeros(len(NEUTRAL))
    confidence[-20:] = 1.0
    seen = RegisteredScan(expression(), confidence)
    (notice,) = target_checks.before_fit(MODEL, {"smile": seen})
    assert notice.code == "target.coverage"


def test_what_a_fit_leaves_is_told_by_patch():
    error = np.full(len(NEUTRAL), 0.4)
    assert target_checks.after_fit(MODEL, "smile", error) == []
    error[[8, 9, 15, 16]] = [2.5, 4.5, 3.0, 2.5]
    error[30] = np.nan
    (notice,) = target_checks.after_fit(MODEL, "smile", error)
    assert notice.code == "fit.unreached"
    assert notice.context["vertex"] == 9
    assert notice.context["mm"] == 4.5
    assert notice.context["size_mm"] == pytest.approx(np.sqrt(4 * 4 * 18.75 * 20 / np.pi), rel=0.2)
    assert "vertex 9 (right)" in notice.message
    # the same on a skin of a tenth of the size is a speck
    speck = replace(MODEL, skin=Surface(0.1 * NEUTRAL, MODEL.skin.faces))
    assert target_checks.after_fit(speck, "smile", error) == []
    error[[0, 27, 40, 45, 60]] = 6.0
    assert len(target_checks.after_fit(MODEL, "smile", error)) == 3


def test_what_stands_up_from_muscles_is_told():
    centre = NEUTRAL[[9, 30]].mean(axis=0)
    away = np.linalg.norm((NEUTRAL - centre)[:, :2], axis=1)
    normals = vertex_normals(MODEL.skin)
    puffed = NEUTRAL + 5.0 * np.exp(-((away / 30.0) ** 2))[:, None] * normals
    fitted = NEUTRAL + 0.3 * (puffed - NEUTRAL)
    (notice,) = target_checks.find_inflated(MODEL, "puff", puffed, fitted)
    assert notice.code == "fit.inflated"
    assert 2.0 < notice.context["mm"] <= 3.5
    assert "air in the cheek" in notice.message
    # a smile that is not reached slides along the face; dents and noise stand up nowhere
    slid = puffed + 6.0 * np.exp(-((away / 30.0) ** 2))[:, None] * [1.0, 0.0, 0.0]
    dented = 2.0 * NEUTRAL - puffed
    noisy = NEUTRAL + np.random.default_rng(1).normal(0.0, 0.5, NEUTRAL.shape)
    for odd in (slid, dented, noisy):
        assert target_checks.find_inflated(MODEL, "smile", odd, NEUTRAL) == []
    hidden = np.where(away[:, None] < 50.0, np.nan, puffed)
    assert target_checks.find_inflated(MODEL, "puff", hidden, NEUTRAL) == []


def test_another_face_for_a_known_name():
    assert (
        target_checks.check_replaced(MODEL, "smile", expression(4.0), scan(expression(5.0))) == []
    )
    (notice,) = target_checks.check_replaced(
        MODEL, "smile", expression(4.0), scan(expression(-4.0))
    )
    assert notice.code == "target.replaced"


def test_flesh_that_nothing_holds_is_refused():
    check_held(Face(MODEL))
    away = MODEL.rest[MODEL.tets[0]] + [500.0, 0.0, 0.0]
    rest = np.concatenate([MODEL.rest, away])
    tets = np.concatenate([MODEL.tets, len(MODEL.rest) + np.arange(4)[None]])
    weights = sp.vstack([MODEL.weights, MODEL.weights[[0]]]).tocsr()
    embedding = sp.csr_array(
        (MODEL.embedding.data, MODEL.embedding.indices, MODEL.embedding.indptr),
        shape=(MODEL.embedding.shape[0], len(rest)),
    )
    loose = replace(MODEL, rest=rest, tets=tets, weights=weights, embedding=embedding)
    with pytest.raises(InputError, match="held by no bone") as caught:
        check_held(Face(loose))
    assert caught.value.code == "model.floating"
    assert caught.value.context["vertex"] == len(MODEL.rest)
    # two held vertices leave it a hinge
    hinged = replace(loose, cranium=np.r_[MODEL.cranium, len(MODEL.rest) + np.arange(2)])
    with pytest.raises(InputError, match="held by no bone"):
        check_held(Face(hinged))
    held = replace(loose, cranium=np.r_[MODEL.cranium, len(MODEL.rest) + np.arange(3)])
    check_held(Face(held))


def test_muscles_that_move_nothing_are_named():
    face = Face(MODEL)
    S = MODEL.weights
    assert idle_muscles(face) == []
    dense = S.toarray()
    dense[:, 0] += dense[:, 2]
    dense[:, 2] = 0.0
    (notice,) = idle_muscles(face.with_weights(replace_values(S, dense.ravel())))
    assert (notice.code, notice.context["muscle"]) == ("muscle.no_share", "right")
    (notice,) = idle_muscles(face.with_weights(sp.csr_array(dense)))
    assert notice.code == "muscle.no_candidates"
