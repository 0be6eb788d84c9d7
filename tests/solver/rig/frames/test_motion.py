"""Frames of a simulation on disk: whole, in order, and of one scene."""

from dataclasses import replace

import numpy as np
import pytest

from solver.errors import InputError
from solver.mechanics.flesh import IDENTITY
from solver.rig.frames import write_chunk
from solver.rig.frames.animation import MotionRecord, motion_values, read_motion
from solver.simulation.forces import FleshMotion
from tests.solver.block import block_model


@pytest.fixture
def rest():
    return block_model().rest


def frames(rest, count, start=0):
    rng = np.random.default_rng(start)
    return [
        MotionRecord(
            frame=number,
            time=number / 30,
            activations=np.tile(IDENTITY, (2, 1)),
            jaw=rng.normal(size=5),
            head=np.array([0.0, 0.2, 0.0, 1.0, 2.0, 3.0]),
            eyes=np.zeros((2, 3)),
            moved=rng.normal(size=rest.shape),
            penetration_mm=0.1,
            behind_teeth=0,
            inverted=0,
            iterations=3,
            halvings=0,
            residual=1e-6,
            seconds=0.5,
        )
        for number in range(start, start + count)
    ]


def test_what_was_written_is_read(tmp_path, rest):
    written = frames(rest, 3)
    motion = FleshMotion(rest + 1.0, rest - 2.0, written[-1].into_world)
    beside = motion_values("scene", motion, None)
    write_chunk(tmp_path, 0, written[:2], beside)
    path = write_chunk(tmp_path, 2, written[2:], beside)
    assert path.name == "000002-000002.json"
    found, end = read_motion(tmp_path, "scene", rest)
    for one, other in zip(found, written, strict=True):
        np.testing.assert_allclose(one.moved, other.moved, atol=1e-6)
        same = replace(one, moved=other.moved).as_dict()
        assert same == other.as_dict()
    np.testing.assert_array_equal(end.x, motion.x)
    np.testing.assert_array_equal(end.v, motion.v)
    np.testing.assert_allclose(end.head.rotation, motion.head.rotation)


def test_a_folder_without_frames_is_rest(tmp_path, rest):
    found, end = read_motion(tmp_path / "frames", "scene", rest)
    assert found == []
    np.testing.assert_array_equal(end.x, rest)
    assert not end.v.any()


def test_frames_of_another_scene_or_after_a_gap_are_refused(tmp_path, rest):
    motion = FleshMotion(rest, rest, frames(rest, 1)[0].into_world)
    beside = motion_values("scene", motion, None)
    write_chunk(tmp_path, 0, frames(rest, 2), beside)
    for scene, model, code in (
        ("other", rest, "simulate.other_scene"),
        ("scene", rest[:-1], "simulate.frames"),
    ):
        with pytest.raises(InputError) as raised:
            read_motion(tmp_path, scene, model)
        assert raised.value.code == code
    write_chunk(tmp_path, 3, frames(rest, 1, start=3), beside)
    with pytest.raises(InputError, match="follow"):
        read_motion(tmp_path, "scene", rest)
    (tmp_path / "000004-000004.json").write_text("{}")
    with pytest.raises(InputError, match=r"holds no frames|follow"):
        read_motion(tmp_path, "scene", rest)
