"""Fitted performances in scenes: gains, time, head, gaps, masks, and what is refused."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

from solver.animation import neck
from solver.animation.performance import FittedSequence
from solver.errors import InputError
from solver.fitting.drives.six_numbers import LEAST_STRETCH
from solver.fitting.stretches import COLUMN, ROW, matrices
from solver.kinds.scene import SimulateScene
from solver.mechanics.flesh import IDENTITY
from solver.rig.frames import SequenceFrame, write_sequence
from solver.scene.document import drives_of, performances_of, read_scene
from solver.scene.places import Places
from solver.similarity import small_motion
from tests.solver.block import block_model

MODEL = block_model()
COUNT = 12
FIRST = 100
FPS = 25.0
TURNED = np.array([0.0, 3.0, 0.3])  # the studio's z is not the model's: turns beyond 180 degrees


def activation(stretches: list[float], turn: list[float]) -> np.ndarray:
    """Return the six numbers of stretches along turned axes."""
    axes = Rotation.from_rotvec(turn).as_matrix()
    return ((axes * stretches) @ axes.T)[ROW, COLUMN]


SQUEEZED = activation([0.6, 1.2, 1.4], [0.3, -0.5, 0.9])


def frames(**status: str) -> list[SequenceFrame]:
    """Return a take in which both muscles and the jaw are on their way; ``f3="kept"`` is one's."""
    found = []
    for number in range(COUNT):
        part = number / (COUNT - 1)
        a = np.array([IDENTITY + part * (SQUEEZED - IDENTITY), IDENTITY * (1.0 - 0.3 * part)])
        jaw = np.array([0.2 * part, 0.0, 0.0, 0.0, -2.0 * part])
        turn = (
            Rotation.from_rotvec([0.0, 0.4 * part, 0.0]) * Rotation.from_rotvec(TURNED)
        ).as_rotvec()
        head = np.array([*turn, 500.0 + 30.0 * part, 1200.0, 80.0])
        told: Any = status.get(f"f{number}", "fitted")
        where = (FIRST + number, a, jaw, head, 0, 3, 0.1)
        found.append(SequenceFrame(*where, told, 0.3, 0.5, 1.0, 1.0))
    return found


@pytest.fixture
def take(tmp_path: Path) -> Path:
    return write(tmp_path, frames())


def write(folder: Path, content: list[SequenceFrame]) -> Path:
    return write_sequence(folder, content, MODEL.muscle_names, FPS, {})[0]


def played(files: Path | dict[str, Path], scene: dict[str, Any] | list[Any], **more: Any) -> Any:
    """Return the drives of a scene's ``performance``."""
    assets = files if isinstance(files, dict) else {"take": files}
    document = {"performance": scene, "interpolation": "linear", **more}
    given = read_scene(document, SimulateScene)
    under = performances_of(given, {}, Places(MODEL, {}, assets), MODEL.weights)
    return drives_of(given, {}, MODEL, MODEL.weights, under)


def take_of(**entry: Any) -> dict[str, Any]:
    return {"asset": "take", **entry}


def test_frames_are_played_as_they_were_fitted(take: Path) -> None:
    drives = played(take, take_of(head="as_fitted"), fps=FPS)
    np.testing.assert_allclose(drives.times, np.arange(COUNT) / FPS)
    for time, frame in zip(drives.times, frames(), strict=True):
        pose = drives(time)
        np.testing.assert_allclose(pose.a, frame.activations, atol=1e-12)
        np.testing.assert_allclose(pose.jaw, frame.jaw, atol=1e-12)
        expected = small_motion(frame.head)
        np.testing.assert_allclose(pose.head(MODEL.rest), expected(MODEL.rest), atol=1e-9)
        assert pose.clamped == 0
    # between frames, too, where the studio's rotation vectors jump
    for time in drives.times[:-1]:
        turn = drives(time).head.rotation.T @ drives(time + 0.5 / FPS).head.rotation
        assert Rotation.from_matrix(turn).magnitude() < 0.03


def test_a_gain_is_a_power_of_the_stretch_by_muscle(take: Path) -> None:
    last = (COUNT - 1) / FPS
    still = played(take, take_of(gain=0.0))(last)
    np.testing.assert_allclose(still.a, np.tile(IDENTITY, (2, 1)), atol=1e-12)
    assert still.jaw[0] == pytest.approx(0.2)  # a gain is of muscles
    both = played(take, take_of(gain=0.8, muscles={"left": 2.0}))(last)
    left, right = matrices(np.array([SQUEEZED, IDENTITY * 0.7]))
    found = matrices(both.a)
    np.testing.assert_allclose(found[0], expm(1.6 * logm(left)), atol=1e-12)
    np.testing.assert_allclose(found[1], expm(0.8 * logm(right)), atol=1e-12)
    twice = played(take, take_of(gain=2.0))(last)
    np.testing.assert_allclose(matrices(twice.a)[0], left @ left, atol=1e-12)
    wild = played(take, take_of(gain=10.0))(last)
    stretches = np.linalg.eigvalsh(matrices(wild.a))
    assert stretches.min() == pytest.approx(LEAST_STRETCH)
    assert stretches.max() <= 1.0 / LEAST_STRETCH + 1e-9
    assert wild.clamped == 2


def test_times_are_those_of_the_chosen_frames_by_the_speed(take: Path) -> None:
    drives = played(take, take_of(start=FIRST + 3, end=FIRST + 9, speed=0.5), fps=10)
    assert drives.times[-1] == pytest.approx(0.4)  # 5 frames at 25 / s, half as fast
    fitted = frames()
    np.testing.assert_allclose(drives(0.0).a, fitted[3].activations, atol=1e-12)
    np.testing.assert_allclose(drives(0.08).jaw, fitted[4].jaw, atol=1e-12)
    np.testing.assert_allclose(drives(0.4).jaw, fitted[8].jaw, atol=1e-12)
    np.testing.assert_allclose(drives(9.0).jaw, fitted[8].jaw, atol=1e-12)  # the last one stays
    between = drives(0.04)
    np.testing.assert_allclose(between.jaw, (fitted[3].jaw + fitted[4].jaw) / 2, atol=1e-12)


def test_frames_before_the_files_zero_are_chosen_and_bridged_by_their_numbers(
    tmp_path: Path,
) -> None:
    early = [replace(each, frame=each.frame - FIRST - 7) for each in frames()]
    whole = frames()
    bridged = {"spans": [{"start": -3, "end": -2}]}
    drives = played(write(tmp_path, early), take_of(start=-5, end=-1, bridges=bridged), fps=FPS)
    assert drives.times[-1] == pytest.approx(3 / FPS)
    np.testing.assert_allclose(drives(0.0).jaw, whole[2].jaw, atol=1e-12)
    between = drives(2 / FPS).a
    assert np.abs(between - whole[4].activations).max() > 1e-4
    np.testing.assert_allclose(drives(3 / FPS).jaw, whole[5].jaw, atol=1e-12)


def test_the_head_moves_rigidly_from_where_it_is_at_the_start(take: Path) -> None:
    drives = played(take, take_of(start=FIRST + 2))
    one, other = (small_motion(frames()[number].head) for number in (2, 8))
    np.testing.assert_allclose(drives(0.0).head(MODEL.rest), MODEL.rest, atol=1e-9)
    moved = drives(6 / FPS).head(MODEL.rest)
    np.testing.assert_allclose(moved, one.inverse()(other(MODEL.rest)), atol=1e-9)
    half = drives(6.5 / FPS).head
    np.testing.assert_allclose(half.rotation @ half.rotation.T, np.eye(3), atol=1e-12)
    ends = [drives(frame / FPS).head for frame in (6, 7)]
    turn = Rotation.from_matrix(ends[0].rotation.T @ ends[1].rotation).magnitude()
    gone = Rotation.from_matrix(ends[0].rotation.T @ half.rotation).magnitude()
    assert gone == pytest.approx(turn / 2)
    pivot = neck(MODEL)[None]
    middle = (ends[0](pivot) + ends[1](pivot)) / 2
    np.testing.assert_allclose(half(pivot), middle, atol=1e-9)
    stiff = played(take, take_of(head="still"), head=[{"time": 0, "move_mm": [0, 0, 4]}])(0.3).head
    np.testing.assert_allclose(stiff.shift, [0.0, 0.0, 4.0], atol=1e-9)


@pytest.mark.parametrize("interpolation", ["linear", "smooth"])
def test_a_gap_is_bridged_by_controls_without_a_jump(tmp_path: Path, interpolation: str) -> None:
    """Frames 4 to 7 hold the pose of another time, 10 and 11 hold nothing at all."""
    content = frames(f4="kept", f5="kept", f6="unseen", f7="predicted", f10="unseen", f11="unseen")
    for number in (4, 5, 6, 7):
        content[number].activations[:] = IDENTITY * 1.5
        content[number].jaw[:] = 9.0
    for number in (10, 11):
        content[number].activations[:] = np.nan
    file = write(tmp_path, content)
    whole = frames()
    drives = played(file, take_of(), interpolation=interpolation)
    [performance] = drives.under.performances
    assert performance.bridged.tolist() == [FIRST + number for number in (4, 5, 6, 7, 10, 11)]
    moments = np.linspace(3 / FPS, 8 / FPS, 101)
    jaws = np.array([drives(moment).jaw[0] for moment in moments])
    assert jaws[0] == pytest.approx(whole[3].jaw[0])
    assert jaws[-1] == pytest.approx(whole[8].jaw[0])
    assert (np.diff(jaws) > 0).all()
    assert np.diff(jaws).max() < 3.0 * np.diff(jaws).mean()
    path = np.array([drives(moment).a.ravel() for moment in moments])
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    assert steps.max() < 3.0 * steps.mean()
    np.testing.assert_allclose(drives(11 / FPS).a, whole[9].activations, atol=1e-12)
    as_it_is = played(file, take_of(end=FIRST + 4, bridges={"missing": False}))
    assert not len(as_it_is.under.performances[0].bridged)
    chosen = played(file, take_of(bridges={"spans": [{"start": FIRST + 1, "end": FIRST + 3}]}))
    assert chosen.under.performances[0].bridged[:2].tolist() == [FIRST + 1, FIRST + 2]


def test_smoothed_frames_are_played(tmp_path: Path) -> None:
    content = frames(f4="smoothed", f5="predicted")
    drives = played(write(tmp_path, content), take_of())
    [performance] = drives.under.performances
    assert performance.bridged.tolist() == [FIRST + 5]
    np.testing.assert_allclose(drives(4 / FPS).a, content[4].activations, atol=1e-9)


def test_performances_are_mixed_by_muscle_and_keys_lie_on_top(take: Path) -> None:
    strong = take_of(gain=2.0, mask=["right"], speed=2.0)
    keys = [{"time": 0, "muscles": {"right": [1.0, 0, 0, 1.1, 0, 1]}, "jaw": {"open_deg": 3}}]
    drives = played(take, [take_of(keys=keys), strong])
    alone = played(take, take_of())
    other = played(take, take_of(gain=2.0, speed=2.0))
    assert drives.times[-1] == pytest.approx(alone.times[-1])
    for time in (0.0, 0.1, 0.2):
        mixed = drives(time)
        np.testing.assert_allclose(mixed.a[0], alone(time).a[0], atol=1e-12)
        np.testing.assert_allclose(mixed.a[1], other(time).a[1], atol=1e-12)  # not the first's keys
        assert mixed.jaw[0] == pytest.approx(alone(time).jaw[0] + np.radians(3))
    only = played(take, take_of(mask=["left"]), keys=keys)(0.4)
    np.testing.assert_allclose(only.a[1], [1.0, 0, 0, 1.1, 0, 1], atol=1e-12)


def test_keys_over_a_performance_are_checked_in_every_frame(take: Path) -> None:
    with pytest.raises(InputError, match="keys and what they are added to at") as caught:
        played(take, take_of(), keys=[{"time": 0, "jaw": {"open_deg": 40}}])
    assert caught.value.code == "scene.jaw"
    played(take, take_of(), keys=[{"time": 0, "jaw": {"open_deg": 30}}])


@pytest.mark.parametrize(
    ("scene", "code", "words"),
    [
        (take_of(asset="tale"), "scene.asset", "'tale'"),
        (take_of(start=99), "scene.frames", "'take' has the frames 100 to 111: start 99"),
        (take_of(start=105, end=105), "scene.frames", "end 105 is not after start 105"),
        (take_of(muscles={"tongue": 1}), "scene.muscle", "'take' names the muscle 'tongue'"),
        (take_of(mask=["tongue"]), "scene.muscle", "mask of performance[0], 'take'"),
        (take_of(curve={"left": 2}), "scene.curve", "'left'"),
        ([take_of(), take_of()], "scene.mask", "have no mask"),
        (
            [take_of(mask=["left"]), take_of(mask=["right", "left"])],
            "scene.mask",
            "performance[1], 'take', names 'left'",
        ),
        (
            take_of(bridges={"spans": [{"start": 0, "end": 90}]}),
            "scene.bridges",
            "bridges.spans[0] of the performance 'take'",
        ),
        (
            take_of(bridges={"spans": [{"start": 0, "end": 900}]}),
            "scene.bridges",
            "every frame is bridged",
        ),
        (take_of(keys=[{"time": 1}, {"time": 1}]), "scene.times", "performance[0].keys[1]"),
        (
            take_of(keys=[{"time": 1, "jaw": {"open_deg": 44}}]),
            "scene.jaw",
            "performance[0].keys[0]",
        ),
        (
            take_of(keys=[{"time": 0, "jaw": {"open_deg": 40}}]),  # and the take opens it further
            "scene.jaw",
            "performance[0].keys and what they are added to at ",
        ),
        (take_of(asset="folded"), "scene.jaw", "frame 104 of the performance 'folded'"),
        (
            take_of(asset="holed"),
            "sequence.values",
            "frame 103 of the performance 'holed': the act",
        ),
        (take_of(asset="other"), "sequence.muscles", "'other' was fitted with another anatomy"),
        (take_of(asset="rig"), "sequence.unreadable", "the asset 'rig', rig.npz, is not"),
        (take_of(asset="endless"), "scene.long", "frames; at most 20000"),
        (
            take_of(asset="later"),
            "sequence.format",
            "'later', later.npz, has the sequence format 9",
        ),
    ],
)
def test_performances_that_cannot_be(
    tmp_path: Path, take: Path, scene: Any, code: str, words: str
) -> None:
    files = {"take": take}
    with np.load(take) as arrays:
        content = dict(arrays)
    jaw = content["jaw"].copy()
    holed = content["activations"].copy()
    jaw[4, 0] = 1.0
    holed[3, 1, 2] = np.nan
    spoilt: dict[str, dict[str, Any]] = {
        "folded": {"jaw": jaw},
        "holed": {"activations": holed},
        "other": {"muscles": np.array(["left", "tongue"])},
        "endless": {"time": content["time"] * 1e7},
        "rig": {"activations": content["activations"][:, :1]},
        "later": {"format": 9},
    }
    for name, changes in spoilt.items():
        files[name] = tmp_path / f"{name}.npz"
        np.savez(files[name], **content | changes)
    with pytest.raises(InputError, match=re.escape(words)) as caught:
        played(files, scene)
    assert caught.value.code == code


def test_a_file_that_is_no_sequence_is_refused(tmp_path: Path) -> None:
    for content in (b"", b"PK", b"frame,time\n1,2\n"):
        path = tmp_path / "take.npz"
        path.write_bytes(content)
        with pytest.raises(InputError) as caught:
            FittedSequence.load(path, "take")
        assert caught.value.code == "sequence.unreadable"
