"""Signals of faces: what is taken off, filled in and steadied, and how they are kept."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from solver.errors import InputError
from solver.kinds.scene_recording import Recording
from solver.scans.live_link import ARKIT_NAMES, FaceTake, read_live_link, write_signals
from solver.scans.recordings import read_recording
from solver.scans.signals import eyes_of, low_pass, play_signals, with_looks
from solver.surface import Floats

SMILE, OPEN = (ARKIT_NAMES.index(name) for name in ("mouthSmileLeft", "jawOpen"))
BLINK, DOWN = (ARKIT_NAMES.index(name) for name in ("eyeBlinkLeft", "eyeLookDownLeft"))


def measured(count: int = 40, **shapes: Floats) -> FaceTake:
    """Return what was measured of a video at 25 frames a second."""
    random = np.random.default_rng(0)
    weights = np.zeros((count, len(ARKIT_NAMES)))
    for name, values in shapes.items():
        weights[:, ARKIT_NAMES.index(name)] = values
    head = random.uniform(-0.4, 0.4, (count, 3))
    eyes = random.uniform(-0.3, 0.3, (count, 2, 3))
    return FaceTake(np.arange(count) / 25.0, weights, head, eyes, np.ones(count, bool), "video")


def play(take: FaceTake, **options: Any) -> FaceTake:
    return play_signals("take.mp4", take, Recording(asset="take", **options))


def test_what_a_video_has_at_rest_is_taken_off_and_what_it_cannot_see_is_at_rest() -> None:
    smile = np.concatenate([np.full(20, 0.3), np.full(20, 0.8)])
    take = measured(mouthSmileLeft=smile, cheekPuff=0.4 + 0.0004 * np.arange(40))
    played = play(take, smooth_hz=0)
    np.testing.assert_allclose(played.weights[:, SMILE], smile - 0.3)
    assert not played.weights[:, ARKIT_NAMES.index("cheekPuff")].any()
    still = play(take, neutral=39, gain=2.0, smooth_hz=0)
    np.testing.assert_allclose(still.weights[:, SMILE], 0.0)
    assert not still.head[39].any()
    turned = Rotation.from_rotvec(take.head[39]) * Rotation.from_rotvec(still.head[5])
    np.testing.assert_allclose(turned.as_rotvec(), take.head[5], atol=1e-12)


def test_a_recording_of_live_link_is_as_it_was_unless_it_is_asked_for() -> None:
    take = replace(measured(mouthSmileLeft=np.linspace(0.1, 0.9, 40)), source="live_link")
    np.testing.assert_array_equal(play(take).weights, take.weights)
    np.testing.assert_allclose(play(take).head, take.head)
    smile = play(take, neutral=0, gain="range")
    assert smile.weights[-1, SMILE] == pytest.approx(1.0)
    assert [notice.code for notice in smile.notices] == ["live_link.range"]
    np.testing.assert_allclose(play(take, fps=50).times, take.times / 2.0)


def test_the_head_is_in_the_world_where_the_camera_is_known() -> None:
    """An upright head, seen from below, is one that looks over the camera."""
    take = measured()
    up = np.tile([-0.2, 0.0, 0.0], (40, 1))  # x turned back: it looks up
    played = play(replace(take, head=up), camera_pitch_deg=np.degrees(0.2), smooth_hz=0)
    np.testing.assert_allclose(played.head, 0.0, atol=1e-12)


def test_jitter_goes_and_motion_stays_when_it_was() -> None:
    random = np.random.default_rng(1)
    times = np.cumsum(random.uniform(0.01, 0.03, 300))
    along = times - times[150]
    for values in (along, along**2):  # also at the ends, and however the frames lie
        np.testing.assert_allclose(low_pass(times, values[:, None], 6.0)[:, 0], values, atol=1e-9)
    even = np.arange(400) / 100.0
    inner = slice(100, 300)
    for hertz, kept in ((1.0, (0.995, 1.0)), (6.0, (0.65, 0.8)), (15.0, (0.0, 0.05))):
        wave = np.sin(2.0 * np.pi * hertz * even)
        left = low_pass(even, wave[:, None], 6.0)[inner, 0]
        assert kept[0] <= left @ wave[inner] / (wave[inner] @ wave[inner]) <= kept[1]


def test_a_blink_is_not_steadied() -> None:
    blink = np.zeros(40)
    blink[20] = 1.0
    played = play(measured(eyeBlinkLeft=blink, jawOpen=blink), smooth_hz=6)
    assert played.weights[20, BLINK] == 1.0
    assert played.weights[20, OPEN] < 0.7


def test_lids_follow_the_eyes() -> None:
    weights = np.zeros((1, len(ARKIT_NAMES)))
    weights[0, DOWN] = 0.5
    eyes = eyes_of(weights)
    looks = Rotation.from_rotvec(eyes[0, 0]).apply([0.0, 0.0, 1.0])
    assert np.degrees(np.arcsin(-looks[1])) == pytest.approx(0.5 * 31.0)
    back = with_looks(np.zeros_like(weights), eyes)
    np.testing.assert_allclose(back, weights, atol=1e-12)
    for name in ("eyeLookOutRight", "eyeLookInLeft", "eyeLookUpLeft"):
        one = np.zeros_like(weights)
        one[0, ARKIT_NAMES.index(name)] = 0.7
        np.testing.assert_allclose(with_looks(np.zeros_like(one), eyes_of(one)), one, atol=1e-12)


def test_signals_are_kept_as_a_recording_that_plays_the_same(tmp_path: Path) -> None:
    take = measured(mouthSmileLeft=np.linspace(0.0, 0.9, 40))
    seen = np.ones(40, bool)
    seen[10:20] = False
    times = take.times + 0.003 * np.sin(np.arange(40))  # of a variable rate
    take = replace(take, seen=seen, times=times - times[0])
    write_signals(tmp_path / "signals.csv", take)
    again = read_live_link(tmp_path / "signals.csv")
    assert (again.source, again.timecodes) == ("video", ())
    np.testing.assert_array_equal(again.seen, take.seen)
    for name in ("times", "weights", "head", "eyes"):
        np.testing.assert_allclose(getattr(again, name), getattr(take, name), atol=1e-8)
    entry = Recording(asset="take", gain=1.2, smooth_hz=5)
    played = read_recording(tmp_path / "signals.csv", entry)
    expected = play_signals("signals.csv", take, entry)
    np.testing.assert_allclose(played.weights, expected.weights, atol=1e-8)
    assert played.gaps == pytest.approx(expected.gaps)
    assert [notice.code for notice in played.notices] == ["video.gaps"]


@pytest.mark.parametrize(("neutral", "why"), [(40, "none 40"), (12, "no face")])
def test_a_frame_at_rest_has_to_be_there(neutral: int, why: str) -> None:
    take = measured()
    take.seen[12] = False
    with pytest.raises(InputError, match=why) as error:
        play(take, neutral=neutral)
    assert error.value.code == "video.neutral"
