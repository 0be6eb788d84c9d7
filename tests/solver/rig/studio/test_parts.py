"""Gums and tongue of a studio's rig: parts of their own where the template has them apart."""

from __future__ import annotations

import numpy as np
import trimesh

from solver.rig.frames.gltf import MATERIALS
from solver.rig.studio.parts import parts_of
from solver.rig.studio.skeleton import HEAD, JAW, Skeleton
from solver.surface import Ints, Surface
from solver.templates.builtin.build import builtin_template
from tests.solver.teeth import RADIUS, fan, row_of_teeth


def parts(skin: Surface) -> dict[str, Ints]:
    """Return the vertices of each part, whose material has its name."""
    weights = np.eye(2)[np.zeros(len(skin.vertices), int)]
    found = parts_of(skin, Skeleton((HEAD, JAW), np.zeros((2, 3)), weights))
    assert all(part.material == part.name for part in found)
    assert all(part.material in MATERIALS for part in found)
    assert sum(len(part.faces) for part in found) == len(skin.faces)
    return {part.name: part.vertices for part in found}


def head(*, joined: bool) -> tuple[Surface, dict[str, Ints]]:
    """Return a ball with teeth, gums and a tongue in it, and the vertices of the latter two."""
    ball = trimesh.creation.icosphere(3, 90.0)
    tongue = trimesh.creation.icosphere(2).apply_scale((17.0, 8.0, 30.0))
    gums = row_of_teeth((0.0, -10.0, 0.0))
    teeth = [
        trimesh.creation.box((7.0, 8.0, 7.0)).apply_translation(place)
        for place in fan(RADIUS, half=80.0, count=12)
    ]
    meshes = [(ball.vertices, ball.faces), (gums.vertices, gums.faces)]
    meshes += [(mesh.vertices, mesh.faces) for mesh in (tongue, *teeth)]
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    faces = [own + start for (_, own), start in zip(meshes, starts, strict=False)]
    if joined:
        faces.append(np.array([[starts[1], starts[1] + 1, starts[2]]]))
    skin = Surface(np.vstack([vertices for vertices, _ in meshes]), np.vstack(faces))
    ranges = {"gums": np.arange(*starts[1:3]), "tongue": np.arange(*starts[2:4])}
    return skin, ranges


def test_gums_and_tongue_are_told_apart_where_they_do_not_hang_together() -> None:
    skin, ranges = head(joined=False)
    found = parts(skin)
    assert set(found) == {"skin", "teeth", "gums", "tongue"}
    for name, vertices in ranges.items():
        np.testing.assert_array_equal(np.sort(found[name]), vertices)
    joined, _ = head(joined=True)
    assert set(parts(joined)) == {"skin", "teeth", "mouth"}


def test_the_built_in_head_has_a_tongue_and_no_gums() -> None:
    found = parts(builtin_template().skin)
    assert {"teeth", "tongue"} <= found.keys()
    assert not {"mouth", "gums"} & found.keys()
