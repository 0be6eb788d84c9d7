"""A take of markers of the small person, fitted whole, in attempts, and refused."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from solver.errors import InputError
from solver.fitting.contraction import Contraction
from solver.fitting.drives.admissible import Admissible, limits_by_plausibility
from solver.fitting.expression_basis import ExpressionBasis
from solver.fitting.face import Face, Pose
from solver.fitting.markers.term import MarkerPlaces
from solver.jobs import fit_markers, run_job
from solver.mechanics.boundary import move_jaw
from solver.model import CondyleTracks, SubjectModel
from solver.rig import ExpressionFit, Rig
from solver.rig.frames import MarkerFrame, read_chunks
from solver.rig.frames.read_back import LIMIT_MM
from solver.scans.markers.places.marker_set import Marker, MarkerSet
from solver.scans.markers.readers.take import Take
from solver.similarity import Similarity, small_motion
from solver.storage import read_container
from tests.fixtures import small_capture, small_model
from tests.solver.glb import shown_skins
from tests.solver.jobs.killed import killed_after
from tests.solver.scans.markers.made_actor import SIZE, actor_model
from tests.solver.usd import played

pytestmark = pytest.mark.long

FRAMES = 10
MARKERS = 30
GONE = (4, 5)  # rows in which no marker is seen
FIRST = 101  # number of the first frame


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rig with one expression, and a take of it: turned axes, metres, a gap and an outlier."""
    return make_files(tmp_path_factory.mktemp("take"), 0.05)


def make_files(folder: Path, contracted: float, model: SubjectModel | None = None) -> Path:
    """Leave them in a folder; muscles are ``contracted`` by about so much, or stretched."""
    model = model or small_model()
    face = Face(model)
    rng = np.random.default_rng(7)
    change = np.zeros(face.layout.size)
    change[face.layout["activations"]] = contracted * rng.standard_normal(6 * model.muscle_count)
    change[face.layout["jaw"]] = [0.1, 0.0, 0.0, 1.0, 0.0]
    pose = face.rest_pose().add(change)
    skin = model.skin.vertices
    none = np.zeros(len(model.skin.vertices))
    smile = ExpressionFit("smile", "train", pose.a, pose.b, skin, skin, none, 0, 1, 0.0, 0.0)
    Rig(model, model.weights, (smile,)).save(folder / "rig.npz")
    inside = model.skin.faces[np.isin(model.skin.faces, model.face).all(axis=1)]
    corners = inside[rng.choice(len(inside), MARKERS, replace=False)]
    markers = tuple(
        Marker(f"M{n}", tuple(map(int, each)), (0.2, 0.3, 0.5), 1.0, sigma_mm=0.3)
        for n, each in enumerate(corners)
    )
    turn = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    session = Similarity(1.0, turn, np.array([3.0, -20.0, 7.0]))
    MarkerSet(markers, session, model.sha256).save(folder / "markers.json")
    places = MarkerPlaces(model, markers)
    state = face.rest
    points = []
    for share in np.linspace(0.0, 1.0, FRAMES):
        state = face.continuation(state, face.rest_pose().add(share * change))
        head = small_motion(np.array([0.1 * share, 0.0, 0.2 * share, 0.0, 5.0 * share, 0.0]))
        points.append(session.inverse()(head(places.at(state.x))))
    positions = np.array(points) + 0.05 * rng.standard_normal((FRAMES, MARKERS, 3))
    positions[list(GONE)] = np.nan
    positions[7, 3] += 20.0
    labels = tuple(marker.label for marker in markers)
    Take("take.c3d", labels, positions, 60.0, FIRST).save(folder / "take.npz")
    return folder


def fit(files: Path, out: Path, **given: object) -> dict[str, np.ndarray]:
    options = {"prior": "scans", "refine": 0} | dict(given.pop("options", {}))
    run_job(
        "fit_markers",
        out,
        options=options,
        markers=files / "take.npz",
        marker_set=files / "markers.json",
        rig=files / "rig.npz",
        **given,
    )
    with np.load(out / "sequence.npz") as data:
        return dict(data)


@pytest.fixture(scope="module")
def whole(files: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    out = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit_markers, "OPTIONS", replace(fit_markers.OPTIONS, frames=3))
        return out, fit(files, out)


def test_a_take_is_fitted(whole: tuple[Path, dict], files: Path) -> None:
    out, found = whole
    model = small_model()
    assert found["format"] == 2
    expected = ["predicted" if number in GONE else "fitted" for number in range(FRAMES)]
    assert found["status"].tolist() == expected
    states = found["marker_state"]
    assert states[7, 3] == "outlier"
    assert np.sum(states == "outlier") == 1
    assert (states[list(GONE)] == "missing").all()
    assert np.isnan(found["marker_mm"][list(GONE)]).all()
    assert np.nanmean(np.where(found["marker_weight"] > 0, found["marker_mm"], np.nan)) < 0.2
    turned = np.linalg.norm(found["head"][-1] - [0.1, 0.0, 0.2, 0.0, 5.0, 0.0])
    assert turned < 0.5
    assert found["held"].shape == (FRAMES, model.muscle_count)
    assert found["held"][GONE[0]].all()
    assert found["sd"].shape == found["information"].shape
    assert (found["sd"][5] > found["sd"][3]).mean() > 0.9
    points = model.rest[model.mandible]
    moved = points @ found["mandible"][-1, :3, :3].T + found["mandible"][-1, :3, 3]
    np.testing.assert_allclose(moved, move_jaw(model.jaw, points, found["jaw"][-1]), atol=1e-5)
    report = json.loads((out / "sequence.json").read_text())
    assert report["predicted"] == [FIRST + row for row in GONE]
    assert report["markers"]["M3"]["outlier"] == pytest.approx(1 / FRAMES)
    assert report["files"]["sequence.glb"]["max_mm"] < LIMIT_MM
    assert report["files"]["markers.bin"]["max_mm"] < 1e-3
    view = read_container(out / "markers.bin")
    off = np.linalg.norm(view.arrays["off"].astype(float), axis=2)
    np.testing.assert_allclose(off, found["marker_mm"], atol=0.02)
    assert [view.header["states"][each] for each in view.arrays["state"][7]] == states[7].tolist()
    with (out / "activations.csv").open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    spread = [float(rows[5][f"jaw.{number}.sd"]) for number in range(1, 6)]
    np.testing.assert_allclose(spread, found["sd"][5][-5:], atol=1e-6)
    # who pulls comes first, with its deviation; then the six numbers of each muscle
    names = [f"{name}.contraction" for name in model.muscle_names]
    told = [*names, *(f"{name}.sd" for name in names), "jaw.1"]
    assert list(rows[0])[: 4 + len(told)] == ["frame", "time", "status", "mean_mm", *told]
    contraction = Contraction.of_face(Face(model))
    assert contraction is not None
    table = [[float(row[name] or "nan") for name in names] for row in rows]
    np.testing.assert_allclose(table, contraction(found["activations"]), atol=1e-6)
    np.testing.assert_allclose(found["contraction"], table, atol=1e-6)
    assert np.nanmax(table) > 0.02
    assert found["contraction_sd"].shape == found["contraction"].shape
    grown = found["contraction_sd"][5] > found["contraction_sd"][3]  # no marker tells of it
    assert grown[np.isfinite(table[0])].mean() > 0.9
    shown = read_container(out / "contractions.bin")
    assert shown.header["muscles"] == list(model.muscle_names)
    np.testing.assert_allclose(shown.arrays["contraction"], table, atol=1e-6)
    np.testing.assert_allclose(shown.arrays["jaw"], found["jaw"], atol=1e-5)


def test_a_point_that_is_nowhere_at_all_is_an_outlier(files: Path, tmp_path: Path) -> None:
    for name in ("markers.json", "rig.npz"):
        (tmp_path / name).write_bytes((files / name).read_bytes())
    with np.load(files / "take.npz") as data:
        arrays = dict(data)
    arrays["positions"][6, 2] = 9e4  # farther off points are not read
    np.savez(tmp_path / "take.npz", **arrays)
    found = fit(tmp_path, tmp_path / "out")
    assert (found["status"][6], found["marker_state"][6, 2]) == ("fitted", "outlier")
    off = read_container(tmp_path / "out" / "markers.bin").arrays["off"]
    assert np.isfinite(off[[each for each in range(FRAMES) if each not in GONE]]).all()


def test_killed_three_times_it_comes_to_the_same(
    whole: tuple[Path, dict], files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fit_markers, "OPTIONS", replace(fit_markers.OPTIONS, frames=3))
    for last in (5, 6, 8):
        with killed_after(last, FRAMES) as progress:
            fit(files, tmp_path, resume=True, progress=progress)
    assert len(read_chunks(tmp_path / "frames", MarkerFrame, "", lambda _: True)) == 6
    found = fit(files, tmp_path, resume=True)
    for name, values in whole[1].items():
        if values.dtype.kind == "f" and name != "seconds":
            np.testing.assert_allclose(found[name], values, atol=1e-6, err_msg=name)
    assert found["marker_state"].tolist() == whole[1]["marker_state"].tolist()


def test_places_are_mended_first_and_the_take_is_smoothed_last(
    whole: tuple[Path, dict], files: Path, tmp_path: Path
) -> None:
    found = fit(files, tmp_path, options={"refine": 10, "smooth": True})
    expected = ["smoothed" if number in GONE else "fitted" for number in range(FRAMES)]
    assert found["status"].tolist() == expected
    report = json.loads((tmp_path / "sequence.json").read_text())
    assert (report["predicted"], report["smoothed"]) == ([], [FIRST + row for row in GONE])
    given, mended = (MarkerSet.load(each / "markers.json") for each in (files, tmp_path))
    assert mended.labels == given.labels
    assert 0.0 < np.abs(mended.heights - given.heights).max() < 1.0
    # frames of the gap know of what comes after it
    assert (found["sd"][list(GONE)] < whole[1]["sd"][list(GONE)]).mean() > 0.9
    jitter = [np.abs(np.diff(each["jaw"][:, 0], 2)).mean() for each in (found, whole[1])]
    assert jitter[0] < jitter[1]


def test_a_smoothed_frame_has_the_distances_of_its_own_pose(files: Path, tmp_path: Path) -> None:
    """Two labels have each other's point, and the take says itself how surely it was seen."""
    for name in ("markers.json", "rig.npz"):
        (tmp_path / name).write_bytes((files / name).read_bytes())
    with np.load(files / "take.npz") as data:
        arrays = dict(data)
    positions = arrays["positions"]
    gaps = np.linalg.norm(positions[0] - positions[0, :1], axis=1)
    swapped = [0, int(np.argsort(gaps)[2])]
    positions[6, swapped] = positions[6, swapped[::-1]]
    sigma = np.full_like(positions, 1.5)
    np.savez(tmp_path / "take.npz", **arrays | {"sigma": sigma})
    options = {"step": 2, "temporal": 0.05}
    before = fit(tmp_path, tmp_path / "before", options=options)
    found = fit(tmp_path, tmp_path / "after", options=options | {"smooth": True})
    row = found["frame"].tolist().index(FIRST + 6)
    assert found["marker_state"][row, swapped].tolist() == ["swapped", "swapped"]
    model = small_model()
    markers = MarkerSet.load(files / "markers.json")
    face = Face(model)
    places = MarkerPlaces(model, markers.markers)
    pose = replace(face.rest_pose(), a=found["activations"][row], b=found["jaw"][row])
    x = face.continuation(face.rest, pose).x
    at = small_motion(found["head"][row])(places.at(x))
    seen = markers.session(positions[6])
    seen[swapped] = seen[swapped[::-1]]
    expected = np.linalg.norm(at - seen, axis=1)
    np.testing.assert_allclose(found["marker_mm"][row], expected, atol=0.03)
    assert np.abs(found["marker_mm"] - before["marker_mm"])[row, swapped].min() > 0.005
    # the last frame knows of none after it
    np.testing.assert_allclose(found["sd"][-1], before["sd"][-1], rtol=0.05)


def test_other_options_do_not_go_on(whole: tuple[Path, dict], files: Path) -> None:
    with pytest.raises(InputError) as caught:
        fit(files, whole[0], resume=True, options={"robust_mm": 2.0})
    assert caught.value.code == "sequence.resume"


def test_another_take_or_rig_does_not_go_on(
    whole: tuple[Path, dict], files: Path, tmp_path: Path
) -> None:
    for name in ("take.npz", "markers.json", "rig.npz"):
        (tmp_path / name).write_bytes((files / name).read_bytes())
    with np.load(files / "take.npz") as data:
        arrays = dict(data)
    arrays["positions"] = arrays["positions"] + 0.01
    np.savez(tmp_path / "take.npz", **arrays)
    with pytest.raises(InputError) as caught:
        fit(tmp_path, whole[0], resume=True)
    assert caught.value.code == "sequence.resume"


def test_a_template_s_expressions_are_solved_once_for_a_rig(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = small_capture("ah").vertices - small_capture("neutral").vertices
    template = SimpleNamespace(shapes=SimpleNamespace(expressions=opened[None]))
    monkeypatch.setattr(fit_markers, "read_template", lambda _: template)
    options = {"prior": "shapes", "end": FIRST + 3}
    first = fit(files, tmp_path / "first", options=options)
    kept = tmp_path / "first" / "expression_basis.npz"

    def never(*_given: object, **_named: object) -> None:
        raise AssertionError

    monkeypatch.setattr(ExpressionBasis, "solve", never)
    again = fit(files, tmp_path / "again", options=options, expression_basis=kept)
    np.testing.assert_array_equal(first["activations"], again["activations"])
    assert (tmp_path / "again" / "expression_basis.npz").read_bytes() == kept.read_bytes()


def test_known_activations_are_kept_to_and_their_muscles_are_not_held(
    whole: tuple[Path, dict], files: Path, tmp_path: Path
) -> None:
    """What is said of one muscle in the last five frames, of which 30 markers tell little."""
    model = small_model()
    muscle = "corrugator_l"
    column = model.muscle_names.index("corrugator_l")
    times = [frame / 60.0 for frame in (5, 9)]
    table = tmp_path / "emg.csv"
    rows = [f"corrugator,left,{time},0.2,0.03" for time in times]
    table.write_text("\n".join(["muscle,side,time,value,sd", *rows]))
    found = fit(files, tmp_path / "out", activations=table)
    report = json.loads((tmp_path / "out" / "sequence.json").read_text())
    figures = report["known"][muscle]
    assert figures["frames"] == 4  # no marker was seen in the first of the five
    contraction = found["contraction"][:, column]
    before = whole[1]["contraction"][:, column]
    np.testing.assert_allclose(contraction[5:], 0.2, atol=0.03)
    assert np.abs(before[5:] - 0.2).min() > 0.1
    np.testing.assert_allclose(contraction[:4], before[:4], atol=1e-4)
    assert (found["held"][6:, column] == 0).all()
    sd = found["contraction_sd"][6:, column]
    assert sd.max() < 0.03 < whole[1]["contraction_sd"][6:, column].min()


def test_every_second_frame_keeps_its_time(files: Path, tmp_path: Path) -> None:
    found = fit(files, tmp_path, options={"step": 2})
    assert found["fps"] == 60.0
    np.testing.assert_allclose(found["time"], np.arange(0, FRAMES, 2) / 60.0)
    header = (tmp_path / "activations.csv").read_text().splitlines()[0].split(",")
    spreads = found["sd"].shape[1] + found["contraction_sd"].shape[1]
    assert sum(name.endswith(".sd") for name in header) == spreads


def test_frames_are_chosen_by_the_numbers_that_the_file_has(files: Path, tmp_path: Path) -> None:
    found = fit(files, tmp_path, options={"start": 102, "end": 106, "step": 2})
    assert found["frame"].tolist() == [102, 104]
    np.testing.assert_allclose(found["time"], np.array([1, 3]) / 60.0)
    (row,) = csv.DictReader((tmp_path / "activations.csv").read_text().splitlines()[:2])
    assert (row["frame"], row["time"]) == ("102", "0.0167")


def test_a_jaw_on_its_tracks(files: Path, tmp_path: Path) -> None:
    found = fit(files, tmp_path, options={"jaw": "tracks"})
    model = small_model()
    assert found["tracks"].shape == (FRAMES, 3)
    assert found["tracks"][:, 0].min() >= 0.0
    assert found["tracks"][-1, 0] == pytest.approx(0.1, abs=0.05)
    points = model.rest[model.mandible]
    moved = points @ found["mandible"][-1, :3, :3].T + found["mandible"][-1, :3, 3]
    near = move_jaw(model.jaw, points, found["jaw"][-1])
    assert np.linalg.norm(near - moved, axis=1).max() < 0.5


def test_a_rig_fitted_within_limits_is_followed_within_them(tmp_path: Path) -> None:
    """Frames as they come, where no marker tells of them, and after the sweep back."""
    model = small_model()
    jaw = replace(model.jaw, tracks=CondyleTracks(0.6, 60.0, 2.0, 0.3))
    make_files(tmp_path, 0.12, replace(model, jaw=jaw))
    free = fit(tmp_path, tmp_path / "free")
    rig = replace(Rig.load(tmp_path / "rig.npz"), drive=Admissible(limits_by_plausibility(1.0)))
    rig.save(tmp_path / "rig.npz")
    limits = rig.face().layout.bounds.feasible
    assert limits is not None
    swept = fit(tmp_path, tmp_path / "within", options={"smooth": True})
    frames = read_chunks(tmp_path / "within" / "frames", MarkerFrame, "", lambda _frame: True)
    assert {"fitted", "predicted"} == {frame.status for frame in frames}
    freed = fit(tmp_path, tmp_path / "freed", options={"jaw": "free"})
    assert [each["tracks"].shape[1] for each in (free, swept, freed)] == [0, 3, 0]
    within = [frame.activations for frame in frames]
    within += [*swept["activations"], *freed["activations"]]
    assert sum(not limits.contains(a) for a in free["activations"]) > FRAMES / 2
    assert all(limits.contains(a) for a in within)


@pytest.fixture(scope="module")
def another(files: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Pose]]:
    """The take played by another actor, whose muscles do the same; and the poses."""
    folder = tmp_path_factory.mktemp("another")
    for name in ("rig.npz", "markers.json"):
        (folder / name).write_bytes((files / name).read_bytes())
    rig = Rig.load({"rig": files / "rig.npz"})
    markers = MarkerSet.load(files / "markers.json")
    face, (smile,) = Face(actor_model(rig.model)), rig.expressions
    places = MarkerPlaces(face.model, markers.markers)
    state = face.rest
    points = []
    poses = []
    end = Pose(smile.activations, smile.jaw)
    for share in np.linspace(0.0, 1.0, FRAMES):
        poses.append(face.rest_pose().toward(end, share))
        state = face.continuation(state, poses[-1])
        head = small_motion(np.array([0.1 * share, 0.0, 0.2 * share, 0.0, 5.0 * share, 0.0]))
        points.append(markers.session.inverse()(head(places.at(state.x))))
    # so few frames a second that a frame named as neutral is one
    Take("take.c3d", markers.labels, np.array(points), 2.0, FIRST).save(folder / "take.npz")
    return folder, poses


def off_person(found: dict[str, np.ndarray], poses: list[Pose]) -> float:
    """Return how far the face is from the person's own in the same poses, mm rms."""
    face = Face(small_model())
    away = []
    own = fitted = face.rest
    for row, pose in enumerate(poses):
        own = face.continuation(own, pose)
        there = replace(face.rest_pose(), a=found["activations"][row], b=found["jaw"][row])
        fitted = face.continuation(fitted, there)
        away.append(face.face_points(fitted.x) - face.face_points(own.x))
    return float(np.sqrt(np.mean(np.sum(np.square(away), axis=-1))))


def test_another_actor_s_take_is_carried(another: tuple[Path, list[Pose]], tmp_path: Path) -> None:
    folder, poses = another
    told = []
    off = []
    for actor in (True, False):
        out = tmp_path / str(actor)
        found = fit(folder, out, options={"actor": actor, "neutral": FIRST, "refine": 5})
        told.append(json.loads((out / "sequence.json").read_text()))
        off.append(off_person(found, poses))
    carried, plain = told
    assert off[0] < 0.2
    assert off[1] > 2.0
    assert carried["actor"]["scale"] == pytest.approx(1 / SIZE, rel=0.1)
    assert carried["actor"]["left_mm"] < 0.5 * carried["actor"]["missed_mm"]
    assert carried["actor"]["neutral"] == [FIRST, FIRST]
    assert carried["notices"] == []
    assert not (tmp_path / "True" / "markers.json").exists()
    assert "actor" not in plain
    assert [each["code"] for each in plain["notices"]] == ["markers.other_person"]


def test_fibre_muscles_and_a_jaw_on_tracks_play_in_other_programs(
    files: Path, tmp_path: Path
) -> None:
    """Frames that are predicted do as well: in glTF as in USD, with the head's motion."""
    found = fit(files, tmp_path, options={"muscles": "fibre", "jaw": "tracks", "prior": "none"})
    assert set(found["status"]) == {"fitted", "predicted"}
    model = small_model()
    skins = shown_skins(tmp_path / "sequence.glb", model.skin.vertices)
    assert np.linalg.norm(skins[-1] - model.skin.vertices, axis=1).max() > 5.0
    points = played(tmp_path / "sequence.usdc")
    bone = model.bones["mandible"].vertices
    for skin, number, twist, motion in zip(
        skins, found["frame"].tolist(), found["head"], found["mandible"], strict=True
    ):
        head = small_motion(twist)
        np.testing.assert_allclose(points("Skin", number), head(skin), atol=5e-3)
        moved = bone @ motion[:3, :3].T + motion[:3, 3]
        np.testing.assert_allclose(points("mandible", number), head(moved), atol=1e-3)


@pytest.mark.parametrize(
    ("code", "change"),
    [
        ("markers.few", {"markers": [0, 1, 2]}),
        ("markers.other_model", {"model_sha256": "0" * 64}),
        ("markers.few", {"markers": [0, 1, 2], "options": {"actor": True}}),
        ("markers.too_large", {"labels": 401}),
        ("markers.too_large", {"labels": 401, "options": {"actor": True}}),
        ("markers.neutral", {"options": {"neutral": 100}}),
        ("options.frames", {"options": {"start": 100}}),
        ("options.frames", {"options": {"end": 112}}),
    ],
)
def test_what_cannot_be_used(code: str, change: dict, files: Path, tmp_path: Path) -> None:
    markers = MarkerSet.load(files / "markers.json")
    if "markers" in change:
        markers = replace(markers, markers=markers.markers[:3])
    if "model_sha256" in change:
        markers = replace(markers, model_sha256=change["model_sha256"])
    markers.save(tmp_path / "markers.json")
    take = Take.load(files / "take.npz")
    if "labels" in change:
        count = change["labels"]
        others = tuple(f"other {number}" for number in range(count - len(take.labels)))
        take = replace(
            take.pick(np.resize(np.arange(len(take.labels)), count)), labels=take.labels + others
        )
    take.save(tmp_path / "take.npz")
    with pytest.raises(InputError) as caught:
        run_job(
            "fit_markers",
            tmp_path / "out",
            options={"prior": "scans"} | change.get("options", {}),
            markers=tmp_path / "take.npz",
            marker_set=tmp_path / "markers.json",
            rig=files / "rig.npz",
        )
    assert caught.value.code == code
