"""Controls of a block of flesh: learned, kept, and played beside blended and exact ones."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from solver.anatomy.template import ShapeBasis
from solver.animation.controls import Controls
from solver.animation.controls.learn import LearnOptions
from solver.animation.controls.learn import learn as controls_of
from solver.animation.controls.maps import ShapeSizes
from solver.animation.controls.mixtures import Mixtures, WalkOptions
from solver.animation.controls.pairs import Pairs, Walks, solve_pairs
from solver.errors import InputError
from solver.fitting.face import Face, Pose
from solver.jobs import animate, blendshapes, learn_controls, run_job
from solver.kinds import FILES
from solver.mechanics.flesh import IDENTITY
from solver.rig import ExpressionFit, Rig, transfer_sheet
from solver.scans import recordings
from solver.scans.live_link import ARKIT_NAMES, FaceTake, read_live_link
from solver.storage import Archive
from solver.templates.builtin import build
from solver.templates.ict_facekit import arkit_source
from tests.command_line import invoke
from tests.solver.block import head_block, thinner
from tests.solver.jobs.test_scenes import skins

pytestmark = pytest.mark.long

MODEL = head_block((7, 5, 1))
LEFT = np.array([[0.8, 0.02, 0.0, 1.1, 0.0, 1.1], IDENTITY])
RIGHT = LEFT[::-1]
OPEN = np.array([0.06, 0.0, 0.0, 0.0, 0.0])
NAMES = ("mouthSmileLeft", "mouthSmileRight", "jawOpen")


@pytest.fixture(scope="module")
def template() -> SimpleNamespace:
    """A template whose shapes are what the muscles of either side and the jaw do."""
    face = Face(MODEL)
    poses = [Pose(LEFT, 0.0 * OPEN), Pose(RIGHT, 0.0 * OPEN), Pose(np.array([IDENTITY] * 2), OPEN)]
    states = [face.continuation(face.rest, pose) for pose in poses]
    moved = [face.whole_skin(state.x, state.pose.b) for state in states] - MODEL.skin.vertices
    none = np.zeros((0, *moved.shape[1:]), np.float32)
    return SimpleNamespace(shapes=ShapeBasis(none, moved.astype(np.float32), NAMES))


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rig of the block at rest."""
    file = tmp_path_factory.mktemp("rig") / "rig.npz"
    face = Face(MODEL)
    skin = MODEL.skin.vertices
    rest = face.rest
    error = np.zeros(len(skin))
    pose = rest.pose.a, rest.pose.b
    fit = ExpressionFit("rest", "train", *pose, skin, skin, error, 0, 1, 0.0, 0.0, rest.x)
    Rig(MODEL, MODEL.weights, (fit,)).save(file)
    return file


@pytest.fixture
def played(template: SimpleNamespace, monkeypatch: pytest.MonkeyPatch) -> None:
    for job in (animate, blendshapes, learn_controls):
        monkeypatch.setattr(job, "read_template", lambda _: template)


@pytest.fixture(scope="module")
def learned(rig: Path, template: SimpleNamespace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that a job of learned controls left."""
    out = tmp_path_factory.mktemp("controls")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learn_controls, "read_template", lambda _: template)
        learn(out, rig)
    return out


def learn(out: Path, rig: Path, **more: Any) -> list[Path]:
    return run_job("learn_controls", out, options={"pairs": 500, "modes": 16}, rig=rig, **more)


def test_controls_are_learned_and_tell_how_well(learned: Path) -> None:
    told = json.loads((learned / "controls.json").read_text())
    assert told["pairs"] >= 500
    assert told["failed"] == 0
    assert told["unseen_mm"]["mean"] < 0.25 * told["blended_mm"]["mean"]
    assert (learned / "controls.png").stat().st_size > 10_000
    controls = Controls.load(learned / "controls.npz", MODEL, MODEL.weights)
    assert controls.names == NAMES
    assert not controls.changes(np.zeros(3)).any()
    skin = controls.skin(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    np.testing.assert_allclose(skin[0], MODEL.skin.vertices, atol=1e-3)
    assert np.abs(skin[1] - skin[0]).max() > 1.0


@pytest.mark.parametrize(("name", "share"), [("quadratic", 1.0), ("published", 0.0)])
def test_one_of_the_maps_is_played_alone_if_asked_for(
    learned: Path, name: Any, share: float
) -> None:
    face = Face(MODEL)
    pairs = Pairs.load(learned / "control_pairs.npz", face, NAMES)
    sizes = ShapeSizes(np.ones(3), np.ones((3, 3)))
    found = controls_of(face, pairs, sizes, options=LearnOptions(map=name, modes=16)).controls
    weights = np.array([0.7, 0.4, 0.5])
    alone = found.polynomial if share else found.network
    expected = alone(weights)[: len(found.directions)] @ found.directions
    np.testing.assert_allclose(found.changes(weights), expected, atol=1e-5)
    assert len(found.network.layers) == (2 if share else 5)
    assert 0.0 < found.doubt_mm(weights) < 10.0


def test_what_is_learned_is_what_a_fit_finds(learned: Path, template: SimpleNamespace) -> None:
    controls = Controls.load(learned / "controls.npz", MODEL, MODEL.weights)
    weights = np.array([0.7, 0.4, 0.5])
    face = Face(MODEL)
    state = face.continuation(face.rest, controls.pose(weights))
    goal = MODEL.skin.vertices + np.tensordot(weights, template.shapes.expressions, 1)
    off = np.linalg.norm(face.face_points(state.x) - goal[MODEL.face], axis=1).mean()
    moved = np.linalg.norm(goal - MODEL.skin.vertices, axis=1)[MODEL.face].mean()
    assert off < 0.15 * moved


def take(path: Path, weights: Sequence[Sequence[float]]) -> Path:
    """Write a Live Link recording of weights of NAMES."""
    rows = ["Timecode," + ",".join(ARKIT_NAMES)]
    for number, each in enumerate(weights):
        named = dict(zip(NAMES, each, strict=True))
        values = ",".join(str(named.get(name, 0.0)) for name in ARKIT_NAMES)
        rows.append(f"00:00:00:{2 * number:02d}.000,{values}")
    path.write_text("\n".join(rows) + "\n")
    return path


FRAMES = [(0.0, 0.0, 0.0), (0.6, 0.0, 0.0), (0.8, 0.5, 0.3), (0.2, 0.9, 0.8)]


def animated(out: Path, rig: Path, scene: dict[str, Any], **left: Path) -> dict[str, Any]:
    recording = take(out.with_suffix(".csv"), FRAMES)
    options = {"scene": {"recording": {"asset": "take"}, **scene}}
    run_job("animate", out, options=options, captures={"take": recording}, rig=rig, **left)
    told: dict[str, Any] = json.loads((out / "animation.json").read_text())
    return told


@pytest.mark.usefixtures("played")
def test_a_recording_plays_by_learned_exact_and_doubted_controls(
    rig: Path, learned: Path, tmp_path: Path
) -> None:
    controls = learned / "controls.npz"
    told = animated(tmp_path / "learned", rig, {"exact_above_mm": 100.0}, controls=controls)
    assert told["transfer"]["controls"] == "learned"
    assert (told["transfer"]["flagged"], told["transfer"]["exact"]) == (0, 0)
    assert "blendshapes" not in told
    told = animated(tmp_path / "exact", rig, {"controls": "exact"})
    assert told["transfer"]["exact"] == len(FRAMES)
    assert told["transfer"]["controls"] == "exact"
    told = animated(tmp_path / "doubted", rig, {"exact_above_mm": 0.0}, controls=controls)
    assert told["transfer"]["flagged"] == told["transfer"]["exact"] > 0
    by_learning, exact, doubted = (
        skins(tmp_path / name) for name in ("learned", "exact", "doubted")
    )
    assert np.abs(exact[3] - exact[0]).max() > 1.0
    # every frame was doubted, so that all were fitted; learned ones are near
    np.testing.assert_allclose(doubted, exact, atol=0.1)
    assert np.linalg.norm(by_learning - exact, axis=2).mean() < 0.1
    with np.load(tmp_path / "learned" / "animation.npz") as arrays:
        np.testing.assert_allclose(arrays["weights"], FRAMES, atol=1e-6)
        assert arrays["doubt_mm"].shape == arrays["exact"].shape == (len(FRAMES),)
        assert (arrays["doubt_mm"][1:] > 0.0).all()


@pytest.mark.usefixtures("played")
def test_shapes_that_the_template_lacks_are_named(
    rig: Path,
    learned: Path,
    template: SimpleNamespace,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shapes = template.shapes
    fewer = ShapeBasis(shapes.identity, shapes.expressions[1:], NAMES[1:])
    for job in (animate, blendshapes):
        monkeypatch.setattr(job, "read_template", lambda _: SimpleNamespace(shapes=fewer))
    scene = {"exact_above_mm": 0.0}
    with pytest.raises(InputError, match=NAMES[0]) as raised:
        animated(tmp_path / "learned", rig, scene, controls=learned / "controls.npz")
    assert raised.value.code == "controls.model"
    told = animated(tmp_path / "blended", rig, {"controls": "blended"})
    assert told["transfer"]["controls"] == "blended"
    lacking = arkit_source(NAMES[0])
    assert lacking in told["transfer"]["unseen_shapes"]
    assert arkit_source(NAMES[1]) not in told["transfer"]["unseen_shapes"]
    (notice,) = told["notices"]
    assert (notice["code"], notice["found"]) == ("recording.shapes", [lacking])


@pytest.mark.usefixtures("played")
def test_a_video_is_looked_at_once_and_played_by_all_rigs(
    rig: Path, learned: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked: list[Any] = []

    def look(file: Path, face: int | None, **_: Any) -> FaceTake:
        looked.append(face)
        return replace(read_live_link(take(tmp_path / "seen.csv", FRAMES)), source="video")

    def cut(_: Path, measured: Mapping[int, Any], options: Any) -> dict[int, Any]:
        return {number: np.zeros((*options.cell[::-1], 3), np.float32) for number in measured}

    monkeypatch.setattr(recordings, "read_video", look)
    monkeypatch.setattr(transfer_sheet, "_cut_faces", cut)
    without_points = SimpleNamespace(points=None)
    monkeypatch.setattr(build, "builtin_template", lambda: without_points)
    film = tmp_path / "talk.mp4"
    film.write_bytes(b"\0\0\0\x14ftypqt  ")
    other = tmp_path / "ben.npz"
    replace(Rig.load({"rig": rig}), weights=thinner(MODEL.weights, 2)).save(other)
    out = tmp_path / "out"
    both = ["transfer", str(film), "--rig", str(other), "--rig", str(rig), "-o", str(out)]
    controls = ["--controls", str(learned / "controls.npz")]
    told = invoke([*both, *controls, "--face", "0"])
    assert told.exit_code == 0, told.output
    assert looked == [0]
    assert "ben: expressions are blended; --learn learns controls" in told.output
    heads = [line.split()[:3] for line in told.output.splitlines()[-3:-1]]
    name = rig.parent.name
    assert heads == [["ben", "4", "blended"], [name, "4", "learned"]]
    ben, anna = (np.load(out / each / "animation.npz")["weights"] for each in ("ben", name))
    np.testing.assert_allclose(ben, anna, atol=1e-6)
    assert (out / "signals.csv").is_file()
    assert (out / "transfer.png").is_file()
    nobodys = ["--controls", str(learned / "controls.npz"), "--rig", str(other)]
    refused = invoke(["transfer", str(film), *nobodys, "-o", str(tmp_path / "none")])
    assert "controls.npz belongs to another rig" in refused.output


@pytest.mark.usefixtures("played")
def test_transfer_learns_controls_once(rig: Path, learned: Path, tmp_path: Path) -> None:
    signals = take(tmp_path / "take.csv", FRAMES)
    out = tmp_path / "out"
    out.mkdir()
    pairs = learned / "control_pairs.npz"
    (out / pairs.name).write_bytes(pairs.read_bytes())  # of an attempt that was stopped
    command = ["transfer", str(signals), "--rig", str(rig), "-o", str(out)]
    told = invoke([*command, "--learn", "--max-seconds", "10"])
    assert told.exit_code == 0, told.output
    made = (out / "controls.npz").stat().st_mtime_ns
    told = invoke([*command, "--learn"])  # they are in the folder
    assert told.exit_code == 0, told.output
    assert (out / "controls.npz").stat().st_mtime_ns == made
    report = json.loads((out / "animation.json").read_text())
    assert report["transfer"]["controls"] == "learned"


@pytest.mark.usefixtures("played")
def test_pairs_that_are_there_are_not_solved_again(
    rig: Path, learned: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("a walk began")

    monkeypatch.setattr(Walks, "walk", refuse)
    pairs = learned / "control_pairs.npz"
    learn(tmp_path / "later", rig, control_pairs=pairs)
    (tmp_path / "killed").mkdir()
    (tmp_path / "killed" / pairs.name).write_bytes(pairs.read_bytes())
    learn(tmp_path / "killed", rig, resume=True)
    for name in ("later", "killed"):
        again = Controls.load(tmp_path / name / "controls.npz", MODEL, MODEL.weights)
        before = Controls.load(learned / "controls.npz", MODEL, MODEL.weights)
        weights = np.array([0.3, 0.2, 0.9])
        np.testing.assert_allclose(again.changes(weights), before.changes(weights), atol=1e-9)


def test_walks_that_jump_are_fitted_as_well_and_the_same_after_a_stop(
    template: SimpleNamespace,
) -> None:
    options = WalkOptions(stops=20, in_steps=4)
    motions = template.shapes.expressions[:, MODEL.face].astype(float)
    walks = Walks(Face(MODEL), Mixtures(NAMES, options), motions)
    kept = list[Pairs]()
    pairs = solve_pairs(walks, 130, keep=kept.append)
    jumped = pairs.rows.walks >= options.in_steps
    assert jumped.sum() >= 40
    weights = pairs.rows.weights[jumped]
    assert np.abs(np.diff(weights, axis=0)).sum(axis=1).max() > 1.0  # further than a step
    off = pairs.rows.off_mm
    assert off[jumped].mean() < 1.5 * off[~jumped].mean()
    begun = next(each for each in kept if not (each.rows.walks >= options.in_steps).any())
    again = solve_pairs(walks, 130, begun)
    np.testing.assert_array_equal(again.rows.weights, pairs.rows.weights)
    np.testing.assert_array_equal(again.rows.changes, pairs.rows.changes)


@pytest.mark.usefixtures("played")
def test_files_of_another_rig_and_what_is_missing_are_refused(
    rig: Path, learned: Path, tmp_path: Path
) -> None:
    other = tmp_path / "other.npz"
    replace(Rig.load({"rig": rig}), weights=thinner(MODEL.weights, 2)).save(other)
    pairs = learned / "control_pairs.npz"
    controls = learned / "controls.npz"

    def code(job: Any, *given: Any, **how: Any) -> str:
        with pytest.raises(InputError) as raised:
            job(*given, **how)
        return raised.value.code

    out = tmp_path / "out"
    assert code(learn, out, other, control_pairs=pairs) == "control_pairs.model"
    assert code(learn, out, rig, control_pairs=controls) == "control_pairs.model"
    assert code(animated, out, other, {}, controls=controls) == "controls.model"
    assert code(animated, out, rig, {}, controls=pairs) == "controls.model"
    assert code(animated, out, rig, {"controls": "learned"}) == "controls.missing"
    scene = {"controls": "exact", "drive": "tracks"}
    assert code(animated, out, rig, scene, tracks=controls) == "scene.controls"
    torn = tmp_path / "torn.npz"
    torn.write_bytes(controls.read_bytes()[:2000])
    assert code(animated, out, rig, {}, controls=torn) == "controls.unreadable"
    kept = Archive.read(controls, "controls", "controls", FILES["controls.npz"].format)
    cut = {**kept.arrays, "skin_modes": kept.arrays["skin_modes"][:-1]}
    Archive(kept.header, cut).write(torn)
    assert code(animated, out, rig, {}, controls=torn) == "controls.unreadable"
