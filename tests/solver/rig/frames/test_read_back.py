"""Files that show something else than they were written from end the job, with the place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pygltflib
import pytest

from solver.errors import SolveError
from solver.rig.frames import read_back
from solver.rig.frames.animation_gltf import AnimatedSkin, write_animation_glb
from solver.rig.frames.read_back import Comparison, MorphedSkin, read_glb
from solver.surface import Floats
from tests.solver.glb import shown_skins
from tests.solver.rig.frames.test_sequence_gltf import frame
from tests.solver.rig.frames.test_skin_basis import FRAMES, NEUTRAL, drifting_skins


def animated(skins: Floats) -> AnimatedSkin:
    skin = AnimatedSkin(NEUTRAL)
    for number, each in enumerate(skins):
        skin.add(frame(number), each)
    return skin


def enlarged(path: Path, node: int = 0) -> MorphedSkin:
    """Return what a file would show if its shapes were larger by half."""
    shown = read_glb(path, node)
    return replace(shown, shapes=1.5 * shown.shapes)


def test_a_sequence_reads_back_as_another_reader_has_it(tmp_path: Path) -> None:
    skins = drifting_skins()
    path = tmp_path / "sequence.glb"
    found = animated(skins).write(path, 25.0)
    off = np.linalg.norm(shown_skins(path, NEUTRAL.vertices) - skins, axis=2)
    place = int(found["frame"]), int(found["vertex"])
    assert found["max_mm"] == pytest.approx(off.max(), abs=1e-3)
    assert found["max_mm"] == pytest.approx(off[place], abs=1e-3)
    assert found["shapes"] == len(pygltflib.GLTF2().load(str(path)).meshes[0].extras["targetNames"])
    assert 0.0 < found["max_mm"] < read_back.LIMIT_MM


def test_a_shape_that_was_changed_ends_the_job(tmp_path: Path) -> None:
    """The bytes of the greatest shape, scaled in the file itself."""
    skins = drifting_skins()
    path = tmp_path / "sequence.glb"
    skin = animated(skins)
    skin.write(path, 25.0)
    document = pygltflib.GLTF2().load(str(path))
    accessor = document.accessors[document.meshes[0].primitives[0].targets[0]["POSITION"]]
    values = accessor.sparse.values if accessor.sparse else accessor
    view = document.bufferViews[values.bufferView]
    content = bytearray(document.binary_blob())
    place = slice(view.byteOffset, view.byteOffset + view.byteLength)
    content[place] = (1.5 * np.frombuffer(content[place], "<f4")).astype("<f4").tobytes()
    document.set_binary_blob(bytes(content))
    document.save(str(path))
    times = np.arange(FRAMES) / 25.0
    with pytest.raises(SolveError, match="read back") as caught:
        skin.compare(path, read_glb(path), times)
    error = caught.value
    assert error.code == "file.differs"
    assert error.context["file"] == "sequence.glb"
    shown = shown_skins(path, NEUTRAL.vertices)
    off = np.linalg.norm(shown - skins, axis=2)[error.context["frame"]]
    assert off.argmax() == error.context["vertex"]
    assert error.context["found"] == pytest.approx(off.max(), abs=1e-3)


def test_an_animation_that_stays_too_far_off_ends_the_job(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("solver.rig.frames.animation_gltf.read_glb", enlarged)
    skins = drifting_skins().astype(np.float32)[:40]
    still = np.zeros((40, 6))
    skins[:, :, 1] += np.linspace(0.0, 9.0, 40, dtype=np.float32)[:, None]
    with pytest.raises(SolveError) as caught:
        write_animation_glb(tmp_path / "animation.glb", NEUTRAL, skins, still, np.arange(40) / 25.0)
    assert caught.value.code == "file.differs"
    assert {"file", "frame", "vertex", "found", "expected"} <= set(caught.value.context)


def test_points_are_compared_whatever_they_are() -> None:
    points = np.array([[0.0, 0.0, 0.0], [1.0, np.nan, 0.0]])
    found = Comparison("view.bin")
    found.add("smile", points.astype(np.float16), points)
    assert found.figures() == {"max_mm": 0.0, "frame": "smile", "vertex": 0}
    with pytest.raises(SolveError) as caught:
        found.add("ah", points, np.zeros((2, 3)))
    assert (caught.value.context["vertex"], caught.value.context["found"]) == (1, None)
    with pytest.raises(SolveError, match="3 points, not 2"):
        found.add("ah", np.zeros((3, 3)), np.zeros((2, 3)))
