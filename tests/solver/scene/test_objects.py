"""Objects of a scene: where they are, and files that hold them."""

import numpy as np
import pytest
import trimesh

from solver.kinds.scene import Object
from solver.scene.places import Places, objects_of
from tests.solver.block import head_block

PATH = [
    {"time": 0},
    {"time": 1, "move_mm": [0, 0, 10]},
    {"time": 2, "move_mm": [0, 0, 10], "rotation_deg": [0, 0, 90]},
]


@pytest.fixture
def places(tmp_path):
    box = trimesh.creation.box([80.0, 60.0, 20.0])
    box.invert()
    box.export(tmp_path / "inward.stl")
    box.apply_scale(1e-3)
    box.export(tmp_path / "metres.glb")
    assets = {path.stem: path for path in tmp_path.iterdir()}
    return Places(head_block(), {"lip": 5}, assets)


def test_a_path_turns_and_moves_an_object_from_its_place(places):
    given = {"name": "glass", "mesh": {"box_mm": [4, 2, 2]}, "at": "lip", "path": PATH}
    entry = Object.model_validate(given)
    [glass] = objects_of([entry], places)
    lip = places.model.skin.vertices[5]
    for time, moved in ((-1.0, 0.0), (0.0, 0.0), (1.0, 10.0), (9.0, 10.0)):
        np.testing.assert_allclose(
            glass.at(time).vertices.mean(axis=0), lip + np.array([0, 0, moved])
        )
    np.testing.assert_allclose(np.ptp(glass.at(0.0).vertices, axis=0), [4, 2, 2])
    np.testing.assert_allclose(np.ptp(glass.at(2.0).vertices, axis=0), [2, 4, 2])
    [straight] = objects_of([entry], places, "linear")
    heights = [each.at(0.2).vertices[:, 2].mean() - lip[2] for each in (glass, straight)]
    assert heights[1] == pytest.approx(2.0)
    assert abs(heights[0] - 2.0) > 0.1  # smooth: a monotone cubic


@pytest.mark.parametrize("asset", ["inward", "metres"])
def test_a_file_is_read_in_its_unit_and_turned_outward(places, asset):
    entry = Object.model_validate({"name": "box", "mesh": {"asset": asset}})
    [box] = objects_of([entry], places)
    assert box.shape.vertices.shape == (8, 3)
    np.testing.assert_allclose(np.ptp(box.shape.vertices, axis=0), [80, 60, 20], atol=1e-3)
    whole = trimesh.Trimesh(box.shape.vertices, box.shape.faces, process=False)
    assert whole.is_watertight
    assert whole.volume == pytest.approx(80 * 60 * 20, rel=1e-4)


@pytest.mark.parametrize(("radius", "length"), [(3.0, 60.0), (4.0, 1.0), (0.01, 500.0)])
def test_a_rod_is_round_closed_and_as_long_as_it_says(places, radius, length):
    entry = Object.model_validate({"name": "rod", "mesh": {"rod_mm": [radius, length]}})
    [rod] = objects_of([entry], places)
    whole = trimesh.Trimesh(rod.shape.vertices, rod.shape.faces, process=False)
    assert whole.is_volume
    assert len(rod.shape.vertices) < 2000
    size = [2 * radius, 2 * radius, length + 2 * radius]
    np.testing.assert_allclose(np.ptp(rod.shape.vertices, axis=0), size)
    volume = np.pi * radius**2 * (length + 4 / 3 * radius)
    assert whole.volume == pytest.approx(volume, rel=0.03)
