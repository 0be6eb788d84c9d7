"""A rig to look at in seconds: the three files that the page reads, of a face with expressions.

The face is the morphable head of the folder MYOFACE_DATA where that is set, else the built-in one.
Nothing is solved: fits are the scans a little smoothed, the flesh follows the skin, and the muscle
sliders push the skin beside each muscle. It shows every part of the page at true sizes, not a fit.

    python tests/browser/sample_rig.py FOLDER [--whole]
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from solver.anatomy.template import Muscle
from solver.storage import write_container
from solver.surface import Floats, Ints, Surface, adjacency, part_of, vertex_normals
from solver.templates.builtin.build import builtin_capture_set, builtin_template
from solver.templates.ict_facekit import ict_capture_set
from solver.templates.tables import CaptureSet

ICT_FACE = 9409  # ICT-FaceKit: the vertices below are face, ears and neck without eyes and mouth
CELL_MM = 8.0
FLESH_MM = 34.0
REACH_MM = 16.0
SHAPES = 32
NO_MUSCLE = 255
DIVIDED = "frontalis"  # the muscle that is in compartments
CUBE = np.array(
    [[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7], [0, 5, 1, 7]]
)


@dataclass(frozen=True)
class Sample:
    """What was written; ``skin`` (k, n, 3) is off ``neutral`` in mm, as are ``basis``' shapes."""

    neutral: Surface
    names: tuple[str, ...]
    skin: Floats
    error: Floats
    muscles: tuple[str, ...]
    stretches: Floats  # (k, m) of the fibres
    linear: Floats
    quadratic: Floats
    basis: Floats

    @property
    def presets(self) -> Floats:
        """Return the slider values (k, m) of each expression."""
        flat = self.basis.reshape(len(self.basis), -1)
        q = np.array([flat @ field.ravel() for field in self.skin])
        return np.clip(np.linalg.lstsq(self.linear, q.T, rcond=1e-3)[0].T, 0, 1)

    def preview(self, controls: Floats) -> Floats:
        """Return the displacement (n, 3) for slider values (k,)."""
        rows, columns = np.triu_indices(len(controls))
        q = self.linear @ controls + self.quadratic @ (controls[rows] * controls[columns])
        return np.einsum("r,rnd->nd", q, self.basis)

    def summary(self) -> dict[str, Any]:
        """Return what a rig's ``summary`` says that the page shows."""
        means = [float(np.nanmean(each)) for each in self.error]
        return {
            "train_mean_mm": float(np.mean(means)),
            "test_mean_mm": None,
            "inverted": 0,
            "muscles": len(self.muscles),
        }


def write_sample(folder: Path, *, whole: bool = False, subject: str = "A") -> Sample:
    """Write ``view.bin``, ``inside.bin`` and ``preview.bin``; ``whole``: with eyes and mouth."""
    folder.mkdir(parents=True, exist_ok=True)
    captures = _captures(subject)
    neutral = captures.neutral
    count = len(neutral.vertices) if whole else min(ICT_FACE, len(neutral.vertices))
    faces = neutral.faces[(neutral.faces < count).all(axis=1)]
    skin = Surface(neutral.vertices[:count], faces)
    scans = {name: s.vertices[:count] for name, s in {**captures.train, **captures.test}.items()}
    target = np.array([scan - skin.vertices for scan in scans.values()])
    fitted = _smoothed(target, skin.faces)
    error = np.linalg.norm(fitted - target, axis=2)
    error[:, skin.vertices[:, 2] < np.quantile(skin.vertices[:, 2], 0.25)] = np.nan
    anatomy = builtin_template()
    names, pulls = _pulls(skin)
    linear, quadratic, basis = _preview(pulls)
    stretches = np.random.default_rng(2).random((len(scans), len(names)))
    sample = Sample(skin, tuple(scans), fitted, error, names, stretches, linear, quadratic, basis)
    _write_view(folder / "view.bin", sample, target)
    muscles = {
        name: surface for muscle in anatomy.muscles for name, surface in _strips(muscle).items()
    }
    bones = {"cranium": anatomy.cranium, "mandible": anatomy.mandible}
    _write_inside(folder / "inside.bin", sample, muscles, bones)
    _write_preview(folder / "preview.bin", sample)
    return sample


def _captures(subject: str) -> CaptureSet:
    data = os.environ.get("MYOFACE_DATA")  # which no confined job has
    return ict_capture_set(Path(data) / "ict_facekit", subject) if data else builtin_capture_set()


def _smoothed(fields: Floats, faces: Ints, rounds: int = 12) -> Floats:
    """Return fields (k, n, 3) after some steps of averaging over neighbours."""
    edges = adjacency(faces, fields.shape[1])
    near = edges / np.maximum(edges.sum(axis=1), 1)[:, None]
    out = []
    for field in fields:
        smooth = field
        for _ in range(rounds):
            smooth = 0.5 * smooth + 0.5 * (near @ smooth)
        out.append(smooth)
    return np.array(out)


def _strips(muscle: Muscle) -> dict[str, Surface]:
    """Return the compartments of a frontalis, cut from the middle to the side; others are whole."""
    if not muscle.name.startswith(DIVIDED):
        return {muscle.name: muscle.surface}
    across = np.abs(muscle.surface.vertices[muscle.surface.faces].mean(axis=1)[:, 0])
    strips = np.array_split(np.argsort(across), len(muscle.compartment_names))
    surfaces = [part_of(muscle.surface, np.sort(faces)) for faces in strips]
    return dict(zip(muscle.compartment_names, surfaces, strict=True))


def _pulls(skin: Surface) -> tuple[tuple[str, ...], Floats]:
    """Return the muscles and how each pulls the skin (m, n, 3), mm, when fully tense."""
    names = []
    pulls = []
    for muscle in builtin_template().muscles:
        way = np.asarray(muscle.origin) - np.asarray(muscle.insertion)
        way = way / (np.linalg.norm(way) or 1.0)
        for name, surface in _strips(muscle).items():
            place = np.array(muscle.insertion)
            if name != muscle.name:
                place[0] = surface.vertices[:, 0].mean()
            off = skin.vertices - place
            names.append(name)
            pulls.append(5.0 * np.exp(-((off / REACH_MM) ** 2).sum(axis=1))[:, None] * way)
    return tuple(names), np.array(pulls)


def _preview(pulls: Floats) -> tuple[Floats, Floats, Floats]:
    """Return ``linear`` (r, k), ``quadratic`` (r, k(k+1)/2) and ``basis`` (r, n, 3)."""
    count = len(pulls)
    left, strength, shapes = np.linalg.svd(pulls.reshape(count, -1), full_matrices=False)
    linear = (left * strength).T[:SHAPES]
    random = np.random.default_rng(1)
    quadratic = random.normal(0.0, 0.2, (len(linear), count * (count + 1) // 2))
    return linear, quadratic, shapes[:SHAPES].reshape(len(linear), -1, 3)


def _write_view(path: Path, sample: Sample, target: Floats) -> None:
    figures = [
        {
            "name": name,
            "mean_mm": float(np.nanmean(error)),
            "p95_mm": float(np.nanpercentile(error, 95)),
            "max_mm": float(np.nanmax(error)),
        }
        for name, error in zip(sample.names, sample.error, strict=True)
    ]
    arrays = {
        "neutral": sample.neutral.vertices.astype(np.float32),
        "faces": sample.neutral.faces.astype(np.uint32),
        "activation": sample.stretches.astype(np.float32),
    }
    for k in range(len(figures)):
        arrays[f"skin/{k}"] = sample.skin[k].astype(np.float16)
        arrays[f"scan/{k}"] = target[k].astype(np.float16)
        arrays[f"error/{k}"] = sample.error[k].astype(np.float16)
    header = {
        "expressions": figures,
        "muscles": list(sample.muscles),
        "wholes": [name.split(".")[0] for name in sample.muscles],
        "flesh_mm3": [1.0 + number for number in range(len(sample.muscles))],
    }
    write_container(path, header, arrays)


def _write_inside(
    path: Path, sample: Sample, muscles: Mapping[str, Surface], bones: Mapping[str, Surface]
) -> None:
    rest, tets = _flesh(sample.neutral)
    tree = cKDTree(sample.neutral.vertices)
    distance, nearest = tree.query(rest, k=4)
    share = np.exp(-distance / 12.0)
    at = np.einsum("vk,evkd->evd", share / 4, sample.skin[:, nearest])
    centres = rest[tets].mean(axis=1)
    away = np.full(len(tets), 6.0)
    owner = np.full(len(tets), NO_MUSCLE, np.uint8)
    arrays: dict[str, np.ndarray] = {
        "rest": rest.astype(np.float32),
        "tets": tets.astype(np.uint32),
    }
    for k, field in enumerate(at):
        arrays[f"at/{k}"] = field.astype(np.float16)
    for number, surface in enumerate(muscles.values()):
        near = cKDTree(surface.vertices).query(centres)[0]
        owner[near < away] = number
        away = np.minimum(away, near)
        inside, weights = _bound(surface.vertices, rest, tets, centres)
        arrays |= _surface(f"muscle/{number}", surface)
        arrays[f"muscle/{number}/tet"] = inside.astype(np.uint32)
        arrays[f"muscle/{number}/weights"] = weights.astype(np.float32)
    for number, surface in enumerate(bones.values()):
        arrays |= _surface(f"bone/{number}", surface)
    arrays["main_muscle"] = owner
    arrays["jaw"] = _jaw(sample, bones["mandible"]).astype(np.float32)
    moves = {"cranium": "skull", "mandible": "jaw"}
    header = {
        "bones": [{"name": name, "moves_with": moves[name]} for name in bones],
        "muscles": list(muscles),
    }
    write_container(path, header, arrays)


def _surface(name: str, surface: Surface) -> dict[str, np.ndarray]:
    return {
        f"{name}/vertices": surface.vertices.astype(np.float32),
        f"{name}/faces": surface.faces.astype(np.uint32),
    }


def _flesh(skin: Surface) -> tuple[Floats, Ints]:
    """Return vertices and tets of a grid that lies behind the skin."""
    low = skin.vertices.min(axis=0) - CELL_MM
    shape = np.ceil((np.ptp(skin.vertices, axis=0) + 2 * CELL_MM) / CELL_MM).astype(int) + 1
    grid = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)
    points = low + grid * CELL_MM
    distance, nearest = cKDTree(skin.vertices).query(points)
    behind = ((points - skin.vertices[nearest]) * vertex_normals(skin)[nearest]).sum(axis=1) < 0
    kept = behind & (distance < FLESH_MM)
    corners = np.array([[(c >> 2) & 1, (c >> 1) & 1, c & 1] for c in range(8)])
    cells = grid[(grid < shape - 1).all(axis=1)]
    numbers = np.ravel_multi_index((cells[:, None] + corners).reshape(-1, 3).T, shape).reshape(
        -1, 8
    )
    numbers = numbers[kept[numbers].all(axis=1)]
    used, tets = np.unique(numbers[:, CUBE].reshape(-1, 4), return_inverse=True)
    return points[used], tets.reshape(-1, 4)


def _bound(points: Floats, rest: Floats, tets: Ints, centres: Floats) -> tuple[Ints, Floats]:
    """Return for each point the tet nearest by its centre, and the point's shares in it."""
    inside = cKDTree(centres).query(points)[1]
    corners = rest[tets[inside]]
    edges = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
    shares = np.linalg.solve(edges, (points - corners[:, 0])[..., None])[..., 0]
    return np.asarray(inside), np.column_stack([1 - shares.sum(axis=1), shares])


def _jaw(sample: Sample, mandible: Surface) -> Floats:
    """Return the motion (k, 4, 4) about the condyles that follows the chin's."""
    vertices = sample.neutral.vertices
    chin = cKDTree(vertices).query(mandible.vertices[np.argmax(mandible.vertices[:, 2])])[1]
    hinge = mandible.vertices[np.argmax(mandible.vertices[:, 1])] * [0, 1, 1]
    motions = []
    for field in sample.skin:
        arm = vertices[chin] - hinge
        angle = -field[chin, 1] / max(arm[2], 1.0)
        c = np.cos(angle)
        s = np.sin(angle)
        motion = np.eye(4)
        motion[1:3, 1:3] = [[c, -s], [s, c]]
        motion[:3, 3] = hinge - motion[:3, :3] @ hinge
        motions.append(motion)
    return np.array(motions)


def _write_preview(path: Path, sample: Sample) -> None:
    controls = [
        {
            **{"name": name, "muscle": name, "kind": "muscle"},
            **{"title": name.replace("_", " "), "full": 0.4},
        }
        for name in sample.muscles
    ]
    presets = [
        {"name": name, "values": values.tolist()}
        for name, values in zip(sample.names, sample.presets, strict=True)
    ]
    header = {
        "controls": controls,
        "presets": presets,
        "error_mm": {"mean": 0.12, "p95": 0.4, "max": 0.9, "poses": 24,
                     "per_control": [0.1] * len(controls)},
    }  # fmt: skip
    arrays = {
        "basis": sample.basis.astype(np.float32),
        "linear": sample.linear.astype(np.float32),
        "quadratic": sample.quadratic.astype(np.float32),
    }
    write_container(path, header, arrays)


if __name__ == "__main__":
    write_sample(Path(sys.argv[1]), whole="--whole" in sys.argv)
