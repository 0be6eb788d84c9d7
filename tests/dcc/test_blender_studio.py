"""Blender plays a recording on a studio's rig as we do, and writes an FBX file that does."""

from __future__ import annotations

import csv
import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from solver.jobs.build_studio_rig import tell_shapes
from solver.rig.studio.glb import write_glb
from solver.rig.studio.light_rig import DrivenBy, HalfWay, LightRig
from solver.rig.studio.parts import parts_of
from solver.rig.studio.shapes import StudioShapes
from solver.rig.studio.skin_texture import SkinTexture
from tests.dcc.test_blender import ROOT, Scene, blender
from tests.solver.rig.studio.test_studio import MODEL, shapes, texture

__all__ = ["blender", "shapes", "texture"]

RATE = 60
FRAMES = [0, 7, 30]


def run(blender: Path, *words: object) -> None:
    command = [blender, *map(str, words)]
    child = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False
    )
    assert child.returncode == 0, child.stdout + child.stderr


@pytest.mark.parametrize("driven_by", ["shapes", "joints"])
def test_a_recording_plays_in_blender_and_in_fbx_as_ours(
    blender: Path, shapes: StudioShapes, texture: SkinTexture, driven_by: DrivenBy, tmp_path: Path
) -> None:
    light = LightRig.of(MODEL, shapes, driven_by)
    bulge = np.zeros_like(light.motions[0])
    bulge[:, 2] = 1.5
    light = LightRig(
        *(light.neutral, light.names, light.motions, light.twists, light.skeleton),
        half_ways=(HalfWay("mouthSmileLeft", bulge),),
    )
    write_glb(light, tmp_path / "studio.glb", texture)
    wrinkles = {"file": "studio_wrinkles_1.png", "driven_by": {"mouthSmileLeft": 0.5}}
    Image.fromarray(np.full((8, 8, 4), 128, np.uint8)).save(tmp_path / wrinkles["file"])
    told = {**tell_shapes(light, shapes), "wrinkles": {"grin": wrinkles}}
    (tmp_path / "studio.json").write_text(json.dumps(told))
    cut = parts_of(MODEL.skin, light.skeleton, texture.coordinates)[0].vertices
    times = np.arange(31) / 30.0
    weights = {
        "jawOpen": 0.5 - 0.5 * np.cos(3.0 * times),
        "mouthClose": 0.4 * times,
        "mouthSmileLeft": times,
    }
    with (tmp_path / "take.csv").open("w", newline="") as stream:
        table = csv.writer(stream)
        table.writerow(
            ["Timecode", "BlendShapeCount", *(f"{n[0].upper()}{n[1:]}" for n in weights)]
        )
        for row in zip(*weights.values(), strict=True):
            table.writerow(["10:00:00:00.000", 61, *row])
    files = [tmp_path / name for name in ("studio.glb", "rig.blend", "take.csv", "rig.fbx")]
    glb, blend, take, fbx = files
    play = ["--recording", take, "--rate", RATE, "--fbx", fbx]
    run(blender, "docs/examples/blender_studio.py", glb, blend, *play)
    for path in (blend, fbx):
        found = path.with_name(f"{path.suffix[1:]}.npz")
        run(blender, "tests/dcc/blender_studio_scene.py", path, found, *FRAMES)
        with np.load(found) as file:
            arrays = dict(file)
        scene = Scene(json.loads(str(arrays.pop("known"))), arrays)
        assert scene.known["keys"] == [*light.targets]
        assert scene.known["bones"] == sorted(light.skeleton.joints)
        moved = 0.0
        for number, frame in enumerate(FRAMES):
            ours = light.play({name: float(values[frame]) for name, values in weights.items()})
            off = np.linalg.norm(scene.mm(f"frame_{number}") - ours[cut], axis=1)
            assert off.max() < 0.05, f"{path.name}, frame {frame}"
            moved = max(moved, float(np.abs(ours - light.neutral.vertices).max()))
        assert moved > 1.0
        if path == blend:  # FBX has no nodes
            grins = [each["grin"] for each in scene.known["strengths"]]
            wanted = np.minimum(2.0 * weights["mouthSmileLeft"][FRAMES], 1.0)
            np.testing.assert_allclose(grins, wanted, atol=1e-3)
