"""``neck.png``: a head on its neck from the side and from the front, with bones and muscles."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from solver.drawing.head import COLOURS, SIDE, DrawnHead, linear
from solver.drawing.render import Camera, DrawnBody, Lit, Pixels, render
from solver.drawing.sheet import MARGIN, Column, SheetLayout, draw_sheet
from solver.model import SubjectModel
from solver.neck.anatomy import JOINTS, Neck, NeckMuscle, NeckPose
from solver.rig.pictures import ThreadOptions, tubes
from solver.surface import Floats, Surface, join_surfaces

# sRGB
SLACK = (0.95, 0.74, 0.68)  # of a muscle that does nothing
STRONG = (0.66, 0.05, 0.08)  # of one at its utmost


@dataclass(frozen=True)
class NeckPictureOptions:
    """Sizes of what is drawn of a neck."""

    cell: tuple[int, int] = (640, 720)  # pixels of a picture
    drum_mm: float = 13.0  # radius of a vertebra's body
    part: float = 0.7  # of the way between two joints that it fills
    hyoid_mm: float = 19.0  # in front of its joint, what is a vertebra's is the hyoid's
    opacity: float = 0.12  # of the skin
    fade: float = 1.0  # place along the neck at which the skin is whole
    radius_mm: float = 1.6  # of a muscle
    sides: int = 8  # of its tube
    steps: int = 16  # along a muscle
    most: float = 0.25  # the activation of the strongest colour
    room: float = 1.05  # of a picture, by the head on its neck


@dataclass(frozen=True)
class NeckShot:
    """A moment: its ``caption``, skin (v, 3) in the world, mm, pose and activations (m,)."""

    caption: str
    skin: Floats
    pose: NeckPose
    activations: Floats  # (0,) without muscles


def draw_neck(
    path: Path,
    model: SubjectModel,
    neck: Neck,
    shots: list[NeckShot],
    detail: str,
    places: Floats | None = None,
    options: NeckPictureOptions = NeckPictureOptions(),
) -> None:
    """Draw each of ``shots`` from the side and from the front.

    ``places`` (v,) along the neck, 0 at the rim, are where the skin fades out before it ends.
    Muscles of the hyoid are left out.
    """
    head = DrawnHead(model.skin)
    whole = np.vstack([shot.skin for shot in shots])
    low = whole.min(axis=0)
    high = whole.max(axis=0)
    width, height = options.cell
    extent = high - low
    span = options.room * float(max(extent[1], max(extent[0], extent[2]) * height / width))
    columns = []
    for shot in shots:
        inside = _inside(model, neck, shot, options)
        lit = head.lit(shot.skin)
        skin = head.body(lit, head.skin, opacity=options.opacity)
        if places is not None:
            cover = np.ones(len(lit.normals))  # of eyes and teeth, too
            cover[: len(places)] = np.clip(places / options.fade, 0.0, 1.0)
            skin = replace(skin, cover=cover)
        bodies = [inside, skin]
        images: list[Pixels] = [
            render(bodies, Camera((low + high) / 2.0, span, yaw), *options.cell)
            for yaw in (SIDE, 0.0)
        ]
        columns.append(Column(shot.caption, images))
    layout = SheetLayout(cell=options.cell, label=MARGIN, columns=4, foot=MARGIN)
    draw_sheet(path, "Neck", detail, ("", ""), columns, layout, scale_mm=None)


def _inside(
    model: SubjectModel, neck: Neck, shot: NeckShot, options: NeckPictureOptions
) -> DrawnBody:
    """Return skull, vertebrae and muscles as one body."""
    matrices = shot.pose.matrices
    bone = np.array(COLOURS["bone"])
    pieces = []
    colours = []
    for name in ("cranium", "mandible"):
        if name in model.bones:
            pieces.append(_move(model.bones[name], matrices[-1]))
            colours.append(bone)
    for number in range(JOINTS - 1):
        drum = _drum(neck.centres[number], neck.centres[number + 1], options)
        pieces.append(_move(drum, matrices[number + 1]))
        colours.append(bone)
    slack = linear(np.array(SLACK))
    strong = linear(np.array(STRONG))
    thread = ThreadOptions(radius_mm=options.radius_mm, sides=options.sides)
    for number, muscle in enumerate(neck.muscles if len(shot.activations) else ()):
        if _on_hyoid(muscle, neck, options.hyoid_mm):
            continue
        part = min(float(shot.activations[number]) / options.most, 1.0)
        pieces.append(tubes(_line(muscle, shot.pose, options.steps)[None], thread))
        colours.append((1.0 - part) * slack + part * strong)
    colour = [
        np.broadcast_to(each, piece.vertices.shape)
        for each, piece in zip(colours, pieces, strict=True)
    ]
    return DrawnBody(Lit(join_surfaces(pieces)), np.vstack(colour))


def _move(shape: Surface, matrix: Floats) -> Surface:
    return shape.with_vertices(shape.vertices @ matrix[:3, :3].T + matrix[:3, 3])


def _drum(below: Floats, above: Floats, options: NeckPictureOptions) -> Surface:
    """Return a drum between two joints, in the place of a vertebra whose shape is not known."""
    along = above - below
    length = float(np.linalg.norm(along))
    made = trimesh.creation.cylinder(options.drum_mm, options.part * length, sections=24)
    turn, _ = Rotation.align_vectors([along / length], [[0.0, 0.0, 1.0]])
    vertices = turn.apply(made.vertices) + (below + above) / 2.0
    return Surface(np.asarray(vertices), np.asarray(made.faces, np.int64))


def _on_hyoid(muscle: NeckMuscle, neck: Neck, far_mm: float) -> bool:
    """Tell whether a muscle ends on a hyoid, which files put on vertebrae and people do not have.

    It lies ``far_mm`` in front of the joint.
    """
    vertebra = (muscle.bodies > 0) & (muscle.bodies < JOINTS)
    joints = neck.centres[np.maximum(muscle.bodies - 1, 0)]
    return bool((vertebra & (muscle.points[:, 2] > joints[:, 2] + far_mm))[[0, -1]].any())


def _line(muscle: NeckMuscle, pose: NeckPose, steps: int) -> Floats:
    """Return points (steps, 3) evenly along a muscle's path."""
    points = pose.points(muscle.bodies, muscle.points)
    away = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    at = np.linspace(0.0, away[-1], steps)
    return np.stack([np.interp(at, away, column) for column in points.T], axis=1)
