"""The importers and the template made from real data, where it is at hand."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh

from solver.anatomy.muscle_weights import enclosed_volume
from solver.anatomy.warp import SkinDepth
from solver.errors import InputError
from solver.surface import Surface
from solver.templates import bodyparts3d, ict_facekit
from solver.templates.bodyparts3d import AnatomicalPart
from solver.templates.ict_template import build_ict_template

DATA = Path(os.environ.get("MYOFACE_DATA", Path(__file__).parents[4] / "shared" / "data"))
ANATOMY = DATA / "bodyparts3d"
FACES = DATA / "ict_facekit"
needs_data = pytest.mark.skipif(
    not (ANATOMY / "index.csv").exists() or not (FACES / "ict_facekit.npz").exists(),
    reason=f"BodyParts3D and ICT-FaceKit are not in {DATA} (MYOFACE_DATA)",
)


def test_folder_without_index_is_named(tmp_path):
    with pytest.raises(InputError, match=r"index\.csv"):
        bodyparts3d.read_parts(tmp_path)


def test_missing_mesh_is_named(tmp_path):
    (tmp_path / "index.csv").write_text("fma_id,category,name\nFMA1,cranium,vomer\n")
    with pytest.raises(InputError, match=r"FMA1\.ply"):
        bodyparts3d.read_parts(tmp_path)


@pytest.mark.parametrize("content", [b"PK not really", b"PK\x03\x04 cut short", b""])
def test_file_that_is_no_face_model_is_named(content, tmp_path):
    (tmp_path / "ict_facekit.npz").write_bytes(content)
    with pytest.raises(InputError, match=r"ict_facekit\.npz"):
        ict_facekit.read_facekit(tmp_path)


def test_quads_and_triangles_become_triangles():
    faces = ict_facekit.triangulate(np.array([[0, 1, 2, 3], [4, 5, 6, -1]]))
    assert faces.tolist() == [[0, 1, 2], [0, 2, 3], [4, 5, 6]]


@pytest.mark.long
@needs_data
def test_anatomy_that_lacks_a_part_is_named(tmp_path):
    rows = (ANATOMY / "index.csv").read_text().splitlines()
    kept = [row for row in rows if "teeth" not in row]
    (tmp_path / "index.csv").write_text("\n".join(kept))
    for row in kept[1:]:
        name = row.split(",")[0] + ".ply"
        shutil.copyfile(ANATOMY / name, tmp_path / name)
    with pytest.raises(InputError, match="tooth"):
        build_ict_template(tmp_path, FACES)


@needs_data
@pytest.mark.slow
def test_bones_and_muscles_lie_under_the_skin():
    template = build_ict_template(ANATOMY, FACES)
    assert len(template.muscles) == 43
    outer = ict_facekit.faces_within(template.skin.faces, ict_facekit.HEAD)
    depth = SkinDepth(Surface(template.skin.vertices, template.skin.faces[outer]))
    for bone in (template.cranium, template.mandible):
        assert depth(bone.vertices)[0].min() > 1.5
    for muscle in template.muscles:
        if "platysma" not in muscle.name:
            assert depth(muscle.surface.vertices)[0].min() > -0.5, muscle.name
    left, right = template.condyles
    assert np.allclose(left * [-1, 1, 1], right, atol=1)


def test_the_other_half_is_the_mirror_image():
    """A skewed box and two muscles, of which the right one is another shape."""
    box = trimesh.creation.box(extents=[10, 4, 4])
    box.apply_translation([2.0, 0, 0])
    whole = Surface(np.asarray(box.vertices), np.asarray(box.faces, np.int64))
    parts = {
        "chin": AnatomicalPart("cranium", whole),
        "left ear": AnatomicalPart(
            "muscle", whole.with_vertices(whole.vertices + np.array([20, 0, 0]))
        ),
        "right ear": AnatomicalPart("muscle", whole.with_vertices(whole.vertices - [60, 0, 0])),
    }
    found = bodyparts3d.symmetric(parts)
    chin = found["chin"].surface
    middle = bodyparts3d.MIDDLE_X
    assert chin.vertices[:, 0].max() == 7.0
    assert chin.vertices[:, 0].min() == 2 * middle - 7.0
    assert enclosed_volume(chin) == pytest.approx(2 * (7.0 - middle) * 16)
    left, right = (found[f"{side} ear"].surface.vertices for side in ("left", "right"))
    np.testing.assert_allclose(right, bodyparts3d.reflect(left))
