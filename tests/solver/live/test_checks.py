"""Frames that are solved beside a session, against the fit of the whole take."""

import numpy as np
import pytest

from solver.live.checks import CheckOptions, CheckOrder, Sample, open_sample_solver, open_solver
from solver.live.rigged import LiveFace
from solver.scans.markers.places.marker_set import Marker, MarkerSet, places_over
from solver.similarity import IDENTITY
from tests.solver.live.live_rig import live_files

RATE = 60.0
EVERY = 10
FRAMES = 91
WEIGHTS = {"jawOpen": 0.5, "mouthSmileLeft": 0.8, "mouthSmileRight": 0.7, "browInnerUp": 0.8}


@pytest.mark.long
def test_a_sampled_frame_is_solved_about_as_in_its_take(tmp_path):
    """Nearer than by as many frames as it stands for: the take's fit trusts each of them less."""
    files = live_files(tmp_path)
    face = LiveFace.open(files, tmp_path)
    model = face.rig.model
    rng = np.random.default_rng(2)
    triangles = model.skin.faces[np.isin(model.skin.faces, model.face).all(axis=1)]
    corners = triangles[rng.choice(len(triangles), 60, replace=False)]
    markers = MarkerSet(
        tuple(
            Marker(f"M{number}", tuple(each), (0.3, 0.3, 0.4), 2.0, sigma_mm=1.0)
            for number, each in enumerate(corners.tolist())
        ),
        IDENTITY,
        model.sha256,
    )
    files["marker_set"] = tmp_path / "markers.json"
    markers.save(files["marker_set"])
    shares = np.tile([0.3, 0.3, 0.4], (60, 1))
    beside = rng.standard_normal((60, 3))  # they are bound where they are not
    samples = []
    for number in range(FRAMES):
        swing = 0.5 - 0.5 * np.cos(4.0 * number / RATE)
        values = np.array([swing * WEIGHTS.get(name, 0.0) for name in face.skin.names])
        skin = face.skin_of(face.amounts(values))
        seen = places_over(skin[corners], shares, np.full(60, 2.0)) + beside
        seen += 0.15 * rng.standard_normal(seen.shape)
        none = np.zeros(0)
        samples.append(Sample(number, seen.astype(np.float32), values, none, none, none))
    take = open_solver(face, "markers", files, 1.0 / RATE)
    whole = [take.solve(sample) for sample in samples]

    def off(seconds):
        options = CheckOptions(alike_s=seconds)
        order = CheckOrder(files, tmp_path, "markers", RATE, options, 0)
        solver = open_sample_solver(face, order)
        skins = [(each.number, solver.solve(each)) for each in samples[::EVERY]]
        errors = [(skin - whole[number])[model.face] for number, skin in skins]
        return np.linalg.norm(errors, axis=2).mean()

    moved = np.linalg.norm((whole[45] - whole[0])[model.face], axis=1).mean()
    usual = off(CheckOptions().alike_s)
    assert usual < 0.4 * moved
    assert usual < 0.85 * off(CheckOptions().usual_s)
