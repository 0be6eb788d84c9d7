"""``rig.npz``: a fitted person in one file, read as the files of the release before were."""

from __future__ import annotations

import shutil
from dataclasses import fields, replace
from pathlib import Path
from zipfile import ZIP_BZIP2, ZIP_DEFLATED, ZIP_STORED, ZipFile

import numpy as np
import pytest

from solver.errors import InputError, make_warning
from solver.mechanics.flesh import IDENTITY
from solver.model import SubjectModel, weights_hash
from solver.rig.expression import FORMAT, ExpressionFit
from solver.rig.rig import FitRound, Rig
from solver.rig.system import ShapeFit, ShapeSystem, TetFit, TetSystem
from solver.storage import Archive, read_arrays
from tests.solver.block import block_model

ROUNDS = (FitRound(1, None, 2.5, 0.4, 1.0), FitRound(2, 0.0, 1.5, 0.3, 0.5))


@pytest.fixture
def rig() -> Rig:
    model = block_model()
    skin = model.skin.vertices + 0.5
    a = np.tile(IDENTITY, (model.muscle_count, 1))
    error = np.full(len(skin), np.nan)
    fit = ExpressionFit(
        "smile", "train", a, np.arange(5.0), skin, skin, error, 0, 3, 0.5, 0.1, x=model.rest + 0.25
    )
    fit = replace(fit, confidence=np.linspace(0.0, 1.0, len(skin)).astype(np.float32))
    notice = make_warning("model.odd", "something is odd")
    return Rig(
        model, model.weights, (fit,), {"fit": 1.5}, (notice,), {"verdict": "good"}, rounds=ROUNDS
    )


def check_same(one: Rig, other: Rig) -> None:
    assert one.model.sha256 == other.model.sha256
    assert weights_hash(one.weights) == weights_hash(other.weights)
    for before, after in zip(one.expressions, other.expressions, strict=True):
        assert (before.name, before.iterations) == (after.name, after.iterations)
        np.testing.assert_array_equal(before.activations, after.activations)
        np.testing.assert_array_equal(before.jaw, after.jaw)
        np.testing.assert_array_equal(before.x, after.x)
        np.testing.assert_array_equal(before.confidence, after.confidence)
        np.testing.assert_allclose(before.skin, after.skin, atol=1e-5)
    assert one.figures == other.figures


def test_a_rig_comes_back_from_its_file_and_from_its_folder(rig: Rig, tmp_path: Path) -> None:
    rig.save(tmp_path / "rig.npz")
    for path in (tmp_path / "rig.npz", tmp_path):
        found = Rig.load(path)
        check_same(rig, found)
        assert (found.seconds, found.notices) == (rig.seconds, rig.notices)
        assert found.rounds == ROUNDS


def by_shapes(rig: Rig, name: str, weight: float) -> ShapeFit:
    """Return an expression of the rig as one that two shapes drive."""
    held = {each.name: getattr(rig.expressions[0], each.name) for each in fields(ExpressionFit)}
    lengths = np.arange(float(rig.model.muscle_count))
    own = {"weights": np.array([weight, 0.5]), "jaw_on_top": np.arange(5.0), "lengths": lengths}
    return ShapeFit(**{**held, "name": name}, **own)


def test_systems_come_back_and_a_rig_without_is_of_muscles_alone(rig: Rig, tmp_path: Path) -> None:
    placed = replace(by_shapes(rig, "kiss", 1.0), head=np.arange(6.0), photos=("a, left", "b"))
    fits = by_shapes(rig, "smile", 0.25), placed
    system = ShapeSystem(fits, ("aside", "bulge"))
    replace(rig, systems={"T": system, "B": ShapeSystem((), ("aside",))}).save(tmp_path / "rig.npz")
    found = Rig.load(tmp_path / "rig.npz")
    check_same(rig, found)
    assert found.systems["B"] == ShapeSystem((), ("aside",))
    assert found.systems["T"].shapes == system.shapes
    for before, after in zip(fits, found.systems["T"].expressions, strict=True):
        assert before.name == after.name
        for each in ("weights", "jaw_on_top", "lengths", "activations", "jaw", "x", "head"):
            np.testing.assert_array_equal(getattr(before, each), getattr(after, each))
        assert before.photos == after.photos
    # as rigs were before heads and photographs were kept, and before there were systems
    archive = Archive.read(tmp_path / "rig.npz", "rig", "a rig", FORMAT)
    older = {"system_T_head", "system_T_photos", "system_B_head", "system_B_photos"}
    assert older <= set(archive.arrays)
    kept = {name: each for name, each in archive.arrays.items() if name not in older}
    Archive(archive.header, kept).write(tmp_path / "scans.npz")
    for after in Rig.load(tmp_path / "scans.npz").systems["T"].expressions:
        assert isinstance(after, ShapeFit)
        assert (after.head.tolist(), after.photos) == (6 * [0.0], ())
    header = {name: each for name, each in archive.header.items() if name != "systems"}
    kept = {name: each for name, each in archive.arrays.items() if not name.startswith("system_")}
    Archive(header, kept).write(tmp_path / "old.npz")
    assert Rig.load(tmp_path / "old.npz").systems == {}
    for damaged in ({"T": {"shapes": ["one"]}}, {"T": {}}, {"M": {"shapes": []}}, [3], {"T": 3}):
        Archive({**archive.header, "systems": damaged}, archive.arrays).write(tmp_path / "bad.npz")
        with pytest.raises(InputError) as error:
            Rig.load(tmp_path / "bad.npz")
        assert error.value.code == "rig.unreadable"


def by_tets(rig: Rig, name: str, stretch: float) -> TetFit:
    """Return an expression of the rig as one that two tets drive."""
    held = {each.name: getattr(rig.expressions[0], each.name) for each in fields(ExpressionFit)}
    return TetFit(**{**held, "name": name}, tet_activations=stretch * np.tile(IDENTITY, (2, 1)))


def test_activations_of_tets_come_back(rig: Rig, tmp_path: Path) -> None:
    system = TetSystem((by_tets(rig, "smile", 0.75), by_tets(rig, "kiss", 1.25)), np.array([1, 4]))
    replace(rig, systems={"P": system}).save(tmp_path / "rig.npz")
    found = Rig.load(tmp_path / "rig.npz").systems["P"]
    assert isinstance(found, TetSystem)
    np.testing.assert_array_equal(found.tets, system.tets)
    for before, after in zip(system.expressions, found.expressions, strict=True):
        assert before.name == after.name
        np.testing.assert_array_equal(before.tet_activations, after.tet_activations)
    assert system.replaced(replace(found, expressions=())).expressions == system.expressions
    other = replace(found, tets=np.array([1, 5]))
    assert system.replaced(other) is other
    archive = Archive.read(tmp_path / "rig.npz", "rig", "a rig", FORMAT)
    tets = "system_P_tets"
    for header, arrays in (
        ({"tets": 3}, {}),
        ({"tets": 2}, {tets: np.array([1, 10**6])}),
        ({"tets": 1}, {tets: np.array([1])}),
        ({}, {}),
    ):
        told = {**archive.header, "systems": {"P": header}}
        Archive(told, {**archive.arrays, **arrays}).write(tmp_path / "bad.npz")
        with pytest.raises(InputError) as error:
            Rig.load(tmp_path / "bad.npz")
        assert error.value.code == "rig.unreadable"
    kept = {name: each for name, each in archive.arrays.items() if name != tets}
    Archive(archive.header, kept).write(tmp_path / "bad.npz")
    with pytest.raises(InputError, match="is not part of a rig"):
        Rig.load(tmp_path / "bad.npz")


def test_a_system_takes_new_fits_in_and_lets_other_scans_go(rig: Rig) -> None:
    smile, kiss = (by_shapes(rig, name, 0.25) for name in ("smile", "kiss"))
    system = ShapeSystem((smile, kiss), ("a", "b"))
    again = by_shapes(rig, "kiss", 1.0)
    names = [each.name for each in system.replaced(ShapeSystem((again,), ("a", "b"))).expressions]
    assert names == ["smile", "kiss"]
    assert system.replaced(ShapeSystem((again,), ("a", "b"))).expressions[1] is again
    assert system.replaced(ShapeSystem((again,), ("a", "c"))).expressions == (again,)
    scan = smile.target.copy()
    assert system.without({"smile": scan}).expressions == (smile, kiss)
    assert system.without({"smile": scan + 0.1}).expressions == (kiss,)


def zip_of(file: Path, packing: int = ZIP_STORED) -> Path:
    """Return a ZIP as the service sends it, with the rig's file among others."""
    path = file.with_name("hero.zip")
    with ZipFile(path, "w", packing) as archive:
        archive.writestr("rig.json", "{}")
        archive.write(file, "rig.npz")
    return path


@pytest.mark.parametrize("packing", [ZIP_STORED, ZIP_DEFLATED])
def test_a_rig_is_read_from_the_zip_that_was_downloaded(
    rig: Rig, packing: int, tmp_path: Path
) -> None:
    rig.save(tmp_path / "rig.npz")
    check_same(rig, Rig.load(zip_of(tmp_path / "rig.npz", packing)))


def test_a_rig_in_a_zip_has_the_bounds_of_other_archives(rig: Rig, tmp_path: Path) -> None:
    file = tmp_path / "rig.npz"
    rig.save(file)
    path = zip_of(file, ZIP_BZIP2)
    with pytest.raises(InputError, match="packed in another way"):
        Rig.load(path)
    with pytest.raises(ValueError, match="at most 100 can be read"):
        read_arrays(zip_of(file), 100, "rig.npz")
    file.write_bytes(b"no archive")
    with pytest.raises(InputError, match="not a ZIP"):
        Rig.load(zip_of(file))


@pytest.fixture
def old(rig: Rig, tmp_path: Path) -> Path:
    """Return the folder of a rig of 0.1, with the model of its subject beside it."""
    folder = tmp_path / "old"
    folder.mkdir()
    rig.model.save(folder / "model.npz")
    rig.save_as_0_1(folder)
    return folder


def roles_of(folder: Path) -> dict[str, Path]:
    names = {"model": "model.npz", "weights": "muscle_weights.npz", "rig": "activations.npz"}
    return {role: folder / name for role, name in names.items()}


def test_a_rig_of_the_release_before_is_read_from_its_four_files(rig: Rig, old: Path) -> None:
    files = roles_of(old)
    check_same(replace(rig, figures=None), Rig.load(old))
    check_same(replace(rig, figures=None), Rig.load(files))
    sequence = {role: files[role] for role in ("model", "weights")}  # as sequences got it
    check_same(replace(rig, figures=None, expressions=()), Rig.load(sequence))
    report = old / "report.json"
    report.write_text('{"verdict": "good"}')
    check_same(rig, Rig.load(old))
    check_same(rig, Rig.load({**files, "report": report}))


def test_arrays_that_came_later_may_be_missing(old: Path) -> None:
    file = old / "activations.npz"
    with np.load(file) as data:
        kept = [name for name in data.files if name not in ("x", "round_trip", "status")]
        arrays = {name: data[name] for name in kept}
    np.savez(file, **arrays)
    [fit] = Rig.load(old).expressions
    assert fit.x is fit.round_trip is None
    assert (fit.status, fit.notices) == ("unknown", ())


def test_files_of_two_models_are_no_rig(rig: Rig, old: Path) -> None:
    for change in ({"rest": rig.model.rest + 1.0}, {"muscle_names": rig.model.muscle_names[::-1]}):
        replace(rig.model, **change).save(old / "model.npz")
        with pytest.raises(InputError) as caught:
            Rig.load(old)
        assert caught.value.code == "rig.model"


def test_half_a_file_is_no_rig(rig: Rig, old: Path) -> None:
    whole = old / "whole.npz"
    rig.save(whole)
    for name in ("muscle_weights.npz", "activations.npz", "whole.npz"):
        content = (old / name).read_bytes()
        (old / name).write_bytes(content[:1000])
        with pytest.raises(InputError) as caught:
            Rig.load(old if name != "whole.npz" else whole)
        assert caught.value.code == "rig.unreadable"
        (old / name).write_bytes(content)


def test_a_model_is_read_from_its_rig(rig: Rig, tmp_path: Path) -> None:
    rig.save(tmp_path / "rig.npz")
    assert SubjectModel.load(tmp_path / "rig.npz").sha256 == rig.model.sha256


def test_what_is_no_rig_is_refused(rig: Rig, tmp_path: Path) -> None:
    rig.model.save(tmp_path / "model.npz")
    rig.save_as_0_1(tmp_path)
    (tmp_path / "activations.npz").unlink()
    junk = shutil.copy(__file__, tmp_path / "junk.npz")
    for path in (tmp_path, tmp_path / "model.npz", tmp_path / "muscle_weights.npz", Path(junk)):
        with pytest.raises(InputError) as raised:
            Rig.load(path)
        assert raised.value.code == "rig.unreadable"


@pytest.mark.parametrize(("name", "value"), [("indices", 2_000_000_000), ("shape", 7)])
def test_a_matrix_that_does_not_fit_its_model_is_refused(
    rig: Rig, tmp_path: Path, name: str, value: int
) -> None:
    path = tmp_path / "rig.npz"
    rig.save(path)
    arrays = read_arrays(path)
    arrays[f"weights_{name}"][0] = value
    np.savez(path, **arrays)
    with pytest.raises(InputError) as raised:
        Rig.load(path)
    assert raised.value.code == "rig.unreadable"


def test_a_size_that_is_an_estimate_stays_one(rig: Rig, tmp_path: Path) -> None:
    assert "model.size" not in [notice.code for notice in rig.warnings]
    model = replace(rig.model, size_from="template")
    assert model.sha256 != rig.model.sha256
    replace(rig, model=model).save(tmp_path / "rig.npz")
    found = Rig.load(tmp_path / "rig.npz")
    (size, *others) = found.warnings
    assert others == list(rig.notices)
    assert size.message == "size unknown: taken from the template, millimetres are estimates"


def test_a_path_may_be_text(rig: Rig, tmp_path: Path) -> None:
    rig.save(str(tmp_path / "rig.npz"))
    for path in (str(tmp_path / "rig.npz"), str(tmp_path)):
        check_same(rig, Rig.load(path))
    assert SubjectModel.load(str(tmp_path / "rig.npz")).sha256 == rig.model.sha256


def test_a_file_that_is_no_rig_is_told_in_words(rig: Rig, tmp_path: Path) -> None:
    rig.save(tmp_path / "rig.npz")
    content = (tmp_path / "rig.npz").read_bytes()
    (tmp_path / "short.npz").write_bytes(content[: len(content) // 2])
    np.savez(tmp_path / "foreign.npz", x=np.zeros(3))
    for name, words in (
        ("short.npz", "short.npz is not a rig: it ends too soon: download it again"),
        ("foreign.npz", "foreign.npz is not a rig: it is another program's NPZ"),
        ("missing.npz", "there is no file .*missing.npz"),
    ):
        with pytest.raises(InputError, match=words) as caught:
            Rig.load(tmp_path / name)
        assert caught.value.code == "rig.unreadable"


def test_what_a_scan_shows_is_by_its_confidence_or_its_errors(rig: Rig, tmp_path: Path) -> None:
    (fit,), vertices = rig.expressions, np.arange(4)
    error = np.where(np.arange(len(fit.error_mm)) == 1, np.nan, 0.1)
    assert fit.confidence is not None
    sure = replace(fit, error_mm=error, confidence=np.full_like(fit.confidence, 0.25))
    np.testing.assert_array_equal(sure.seen(vertices), [0.25, 0.0, 0.25, 0.25])
    older = replace(sure, confidence=None)
    replace(rig, expressions=(older,)).save(tmp_path / "rig.npz")
    (read,) = Rig.load(tmp_path / "rig.npz").expressions
    assert read.confidence is None
    np.testing.assert_array_equal(read.seen(vertices), [1.0, 0.0, 1.0, 1.0])
