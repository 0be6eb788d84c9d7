"""A scan topology ready to be drawn: coloured parts, and eyes with an iris."""

from __future__ import annotations

import colorsys
import re
from dataclasses import dataclass, replace

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from solver.drawing.render import GAMMA, Camera, ColoursAt, DrawnBody, Lit
from solver.model import OTHER_SIDE, name_words
from solver.surface import Floats, Ints, Surface, adjacency, nearest_sphere, own_numbers

# Colours, linear RGB but for the sRGB of muscles and of the error's scale.

COLOURS = {
    "skin": (0.62, 0.43, 0.34),
    "lips": (0.45, 0.18, 0.16),
    "teeth": (0.72, 0.66, 0.54),
    "mouth": (0.45, 0.16, 0.15),
    "eyes": (0.74, 0.72, 0.69),  # the sclera
    "iris": (0.10, 0.16, 0.17),
    "pupil": (0.008, 0.008, 0.01),
    "bone": (0.72, 0.64, 0.50),
    "fat": (0.80, 0.62, 0.33),
    "unmeasured": (0.60, 0.60, 0.61),
}
IRIS_MM = 6.0  # radius; an adult iris is 11.7 mm across (Rüfer et al. 2005)
PUPIL_MM = 2.4  # radius in the light of a room

HEAT_MAX_MM = 2.0  # end of the scale where nobody says another: 1 mm is a good fit
HEAT = np.array(  # sRGB at equal steps from 0 to the scale's end, ever darker
    [
        (0.84, 0.91, 0.94),
        (0.56, 0.79, 0.87),
        (0.97, 0.89, 0.58),
        (0.98, 0.66, 0.32),
        (0.88, 0.33, 0.20),
        (0.55, 0.05, 0.18),
    ]
)


def heat(error_mm: Floats, most_mm: float = HEAT_MAX_MM) -> Floats:
    """Return the sRGB colour (n, 3) of distances (n,) in mm, the last from ``most_mm`` on."""
    place = np.clip(error_mm / most_mm, 0, 1)
    steps = np.linspace(0, 1, len(HEAT))
    return np.column_stack([np.interp(place, steps, HEAT[:, k]) for k in range(3)])


def linear(srgb: Floats) -> Floats:
    """Return linear colours of sRGB colours."""
    return np.asarray(srgb, np.float64) ** GAMMA


_SIDES = {"left": "left", "l": "left", "right": "right", "r": "right"}  # words of muscles' names


def both_sides(muscle: str) -> str:
    """Return a muscle's name without its side: ``left buccinator`` -> ``buccinator``."""
    return " ".join(word for word in name_words(muscle) if word.lower() not in OTHER_SIDE)


def muscle_side(muscle: str) -> str:
    """Return the side in a muscle's name, ``left`` or ``right``; "" for one in the middle."""
    words = (word.lower() for word in name_words(muscle))
    return next((_SIDES[word] for word in words if word in _SIDES), "")


def other_side(muscle: str) -> str:
    """Return the muscle's name on the other side: ``left buccinator`` -> ``right buccinator``."""
    return re.sub(r"[^\s_.]+", lambda word: OTHER_SIDE.get(word[0].lower(), word[0]), muscle)


def muscle_colours(names: tuple[str, ...]) -> dict[str, tuple[float, ...]]:
    """Return muscle without side -> sRGB colour, of hues far apart for neighbours in the list."""
    lightness = (0.40, 0.56, 0.48, 0.66)
    return {
        kind: colorsys.hls_to_rgb((0.985 + number * 0.381966) % 1.0, lightness[number % 4], 0.58)
        for number, kind in enumerate(dict.fromkeys(map(both_sides, names)))
    }


# Parts of a scan topology. A subject model does not name them, so they are told apart by shape:
# they are separate components, eyeballs are spheres, and small ones lie at an eye or are teeth.


@dataclass(frozen=True)
class PartSizes:
    """Sizes that tell the parts of a head apart."""

    eye_radius_mm: tuple[float, float] = (9.0, 18.0)
    # Of an eye: deviation from the best sphere by its radius (the cornea's bulge gives 0.04).
    roundness: float = 0.07
    near_eye: float = 2.2  # radii of an eye: lashes and tear film lie within
    tooth_mm: float = 34.0  # most of crown and root


PART_SIZES = PartSizes()


def skin_parts(skin: Surface, sizes: PartSizes = PART_SIZES) -> dict[str, Ints]:
    """Return part -> face numbers for ``skin``, ``eyes``, ``teeth``, ``mouth`` and ``lashes``.

    Every face belongs to one part; parts that are not there are left out. ``mouth`` is gums and
    tongue, ``lashes`` is everything else about the eyes.
    """
    edges = adjacency(skin.faces, len(skin.vertices))
    label = connected_components(edges, directed=False)[1]
    kinds = np.array(_kinds(skin, label, sizes))[label[skin.faces[:, 0]]]
    names = ("skin", "eyes", "teeth", "mouth", "lashes")
    faces = {name: np.flatnonzero(kinds == name) for name in names}
    return {name: numbers for name, numbers in faces.items() if len(numbers)}


def _kinds(skin: Surface, label: Ints, sizes: PartSizes) -> list[str]:
    """Return the part of every component, ``label`` (n,) giving the component of each vertex."""
    points = [skin.vertices[label == number] for number in range(label.max() + 1)]
    spheres = [_eye_sphere(component, sizes) for component in points]
    eyes = [sphere for sphere in spheres if sphere is not None]
    extents = [np.ptp(component, axis=0) for component in points]

    def kind(number: int) -> str:
        centre = points[number].mean(axis=0)
        if spheres[number] is not None:
            return "eyes"
        if any(np.linalg.norm(centre - eye) < sizes.near_eye * radius for eye, radius in eyes):
            return "lashes"
        return "teeth" if extents[number].max() < sizes.tooth_mm else "mouth"

    kinds = [kind(number) for number in range(len(points))]
    kinds[int(np.argmax([len(component) for component in points]))] = "skin"
    if "teeth" not in kinds:  # rows of teeth in one piece: wider than deep, as no tongue is
        for number, (across, _, deep) in enumerate(extents):
            if kinds[number] == "mouth" and across > deep:
                kinds[number] = "teeth"
    return kinds


def _eye_sphere(points: Floats, sizes: PartSizes) -> tuple[Floats, float] | None:
    """Return centre and radius if the points lie on most of a sphere of an eye's size."""
    if len(points) < 12:
        return None
    centre, _ = nearest_sphere(points)
    distance = np.linalg.norm(points - centre, axis=1)
    radius = float(distance.mean())
    is_round = distance.std() < sizes.roundness * radius
    is_whole = np.ptp(points, axis=0).min() > 1.6 * radius
    least, most = sizes.eye_radius_mm
    return (centre, radius) if least < radius < most and is_round and is_whole else None


# The head as it is drawn.

THREE_QUARTER = np.radians(38.0)  # of a camera, from the front
SIDE = np.radians(88.0)

EYE_SUBDIVISIONS = 2  # so that the iris has a round edge
NONE = np.zeros((0, 3), np.int64)
WORN_GLOSS = 0.03  # of a skin in a scan's colours, which have highlights in them


class DrawnHead:
    """The parts of ``neutral`` that are drawn: lashes are left out, eyeballs made finer.

    ``skin``, ``teeth``, ``mouth`` (gums and tongue) and ``eyes`` (the finer ones) are faces (f, 3).
    """

    def __init__(self, neutral: Surface) -> None:
        numbers = skin_parts(neutral)
        parts = {name: neutral.faces[faces] for name, faces in numbers.items()}
        self._skin_numbers = numbers["skin"]
        self._colour = np.tile(COLOURS["skin"], (len(neutral.vertices), 1))
        for name, faces in parts.items():
            self._colour[faces] = COLOURS.get(name, COLOURS["skin"])
        self.skin = parts["skin"]
        self.teeth = parts.get("teeth", NONE)
        self.mouth = parts.get("mouth", NONE)
        self._eye_vertices, self._eye_faces = own_numbers(parts.get("eyes", NONE))
        self.eyes = NONE
        if len(self._eye_vertices):
            fine, faces = igl.upsample(
                neutral.vertices[self._eye_vertices], self._eye_faces, EYE_SUBDIVISIONS
            )
            self.eyes = faces.astype(np.int64) + len(neutral.vertices)
            self._colour = np.vstack([self._colour, _eye_colour(fine)])

    def paint(self, vertices: Ints, part: str) -> None:
        """Give vertices of the skin the colour of a ``part`` from now on."""
        self._colour[vertices] = COLOURS[part]

    def lit(self, vertices: Floats, light: Floats | None = None) -> Lit:
        """Return the head at ``vertices`` (v, 3); ``light`` may be that of another pose."""
        if len(self.eyes):
            eyes = vertices[self._eye_vertices]
            fine, _ = igl.upsample(eyes, self._eye_faces, EYE_SUBDIVISIONS)
            vertices = np.vstack([vertices, fine])
        surface = Surface(vertices, np.vstack([self.skin, self.teeth, self.mouth, self.eyes]))
        return Lit(surface, light)

    def body(self, lit: Lit, faces: Ints | None = None, *, opacity: float = 1.0) -> DrawnBody:
        """Return the head, or some of its faces, in natural colours."""
        return DrawnBody(lit, self._colour, faces=faces, opacity=opacity)

    def wearing(self, lit: Lit, image: ColoursAt) -> DrawnBody:
        """Return the head with a skin in the colours of an ``image`` of the neutral's triangles."""

        def at(faces: Ints, shares: Floats) -> tuple[Floats, NDArray[np.bool_]]:
            on_skin = faces < len(self._skin_numbers)  # drawn before all other parts
            own = np.where(on_skin, faces, 0)
            colours, known = image(self._skin_numbers[own], shares)
            return colours, known & on_skin

        return replace(self.body(lit), image=at, gloss=WORN_GLOSS)

    def heat_map(self, lit: Lit, error_mm: Floats, most_mm: float = HEAT_MAX_MM) -> DrawnBody:
        """Return the head in the colours of a distance (v,) in mm, grey where it is NaN."""
        colour = np.tile(COLOURS["unmeasured"], (len(self._colour), 1))
        measured = np.flatnonzero(np.isfinite(error_mm))
        colour[measured] = linear(heat(error_mm[measured], most_mm))
        return DrawnBody(lit, colour, gloss=0.04)

    def compare(
        self, first: Floats, second: Floats, error_mm: Floats, most_mm: float = HEAT_MAX_MM
    ) -> list[DrawnBody]:
        """Return the head at ``first`` and at ``second`` (v, 3), and a heat map on the latter."""
        lit = self.lit(second)
        return [self.body(self.lit(first)), self.body(lit), self.heat_map(lit, error_mm, most_mm)]


def _eye_colour(points: Floats) -> Floats:
    """Return the colours (n, 3) of two eyeballs that look forward."""
    colour = np.tile(COLOURS["eyes"], (len(points), 1))
    is_left = points[:, 0] > points[:, 0].mean()
    for eye in (np.flatnonzero(is_left), np.flatnonzero(~is_left)):
        offset = points[eye] - (points[eye].min(axis=0) + points[eye].max(axis=0)) / 2
        radius = np.hypot(offset[:, 0], offset[:, 1])
        front = offset[:, 2] > 0
        colour[eye[front & (radius < IRIS_MM)]] = COLOURS["iris"]
        colour[eye[front & (radius < PUPIL_MM)]] = COLOURS["pupil"]
    return colour


def face_camera(skin: Floats, face: Ints, yaw: float) -> Camera:
    """Return a camera that shows the face with the head around it."""
    low = skin[face].min(axis=0)
    high = skin[face].max(axis=0)
    height = high[1] - low[1]
    centre = (low + high) / 2 + np.array([0.0, 0.06 * height, 0.0])
    head = skin[skin[:, 1] > low[1]]
    centre[2] = (head[:, 2].min() + head[:, 2].max()) / 2
    return Camera(centre, span=1.62 * height, yaw=yaw)
