"""Takes are read by the jobs of exact fits, with gaps where frames did not come."""

import hashlib

import numpy as np
import pytest

from solver.errors import InputError
from solver.live.sent import FILE, SentModes, SentOptions, gather_takes, part_of, read_takes
from solver.live.takes import (
    PART,
    SentFace,
    TakeLimits,
    TakeWriter,
    check_name,
    check_room,
    drop_part,
    file_name,
    finish_part,
)
from solver.live.weights import LiveWeights
from solver.scans.live_link import ARKIT_NAMES, read_live_link
from solver.scans.markers.readers.take import read_take

MODES = SentModes({"model": "a", "weights": "b"}, np.zeros((2, 5, 3), np.float16))
TIMES = 100.0 + np.array([0, 1, 2, 5, 6, 6, 7]) / 60


SENT = [SentFace(np.array([number, 0.1]), (0.1 * number, 0.5)) for number in range(7)]
SENT[1] = SENT[4] = None  # dropped, or held


def record(folder, source, labels, frames):
    writer = TakeWriter(folder, "one", source, labels, frames.shape[1:], MODES)
    for seconds, numbers, sent in zip(TIMES, frames, SENT, strict=True):
        writer.add(seconds, numbers, sent)
    left = writer.finish()
    drop_part(folder, left)
    return left


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
    left = finish_part(part)
    assert left.frames == 3
    assert finish_part(part) == left  # of an attempt that was killed before it was listed
    drop_part(tmp_path, left)
    assert not part.exists()
    assert np.load(tmp_path / "take_two.npy").shape == (3, 4, 3)


@pytest.mark.parametrize("size", [0, 20, None])
def test_a_take_without_a_frame_is_none_whenever_its_process_died(tmp_path, size):
    TakeWriter(tmp_path, "two", "points", [], (4, 3), MODES)
    part = tmp_path / f"{file_name('two', 'points')}{PART}"
    if size is not None:
        part.write_bytes(part.read_bytes()[:size])
    assert check_name("two", tmp_path, "points") == "two-2"
    assert finish_part(part) is None
    assert not part.exists()


def test_a_clock_that_is_set_back_costs_no_frame(tmp_path):
    writer = TakeWriter(tmp_path, "two", "points", [], (4, 3), MODES)
    seconds = np.array([100.0, 100.02, 100.04, 3.0, 3.02, 3.01, 3.04])
    for number, when in enumerate(seconds):
        writer.add(when, np.full((4, 3), number, np.float32))
    left = writer.finish()
    assert (left.frames, left.seconds) == (6, pytest.approx(0.10))
    found = np.load(tmp_path / left.file)
    np.testing.assert_array_equal(found[:, 0, 0], [0, 1, 2, 3, 4, 6])


def test_a_session_leaves_no_more_than_its_job_may(tmp_path):
    files = [tmp_path / f"take_{number}.npz" for number in range(3)]
    for path in files:
        path.write_bytes(bytes(10))
    check_room(files)
    for limits in (TakeLimits(most_takes=3), TakeLimits(most_left_bytes=30)):
        with pytest.raises(InputError) as caught:
            check_room(files, limits)
        assert caught.value.code == "live.takes_full"


@pytest.mark.parametrize(
    ("source", "shape", "frames"),
    [("points", (20, 3), [0, 2, 5, 7]), ("weights", (61, 1), [0, 1, 2, 4])],
)
def test_what_was_sent_lies_beside_a_take_by_its_frames(tmp_path, source, shape, frames):
    """Of two rows at one time the first counts; of weights frames without one are left out."""
    numbers = np.full((7, *shape), 0.5, np.float32)
    if source == "weights":
        numbers[1] = np.nan
    left = tmp_path / record(tmp_path, source, LiveWeights.labels, numbers).file
    _, [sent] = read_takes(part_of(left))
    assert sent.frames.tolist() == frames
    np.testing.assert_array_equal(sent.amounts[:, 0], [0, 2, 3, 6])
    assert sent.told == {"p50_mm": pytest.approx(0.6), "p95_mm": 0.5}
    assert sent.sha256 == hashlib.sha256(left.read_bytes()).hexdigest()


def test_what_was_sent_of_all_takes_is_gathered(tmp_path):
    frames = np.zeros((7, 4, 3), np.float32)

    def gathered(**given):
        gather_takes(tmp_path, MODES, **given)
        assert not list(tmp_path.glob(f"*{PART}"))
        archive, takes = read_takes(tmp_path / FILE)
        assert archive.header["of"] == MODES.identity
        np.testing.assert_array_equal(archive.arrays["basis"], MODES.basis)
        return [each.name for each in takes]

    record(tmp_path, "points", [], frames)
    assert gathered() == ["one"]
    other = SentModes(MODES.rig, MODES.basis + np.float16(1))
    stranger = TakeWriter(tmp_path, "other", "points", [], (4, 3), other)
    stranger.add(0.0, frames[0])
    drop_part(tmp_path, stranger.finish())
    held = TakeWriter(tmp_path, "held", "points", [], (4, 3), MODES)
    held.add(0.0, frames[0])
    drop_part(tmp_path, held.finish())
    assert gathered() == ["one", "held"]  # a later session in the same folder
    record(tmp_path, "points", [], frames)
    assert gathered(options=SentOptions(most_bytes=20)) == ["held", "one"]
    record(tmp_path, "points", [], frames)
    gather_takes(tmp_path, None)
    assert not list(tmp_path.glob(f"*{PART}"))


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
