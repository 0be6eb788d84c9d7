"""MediaPipe on pictures of a real scan finds what a person marked on it."""

from pathlib import Path

import numpy as np
import pytest

from solver.errors import InputError
from solver.meshio.raw import read_raw
from solver.registration.landmarks import find_landmarks, read_landmarks
from solver.surface import Surface
from tests.fixtures import data_folder, face_landmarker


@pytest.mark.long
def test_eyes_and_mouth_of_a_raw_scan_are_found():
    model = face_landmarker()
    raw = read_raw(data_folder("scans", "menpo3d", "james.obj"))
    marked = read_landmarks(data_folder("scans", "menpo3d", "james.ljson"))
    scan = Surface(raw.vertices, raw.faces)
    found = find_landmarks(scan, np.array(list(marked.values())), model)
    for name in ("cheilion_l", "cheilion_r", "endocanthion_l", "endocanthion_r", "nose_tip"):
        assert np.linalg.norm(found[name] - marked[name]) < 5.0, name


def test_without_extra_or_model_the_error_says_what_to_do():
    flat = Surface(np.eye(3), np.array([[0, 1, 2]]))
    with pytest.raises(InputError) as caught:
        find_landmarks(flat, np.eye(3), Path("missing.task"))
    assert caught.value.code in ("landmarks.extra", "landmarks.model")
