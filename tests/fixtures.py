"""Subject models and captures for tests: a small one of our own, and real ones.

The small person lies in ``tests/fixtures`` (made by :mod:`tests.make_fixtures`) and is always
there. Real models and captures are read from the shared data folder, ``MYOFACE_DATA`` or
``../shared/data`` beside the project; a test that needs it is skipped, with the reason, where it is
missing.
"""

from __future__ import annotations

import json
import os
import sys
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp

from solver.fitting.face import Face
from solver.model import JawFrame, SubjectModel
from solver.rig import ExpressionFit, Rig
from solver.surface import Floats, Ints, Surface

MM_PER_M = 1000.0
NARROW_FACE = 6706  # ICT-FaceKit: the vertices below are the face without ears and neck
BOUNDARY_CRANIUM = 1
BOUNDARY_MANDIBLE = 2
MODEL_FILE = Path(__file__).parent / "fixtures" / "small_model.npz"
EXPRESSIONS_FILE = MODEL_FILE.with_name("small_expressions.npz")
JAX_FOLDER = Path(__file__).parents[1] / ".jax"
MEDIAPIPE_FOLDER = JAX_FOLDER.with_name(".mediapipe")
FELUPE_FILE = MODEL_FILE.with_name("felupe_bar.npz")


@cache
def small_model() -> SubjectModel:
    """Return a person with the built-in face, in about 5000 tets with a minimum angle of 14 deg.

    Its topology has eyes, teeth, tongue, ears and neck; S are the template's initial weights.
    """
    return SubjectModel.load(MODEL_FILE)


@cache
def small_capture(name: str) -> Surface:
    """Return ``neutral``, ``smile``, ``surprise`` or ``ah`` of the small person, whole topology."""
    neutral = small_model().skin
    if name == "neutral":
        return neutral
    with np.load(EXPRESSIONS_FILE) as data:
        return neutral.with_vertices(neutral.vertices + data[name].astype(np.float64))


@cache
def small_rig() -> Rig:
    """Return the small person with one fitted expression, ``ah``: the jaw alone is open."""
    model = small_model()
    face = Face(model)
    rest = face.rest_pose()
    change = np.zeros(face.layout.size)
    change[face.layout["jaw"]] = [0.1, 0.0, 0.0, 1.0, 0.0]
    pose = rest.add(change)
    skin = small_capture("ah").vertices
    none = np.zeros(len(model.skin.vertices))
    opened = ExpressionFit("ah", "train", pose.a, pose.b, skin, skin, none, 0, 1, 0.0, 0.0)
    return Rig(model, model.weights, (opened,))


def jax_module() -> Any:
    """Return JAX, which `scripts/jax` puts beside the locked packages, or skip the calling test."""
    return _module_beside(JAX_FOLDER, "jax", "JAX is not installed: scripts/jax")


def face_landmarker() -> Path:
    """Return the landmarker's file, with MediaPipe there to run it, or skip the calling test."""
    _module_beside(MEDIAPIPE_FOLDER, "mediapipe", "MediaPipe is not installed: scripts/mediapipe")
    return data_folder("face_models", "face_landmarker_v2.task")


def _module_beside(folder: Path, name: str, reason: str) -> Any:
    if folder.is_dir() and str(folder) not in sys.path:
        sys.path.append(str(folder))
    return pytest.importorskip(name, reason=reason)


def data_folder(*parts: str) -> Path:
    """Return a path inside the shared data, or skip the calling test."""
    default = Path(__file__).parents[1] / ".." / "shared" / "data"
    path = Path(os.environ.get("MYOFACE_DATA", default)).joinpath(*parts)
    if not path.exists():
        pytest.skip(f"shared data is missing: {path}")
    return path


@cache
def fixture_model(name: str) -> SubjectModel:
    """Return one of the ready models: ``neutral``, ``neutral_coarse``, ``big``, ``id1``, ``id2``.

    Tets with all four vertices fixed and tets that bridge mandible and cranium are left out, with
    the vertices only they used; ``cranium`` and ``sliding`` are disjoint.
    """
    with np.load(data_folder("subject_models", f"model_{name}.npz"), allow_pickle=False) as file:
        data = dict(file)
    all_rest = data["tet_V"] * MM_PER_M
    keep = ~(data["tet_all_fixed"] | data["tet_bridge_tmj"])
    old_tets = data["T"].astype(np.int64)
    used = np.unique(old_tets[keep])
    new_number = np.full(len(all_rest), -1)
    new_number[used] = np.arange(len(used))
    rest = all_rest[used]
    tets = _positive(rest, new_number[old_tets[keep]])

    def kept(ids: Ints) -> Ints:
        numbers = new_number[ids]
        return numbers[numbers >= 0]

    corners = new_number[old_tets[data["skin_tet"]]]
    held = (corners >= 0).all(axis=1)
    embedded = data["skin_vertex_ids"][held]
    names = tuple(str(muscle) for muscle in data["muscle_names"])
    weights = _weights(data, keep, len(names))
    skin = Surface(data["skin_rest"] * MM_PER_M, data["face_tri"].astype(np.int64))
    face = embedded[embedded < NARROW_FACE]
    return SubjectModel(
        rest=rest,
        tets=tets,
        cranium=kept(np.setdiff1d(data["fixed_cranium"], data["sliding_cranium"])),
        mandible=kept(data["fixed_mandible"]),
        cut=kept(data["fixed_cut"]),
        sliding=kept(data["sliding_cranium"]),
        muscle_names=names,
        weights=weights,
        skin=skin,
        embedded=embedded,
        embedding=_embedding(corners[held], data["skin_w"][held], len(rest)),
        offset=data["skin_offset"][held] * MM_PER_M,
        attached_mandible=np.zeros(0, np.int64),
        face=face,
        jaw=JawFrame(data["jaw_origin"] * MM_PER_M, data["jaw_axes"]),
        muscles=_muscle_blocks(rest, tets, weights, names),
        bones={
            name: compact(all_rest, data["bnd_faces"][data["bnd_label"] == label][:, ::-1])
            for name, label in (("cranium", BOUNDARY_CRANIUM), ("mandible", BOUNDARY_MANDIBLE))
        },
        regions=_thirds(skin.vertices, face),
        template={"name": f"model_{name}", "version": "0", "sha256": ""},
    )


@cache
def ict_capture(name: str) -> Surface:
    """Return ``neutral`` or an expression of subject A (ICT-FaceKit mean face), whole topology."""
    sets = json.loads(data_folder("ict_facekit", "capture_sets.json").read_text())
    with np.load(data_folder("ict_facekit", "ict_facekit.npz"), allow_pickle=False) as data:
        vertices = data["V"].astype(np.float64)
        if name != "neutral":
            shapes = [str(shape) for shape in data["ex"]]
            for shape, weight in {**sets["train"], **sets["test"]}[name].items():
                vertices += weight * data["E"][shapes.index(shape)]
        return Surface(vertices * 10.0, triangles(data["quads"].astype(np.int64)))


def triangles(quads: Ints) -> Ints:
    """Split quads (f, 4), with -1 in the last column of a triangle, into triangles."""
    return np.concatenate([quads[:, :3], quads[quads[:, 3] >= 0][:, [0, 2, 3]]])


def compact(vertices: Floats, faces: Ints) -> Surface:
    """Return the faces with only the vertices they use."""
    used, numbers = np.unique(faces, return_inverse=True)
    return Surface(vertices[used], numbers.reshape(-1, 3).astype(np.int64))


def _positive(rest: Floats, tets: Ints) -> Ints:
    edges = rest[tets[:, 1:]] - rest[tets[:, :1]]
    tets = tets.copy()
    negative = np.linalg.det(edges) < 0
    tets[negative] = tets[negative][:, [0, 2, 1, 3]]
    return tets


def _embedding(corners: Ints, barycentric: Floats, vertices: int) -> sp.csr_array:
    rows = np.repeat(np.arange(len(corners)), 4)
    return sp.csr_array(
        (barycentric.ravel(), (rows, corners.ravel())), shape=(len(corners), vertices)
    )


def _weights(data: dict[str, np.ndarray], keep: np.ndarray, muscles: int) -> sp.csr_array:
    tets = len(keep)
    rows = np.repeat(np.arange(tets), np.diff(data["cand_indptr"]))
    columns = np.concatenate([np.zeros(tets, int), data["cand_indices"] + 1])
    order = np.lexsort((columns, np.concatenate([np.arange(tets), rows])))
    values = np.concatenate([data["S0_passive"], data["S0"]])
    indptr = data["cand_indptr"] + np.arange(tets + 1)
    shape = (tets, muscles + 1)
    weights = sp.csr_array((values[order], columns[order], indptr), shape=shape)
    return weights[np.flatnonzero(keep)]


def _muscle_blocks(
    rest: Floats, tets: Ints, weights: sp.csr_array, names: tuple[str, ...]
) -> dict[str, Surface]:
    """Return the outer faces of the tets in which each muscle has the greatest share."""
    main = weights[:, 1:].tocsr().argmax(axis=1)
    active = np.asarray(weights[:, [0]].todense()).ravel() < 0.5
    blocks = {}
    for number, name in enumerate(names):
        mine = tets[active & (np.asarray(main).ravel() == number)]
        if len(mine) == 0:
            continue
        faces = mine[:, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]].reshape(-1, 3)
        _, first, count = np.unique(
            np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
        )
        blocks[name] = compact(rest, faces[first[count == 1]])
    return blocks


def _thirds(skin: Floats, face: Ints) -> dict[str, Ints]:
    height = skin[face, 1]
    low, high = np.quantile(height, [1 / 3, 2 / 3])
    return {
        "lower face": face[height < low],
        "mid face": face[(height >= low) & (height < high)],
        "upper face": face[height >= high],
    }
