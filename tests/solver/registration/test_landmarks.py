"""Landmark files: what is read, and which fault of them is named."""

import json

import numpy as np
import pytest

from solver.errors import InputError
from solver.registration.landmarks import landmark_vertices, match, read_landmarks
from solver.templates.builtin.build import builtin_template
from tests.fixtures import data_folder

NAMES = ("sellion", "nose_tip", "cheilion_l", "cheilion_r", "exocanthion_l", "exocanthion_r")


@pytest.fixture(scope="module")
def template():
    return builtin_template()


@pytest.fixture
def points(template):
    known = landmark_vertices(template)
    return {name: 0.1 * template.skin.vertices[known[name]] for name in NAMES}


def code_of(call, *args):
    with pytest.raises(InputError) as caught:
        call(*args)
    return caught.value


def test_json_and_csv_say_the_same(tmp_path, points, template):
    as_json = tmp_path / "a.json"
    as_csv = tmp_path / "a.csv"
    as_json.write_text(json.dumps({name: point.tolist() for name, point in points.items()}))
    rows = [f"{name},{x},{y},{z}" for name, (x, y, z) in points.items()]
    as_csv.write_text("\n".join(["name,x,y,z", *rows]))
    for path in (as_json, as_csv):
        given, vertices = match(path.name, read_landmarks(path), template)
        assert len(given) == len(NAMES)
        np.testing.assert_allclose(10 * given, template.skin.vertices[vertices], atol=1e-9)


def test_the_68_points_are_named_whatever_their_order(template):
    path = data_folder("scans", "menpo3d", "james.ljson")
    found = read_landmarks(path)
    assert found["exocanthion_l"][0] > found["endocanthion_l"][0] > found["endocanthion_r"][0]
    assert found["nose_tip"][2] > found["sellion"][2]
    given, _ = match(path.name, found, template)
    assert len(given) >= 12


def test_left_and_right_exchanged_are_found_out(points, template):
    turned = dict(points)
    for name in ("cheilion", "exocanthion"):
        turned[f"{name}_l"] = points[f"{name}_r"]
        turned[f"{name}_r"] = points[f"{name}_l"]
    assert code_of(match, "a.json", turned, template).code == "landmarks.swapped"


def test_a_misplaced_landmark_is_named(points, template):
    points["cheilion_l"] = points["cheilion_l"] + 6.0
    fault = code_of(match, "a.json", points, template)
    assert fault.code == "landmarks.misplaced"
    assert fault.context["landmark"] == "cheilion_l"


@pytest.mark.parametrize(
    ("name", "content", "code"),
    [
        ("a.csv", "sellion,1,2\n", "landmarks.unreadable"),
        ("a.csv", "sellion,1,2,nan\n", "landmarks.unreadable"),
        ("a.csv", "sellion,1,2,3\nsellion,1,2,4\n", "landmarks.unreadable"),
        ("a.json", "[1, 2]", "landmarks.unreadable"),
        ("a.json", '{"sellion": "123"}', "landmarks.unreadable"),
        ("a.json", '{"sellion": [1, 2]}', "landmarks.unreadable"),
        ("a.json", '{"groups": {}}', "landmarks.unreadable"),
        ("a.ljson", '{"groups": {"a": {"landmarks": {"points": 5}}}}', "landmarks.unreadable"),
        ("a.json", "[" * 100_000, "landmarks.unreadable"),
        ("a.txt", "", "landmarks.format"),
    ],
)
def test_faults_are_named(tmp_path, name, content, code):
    path = tmp_path / name
    path.write_text(content)
    assert code_of(read_landmarks, path).code == code


@pytest.mark.parametrize(
    ("name", "content"), [("a.csv", "sellion,1,2,3\n"), ("a.json", '{"sellion": [1, 2, 3]}')]
)
def test_a_mark_of_byte_order_costs_no_landmark(tmp_path, name, content):
    (tmp_path / name).write_text(content, encoding="utf-8-sig")
    assert [*read_landmarks(tmp_path / name)] == ["sellion"]


def test_landmarks_in_one_place_are_refused(points, template):
    in_one = dict.fromkeys(points, np.zeros(3))
    assert code_of(match, "a.json", in_one, template).code == "landmarks.misplaced"


def test_unknown_names_are_answered_with_the_known(points, template):
    fault = code_of(match, "a.json", {"chin": points["sellion"]}, template)
    assert fault.code == "landmarks.unknown"
    assert "sellion" in fault.message
