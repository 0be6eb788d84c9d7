"""Scans fitted by weights of shapes whose head is placed with them."""

from __future__ import annotations

import numpy as np
import pytest

from solver.fitting.tracking.dense import HeadAndFace, stillness
from solver.kinds import KINDS
from solver.kinds.kind import OptionsError
from solver.meshio.registered import RegisteredScan
from solver.rig.shape_fits import SCAN_HEAD, fit_scan
from solver.similarity import small_motion
from solver.tracks.basis import MuscleTracks
from solver.tracks.plain import PlainFace
from tests.fixtures import small_model
from tests.solver.jobs.test_fit_photo import shapes

# 5 degrees about an axis of the head's, and 3 mm
TURN = np.deg2rad(5.0) * np.array([0.6, 0.64, 0.48])
SHIFT = 3.0 * np.array([0.48, 0.6, 0.64])


@pytest.fixture(scope="module")
def face() -> PlainFace:
    model = small_model()
    return PlainFace(model, MuscleTracks.of(model, shapes()))


def test_a_turned_scan_is_fitted_as_the_unturned_one(face: PlainFace) -> None:
    made = face.tracks.controls({"mouthSmileLeft": 0.8, "browInnerUp": 0.5})
    skin = face.skin(face.move(face.rest(), made))
    turn = small_motion(np.concatenate([TURN, np.zeros(3)]))
    middle = skin.mean(axis=0)
    motion = turn.then(small_motion(np.concatenate([np.zeros(3), middle - turn(middle) + SHIFT])))
    seen = np.ones(len(skin))
    fixed = HeadAndFace()
    placed = HeadAndFace(still=stillness(face.face), options=SCAN_HEAD)
    unturned = fit_scan(face, "smile", RegisteredScan(skin, seen), fixed)
    scan = RegisteredScan(motion(skin), seen)
    found, wrong = (fit_scan(face, "smile", scan, each) for each in (placed, fixed))
    ids = face.face.model.face
    off, off_fixed = (
        np.linalg.norm((each.skin - unturned.skin)[ids], axis=1) for each in (found, wrong)
    )
    assert off.max() < 0.02
    assert off_fixed.mean() > 1.0
    np.testing.assert_allclose(found.head, motion.twist, atol=1e-3)
    np.testing.assert_allclose(found.target, skin, atol=0.01)  # in the skull's axes, as the skin
    assert not wrong.head.any()
    # the scan is known again, and so is another one
    assert found.is_of(scan.vertices)
    assert not found.is_of(skin)


def test_a_head_that_is_hardly_seen_stays(face: PlainFace) -> None:
    skin = face.face.model.skin.vertices
    still = stillness(face.face)
    placed = HeadAndFace(still=still, options=SCAN_HEAD)
    seen = np.zeros(len(skin))
    seen[face.face.model.face] = still <= np.sort(still)[len(still) // 4]
    seen[face.face.model.face[still > SCAN_HEAD.still]] = 0.0
    moved = RegisteredScan(skin + SHIFT, seen)
    found = fit_scan(face, "half", moved, placed)
    assert [each.code for each in found.notices] == ["target.no_head"]
    assert not found.head.any()
    seen[face.face.model.face] = np.arange(len(still)) < 5  # where a fixed one is nobody asks
    assert fit_scan(face, "few", RegisteredScan(skin, seen), HeadAndFace()).notices == ()


def test_heads_are_placed_for_weights_alone() -> None:
    for beside in ("muscles", "per_tet"):
        with pytest.raises(OptionsError, match="place no head"):
            KINDS["fit_tracks"].read({"head": "placed", beside: True})
