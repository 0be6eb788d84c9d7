"""What a registration leaves of a scan's colours, and what it says where an image is missing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from myoface.client.scan_packing import with_images
from solver.jobs import run_job
from solver.registration.skin_images import MADE_FOR
from solver.registration.texture import texture_coordinates
from solver.registration.topology import topology
from solver.rig.studio.skin_texture import SkinTexture
from solver.surface import faces_within, part_of
from solver.templates.builtin.build import builtin_template

pytestmark = pytest.mark.slow


def coloured_scan(folder: Path) -> Path:
    """Write the built-in face with an image: red on the subject's left, blue on the right."""
    template = builtin_template()
    skin = template.skin
    head = part_of(skin, np.flatnonzero(faces_within(skin.faces, topology(template).outer)))
    lines = ["mtllib scan.mtl", "usemtl skin"]
    lines += [f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in head.vertices]
    lines += [f"vt {0.5 + x / 400:.6f} 0.5" for x in head.vertices[:, 0]]
    lines += ["f " + " ".join(f"{corner}/{corner}" for corner in row) for row in head.faces + 1]
    path = folder / "scan.obj"
    path.write_text("\n".join(lines) + "\n")
    (folder / "scan.mtl").write_text("newmtl skin\nmap_Kd skin.png\n")
    pixels = np.zeros((16, 256, 3), np.uint8)
    pixels[:, 128:, 0] = pixels[:, :128, 2] = 200
    Image.fromarray(pixels).save(folder / "skin.png")
    return path


def test_a_registration_leaves_the_colours_or_says_what_is_missing(tmp_path: Path) -> None:
    scan = coloured_scan(tmp_path)
    out = tmp_path / "out"
    # as the client sends it
    packed = with_images(scan, tmp_path)
    files = run_job("register_scan", out, options={"texture_size": 1024}, scan=packed)
    assert {"texture.png", "texture_confidence.png"} <= {file.name for file in files}
    told = json.loads((out / "registration.json").read_text())
    quality = told["texture"]
    assert quality["coverage"] > 0.9
    assert quality["ssim"] > 0.9
    assert quality["delta_e_mean"] < 2.0
    with Image.open(out / "texture_views.png") as picture:
        drawn = np.asarray(picture).astype(int)
    strong = drawn[:, :, [0, 2]].max(axis=2) - drawn[:, :, 1] > 150  # of red or blue
    for half in np.array_split(strong, 2):  # the scan above, the skin below
        assert 0.1 < half.mean() < 0.9
    # the image says so itself, to whatever wears it
    coordinates = texture_coordinates(builtin_template())
    worn = SkinTexture.read(coordinates, len(coordinates.corners), out / "texture.png")
    assert worn.figures == quality
    with Image.open(out / "texture.png") as image:
        template = builtin_template()
        assert template.texture is not None
        assert image.info[MADE_FOR] == template.texture.sha256
        assert image.size == (1024, 1024)
        found = np.asarray(image)
    at = template.texture.pixels(1024)[template.texture.corners].mean(axis=1).astype(int)
    middle = template.skin.vertices[template.skin.faces].mean(axis=1)
    face = faces_within(template.skin.faces, topology(template).face)
    for side, channel in ((middle[:, 0] > 8.0, 0), (middle[:, 0] < -8.0, 2)):
        column, row = at[face & side].T
        assert (found[row, column, channel] > 150).mean() > 0.98
    (tmp_path / "skin.png").unlink()
    again = tmp_path / "again"
    files = run_job("register_scan", again, scan=scan)
    assert "registered.ply" in {file.name for file in files}
    assert not (again / "texture.png").exists()
    told = json.loads((again / "registration.json").read_text())
    assert "texture" not in told
    missing = next(each for each in told["findings"] if each["code"] == "texture.missing")
    assert "skin.png" in missing["message"]
