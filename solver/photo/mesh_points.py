"""Find where a detector's landmarks are on a template's skin.

The head is drawn from several sides, as several people with several expressions, the detector is
run on the pictures, and what it finds is carried back to the triangles that are seen there. All of
that lies in heaps on the template's skin with parted lips, where upper and lower lip are apart: a
landmark is the middle of its largest heap, and how wide that is tells how well pictures agree.
No table of vertices is made by hand.

Templates have no colours, and lips of the skin's colour look ajar: the detector then has their
inner borders too far apart. So their outline is found first, and they are painted within it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial.distance import cdist

from solver.anatomy.embedding import barycentric
from solver.anatomy.skin_points import SkinPoints
from solver.anatomy.template import Template
from solver.drawing.head import DrawnHead, face_camera
from solver.drawing.render import Camera, Visible, look, render
from solver.errors import InputError
from solver.progress import ProgressCallback, Step, silent
from solver.registration.detector import LIP_OUTLINE, SKIN_POINTS, DetectorOptions, FaceDetector
from solver.registration.landmarks import landmark_vertices
from solver.surface import Floats, Ints, unit_rows

Expression = dict[str, float]


@dataclass(frozen=True)
class MeshPointOptions:
    """The pictures that are drawn, and what counts as agreement."""

    pixels: int = 512  # of a picture's side
    yaws_deg: tuple[float, ...] = (-24.0, -12.0, 0.0, 12.0, 24.0)
    pitches_deg: tuple[float, ...] = (-10.0, 0.0, 10.0)
    people: int = 4  # the template's own head, and random ones of its identity shapes
    identity_strength: float = 0.7  # of each shape of these, standard deviations
    # of each person, by weights of the template's expressions that it has
    expressions: tuple[Expression, ...] = (
        {},
        {"jawOpen": 0.5},
        {"mouthSmileLeft": 0.7, "mouthSmileRight": 0.7},
        {"mouthFunnel": 0.6, "browInnerUp": 0.7},
        {
            "eyeWideLeft": 0.8,
            "eyeWideRight": 0.8,
            "mouthStretchLeft": 0.6,
            "mouthStretchRight": 0.6,
        },
        {"eyeSquintLeft": 0.7, "eyeSquintRight": 0.7, "jawOpen": 0.2},
    )
    slip_px: float = 3.0  # from a landmark to the skin that is seen nearest to it
    # least cosine between skin and camera: at an outline, what is marked may lie behind it
    facing: float = 0.4
    heap_mm: float = 8.0  # radius within which places are of one heap
    least_share: float = 1 / 3  # of pictures that the largest heap has to be from
    most_spread_mm: float = 4.0  # of a landmark that is kept
    seed: int = 0  # of the random people
    # of the pictures of the template's own head by which the lips are outlined
    outline_yaws_deg: tuple[float, ...] = (-10.0, 0.0, 10.0)
    lip_depth_mm: float = 8.0  # further behind the corners of the mouth nothing is painted


MESH_POINTS = MeshPointOptions()


@dataclass(frozen=True)
class FoundPoints:
    """Points of a detector on a skin, and how they were found."""

    points: SkinPoints
    pictures: int  # that were drawn
    with_face: int  # in which the detector saw a face
    left_out: dict[str, float]  # landmark -> its spread in mm; inf where it was seen too rarely


def find_points(
    template: Template,
    model: Path,
    options: MeshPointOptions = MESH_POINTS,
    progress: ProgressCallback = silent,
) -> FoundPoints:
    """Return the points of the skin that the detector of the file ``model`` marks in pictures.

    Raises :class:`InputError`: ``landmarks.extra`` and ``landmarks.model`` as
    :class:`~solver.registration.detector.FaceDetector`, ``photo.no_face`` where it sees no face in
    most of the pictures.
    """
    with FaceDetector(model, DetectorOptions(most_faces=1)) as detector:
        drawn = DrawnHead(template.skin)
        few = replace(options, people=1, yaws_deg=options.outline_yaws_deg)
        outline = _find(template, drawn, detector, few, silent).points
        drawn.paint(_lips(template, outline, options.lip_depth_mm), "lips")
        return _find(template, drawn, detector, options, progress)


def _find(
    template: Template,
    drawn: DrawnHead,
    detector: FaceDetector,
    options: MeshPointOptions,
    progress: ProgressCallback,
) -> FoundPoints:
    """Return the points that the detector marks on a head as it is painted."""
    heads = list(_heads(template, options))
    seen = []
    pictures = 0
    for number, skin in enumerate(heads):
        progress(Step("pictures", number / len(heads)))
        lit = drawn.lit(skin)
        for camera in _cameras(template, skin, options):
            picture = render([drawn.body(lit)], camera, options.pixels, options.pixels)
            visible = look(camera, lit.surface, options.pixels, options.pixels)
            pictures += 1
            for face in detector.faces(picture):
                corners, weights = _carry_back(
                    visible, len(drawn.skin), face.points[:SKIN_POINTS], options.slip_px
                )
                normals = np.einsum("ki,kij->kj", weights, lit.normals[corners])
                weights[unit_rows(normals) @ camera.axes[2] < options.facing] = np.nan
                seen.append((corners, weights))
    if len(seen) < options.least_share * pictures:
        message = f"the detector sees a face in {len(seen)} of {pictures} pictures of the template"
        raise InputError("photo.no_face", message, found=len(seen), expected=pictures)
    corners, weights = (np.stack(each, axis=1) for each in zip(*seen, strict=True))
    return _agree(template, corners, weights, pictures, options)


def _lips(template: Template, points: SkinPoints, depth_mm: float) -> Ints:
    """Return the vertices of the flesh within the outline of the lips, as seen from the front."""
    skin = template.skin.vertices
    outline = points.select([str(row) for row in LIP_OUTLINE if str(row) in points.names]).at(skin)
    flesh = np.unique(template.flesh.faces)
    in_front = skin[flesh, 2] > outline[:, 2].min(initial=np.inf) - depth_mm
    return np.asarray(flesh[in_front & is_within(skin[flesh, :2], outline[:, :2])])


def is_within(points: Floats, polygon: Floats) -> NDArray[np.bool_]:
    """Tell which points (n, 2) lie within a polygon (k, 2): a ray to the right leaves it once."""
    start = polygon
    end = np.roll(polygon, -1, axis=0)
    x, y = points.T[:, :, None]
    crosses = (start[:, 1] > y) != (end[:, 1] > y)
    rise = np.where(crosses, end[:, 1] - start[:, 1], 1.0)
    at = start[:, 0] + (y - start[:, 1]) / rise * (end[:, 0] - start[:, 0])
    return np.asarray((crosses & (x < at)).sum(axis=1) % 2 == 1)


def _heads(template: Template, options: MeshPointOptions) -> Iterator[Floats]:
    """Yield skins (V, 3) of several people, each with every expression."""
    neutral = template.skin.vertices
    shapes = template.shapes
    if shapes is None:
        yield neutral
        return
    generator = np.random.default_rng(options.seed)
    number = {name: row for row, name in enumerate(shapes.expression_names)}
    for person in range(options.people if len(shapes.identity) else 1):
        strength = options.identity_strength if person else 0.0
        who = strength * generator.standard_normal(len(shapes.identity))
        own = neutral + np.tensordot(who, shapes.identity, 1)
        for weights in options.expressions:
            known = {number[name]: weight for name, weight in weights.items() if name in number}
            if known or not weights:
                rows = shapes.expressions[list(known)]
                yield own + np.tensordot(np.array(list(known.values())), rows, 1)


def _cameras(template: Template, skin: Floats, options: MeshPointOptions) -> Iterator[Camera]:
    for yaw in np.radians(options.yaws_deg):
        for pitch in np.radians(options.pitches_deg):
            yield replace(face_camera(skin, template.face_vertices, yaw), pitch=pitch)


def _carry_back(
    visible: Visible, skin_faces: int, places: Floats, slip_px: float
) -> tuple[Ints, Floats]:
    """Return corners (k, 3) and weights (k, 3) of the skin seen nearest to ``places`` (k, 2), px.

    The first ``skin_faces`` of what is visible are skin; weights are NaN where none is near.
    """
    skin = (visible.triangle >= 0) & (visible.triangle < skin_faces)
    distance, nearest = distance_transform_edt(~skin, return_indices=True)
    height, width = skin.shape
    column, row = places.astype(np.int64).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    pixel = row.clip(0, height - 1), column.clip(0, width - 1)
    there = tuple(nearest[:, *pixel])
    weights = visible.weights[there].astype(np.float64)
    weights[~inside | (distance[pixel] > slip_px)] = np.nan
    return visible.faces[visible.triangle[there]], weights


def _agree(
    template: Template, corners: Ints, weights: Floats, pictures: int, options: MeshPointOptions
) -> FoundPoints:
    """Return the mean points of corners and weights (k, n, 3) of n pictures with a face."""
    surface = template.parted_flesh
    places = np.einsum("kni,knij->knj", weights, surface.vertices[corners])
    heaps = [_largest_heap(each[np.isfinite(each[:, 0])], options.heap_mm) for each in places]
    share = np.array([heap.count for heap in heaps]) / pictures
    spread_mm = np.array([heap.spread for heap in heaps])
    spread_mm[share < options.least_share] = np.inf
    middles = np.array([heap.middle for heap in heaps])
    kept = np.flatnonzero(spread_mm <= options.most_spread_mm)
    face, shares, _ = barycentric(middles[kept], surface)
    points = SkinPoints(
        surface.faces[face], shares, tuple(str(row) for row in kept), spread_mm[kept]
    )
    others = np.flatnonzero(spread_mm > options.most_spread_mm)
    left_out = {str(row): float(spread_mm[row]) for row in others}
    return FoundPoints(points, pictures, weights.shape[1], left_out)


@dataclass(frozen=True)
class _Heap:
    """Places that lie together."""

    middle: Floats  # (3,)
    spread: float  # root mean square of their distances from it
    count: int


def _largest_heap(places: Floats, radius: float, rounds: int = 10) -> _Heap:
    """Return the places (n, 3) around where they are densest (mean shift with a flat kernel)."""
    if not len(places):
        return _Heap(np.zeros(3), np.inf, 0)
    neighbours = (cdist(places, places) < radius).sum(axis=1)
    middle = places[neighbours.argmax()]
    for _ in range(rounds):
        distance = np.linalg.norm(places - middle, axis=1)
        near = distance < radius
        middle = places[near].mean(axis=0)
    return _Heap(middle, float(np.sqrt((distance[near] ** 2).mean())), int(near.sum()))


NAMED_MM = 2.0  # standard deviation of a landmark that a person marks by its name


def landmark_points(template: Template) -> SkinPoints:
    """Return where landmarks of photographs are on a template's skin.

    They are its own by their names, and a detector's where the template has its points.
    """
    named = landmark_vertices(template)
    corners = np.repeat(np.array([*named.values()], np.int64)[:, None], 3, axis=1)
    weights = np.tile([1.0, 0.0, 0.0], (len(named), 1))
    own = SkinPoints(corners, weights, tuple(named), np.full(len(named), NAMED_MM))
    if template.points is None:
        return own
    found = template.points
    return SkinPoints(
        np.vstack([own.corners, found.corners]),
        np.vstack([own.weights, found.weights]),
        (*own.names, *found.names),
        np.concatenate([own.spread_mm, found.spread_mm]),
    )
