"""The job that fits photographs: what it leaves, moments of several, and what it refuses."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from solver.drawing.head import DrawnHead
from solver.drawing.render import rasterise
from solver.errors import InputError
from solver.jobs import run_job
from solver.photo.archive import CAMERA
from solver.photo.camera import PinholeCamera
from solver.photo.mesh_points import landmark_points
from solver.rig import Rig, ShapeFit
from solver.rig.frames.read_back import read_glb
from solver.similarity import weighted_motion
from solver.storage import Archive
from solver.templates.builtin.build import builtin_template
from solver.tracks.basis import MuscleTracks
from solver.tracks.shapes import template_shapes
from tests.fixtures import small_model, small_rig

pytestmark = pytest.mark.long

MODEL = small_model()
NEUTRAL = MODEL.skin.vertices
WEIGHTS = {"mouthSmileLeft": 0.8, "mouthSmileRight": 0.8, "browInnerUp": 0.6}
SIZE = (270, 360)


@cache
def shapes() -> dict[str, np.ndarray]:
    """A dozen of the template's shapes, those of the face that is photographed among them."""
    basis = builtin_template().shapes
    assert basis is not None
    named = template_shapes(MODEL, basis)
    others = ("jawOpen", "mouthPucker", "browDownLeft", "browDownRight", "mouthFunnel")
    return {name: named[name] for name in (*WEIGHTS, *others)}


def smile() -> np.ndarray:
    return NEUTRAL + sum(weight * shapes()[name] for name, weight in WEIGHTS.items())


def camera(yaw: float) -> PinholeCamera:
    """Return a camera 700 mm from the face, turned by a yaw in degrees."""
    turn = Rotation.from_euler("xy", [3.0, yaw], degrees=True).as_matrix()
    rotation = np.diag([1.0, -1.0, -1.0]) @ turn
    shift = np.array([2.0, 3.0, 700.0]) - rotation @ NEUTRAL[MODEL.face].mean(axis=0)
    return PinholeCamera(np.full(2, 700.0), np.array(SIZE) / 2.0, rotation, shift)


def photograph(
    folder: Path, name: str, skin: np.ndarray, yaw: float, raised_mm: float = 0.0, **more: Any
) -> None:
    """Draw a face into a JPEG, with its landmarks in the JSON beside it.

    Those of the lower face are marked ``raised_mm`` above their places.
    """
    seen_by = camera(yaw)
    head = DrawnHead(MODEL.skin)
    body = head.body(head.lit(skin))
    surface = body.lit.surface
    seen = rasterise(seen_by.project(surface.vertices), surface.faces, *SIZE)
    pixels = np.full((SIZE[1], SIZE[0], 3), 0.3)
    pixels[seen.mask] = seen.interpolate(body.colour * body.lit.light)
    picture = Image.fromarray((255 * np.clip(pixels, 0, 1) ** (1 / 2.2)).astype(np.uint8))
    picture.save(folder / f"{name}.jpg", quality=95)
    points = landmark_points(builtin_template())
    known = points.at(skin)
    known[known[:, 1] < NEUTRAL[MODEL.face, 1].mean(), 1] += raised_mm
    places = seen_by.project(known)[:, :2]
    marks = {n: p.tolist() for n, p in zip(points.names, places, strict=True) if n.isdigit()}
    (folder / f"{name}.json").write_text(json.dumps({"landmarks": marks, **more}))


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rig, its tracks, and photographs."""
    folder = tmp_path_factory.mktemp("photographs")
    small_rig().save(folder / "rig.npz")
    MuscleTracks.of(MODEL, shapes()).save(folder / "tracks.npz")
    photograph(folder, "front", smile(), 0.0)
    photograph(folder, "left", smile(), 30.0)
    photograph(folder, "rest", NEUTRAL, 10.0)
    photograph(folder, "own_rest", NEUTRAL, 10.0, raised_mm=4.0)
    photograph(folder, "own_still", NEUTRAL, -10.0, raised_mm=4.0)
    return folder


def fit(files: Path, out: Path, *names: str, **options: Any) -> tuple[Rig, dict[str, Any]]:
    """Fit photographs by name; return the rig that is left, and what is told of them."""
    out.mkdir(exist_ok=True)
    run_job(
        "fit_photo",
        out,
        rig=files / "rig.npz",
        tracks=files / "tracks.npz",
        captures={name: files / f"{name}.jpg" for name in names},
        facts={name: files / f"{name}.json" for name in names},
        options=options,
    )
    return Rig.load(out / "rig.npz"), json.loads((out / "photo.json").read_text())


def off(skin: np.ndarray, truth: np.ndarray) -> float:
    """Return the mean distance in mm of faces, the head's motion apart."""
    ids = MODEL.face
    motion = weighted_motion(skin[ids], truth[ids], np.ones(len(ids)))
    return float(np.linalg.norm(motion(skin[ids]) - truth[ids], axis=1).mean())


def test_a_moment_of_two_photographs_and_a_face_at_rest(files: Path, tmp_path: Path) -> None:
    moments = {"smile": ["front", "left"]}
    rig, told = fit(files, tmp_path, "front", "left", "rest", moments=moments)
    found = {each.name: each for each in rig.systems["T"].expressions}
    assert found.keys() == {"smile", "rest"} == told["expressions"].keys()
    moved = off(NEUTRAL, smile())
    assert off(found["smile"].skin, smile()) < 0.4 * moved
    # a neutral face invents no expression
    assert off(found["rest"].skin, NEUTRAL) < 0.25 * moved
    assert all(each.inverted == 0 for each in found.values())
    cameras = told["expressions"]["smile"]["photos"]
    assert cameras.keys() == {"front", "left"}
    apart = [np.array(each["camera"]["rotation"]) for each in cameras.values()]
    turned = Rotation.from_matrix(apart[0].T @ apart[1]).magnitude()
    assert np.degrees(turned) == pytest.approx(30.0, abs=3.0)
    check_kept(tmp_path, rig, told)
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["systems"]["smile"]["T"]["mean_mm"] is None
    assert Image.open(tmp_path / "photo.png").height > 1000


def check_kept(folder: Path, rig: Rig, told: dict[str, Any]) -> None:
    """Check that photo.npz has what photo.json rounds: cameras, and landmarks by them."""
    kept = Archive.read(folder / "photo.npz", "photo", "a file of photographs", 1)
    arrays = kept.arrays
    assert kept.header["expressions"] == {"smile": ["front", "left"], "rest": ["rest"]}
    assert kept.header["model_sha256"] == MODEL.sha256
    smiling = next(each for each in rig.systems["T"].expressions if each.name == "smile")
    assert isinstance(smiling, ShapeFit)
    assert smiling.photos == ("front", "left")
    row = kept.header["photos"].index(smiling.photos[1])
    seen_by = PinholeCamera(*(arrays[f"camera_{name}"][row] for name in CAMERA))
    figures = told["expressions"]["smile"]["photos"]["left"]
    np.testing.assert_allclose(seen_by.translation, figures["camera"]["translation"], atol=1e-3)
    assert not np.array_equal(seen_by.translation, figures["camera"]["translation"])
    own = arrays["landmark_photo"] == row
    points = landmark_points(builtin_template()).select(arrays["landmark_names"][own].tolist())
    fitted = arrays["landmark_px"][own] + arrays["landmark_residual_px"][own]
    np.testing.assert_allclose(seen_by.project(points.at(smiling.skin))[:, :2], fitted, atol=0.01)
    assert arrays["landmark_weights"].shape == (len(own), 2)
    assert arrays["light"].shape == (3, 9, 3)
    assert arrays["albedo"].shape == (3, len(MODEL.face), 3) == (*arrays["albedo_seen"].shape, 3)
    assert 0.3 < arrays["albedo_seen"].mean() < 1.0


def test_plain_shapes_by_landmarks_alone(files: Path, tmp_path: Path) -> None:
    rig, told = fit(files, tmp_path, "front", model="shapes", shading=False)
    assert off(rig.systems["B"].expressions[0].skin, smile()) < 0.5 * off(NEUTRAL, smile())
    assert told["expressions"]["front"]["photos"]["front"]["landmarks_mm"] < 1.0


def test_a_model_serves_in_the_place_of_a_rig(files: Path, tmp_path: Path) -> None:
    MODEL.save(tmp_path / "model.npz")
    given: dict[str, Any] = {
        "tracks": files / "tracks.npz",
        "captures": {"front": files / "front.jpg"},
        "facts": {"front": files / "front.json"},
        "options": {"model": "shapes", "shading": False},
    }
    with pytest.raises(InputError, match="needs a rig or a model") as error:
        run_job("fit_photo", tmp_path, **given)
    assert error.value.code == "job.missing"
    run_job("fit_photo", tmp_path, model=tmp_path / "model.npz", **given)
    rig = Rig.load(tmp_path / "rig.npz")
    assert not rig.expressions
    shown = read_glb(tmp_path / "rig.glb").expressions()["front"]
    np.testing.assert_allclose(shown, rig.systems["B"].expressions[0].skin, atol=1e-3)
    assert json.loads((tmp_path / "report.json").read_text())["system"] == "B"
    assert (tmp_path / "fit_front.png").is_file()
    assert "front: the fit that rig.glb shows" in (tmp_path / "report.html").read_text()
    assert (rig.model.rest == MODEL.rest).all()
    assert off(rig.systems["B"].expressions[0].skin, smile()) < 0.5 * off(NEUTRAL, smile())


def test_a_neutral_photograph_tells_where_a_person_s_landmarks_are(
    files: Path, tmp_path: Path
) -> None:
    given: dict[str, Any] = {"model": "shapes", "shading": False}
    moved = []
    for number, options in enumerate((given, {**given, "neutral": "own_rest"})):
        rig, _ = fit(files, tmp_path / str(number), "own_rest", "own_still", **options)
        found = {each.name: each for each in rig.systems["B"].expressions}
        moved.append(off(found["own_still"].skin, NEUTRAL))
    assert moved[0] > 0.3
    assert moved[1] < 0.3 * moved[0]


def test_a_photograph_of_somebody_else_is_told(files: Path, tmp_path: Path) -> None:
    basis = builtin_template().shapes
    assert basis is not None
    who = np.random.default_rng(4).standard_normal(len(basis.identity))
    stranger = smile() + np.tensordot(who, basis.identity, 1)
    photograph(files, "stranger", stranger, 10.0)
    rig, told = fit(files, tmp_path, "front", "stranger", model="shapes", shading=False)
    codes = {
        each.name: [notice.code for notice in each.notices] for each in rig.systems["B"].expressions
    }
    assert "photo.other_person" in codes["stranger"]
    assert "photo.other_person" not in codes["front"]
    assert [each["file"] for each in told["notices"]] == ["stranger"]
    nats = {
        name: each["photos"][name]["somebody_else_nats"]
        for name, each in told["expressions"].items()
    }
    assert nats["front"] < 0.0 < nats["stranger"]


def test_a_photograph_that_shows_no_skin_is_refused(files: Path, tmp_path: Path) -> None:
    photograph(files, "night", smile(), 0.0)
    Image.new("RGB", SIZE).save(files / "night.jpg")
    with pytest.raises(InputError, match="night: too little skin is left") as error:
        fit(files, tmp_path, "front", "night", model="shapes")
    assert error.value.code == "photo.no_skin"


def test_what_a_photograph_leaves_unexplained_is_told(files: Path, tmp_path: Path) -> None:
    """A pattern before half of the face, places of no skin, a turn of 50 degrees."""
    photograph(files, "hidden", smile(), 0.0)
    pixels = np.array(Image.open(files / "hidden.jpg"))
    stripes = 255 * (np.arange(SIZE[0]) // 12 % 2)
    pixels[SIZE[1] // 2 :, :] = 40 + stripes[:, None] * np.array([0.6, 0.7, 0.5])
    Image.fromarray(pixels).save(files / "hidden.jpg", quality=95)
    photograph(files, "aside", smile(), 50.0)
    irises = [str(row) for row in range(468, 478)]
    for name, extra in (("hidden", irises), ("aside", irises[:1])):
        facts = files / f"{name}.json"
        marks = json.loads(facts.read_text())["landmarks"]
        kept = dict([*marks.items()][-8:]) if name == "hidden" else marks
        more = {mark: [130.0, 160.0] for mark in extra}
        facts.write_text(json.dumps({"landmarks": kept | more}))
    _, told = fit(files, tmp_path, "front", "hidden", "aside", model="shapes")
    figures = {name: each["photos"][name] for name, each in told["expressions"].items()}
    assert figures["front"]["skin_unexplained"] < 0.02
    assert 0.85 < figures["front"]["skin_compared"] < 1.0
    assert figures["hidden"]["skin_unexplained"] > 0.2
    codes = {(each["file"], each["code"]) for each in told["notices"]}
    wanted = {("hidden", "photo.unexplained"), ("hidden", "photo.left_out")}
    assert wanted | {("aside", "photo.profile")} <= codes
    assert not any(name == "front" for name, _ in codes)
    (left,) = (each for each in told["notices"] if each["code"] == "photo.left_out")
    assert (left["landmarks"], left["curves"]) == (irises, [])
    assert "10 of 18 landmarks" in left["message"]
    assert figures["aside"]["left_out"] == {"curves": [], "landmarks": ["468"]}


def test_a_curve_of_another_place_is_refused(files: Path, tmp_path: Path) -> None:
    corner = [[5, 5], [60, 5], [60, 40], [5, 40], [5, 5]]
    photograph(files, "traced", smile(), 0.0, curves={"lips_outer": corner})
    with pytest.raises(InputError, match="the curve lips_outer is") as error:
        fit(files, tmp_path, "traced", model="shapes")
    assert (error.value.code, error.value.context["where"]) == ("photo.curve", "lips_outer")


def test_landmarks_of_the_far_side_are_refused(files: Path, tmp_path: Path) -> None:
    """Of a mirrored picture without eyes and brows nothing else says so."""
    photograph(files, "mirrored", smile(), 0.0)
    facts = files / "mirrored.json"
    marks = json.loads(facts.read_text())["landmarks"]
    middle = NEUTRAL[MODEL.face, 1].mean()
    points = landmark_points(builtin_template())
    low = points.at(NEUTRAL)[:, 1] < middle
    kept = {name for name, is_low in zip(points.names, low, strict=True) if is_low}
    mirrored = {name: [SIZE[0] - x, y] for name, (x, y) in marks.items() if name in kept}
    facts.write_text(json.dumps({"landmarks": mirrored}))
    with pytest.raises(InputError, match="left and right may be exchanged") as error:
        fit(files, tmp_path, "mirrored", model="shapes")
    assert (error.value.code, error.value.context["photo"]) == ("photo.pose", "mirrored")


def placed(yaw: float) -> dict[str, Any]:
    """Return what facts say of a camera, with its place in the world."""
    known = camera(yaw)
    named = dict(zip(("fx", "fy", "cx", "cy"), [*known.focal, *known.centre], strict=True))
    return named | {"rotation": known.rotation.tolist(), "translation": known.translation.tolist()}


@pytest.mark.parametrize(("yaw", "is_told"), [(30.0, False), (-30.0, True)])
def test_cameras_that_contradict_are_told(
    files: Path, tmp_path: Path, yaw: float, is_told: bool
) -> None:
    photograph(files, "placed", smile(), 0.0, camera=placed(0.0))
    photograph(files, "aside", smile(), 30.0, camera=placed(yaw))
    options: dict[str, Any] = {"model": "shapes", "shading": False}
    rig, told = fit(
        files, tmp_path, "placed", "aside", moments={"a": ["placed", "aside"]}, **options
    )
    (found,) = rig.systems["B"].expressions
    assert ("photo.cameras" in [each.code for each in found.notices]) == is_told
    figures = told["expressions"]["a"]["photos"]
    assert (figures["aside"]["reprojection"]["given_px"] > 5.0) == is_told
    assert figures["placed"]["reprojection"]["alone_px"] < 3.0


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        ({"moments": {"smile": ["front", "back"]}}, "photo.moment", "no photograph 'back'"),
        ({"moments": {"a": ["front"], "b": ["front"]}}, "photo.moment", "named twice"),
        ({"moments": {"left": ["front"]}}, "photo.moment", "is called 'left' too"),
        ({"neutral": "back"}, "photo.neutral", "no photograph 'back'"),
        ({"boxes": {"back": [0, 0, 9, 9]}}, "photo.neutral", "no photograph 'back'"),
    ],
)
def test_photographs_that_are_not_there(
    files: Path, tmp_path: Path, options: dict[str, Any], code: str, words: str
) -> None:
    with pytest.raises(InputError, match=words) as error:
        fit(files, tmp_path, "front", "left", **options)
    assert error.value.code == code


def test_a_photograph_without_landmarks_says_how_to_give_them(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MYOFACE_FACE_LANDMARKER", raising=False)
    monkeypatch.setenv("MYOFACE_CACHE", str(tmp_path / "cache"))
    given = {"rig": files / "rig.npz", "tracks": files / "tracks.npz"}
    with pytest.raises(InputError, match=r"front has no .* myoface assets fetch landm") as error:
        run_job("fit_photo", tmp_path, captures={"front": files / "front.jpg"}, **given)
    assert error.value.code == "landmarks.model"
