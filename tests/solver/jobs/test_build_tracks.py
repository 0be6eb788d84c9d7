"""The job that builds muscle tracks: its files, and what is told of shapes and muscles."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse as sp

from solver.anatomy.template import ShapeBasis
from solver.errors import InputError
from solver.jobs import build_tracks, run_job
from solver.meshio import registered
from solver.meshio.registered import write_registered
from solver.model import SubjectModel
from solver.surface import Surface
from solver.tracks.basis import MuscleTracks
from tests.solver.tracks.block import block_shapes, tracked_block


@pytest.fixture
def model_file(tmp_path, monkeypatch):
    model = tracked_block()
    shapes = block_shapes(model) | {"still": np.zeros_like(model.skin.vertices)}
    motions = np.array(list(shapes.values()), np.float32)
    basis = ShapeBasis(motions[:0], motions, tuple(shapes))
    monkeypatch.setattr(build_tracks, "read_template", lambda _: SimpleNamespace(shapes=basis))
    file = tmp_path / "model.npz"
    model.save(file)
    return file


@pytest.mark.long
def test_it_leaves_tracks_their_figures_and_a_picture(tmp_path, model_file):
    options = {"stiffness": {"left": 2.0}, "length_mm": 2, "bones": "held"}
    files = run_job("build_tracks", tmp_path / "out", options=options, model=model_file)
    assert [file.name for file in files] == ["tracks.npz", "tracks.json", "tracks.png"]
    tracks = MuscleTracks.load(files[0], SubjectModel.load(model_file))
    assert tracks.names == ("aside", "bulge", "open", "still")
    assert tracks.stiffness.tolist() == [2.0, 1.0]
    assert (tracks.bones, tracks.length_mm) == ("held", 2.0)
    told = json.loads(files[1].read_text())
    still = {"code": "tracks.shapes", "message": "still moves no skin on flesh"}
    assert told["notices"] == [still]
    assert [shape["turned_tets"] for shape in told["shapes"]] == [0, 0, 0, 0]
    assert [muscle["name"] for muscle in told["muscles"]] == ["left", "right"]
    assert all(muscle["length_mm"] > 10.0 and not muscle["closed"] for muscle in told["muscles"])
    assert {shape["name"] for shape in told["tried"]} == set(tracks.names)
    assert all(shape["reached"] and shape["inverted"] == 0 for shape in told["tried"])
    assert files[2].read_bytes().startswith(b"\x89PNG")


@pytest.mark.long
def test_scans_become_shapes_on_top_of_the_template_s(tmp_path, model_file, monkeypatch):
    monkeypatch.setattr(registered, "PLAUSIBLE", replace(registered.PLAUSIBLE, head_mm=(10, 700)))
    model = SubjectModel.load(model_file)
    skin = model.skin.vertices.copy()
    skin += 0.5 * block_shapes(model)["aside"]
    skin[model.face[:4], 2] += 0.5
    scan = tmp_path / "aside.ply"
    write_registered(scan, Surface(skin, model.skin.faces), np.ones(len(skin)))
    files = run_job(
        "build_tracks", tmp_path / "out", model=model_file, captures={"aside": scan}, options={}
    )
    assert MuscleTracks.load(files[0], model).names[-1] == "own_aside"
    told = json.loads(files[1].read_text())
    shape = told["shapes"][-1]
    assert shape["name"] == "own_aside"
    assert shape["on_top_of"]["aside"] == pytest.approx(0.5, abs=0.2)
    assert 0.0 < shape["left_mm"] < 0.5
    assert "own_aside" in {shape["name"] for shape in told["tried"]}


def test_shapes_that_turn_flesh_inside_out_are_told_and_kept(tmp_path, model_file, monkeypatch):
    model = SubjectModel.load(model_file)
    folded = np.zeros_like(model.skin.vertices)
    folded[model.embedded, 2] = -25.0
    basis = ShapeBasis(folded[None].astype(np.float32)[:0], folded[None], ("folded",))
    monkeypatch.setattr(build_tracks, "read_template", lambda _: SimpleNamespace(shapes=basis))
    files = run_job("build_tracks", tmp_path / "out", options={"bones": "held"}, model=model_file)
    told = json.loads(files[1].read_text())
    [shape] = told["shapes"]
    assert shape["turned_tets"] > 10
    [notice] = [each for each in told["notices"] if each["code"] == "tracks.turned"]
    assert notice["shapes"] == {"folded": shape["turned_tets"]}


def test_muscles_that_stay_passive_are_told(tmp_path, model_file):
    """One without flesh, and all the others where the model has no fibres."""
    model = SubjectModel.load(model_file)
    weights = model.weights.toarray()
    weights[:, 0] += weights[:, 1]
    weights[:, 1] = 0.0
    file = tmp_path / "passive.npz"
    replace(model, weights=sp.csr_array(weights), fibres=None).save(file)
    steps = []
    files = run_job("build_tracks", tmp_path / "out", model=file, progress=steps.append)
    [notice] = [
        each
        for each in json.loads(files[1].read_text())["notices"]
        if each["code"] == "tracks.passive"
    ]
    assert notice["muscles"] == {"left": "flesh", "right": "fibres"}
    assert notice["message"] in [each.message for each in steps if each.phase == "warning"]


def test_a_muscle_that_there_is_not_is_told(tmp_path, model_file):
    options = {"stiffness": {"lefty": 2.0}}
    with pytest.raises(InputError) as error:
        run_job("build_tracks", tmp_path / "out", options=options, model=model_file)
    assert error.value.code == "tracks.muscle"
