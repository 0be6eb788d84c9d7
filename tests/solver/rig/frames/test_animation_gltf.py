"""An animated face reads back, from few shapes, whole numbers and few keys, as what it was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pygltflib
import pytest
import trimesh
from scipy.spatial.transform import Rotation, Slerp

from solver.rig.frames.animation_gltf import AnimationOptions, needed_keys, write_animation_glb
from solver.rig.frames.gltf import Solid
from solver.rig.frames.read_back import LIMIT_MM, validate_glb
from solver.surface import Floats, Ints, Surface, vertex_normals

BALL = trimesh.creation.icosphere(subdivisions=3, radius=90.0)
NEUTRAL = Surface(np.asarray(BALL.vertices, np.float64), np.asarray(BALL.faces, np.int64))
KEYS_MM = AnimationOptions().keys_mm
SHAPES_MM = AnimationOptions().basis.within_mm
FRAMES = 50
TIMES = np.arange(FRAMES) / 25.0
STILL = np.zeros((FRAMES, 6))
KINDS = {5120: "i1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}


def moving_skins() -> np.ndarray:
    """Return a jaw that turns and cheeks that swell, on one half of a ball."""
    jaw = NEUTRAL.vertices[:, 1] < -20.0
    skins = np.tile(NEUTRAL.vertices, (FRAMES, 1, 1))
    for number, skin in enumerate(skins):
        turn = Rotation.from_rotvec([0.3 * np.sin(0.1 * number) ** 2, 0.0, 0.0])
        skin[jaw] = turn.apply(skin[jaw])
        swell = 6.0 * np.cos(0.23 * number) * np.exp(-((skin[:, 0] - 60.0) ** 2) / 400.0)
        skin += (NEUTRAL.vertices[:, 1] < 30.0)[:, None] * swell[:, None] * NEUTRAL.vertices / 90.0
    return skins.astype(np.float32)


def test_skins_read_back(tmp_path: Path) -> None:
    skins = moving_skins()
    heads = STILL.copy()
    heads[:, 1] = 0.5 * TIMES
    heads[:, 5] = 4.0 * np.sin(4.0 * TIMES)
    written = write_animation_glb(tmp_path / "animation.glb", NEUTRAL, skins, heads, TIMES)
    shown = Shown(tmp_path / "animation.glb")
    assert len(shown.names) == written.shapes < 15
    assert validate_glb(tmp_path / "animation.glb", shown.names) == []
    assert 0.0 <= shown.weights.min() < shown.weights.max() <= 1.0  # where Blender holds them
    assert len(shown.weights) == written.keys < FRAMES
    off = []
    for time, skin, head in zip(TIMES, skins, heads, strict=True):
        away = np.linalg.norm(shown.skin(time) - skin, axis=1).max()
        assert away < SHAPES_MM + KEYS_MM + 0.05
        placed = Rotation.from_rotvec(head[:3]).apply(skin) + head[3:]
        off.append(np.linalg.norm(shown.placed(time) - placed, axis=1))
    assert np.max(off) == pytest.approx(written.max_error_mm, abs=2e-3)
    assert off[written.frame][written.vertex] == pytest.approx(np.max(off), abs=2e-3)
    assert 0.01 < np.max(off) < LIMIT_MM
    for number in (7, 33):
        expected = vertex_normals(NEUTRAL.with_vertices(skins[number].astype(np.float64)))
        at_rest = vertex_normals(NEUTRAL)
        found = at_rest + shown.change(TIMES[number], "NORMAL")
        assert turned(found, expected) < 0.5 * turned(at_rest, expected)
        placed = Rotation.from_rotvec(heads[number, :3]).apply(skins[number]) + heads[number, 3:]
        away = np.linalg.norm(shown.placed(TIMES[number]) - placed, axis=1).max()
        assert away < written.max_error_mm + 2.0 * KEYS_MM


def test_what_the_face_meets_is_where_it_was(tmp_path: Path) -> None:
    pane = trimesh.creation.box([80.0, 60.0, 2.0])
    glass = Surface(np.asarray(pane.vertices, np.float64), np.asarray(pane.faces, np.int64))
    places = np.zeros((FRAMES, 6))
    places[:, 2] = 2.5 * TIMES
    places[:, 4] = 30.0 * np.sin(3.0 * TIMES)
    places[:, 5] = 140.0
    still = np.tile([0.0, 1.2, 0.0, 0.0, 0.0, 200.0], (FRAMES, 1))
    solids = [Solid("glass", glass, places), Solid("wall", glass, still)]
    path = tmp_path / "animation.glb"
    write_animation_glb(path, NEUTRAL, moving_skins(), STILL, TIMES, solids)
    shown = Shown(path)
    assert validate_glb(path, shown.names) == []
    assert [node.name for node in shown.document.nodes] == ["face", "glass", "wall"]
    assert len(shown.tracks[1, "rotation"][0]) < FRAMES
    assert len(shown.tracks[2, "rotation"][0]) == 2
    for node, solid in enumerate(solids, start=1):
        mesh = shown.document.meshes[shown.document.nodes[node].mesh]
        corners = shown.values(mesh.primitives[0].attributes.POSITION) * 1e3
        np.testing.assert_allclose(corners, glass.vertices, atol=1e-4)
        begin = shown.document.nodes[node]
        np.testing.assert_allclose(begin.translation, 1e-3 * solid.places[0, 3:])
        for time, place in zip(TIMES, solid.places, strict=True):
            expected = Rotation.from_rotvec(place[:3]).apply(corners) + place[3:]
            away = np.linalg.norm(shown.rigid(node, time, corners) - expected, axis=1)
            assert away.max() < KEYS_MM + 1e-3


def test_what_is_still_takes_no_room(tmp_path: Path) -> None:
    skins = np.tile(NEUTRAL.vertices.astype(np.float32), (FRAMES, 1, 1))
    written = write_animation_glb(tmp_path / "animation.glb", NEUTRAL, skins, STILL, TIMES)
    assert (written.shapes, written.keys) == (1, 2)
    assert written.max_error_mm < 1e-3
    assert validate_glb(tmp_path / "animation.glb", ["start"]) == []
    skins[:, 17, 2] += np.linspace(0.0, 9.0, FRAMES, dtype=np.float32)
    written = write_animation_glb(tmp_path / "one.glb", NEUTRAL, skins, STILL, TIMES)
    assert (written.shapes, written.keys) == (2, 2)
    assert written.max_error_mm < 0.02
    room = (tmp_path / "one.glb").stat().st_size - (tmp_path / "animation.glb").stat().st_size
    assert room < 2000
    moving = skins[30:31]
    written = write_animation_glb(tmp_path / "pose.glb", NEUTRAL, moving, STILL[:1], TIMES[:1])
    assert (written.shapes, written.keys) == (1, 1)
    assert written.max_error_mm < 0.02


def test_keys_are_where_lines_bend() -> None:
    values = np.interp(np.arange(40), [0, 12, 25, 39], [0.0, 3.0, -1.0, -1.0])

    def error(first: int, last: int, frames: Ints) -> Floats:
        return np.abs(np.interp(frames, [first, last], values[[first, last]]) - values[frames])

    np.testing.assert_array_equal(needed_keys(40, error, 1e-9), [0, 12, 25, 39])
    np.testing.assert_array_equal(needed_keys(1, error, 1.0), [0])


def turned(a: Floats, b: Floats) -> float:
    """Return the mean angle between vectors (n, 3)."""
    lengths = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    return float(np.arccos(np.clip(np.sum(a * b, axis=1) / lengths, -1.0, 1.0)).mean())


class Shown:
    """A GLB as a viewer shows it."""

    def __init__(self, path: Path) -> None:
        self.document = pygltflib.GLTF2().load(str(path))
        mesh = self.document.meshes[0]
        self.names = mesh.extras["targetNames"]
        self.tracks = {}
        animation = self.document.animations[0]
        for channel in animation.channels:
            sampler = animation.samplers[channel.sampler]
            times = self.values(sampler.input)[:, 0]
            target = channel.target.node, channel.target.path
            self.tracks[target] = times, self.values(sampler.output)
        times, weights = self.tracks[0, "weights"]
        self.times, self.weights = times, weights.reshape(len(times), len(self.names))

    def change(self, time: float, what: str) -> Floats:
        weights = [np.interp(time, self.times, track) for track in self.weights.T]
        targets = self.document.meshes[0].primitives[0].targets
        return np.tensordot(weights, [self.values(target[what]) for target in targets], 1)

    def skin(self, time: float) -> Floats:
        return NEUTRAL.vertices + 1e3 * self.change(time, "POSITION")

    def placed(self, time: float) -> Floats:
        return self.rigid(0, time, self.skin(time))

    def rigid(self, node: int, time: float, points: Floats) -> Floats:
        times, turns = self.tracks[node, "rotation"]
        turn = Slerp(times, Rotation.from_quat(turns))(np.clip(time, times[0], times[-1]))
        times, shifts = self.tracks[node, "translation"]
        shift = [1e3 * np.interp(time, times, track) for track in shifts.T]
        return np.asarray(turn.apply(points) + shift)

    def values(self, number: int) -> Floats:
        accessor = self.document.accessors[number]
        kind = KINDS[accessor.componentType]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type]
        if accessor.sparse is None:
            return self.stored(accessor.bufferView, kind, width)
        values = np.zeros((accessor.count, width))
        places = accessor.sparse.indices
        rows = self.stored(places.bufferView, KINDS[places.componentType], 1)[:, 0].astype(int)
        values[rows] = self.stored(accessor.sparse.values.bufferView, kind, width)
        return values / np.iinfo(kind).max

    def stored(self, view: int, kind: str, width: int) -> Floats:
        place = self.document.bufferViews[view]
        content = self.document.binary_blob()[place.byteOffset :][: place.byteLength]
        return np.frombuffer(content, kind).reshape(-1, width).astype(float)
