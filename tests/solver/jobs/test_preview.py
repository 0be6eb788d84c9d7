"""The job that makes sliders: what is in the file is what a page evaluates."""

from __future__ import annotations

import itertools
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from solver.errors import InputError, SolveError
from solver.fitting.face import Face, Pose
from solver.jobs import run_job
from solver.mechanics.flesh import IDENTITY
from solver.progress import Step
from solver.rig import ExpressionFit, Rig
from solver.rig.preview import Preview, write_preview
from solver.storage import read_container
from tests.solver.block import head_block

pytestmark = pytest.mark.long

MODEL = head_block((7, 5, 1))


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a rig of two simulated expressions."""
    folder = tmp_path_factory.mktemp("rig")
    face = Face(MODEL)
    rest = face.rest
    fits = []
    for name, stretch, hinge in (("wide", (0.8, 0.95), 0.06), ("narrow", (0.95, 0.8), 0.02)):
        a = np.array([[s, 0.02, 0.0, 1 / np.sqrt(s), 0.0, 1 / np.sqrt(s)] for s in stretch])
        b = np.array([hinge, 0.0, 0.0, 0.0, 0.0])
        state = face.continuation(rest, Pose(a, b))
        skin = face.whole_skin(state.x, b)
        error = np.zeros(len(skin))
        fits.append(ExpressionFit(name, "train", a, b, skin, skin, error, 0, 1, 0.0, 0.0, state.x))
    Rig(MODEL, MODEL.weights, tuple(fits)).save(folder / "rig.npz")
    return folder


def build(files: Path, out: Path, **more: object) -> list[Path]:
    return run_job("build_preview", out, rig=files / "rig.npz", **more)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def built(files: Path) -> tuple[Path, list[Step]]:
    steps: list[Step] = []
    build(files, files / "out", progress=steps.append)
    return files / "out", steps


def test_a_page_that_evaluates_the_file_shows_the_fits(
    files: Path, built: tuple[Path, list[Step]]
) -> None:
    out, steps = built
    held = read_container(out / "preview.bin")
    controls = held.header["controls"]
    arrays = held.arrays
    first, second = np.triu_indices(len(controls))
    fits = {fit.name: fit for fit in Rig.load(files).expressions}
    for preset in held.header["presets"]:
        c = np.array(preset["values"])
        q = arrays["linear"] @ c + arrays["quadratic"] @ (c[first] * c[second])
        skin = MODEL.skin.vertices + np.tensordot(q, arrays["basis"], 1)
        fit = fits[preset["name"]]
        off = np.linalg.norm(skin - fit.skin, axis=1)[MODEL.face].mean()
        moved = np.linalg.norm(fit.skin - MODEL.skin.vertices, axis=1)[MODEL.face].mean()
        assert off < 0.05 * moved
        assert preset["mean_mm"] == pytest.approx(off, abs=1e-3)
    figures = json.loads((out / "preview.json").read_text())
    assert figures["files"]["preview.bin"]["max_mm"] == 0.0
    error = held.header["error_mm"]
    assert {key: error[key] for key in figures["error_mm"]} == figures["error_mm"]
    assert error["mean"] < 0.05 * error["moved"]
    assert len(error["per_control"]) == len(controls)
    assert figures["poses"]["dropped"] == 0
    fractions = [step.fraction for step in steps]
    assert fractions == sorted(fractions)
    assert (out / "preview.png").read_bytes().startswith(b"\x89PNG")


def test_the_same_seed_gives_the_same_file(
    files: Path, built: tuple[Path, list[Step]], tmp_path: Path
) -> None:
    build(files, tmp_path, options={"seed": 0})
    same, other = ((folder / "preview.bin").read_bytes() for folder in (built[0], tmp_path))
    assert same == other


def test_out_of_time_it_is_made_of_what_is_ready_and_says_so(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ticks = itertools.count()
    monkeypatch.setattr(time, "monotonic", lambda: float(next(ticks)))
    build(files, tmp_path, options={"max_seconds": 60})
    poses = json.loads((tmp_path / "preview.json").read_text())["poses"]
    assert 0 < poses["learned"] < poses["planned"]
    assert poses["dropped"] > 0


def test_a_rig_without_a_fit_is_refused(files: Path, tmp_path: Path) -> None:
    a = np.tile(IDENTITY, (MODEL.muscle_count, 1))
    b = np.zeros(5)
    skin = MODEL.skin.vertices
    failed = ExpressionFit(
        "wide", "test", a, b, skin, skin, np.zeros(len(skin)), 0, 0, 0.0, 0.0, status="failed"
    )
    Rig(MODEL, MODEL.weights, (failed,)).save(tmp_path / "rig.npz")
    with pytest.raises(InputError) as caught:
        build(tmp_path, tmp_path / "out")
    assert caught.value.code == "preview.nothing"


def test_sliders_that_were_written_wrong_end_the_job(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def spoil(path: Path, preview: Preview) -> None:
        skin = replace(preview.skin, linear=1.5 * preview.skin.linear)
        write_preview(path, replace(preview, skin=skin))

    monkeypatch.setattr("solver.jobs.build_preview.write_preview", spoil)
    with pytest.raises(SolveError, match=r"preview\.bin, read back") as caught:
        build(files, tmp_path)
    assert caught.value.code == "file.differs"
    assert not (tmp_path / "preview.json").exists()
