"""The job that estimates a neutral: what it leaves, that a model and its rigs tell, and limits."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from solver.errors import InputError
from solver.jobs import run_job
from solver.meshio.registered import read_registered
from solver.rig import Rig
from solver.similarity import fit_similarity
from solver.templates.builtin.build import builtin_template
from tests.fixtures import small_rig
from tests.solver.jobs.test_fit_photo import MODEL, NEUTRAL, photograph, smile

TEMPLATE = builtin_template()

pytestmark = pytest.mark.long


def test_an_estimate_is_a_neutral_that_says_what_it_is(tmp_path: Path) -> None:
    photograph(tmp_path, "front", smile(), 0.0)
    photograph(tmp_path, "aside", NEUTRAL, 25.0)
    names = ("front", "aside")
    out = tmp_path / "out"
    out.mkdir()
    run_job(
        "neutral_from_photos",
        out,
        captures={name: tmp_path / f"{name}.jpg" for name in names},
        facts={name: tmp_path / f"{name}.json" for name in names},
    )
    skin = TEMPLATE.skin
    found = read_registered(out / "neutral.ply", skin.faces, len(skin.vertices))
    assert found.size_from == "photographs"
    mean = TEMPLATE.skin.vertices
    face = MODEL.face
    away = {}
    for name, each in (("found", found.vertices), ("mean", mean), ("smile", smile())):
        same_size = fit_similarity(each[face], NEUTRAL[face])
        away[name] = float(np.linalg.norm(same_size(each[face]) - NEUTRAL[face], axis=1).mean())
    # nearer than the template's own person, and a smile is no part of who it is
    assert away["found"] < 0.7 * min(away["mean"], away["smile"])
    told = json.loads((out / "neutral.json").read_text())
    assert told["notices"][0]["code"] == "model.estimated"
    assert told["photos"]["front"]["weights"]["mouthSmileLeft"] > 0.3
    assert (out / "neutral.png").stat().st_size > 10_000


def test_a_photograph_of_somebody_else_is_told(tmp_path: Path) -> None:
    basis = TEMPLATE.shapes
    assert basis is not None
    who = np.random.default_rng(4).standard_normal(len(basis.identity))
    stranger = NEUTRAL + np.tensordot(who, basis.identity, 1)
    names = ("front", "left", "stranger")
    for name, skin, yaw in zip(names, (NEUTRAL, smile(), stranger), (0.0, 20.0, 10.0), strict=True):
        photograph(tmp_path, name, skin, yaw)
    run_job(
        "neutral_from_photos",
        tmp_path,
        captures={name: tmp_path / f"{name}.jpg" for name in names},
        facts={name: tmp_path / f"{name}.json" for name in names},
    )
    told = json.loads((tmp_path / "neutral.json").read_text())
    noticed = [each["file"] for each in told["notices"] if each["code"] == "photo.other_person"]
    assert noticed == ["stranger"]
    assert told["photos"]["front"]["somebody_else_nats"] < 3.0


def test_every_rig_of_an_estimate_says_so(tmp_path: Path) -> None:
    rig = small_rig()
    replace(rig, model=replace(rig.model, size_from="photographs")).save(tmp_path / "rig.npz")
    assert "model.estimated" in [each.code for each in Rig.load(tmp_path / "rig.npz").warnings]


@pytest.mark.parametrize(("scale", "is_refused"), [(0.5, False), (0.25, True)])
def test_a_small_face_is_told_whose_landmarks_are_given(
    tmp_path: Path, scale: float, is_refused: bool
) -> None:
    photograph(tmp_path, "far", NEUTRAL, 0.0)
    picture = tmp_path / "far.jpg"
    facts = tmp_path / "far.json"
    whole = Image.open(picture)
    whole.resize((round(scale * whole.width), round(scale * whole.height))).save(picture)
    marks = json.loads(facts.read_text())["landmarks"]
    reduced = {name: [scale * each for each in place] for name, place in marks.items()}
    facts.write_text(json.dumps({"landmarks": reduced}))
    files = {"captures": {"far": picture}, "facts": {"far": facts}}
    if is_refused:
        with pytest.raises(InputError) as error:
            run_job("neutral_from_photos", tmp_path, **files)
        assert (error.value.code, error.value.context["file"]) == ("photo.small", "far")
        return
    run_job("neutral_from_photos", tmp_path, **files)
    told = json.loads((tmp_path / "neutral.json").read_text())
    assert "photo.small" in [each["code"] for each in told["notices"]]


def test_more_photographs_than_it_reads_are_refused(tmp_path: Path) -> None:
    photo = tmp_path / "a.jpg"
    photo.touch()
    captures = {f"photo{number}": photo for number in np.arange(9)}
    with pytest.raises(InputError) as error:
        run_job("neutral_from_photos", tmp_path, captures=captures)
    assert (error.value.code, error.value.context["expected"]) == ("photo.too_many", 8)
