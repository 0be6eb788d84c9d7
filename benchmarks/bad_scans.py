"""Bad scans made from good ones: one maker for each fault that an ingest check must name."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import igl
import numpy as np
import trimesh

from solver.anatomy.template import Template
from solver.meshio.obj import write_obj
from solver.registration.landmarks import landmark_vertices
from solver.surface import Floats, Surface


@dataclass(frozen=True)
class Subject:
    """A good head (its whole surface as scanned) in the template's topology, and the template.

    ``closed_eyes`` and ``open_mouth`` are the same person with that expression.
    """

    head: Surface
    closed_eyes: Surface
    open_mouth: Surface
    template: Template


@dataclass(frozen=True)
class BadScan:
    """A file, the code that must be among its findings, and what a check is told."""

    path: Path
    code: str
    verdict: str
    landmarks: Path | None = None


Maker = Callable[[Subject, Path], BadScan]


def _obj(folder: Path, name: str, vertices: Floats, surface: Surface) -> Path:
    path = folder / f"{name}.obj"
    write_obj(path, surface.with_vertices(vertices))
    return path


def _meshed(folder: Path, name: str, mesh: trimesh.Trimesh) -> Path:
    path = folder / name
    mesh.export(path)
    return path


def _kept(surface: Surface, kept: np.ndarray) -> Surface:
    return Surface(surface.vertices, surface.faces[kept])


def _rewritten(path: Path, change: Callable[[list[str]], list[str]]) -> Path:
    lines = path.read_text(encoding="ascii").splitlines()
    path.write_text("\n".join(change(lines)) + "\n", encoding="ascii")
    return path


def not_a_face(_: Subject, folder: Path) -> BadScan:
    """Make a lumpy ball of a head's size."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=95.0)
    points = np.asarray(ball.vertices)
    lumps = 1 + 0.06 * np.sin(points[:, [1, 2, 0]] / 23.0).sum(axis=1, keepdims=True)
    surface = Surface(points * lumps, np.asarray(ball.faces, np.int64))
    path = _obj(folder, "ball", surface.vertices, surface)
    return BadScan(path, "scan.not_a_face", "bad")


def skull(subject: Subject, folder: Path) -> BadScan:
    """Take the template's own skull."""
    bone = subject.template.cranium
    return BadScan(_obj(folder, "skull", bone.vertices, bone), "scan.not_a_face", "bad")


def half_a_face(subject: Subject, folder: Path) -> BadScan:
    """Keep only what lies left of the middle."""
    head = subject.head
    half = _kept(head, head.vertices[head.faces][:, :, 0].min(axis=1) > 2.0)
    return BadScan(_obj(folder, "half", half.vertices, half), "scan.half_face", "bad")


def two_heads(subject: Subject, folder: Path) -> BadScan:
    """Put the head in twice, the second beside it and turned a little."""
    head = subject.head
    angle = np.radians(20.0)
    turn = np.array(
        [[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]]
    )
    both = np.vstack([head.vertices, head.vertices @ turn.T + [330.0, -25.0, 40.0]])
    pair = Surface(both, np.vstack([head.faces, head.faces + len(head.vertices)]))
    return BadScan(_obj(folder, "two", both, pair), "scan.two_heads", "bad")


def scaled(factor: float) -> Maker:
    """Scale the head as in another unit."""

    def make(subject: Subject, folder: Path) -> BadScan:
        path = _obj(folder, f"scaled-{factor:g}", subject.head.vertices * factor, subject.head)
        return BadScan(path, "scan.scale", "usable")

    return make


def metres_in_mm(subject: Subject, folder: Path) -> BadScan:
    """Write a GLB, whose unit is the metre, that holds millimetres."""
    mesh = trimesh.Trimesh(subject.head.vertices, subject.head.faces, process=False)
    return BadScan(_meshed(folder, "mm.glb", mesh), "scan.scale", "usable")


def upside_down(subject: Subject, folder: Path) -> BadScan:
    """Turn the head to stand on its top."""
    vertices = subject.head.vertices * [-1.0, -1.0, 1.0]
    return BadScan(_obj(folder, "upside", vertices, subject.head), "scan.upside_down", "usable")


def mirrored(subject: Subject, folder: Path) -> BadScan:
    """Mirror, triangles as they were; inverted normals can look the same."""
    vertices = subject.head.vertices * [-1.0, 1.0, 1.0]
    return BadScan(_obj(folder, "mirrored", vertices, subject.head), "scan.mirrored", "usable")


def mirrored_with_normals(subject: Subject, folder: Path) -> BadScan:
    """Do the same with stored normals, which tell the two apart."""
    mesh = trimesh.Trimesh(subject.head.vertices, subject.head.faces, process=False)
    flip = np.array([-1.0, 1.0, 1.0])
    other = trimesh.Trimesh(
        mesh.vertices * flip, mesh.faces, vertex_normals=mesh.vertex_normals * flip, process=False
    )
    path = folder / "mirrored.ply"
    path.write_bytes(trimesh.exchange.ply.export_ply(other, vertex_normal=True))
    return BadScan(path, "scan.mirrored", "bad")


def closed_eyes(subject: Subject, folder: Path) -> BadScan:
    """Take a neutral with the eyes closed."""
    scan = subject.closed_eyes
    return BadScan(_obj(folder, "closed", scan.vertices, scan), "scan.eyes_closed", "usable")


def open_mouth(subject: Subject, folder: Path) -> BadScan:
    """Take a neutral with the mouth open."""
    scan = subject.open_mouth
    return BadScan(_obj(folder, "open", scan.vertices, scan), "scan.mouth_open", "bad")


def duplicate_vertices(subject: Subject, folder: Path) -> BadScan:
    """Give every triangle vertices of its own."""
    loose = subject.head.vertices[subject.head.faces].reshape(-1, 3)
    soup = Surface(loose, np.arange(len(loose), dtype=np.int64).reshape(-1, 3))
    return BadScan(_obj(folder, "loose", loose, soup), "scan.duplicate_vertices", "usable")


def non_manifold(subject: Subject, folder: Path) -> BadScan:
    """Put three fins on the forehead's edges."""
    head = subject.head
    start = np.argsort(-head.vertices[head.faces].mean(axis=1)[:, 2])[:3]
    tips = head.vertices[head.faces[start]].mean(axis=1) + np.array([0.0, 0.0, 4.0])
    vertices = np.vstack([head.vertices, tips])
    numbers = len(head.vertices) + np.arange(3)
    fins = np.column_stack([head.faces[start][:, :2], numbers])
    fin = Surface(vertices, np.vstack([head.faces, fins]))
    return BadScan(_obj(folder, "fins", vertices, fin), "scan.non_manifold", "usable")


def inverted_normals(subject: Subject, folder: Path) -> BadScan:
    """Let every triangle be turned round."""
    head = Surface(subject.head.vertices, subject.head.faces[:, ::-1])
    path = _obj(folder, "inverted", head.vertices, head)
    return BadScan(path, "scan.inverted_normals", "usable")


def a_million_vertices(subject: Subject, folder: Path) -> BadScan:
    """Subdivide the head until it has a million vertices."""
    vertices = subject.head.vertices
    faces = subject.head.faces
    while len(vertices) < 1_000_000:
        vertices, faces = igl.upsample(vertices, faces)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    return BadScan(_meshed(folder, "million.ply", mesh), "scan.dense", "usable")


def point_cloud(subject: Subject, folder: Path) -> BadScan:
    """Take points of the surface without normals."""
    mesh = trimesh.Trimesh(subject.head.vertices, subject.head.faces, process=False)
    points, _ = trimesh.sample.sample_surface(mesh, 60_000, seed=1)
    path = folder / "points.xyz"
    np.savetxt(path, points, fmt="%.4f")
    return BadScan(path, "scan.no_normals", "usable")


def swapped_landmarks(subject: Subject, folder: Path) -> BadScan:
    """Take good landmarks whose sides are exchanged."""
    path = _obj(folder, "marked", subject.head.vertices, subject.head)
    points = {
        name: subject.head.vertices[vertex].tolist()
        for name, vertex in landmark_vertices(subject.template).items()
    }
    other = {"_l": "_r", "_r": "_l"}
    swapped = {
        name[:-2] + other.get(name[-2:], name[-2:]): point
        for name, point in points.items()
        if name[:-2] + other.get(name[-2:], name[-2:]) in points
    }
    landmarks = folder / "landmarks.json"
    landmarks.write_text(json.dumps(swapped), encoding="utf-8")
    return BadScan(path, "landmarks.swapped", "bad", landmarks)


def truncated(suffix: str) -> Maker:
    """Cut a file of which the last third is missing."""

    def make(subject: Subject, folder: Path) -> BadScan:
        mesh = trimesh.Trimesh(subject.head.vertices, subject.head.faces, process=False)
        path = folder / f"cut{suffix}"
        if suffix == ".obj":
            write_obj(path, subject.head)
        else:
            mesh.export(path)
        content = path.read_bytes()
        path.write_bytes(content[: len(content) * 2 // 3])
        return BadScan(path, "scan.truncated", "bad")

    return make


def not_a_number(subject: Subject, folder: Path) -> BadScan:
    """Write three coordinates that are no numbers."""
    path = _obj(folder, "nan", subject.head.vertices, subject.head)

    def spoil(lines: list[str]) -> list[str]:
        for line in (50, 51, 900):
            lines[line] = "v 1.0 nan 2.0"
        return lines

    return BadScan(_rewritten(path, spoil), "scan.nan", "usable")


def empty_groups(subject: Subject, folder: Path) -> BadScan:
    """Add two groups without a triangle."""
    path = _obj(folder, "groups", subject.head.vertices, subject.head)

    def spoil(lines: list[str]) -> list[str]:
        first = next(number for number, line in enumerate(lines) if line.startswith("f "))
        return [*lines[:first], "g hair", "g skin", *lines[first:], "g hat"]

    return BadScan(_rewritten(path, spoil), "scan.empty_groups", "usable")


def zero_area_faces(subject: Subject, folder: Path) -> BadScan:
    """Add triangles of two corners only."""
    head = subject.head
    flat = head.faces[::100][:, [0, 1, 1]]
    surface = Surface(head.vertices, np.vstack([head.faces, flat]))
    path = _obj(folder, "flat", head.vertices, surface)
    return BadScan(path, "scan.zero_area_faces", "usable")


def wrong_extension(subject: Subject, folder: Path) -> BadScan:
    """Write OBJ in a file called PLY."""
    path = _obj(folder, "really", subject.head.vertices, subject.head).rename(folder / "obj.ply")
    return BadScan(path, "scan.wrong_extension", "usable")


def a_picture(_: Subject, folder: Path) -> BadScan:
    """Write a PNG in a file called OBJ."""
    path = folder / "picture.obj"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(2000))
    return BadScan(path, "scan.wrong_extension", "bad")


BAD_SCANS: dict[str, Maker] = {
    "not a face": not_a_face,
    "skull": skull,
    "half a face": half_a_face,
    "two heads": two_heads,
    "scale wrong by 10, small": scaled(0.1),
    "scale wrong by 10, large": scaled(10.0),
    "scale wrong by 1000, small": scaled(0.001),
    "scale wrong by 1000, large": scaled(1000.0),
    "scale wrong by 1000, GLB in mm": metres_in_mm,
    "upside-down": upside_down,
    "mirrored": mirrored,
    "mirrored, with normals": mirrored_with_normals,
    "closed eyes": closed_eyes,
    "open mouth": open_mouth,
    "duplicate vertices": duplicate_vertices,
    "non-manifold": non_manifold,
    "inverted normals": inverted_normals,
    "a million vertices": a_million_vertices,
    "point cloud without normals": point_cloud,
    "landmarks swapped": swapped_landmarks,
    "truncated OBJ": truncated(".obj"),
    "truncated PLY": truncated(".ply"),
    "truncated STL": truncated(".stl"),
    "truncated GLB": truncated(".glb"),
    "NaN": not_a_number,
    "empty groups": empty_groups,
    "zero-area faces": zero_area_faces,
    "wrong extension": wrong_extension,
    "a picture": a_picture,
}
"""Fault -> maker. A neutral that is missing is the service's to say."""
