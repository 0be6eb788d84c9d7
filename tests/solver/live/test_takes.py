"""Takes are read by the jobs of exact fits, with gaps where frames did not come."""

import numpy as np
import pytest

from solver.errors import InputError
from solver.live.sent import SentModes
from solver.live.takes import PART, TakeWriter, check_name, file_name, finish_part
from solver.live.weights import LiveWeights
from solver.scans.markers.readers.take import read_take
from solver.scans.performance import ARKIT_NAMES, read_live_link

MODES = SentModes({"model": "a", "weights": "b"}, np.zeros((2, 5, 3), np.float16))
TIMES = 100.0 + np.array([0, 1, 2, 5, 6, 6, 7]) / 60


def record(folder, source, labels, frames):
    writer = TakeWriter(folder, "one", source, labels, frames.shape[1:], MODES)
    for seconds, numbers in zip(TIMES, frames, strict=True):
        writer.add(seconds, numbers)
    return writer.finish()


def test_markers_are_left_at_even_times(tmp_path):
    frames = np.random.default_rng(1).uniform(1.0, 9.0, (7, 3, 3)).astype(np.float32)
    frames[1, 2, 0] = np.nan
    left = record(tmp_path, "markers", ["A", "B", "C"], frames)
    assert (left.file, left.frames) == ("take_one.npz", 6)
    take = read_take(tmp_path / left.file)
    assert take.labels == ("A", "B", "C")
    assert take.rate == pytest.approx(60.0, rel=1e-6)
    assert len(take) == 8
    assert np.isnan(take.positions[3:5]).all()
    assert np.isnan(take.positions[1, 2]).all()
    np.testing.assert_allclose(take.positions[[0, 2, 5, 7]], frames[[0, 2, 3, 6]])


def test_weights_are_left_as_a_recording(tmp_path):
    frames = np.random.default_rng(1).uniform(0.0, 0.9, (7, 61, 1)).astype(np.float32)
    frames[2, 4] = np.nan
    left = record(tmp_path, "weights", LiveWeights.labels, frames)
    take = read_live_link(tmp_path / left.file)
    assert take.source == "live_link"
    np.testing.assert_allclose(take.times, TIMES[[0, 1, 2, 3, 4, 6]] - 100.0, atol=1e-8)
    np.testing.assert_allclose(take.weights[0], frames[0, :52, 0], atol=1e-7)
    assert take.weights[2, 4] == pytest.approx(frames[1, 4, 0])
    assert len(ARKIT_NAMES) == 52


def test_points_are_left_as_an_array(tmp_path):
    frames = np.random.default_rng(1).standard_normal((7, 20, 3)).astype(np.float32)
    left = record(tmp_path, "points", [], frames)
    found = np.load(tmp_path / left.file)
    assert found.shape == (8, 20, 3)
    assert np.isnan(found[3]).all()
    np.testing.assert_array_equal(found[7], frames[6])


def test_a_take_whose_process_died_is_finished_by_its_part(tmp_path):
    writer = TakeWriter(tmp_path, "two", "points", [], (4, 3), MODES)
    for number in range(3):
        writer.add(number / 30, np.full((4, 3), number, np.float32))
    writer._stream.write(b"half of a frame")
    writer._stream.flush()
    part = tmp_path / f"{file_name('two', 'points')}{PART}"
    assert finish_part(part).frames == 3
    assert not part.exists()
    assert np.load(tmp_path / "take_two.npy").shape == (3, 4, 3)


def test_a_take_without_frames_leaves_nothing(tmp_path):
    assert TakeWriter(tmp_path, "none", "weights", [], (61, 1), MODES).finish() is None
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["", "../x", "a b", 7, None, "-x", "x" * 65])
def test_names_that_are_no_files_are_refused(tmp_path, name):
    with pytest.raises(InputError) as caught:
        check_name(name, tmp_path, "weights")
    assert caught.value.code == "live.take_name"


def test_a_name_that_is_taken_gets_a_number(tmp_path):
    (tmp_path / "take_smile.csv").touch()
    assert check_name("smile", tmp_path, "weights") == "smile-2"
