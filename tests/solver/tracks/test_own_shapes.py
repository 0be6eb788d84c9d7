"""A scan as a person's own shape: with the sum that it is on top of, it is the scan."""

import numpy as np
import pytest

from solver.meshio.registered import RegisteredScan
from solver.storage import Archive
from solver.tracks.basis import MuscleTracks
from solver.tracks.own_shapes import with_own_shapes
from solver.tracks.plain import PlainFace
from tests.solver.tracks.block import block_shapes, tracked_block


@pytest.fixture(scope="module")
def model():
    return tracked_block()


@pytest.fixture(scope="module")
def tracks(model):
    return MuscleTracks.of(model, block_shapes(model))


@pytest.fixture(scope="module")
def scanned(model, tracks):
    """A skin (V, 3) of three shapes and a dimple that none of them has."""
    face = PlainFace(model, tracks)
    q = tracks.controls({"aside": 0.6, "open": 0.5}, np.array([0.0, 0.0, 0.3, 0.0, 0.0]))
    skin = face.skin(face.move(face.rest(), q))
    dimple = np.exp(-(((model.skin.vertices[:, :2] - [38.0, 25.0]) / 8.0) ** 2).sum(axis=1))
    dimple[model.attached_mandible] = 0.0
    return skin - dimple[:, None] * [0.0, 0.0, 2.0]


def test_a_scan_is_its_shape_with_the_sum_below(model, tracks, scanned):
    own = with_own_shapes(model, tracks, {"smile": RegisteredScan(scanned, np.ones(len(scanned)))})
    assert own.tracks.names == (*tracks.names, "own_smile")
    face = PlainFace(model, own.tracks)
    q = own.tracks.whole("own_smile")
    alone = own.tracks.controls({"own_smile": 1.0})
    assert (q[: len(tracks.names)] > 0.0).any()
    assert not alone[: len(tracks.names)].any()

    def left(controls):
        skin = face.skin(face.move(face.rest(), controls))[model.face]
        return float(np.linalg.norm(skin - scanned[model.face], axis=1).mean())

    assert 0.05 < own.left_mm["own_smile"] < 0.5
    assert left(q) < 0.15 * own.left_mm["own_smile"]


def test_nothing_is_asked_for_where_a_scan_has_seen_nothing(model, tracks, scanned):
    seen = np.where(model.skin.vertices[:, 0] > 25.0, 0.0, 1.0)
    torn = np.where(seen[:, None] > 0.0, scanned, scanned + 100.0)
    own = with_own_shapes(model, tracks, {"smile": RegisteredScan(torn, seen)})
    face = PlainFace(model, own.tracks)
    skin = face.skin(face.move(face.rest(), own.tracks.whole("own_smile")))
    off = np.linalg.norm(skin - scanned, axis=1)[model.face]
    assert off[seen[model.face] > 0.0].mean() < 0.05
    assert off.max() < 3.0


def test_own_shapes_are_kept_and_files_of_before_have_none(tmp_path, model, tracks, scanned):
    scans = {"smile": RegisteredScan(scanned, np.ones(len(scanned)))}
    own = with_own_shapes(model, tracks, scans).tracks
    file = tmp_path / "tracks.npz"
    own.save(file)
    again = MuscleTracks.load(file, model)
    assert again.names == own.names
    np.testing.assert_array_equal(again.whole("own_smile"), own.whole("own_smile"))
    archive = Archive.read(file, "tracks", "a set of muscle tracks", 1)
    del archive.arrays["sums"]
    archive.write(file)
    assert not MuscleTracks.load(file, model).sums.any()
