"""Files of frames: those of the release before are read, chunks follow on one another."""

from pathlib import Path

import numpy as np
import pytest

from solver.errors import InputError
from solver.rig.frames import ChunkOptions, ChunkWriter, FrameRecord, read_chunks, read_frames
from solver.rig.frames.animation import MotionRecord, read_motion

BEFORE = Path(__file__).parent / "frames_of_0_1"


def record(number):
    return FrameRecord(number, np.ones((2, 6)), np.zeros(5), np.arange(6.0), 0, 3, 0.5)


def read(folder, code="sequence.frames", muscles=2):
    return read_chunks(
        folder, FrameRecord, code, lambda frame: frame.activations.shape == (muscles, 6)
    )


def test_sequences_of_the_release_before_are_read():
    frames = read_frames(BEFORE / "sequence", 2)
    assert [(frame.frame, frame.status) for frame in frames] == [(4, "fitted"), (6, "unseen")]
    assert (frames[0].mean_mm, frames[1].mean_mm, frames[0].iterations) == (0.25, None, 3)
    np.testing.assert_array_equal(frames[0].activations, np.arange(12.0).reshape(2, 6))
    np.testing.assert_array_equal(frames[1].head, [0.0, 0.1, 0.0, 1.0, 2.0, 3.0])


def test_simulations_of_the_release_before_are_read():
    rest = np.arange(12.0).reshape(4, 3)
    frames, motion = read_motion(BEFORE / "motion", "the scene", rest)
    assert [type(frame) for frame in frames] == [MotionRecord, MotionRecord]
    assert (frames[1].time, frames[1].behind_teeth) == (0.04, 1)
    np.testing.assert_array_equal(frames[1].moved, np.full((4, 3), 0.5))
    np.testing.assert_array_equal(motion.x, rest + 1.0)
    np.testing.assert_array_equal(motion.v, rest - 2.0)
    np.testing.assert_allclose(motion.head.shift, [1.0, 2.0, 3.0])


def test_files_are_written_when_they_are_full_and_at_the_end(tmp_path):
    beside = []
    writer = ChunkWriter(
        tmp_path, 0, ChunkOptions(2, 60.0), lambda last: {"last": beside.append(last.frame)}
    )
    for number in range(5):
        writer.add(record(number))
    assert len(list(tmp_path.iterdir())) == 2
    writer.flush()
    writer.flush()
    names = ["000000-000001.json", "000002-000003.json", "000004-000004.json"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    assert beside == [1, 3, 4]
    found = read(tmp_path)
    assert [frame.as_dict() for frame in found] == [record(n).as_dict() for n in range(5)]


def test_files_are_written_when_they_are_overdue(tmp_path):
    writer = ChunkWriter(tmp_path, 7, ChunkOptions(100, -1.0))
    writer.add(record(0))
    assert [path.name for path in tmp_path.iterdir()] == ["000007-000007.json"]


def test_gaps_and_other_models_are_refused(tmp_path):
    writer = ChunkWriter(tmp_path, 0, ChunkOptions(1))
    for number in range(3):
        writer.add(record(number))
    with pytest.raises(InputError, match="does not follow") as raised:
        read(tmp_path, "simulate.frames", muscles=3)
    assert raised.value.code == "simulate.frames"
    (tmp_path / "000001-000001.json").unlink()
    with pytest.raises(InputError, match="does not follow on the 1 frames"):
        read(tmp_path)
    (tmp_path / "000001-000001.json").write_text('{"format": 2}')
    with pytest.raises(InputError, match="holds no frames: their format is 2"):
        read(tmp_path)
