"""A recording drives ICT-FaceKit: every weight finds its shape, and nothing else moves."""

from __future__ import annotations

import numpy as np
import pytest

from solver.scans.live_link import ARKIT_NAMES, read_live_link
from solver.templates.ict_facekit import arkit_source, drive, read_facekit
from tests.fixtures import data_folder


def test_every_arkit_weight_but_the_tongue_drives_a_shape() -> None:
    with np.load(data_folder("ict_facekit", "ict_facekit.npz")) as data:
        sources = {arkit_source(str(name)) for name in data["ex"]}
    assert set(ARKIT_NAMES) - sources == {"tongueOut"}


@pytest.mark.parametrize("number", [0, 1234])
def test_a_frame_is_the_sum_of_its_shapes(number: int) -> None:
    faces = data_folder("ict_facekit")
    recording = data_folder("performance", "alex_rom_3.csv")
    kit = read_facekit(faces)
    take = read_live_link(recording)
    frames = drive(kit, kit.skin.vertices, take)
    weights = dict(zip(ARKIT_NAMES, take.weights[number], strict=True))
    with np.load(faces / "ict_facekit.npz") as data:
        expected = data["V"].astype(float)
        for name, shape in zip(data["ex"], data["E"], strict=True):
            expected += weights.get(arkit_source(str(name)), 0.0) * shape
    assert len(frames) == 4030
    np.testing.assert_allclose(frames.frame(number), 10.0 * expected, atol=1e-3)
