"""From a scene's JSON to edits: places, maps, and what a person does not have."""

from typing import get_args

import jsonschema
import numpy as np
import pytest

from solver.edits.changes import Bone, Fat, Filler, Paralysis, Scaling
from solver.edits.fat_compartments import FAT_MAP
from solver.errors import InputError
from solver.kinds.document import json_schema
from solver.kinds.scene import EditScene
from solver.kinds.scene_edits import Edit
from solver.scene import edit_of
from solver.scene.document import read_scene
from solver.scene.places import Places
from tests.fixtures import small_model
from tests.solver.block import head_block

EVERY_KIND = [
    {"kind": "fat", "f_min": 1.0, "f_max": 1.2, "map": {"regions": ["left"]}},
    {"kind": "filler", "path": [{"at": "lip", "depth_mm": 3}, {"at": [75, 60, 45]}], "ml": 0.4},
    {"kind": "bone", "bone": "mandible", "at": 7, "radius_mm": 20, "move_mm": [0, 0, 5]},
    {"kind": "stiffness", "factor": 4, "map": {"spots": ["lip", 3], "radius_mm": 20}},
    {"kind": "density", "factor": 2, "map": {"asset": "heavy"}},
    {"kind": "paralysis", "side": "left"},
]


@pytest.fixture
def places(tmp_path):
    model = head_block()
    np.save(tmp_path / "heavy.npy", np.linspace(0, 1, len(model.skin.vertices)))
    (tmp_path / "words.npy").write_text("no array")
    assets = {name: tmp_path / f"{name}.npy" for name in ("heavy", "words")}
    return Places(model, {"lip": 5}, assets)


def described(entries):
    return read_scene({"edits": entries}, EditScene).edits


def test_every_kind_is_described_and_becomes_an_edit(places):
    jsonschema.validate({"edits": EVERY_KIND}, json_schema(EditScene))
    assert [each["kind"] for each in EVERY_KIND] == [
        kind.model_fields["kind"].annotation.__args__[0]
        for kind in (get_args(each)[0] for each in get_args(get_args(Edit)[0]))
    ]
    made = [edit_of(entry, places) for entry in described(EVERY_KIND)]
    assert [type(each) for each in made] == [Fat, Filler, Bone, Scaling, Scaling, Paralysis]
    skin = places.model.skin.vertices
    np.testing.assert_array_equal(np.flatnonzero(made[0].painted), places.model.regions["left"])
    np.testing.assert_allclose(made[1].path, [skin[5] - [0, 0, 3], [75, 60, 45]])
    np.testing.assert_array_equal(made[2].at, skin[7])
    assert made[3].painted[5] == made[3].painted[3] == 1.0
    assert made[4].painted[-1] == 1.0
    assert made[5] == Paralysis(None, "left", 0.0)


def test_fat_without_a_map_is_in_the_compartments():
    person = Places.of(small_model(), None, {})
    entries = [{"kind": "fat", "f_min": 1.0, "f_max": f, "sex": "female"} for f in (1.2, 0.8)]
    gain, loss = (edit_of(entry, person) for entry in described(entries))
    for fat, is_gain in ((gain, True), (loss, False)):
        np.testing.assert_array_equal(fat.painted, person.fat_map(gain=is_gain, sex="female"))
        assert fat.depth_mm == FAT_MAP.depth_mm
    painted = {"map": {"spots": ["pogonion"], "radius_mm": 20}}
    [spot] = [edit_of(entry, person) for entry in described([entries[0] | painted])]
    assert spot.painted[person.landmarks["pogonion"]] == 1.0
    assert spot.depth_mm is None


def test_fat_is_everywhere_where_no_landmarks_place_compartments(places):
    [everywhere] = [edit_of(entry, places) for entry in described([EVERY_KIND[0] | {"map": None}])]
    assert everywhere.painted is None
    assert "which lacks alar_curvature" in places.without_compartments


@pytest.mark.parametrize(
    "entry",
    [
        {"kind": "fat", "f_min": 1.0},
        {"kind": "fat", "f_min": 1.0, "f_max": 1.1, "sex": "other"},
        {"kind": "fat", "f_min": 1.0, "f_max": 9.0},
        {"kind": "fat", "f_min": 1.0, "f_max": 1.1, "map": {"spots": ["lip"]}},
        {"kind": "filler", "path": [], "ml": 1},
        {"kind": "bone", "bone": "hyoid", "at": 1, "radius_mm": 20, "move_mm": [0, 0, 5]},
        {"kind": "stiffness", "factor": 0},
        {"kind": "paralysis", "side": "up"},
        {"kind": "wings"},
        {"side": "left"},
    ],
)
def test_the_schema_refuses(entry):
    assert not jsonschema.Draft202012Validator(json_schema(EditScene)).is_valid({"edits": [entry]})
    with pytest.raises(InputError) as raised:
        described([entry])
    assert raised.value.code == "scene.schema"


@pytest.mark.parametrize(
    ("painted", "code", "words"),
    [
        ({"regions": ["left", "tail"]}, "scene.region", "left, right"),
        ({"spots": ["ear"], "radius_mm": 9}, "scene.landmark", "there are lip"),
        ({"spots": [10_000], "radius_mm": 9}, "scene.vertex", "0 to 62"),
        ({"asset": "light"}, "scene.asset", "heavy, words"),
        ({"asset": "words"}, "scene.map", "words.npy"),
    ],
)
def test_what_the_person_does_not_have_is_named(places, painted, code, words):
    entries = described([{"kind": "stiffness", "factor": 2, "map": painted}])
    with pytest.raises(InputError, match=words) as raised:
        [edit_of(entry, places) for entry in entries]
    assert raised.value.code == code
