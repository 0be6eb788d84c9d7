"""Show 3: how far raised brows move the flesh along the skull, and with the flesh pinned to it.

``at_skull_mm``: the motion along the bone of the vertices that slide above the brows, its median,
95th percentile and maximum. ``brows_mm``: the mean motion of the brows' skin. ``lifted_mm``: how
far a sliding vertex leaves its plane at most.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import igl
import numpy as np

from benchmarks.documents import Figures
from benchmarks.physics.fitted import Fitted
from solver.anatomy.bones import bone_normals
from solver.drawing import head as drawing_head
from solver.drawing.head import THREE_QUARTER, DrawnHead, face_camera
from solver.drawing.render import DrawnBody, Lit, render_bust
from solver.drawing.sheet import HEADER, Sheet
from solver.fitting.face import Face, Pose
from solver.rig.pictures import WIDTH
from solver.surface import Floats, Surface

RAISED = ("browInnerUp", "browOuterUp")
MOST_MM = 8.0
FOOTER = 64


@dataclass(frozen=True)
class Raised:
    """A face with its brows raised: vertices x (p, 3) and the pose."""

    face: Face
    x: Floats
    pose: Pose


def raised(person: Fitted, *, pinned: bool) -> Raised:
    """Return the person with both brows raised as far as the blendshapes go."""
    face = person.face(pinned=pinned)
    pose = person.blend(*RAISED)
    return Raised(face, face.continuation(face.rest, pose).x, pose)


def run(person: Fitted) -> Figures:
    """Measure the sliding face and the pinned one."""
    return {
        "sliding": measured(raised(person, pinned=False)),
        "pinned": measured(raised(person, pinned=True)),
    }


def measured(state: Raised) -> Figures:
    """Return the figures of one face."""
    model = state.face.model
    along = along_bone(state)[model.sliding]
    brows = model.skin.vertices[model.regions["brows"]]
    above = along[model.rest[model.sliding, 1] > brows[:, 1].mean()]
    skin = state.face.whole_skin(state.x, state.pose.b) - model.skin.vertices
    return {
        "at_skull_mm": {
            "median": float(np.median(above)),
            "p95": float(np.percentile(above, 95)),
            "max": float(above.max()),
        },
        "brows_mm": float(np.linalg.norm(skin[model.regions["brows"]], axis=1).mean()),
        "lifted_mm": float(np.abs(state.face.flesh.sliding.drift(state.x)).max(initial=0.0)),
    }


def along_bone(state: Raised) -> Floats:
    """Return every vertex's motion in mm (p,), without that off the bone where it slides."""
    model = state.face.model
    motion = state.x - model.rest
    normals = bone_normals(model.bones["cranium"], model.rest[model.sliding])
    off = (motion[model.sliding] * normals).sum(axis=1, keepdims=True)
    motion[model.sliding] -= off * normals
    return np.asarray(np.linalg.norm(motion, axis=1))


def picture(path: Path, person: Fitted) -> None:
    """Draw skin motion, and motion along the skull under it, sliding beside pinned."""
    model = person.model
    head = DrawnHead(model.skin)
    cell = (WIDTH // 4, 480)
    page = Sheet(WIDTH, HEADER + cell[1] + FOOTER)
    page.heading("Brows raised", "How far the skin moves, and the flesh along the skull, in mm")
    inner = _inner_faces(person)
    for number, (name, pinned) in enumerate((("sliding", False), ("pinned", True))):
        state = raised(person, pinned=pinned)
        skin = state.face.whole_skin(state.x, state.pose.b)
        moved = np.linalg.norm(skin - model.skin.vertices, axis=1)
        shown = np.full(len(moved), np.nan)
        shown[model.face] = moved[model.face]
        skull = Lit(Surface(state.x, inner))
        colour = drawing_head.linear(drawing_head.heat(along_bone(state), MOST_MM))
        bodies = {
            f"{name}: skin": head.heat_map(head.lit(skin), shown, MOST_MM),
            f"{name}: at the skull": DrawnBody(skull, colour, gloss=0.04),
        }
        for column, (title, body) in enumerate(bodies.items(), start=2 * number):
            camera = face_camera(model.skin.vertices, model.face, THREE_QUARTER)
            page.panel((column * cell[0], HEADER), render_bust([body], camera, cell))
            page.text((column * cell[0] + cell[0] // 2, HEADER), title, 20, anchor="ma")
    page.scale((WIDTH - cell[0] - 120, HEADER + cell[1] + 12), cell[0], MOST_MM)
    path.parent.mkdir(parents=True, exist_ok=True)
    page.save(path)


def _inner_faces(person: Fitted) -> np.ndarray:
    """Return the flesh's faces (f, 3) on bone, seen from outside."""
    model = person.model
    on_bone = np.zeros(len(model.rest), dtype=bool)
    on_bone[np.concatenate([model.cranium, model.sliding])] = True
    faces = igl.boundary_facets(model.tets)[0]
    return np.asarray(faces[on_bone[faces].all(axis=1)][:, ::-1])
