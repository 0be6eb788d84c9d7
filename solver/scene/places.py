"""Places, maps painted on the skin, and objects that a scene names on and around a person.

A place is a landmark's name, the number of a skin vertex, or a point [x, y, z] in mm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import ipctk
import numpy as np
import trimesh

from solver.anatomy.template import Template
from solver.animation import Interpolation, Track, track
from solver.contact.barrier import ContactSurface, collision_mesh
from solver.contact.crossing import depth_inside
from solver.drawing.head import skin_parts
from solver.edits.changes import spots
from solver.edits.fat_compartments import Sex, fat_map, missing_landmarks
from solver.errors import InputError
from solver.kinds.scene import Ball, Box, Object, Rod
from solver.kinds.scene_edits import AssetMap, RegionMap, SkinMap
from solver.meshio.raw import read_raw
from solver.model import SubjectModel
from solver.registration.landmarks import landmark_vertices
from solver.similarity import small_motion
from solver.storage import map_array
from solver.surface import Floats, Surface, inside, join_surfaces
from solver.templates.builtin.build import NAME as BUILTIN
from solver.templates.builtin.build import builtin_template

Place = str | int | Sequence[float]


@dataclass(frozen=True)
class Places:
    """A person's places: ``landmarks`` by name are skin vertices, ``assets`` files by name."""

    model: SubjectModel
    landmarks: Mapping[str, int]
    assets: Mapping[str, Path] = field(default_factory=dict)

    @classmethod
    def of(cls, model: SubjectModel, template: Path | None, assets: Mapping[str, Path]) -> Places:
        """Return the places of a person whose model was made with ``template``.

        Without one it is the built-in template, and a person of another has no landmarks. Raises
        :class:`InputError` (``scene.template``) for a template of another topology.
        """
        if template is not None:
            anatomy = Template.load(template)
        elif model.template["name"] == BUILTIN:
            anatomy = builtin_template()
        else:
            return cls(model, {}, assets)
        if len(anatomy.skin.vertices) != len(model.skin.vertices):
            own = model.template["name"]
            reason = f"the model was made with the template {own}, not with {anatomy.name}"
            raise InputError("scene.template", reason, expected=own, found=anatomy.name)
        return cls(model, landmark_vertices(anatomy), assets)

    def vertex(self, place: Place) -> int:
        """Return the skin vertex at or nearest to a place.

        Raises :class:`InputError`: ``scene.landmark`` or ``scene.vertex`` for one that is not.
        """
        count = len(self.model.skin.vertices)
        if isinstance(place, str):
            reason = f"there is no landmark {place!r}; there are"
            none = "none without the template of the model"
            _check_name(place, sorted(self.landmarks), "scene.landmark", reason, none)
            return self.landmarks[place]
        if isinstance(place, int):
            if not 0 <= place < count:
                reason = f"the skin has the vertices 0 to {count - 1}, not {place}"
                raise InputError("scene.vertex", reason, found=place, expected=count)
            return place
        away = np.linalg.norm(self.model.skin.vertices - np.array(place, np.float64), axis=1)
        return int(np.argmin(away))

    def point(self, place: Place) -> Floats:
        """Return the point (3,) of a place, at rest; raises as :meth:`vertex`."""
        if isinstance(place, str | int):
            return np.asarray(self.model.skin.vertices[self.vertex(place)])
        return np.array(place, np.float64)

    def asset(self, name: str) -> Path:
        """Return the file of an asset; raises ``scene.asset`` if the job was given none."""
        reason = f"the job was given no asset {name!r}; it was given"
        _check_name(name, sorted(self.assets), "scene.asset", reason)
        return self.assets[name]

    def map_of(self, given: SkinMap | None) -> Floats | None:
        """Return a map (V,) on the skin: of an asset, of ``regions``, or of ``spots``.

        None stays None. Raises ``scene.region``, ``scene.map`` and as :meth:`vertex`.
        """
        if given is None:
            return None
        if isinstance(given, AssetMap):
            return self._file(self.asset(given.asset))
        if isinstance(given, RegionMap):
            return self._regions(given.regions)
        centres = np.array([self.point(place) for place in given.spots])
        return spots(self.model, centres.reshape(-1, 3), given.radius_mm)

    def fat_map(self, *, gain: bool, sex: Sex | None = None) -> Floats:
        """Return the map (V,) of the fat compartments, not for :attr:`without_compartments`."""
        return fat_map(self.model, self.landmarks, gain=gain, sex=sex)

    @property
    def without_compartments(self) -> str | None:
        """Return why fat changes everywhere alike; None where it has its compartments."""
        missing = missing_landmarks(self.landmarks)
        if not missing:
            return None
        listed = "" if not self.landmarks else f", which lacks {', '.join(missing)}"
        return f"fat changes everywhere alike: compartments need landmarks of the template{listed}"

    def _file(self, path: Path) -> Floats:
        try:
            return np.array(map_array(path), dtype=np.float64)
        except (OSError, ValueError) as error:
            reason = f"{path.name} is not an NPY file of numbers: {error}"
            raise InputError("scene.map", reason, file=path.name) from error

    def _regions(self, names: Sequence[str]) -> Floats:
        regions = self.model.regions
        for name in names:
            reason = f"the subject has no region {name!r}; it has"
            _check_name(name, list(regions), "scene.region", reason)
        vertices = [np.zeros(0, np.int64), *(regions[name] for name in names)]
        numbers = np.arange(len(self.model.skin.vertices))
        return np.isin(numbers, np.concatenate(vertices)).astype(np.float64)


def _check_name(name: str, known: list[str], code: str, reason: str, none: str = "none") -> None:
    """Raise ``code`` for a name that is not ``known``; the ``reason`` ends with those that are."""
    if name not in known:
        listed = ", ".join(known) or none
        raise InputError(code, f"{reason} {listed}", found=name, expected=known)


# Objects: closed meshes from outside, and where they are at any time.

MOST_VERTICES = 20_000  # of one object: contact looks at every triangle in every step
BALL_SUBDIVISIONS = 3  # of an icosahedron, for a round enough ball


@dataclass(frozen=True)
class SceneObject:
    """An object: its ``shape`` around its own origin, mm, and its ``path``.

    The path gives a rotation vector and a shift (6,) at any time in s.
    """

    name: str
    shape: Surface
    path: Track

    def at(self, time: float) -> Surface:
        """Return it in the world at ``time`` in s."""
        return self.shape.with_vertices(small_motion(self.path(time))(self.shape.vertices))


def objects_of(
    entries: Sequence[Object], places: Places, interpolation: Interpolation = "smooth"
) -> list[SceneObject]:
    """Return the objects that a scene describes.

    Raises :class:`InputError`: ``scene.object_name`` for two of one name, ``scene.object_large``
    for one with too many vertices, and as :func:`track`, :class:`Places` and :func:`read_raw`.
    """
    names = [entry.name for entry in entries]
    for number, name in enumerate(names):
        if name in names[:number]:
            raise InputError("scene.object_name", f"two objects are named {name!r}", found=name)
    return [_object(entry, places, interpolation) for entry in entries]


def _object(entry: Object, places: Places, interpolation: Interpolation) -> SceneObject:
    name = entry.name
    mesh = entry.mesh
    origin = places.point(entry.at)
    if isinstance(mesh, Box):
        shape = _surface(trimesh.creation.box(mesh.box_mm))
    elif isinstance(mesh, Ball):
        shape = _surface(trimesh.creation.icosphere(BALL_SUBDIVISIONS, mesh.ball_mm))
    elif isinstance(mesh, Rod):
        radius, length = mesh.rod_mm
        shape = _rod(radius, length)
    else:
        shape = _read(name, places.asset(mesh.asset))
    times = [key.time for key in entry.path] or [0.0]
    motion = [[*np.radians(key.rotation_deg), *origin + key.move_mm] for key in entry.path]
    values = np.array(motion or [[0.0, 0.0, 0.0, *origin]])
    return SceneObject(name, shape, track(times, values, f"{name}'s path", interpolation))


@dataclass(frozen=True)
class RodOptions:
    """Mesh of a rod."""

    sides: int = 24
    rings: int = 60  # along it, at most


def _rod(radius: float, length: float, options: RodOptions = RodOptions()) -> Surface:
    """Return a round rod along z; ``length`` is without its round ends."""
    sides = options.sides
    half = 0.5 * length / radius  # in radii, as what is made of small triangles has holes
    angles = np.linspace(0.0, 0.5 * np.pi, sides // 4 + 1)
    cap = np.column_stack([np.sin(angles), -np.cos(angles)])
    cap[0, 0] = 0.0
    # rings as far apart as the radius, so that few triangles are needles
    between = np.linspace(-half, half, min(int(np.ceil(2.0 * half)), options.rings) + 1)[1:-1]
    side = np.column_stack([np.ones_like(between), between])
    end = np.array([0.0, half])
    profile = np.vstack([cap - end, side, cap[::-1] * np.array([1.0, -1.0]) + end])
    unit = _surface(trimesh.creation.revolve(profile, sections=sides))
    return unit.with_vertices(radius * unit.vertices)


def _read(name: str, path: Path) -> Surface:
    """Return the mesh of a file: corners at one place joined, a closed one turned outward."""
    raw = read_raw(path)
    vertices = raw.vertices * (raw.mm_per_unit or 1.0)
    whole = trimesh.Trimesh(vertices, raw.faces, process=True)
    count = len(whole.vertices)
    if count > MOST_VERTICES:
        reason = f"{name} has {count} vertices; at most {MOST_VERTICES} may meet a face"
        limits = {"found": count, "expected": MOST_VERTICES}
        raise InputError("scene.object_large", reason, file=path.name, **limits)
    if whole.is_watertight and whole.volume < 0.0:
        whole.invert()
    return _surface(whole)


def _surface(mesh: trimesh.Trimesh) -> Surface:
    return Surface(np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64))


def check_objects(model: SubjectModel, objects: Mapping[str, Surface]) -> None:
    """Refuse objects, in the head's frame where they begin, that contact cannot start with.

    Raises :class:`InputError`: ``scene.object_open`` where one is not closed and turned outward,
    ``scene.object_inside`` where one begins inside the face, crosses its skin or is wholly in the
    head, from where it would come out through the skin; and as :meth:`ContactSurface.of`.
    """
    for name, each in objects.items():
        # closed: every edge has two triangles, one to either side, that look outward
        if not trimesh.Trimesh(each.vertices, each.faces, process=False).is_volume:
            reason = f"{name} is not a closed surface whose triangles look outward"
            raise InputError("scene.object_open", reason, object=name)
    if not objects:
        return
    skin = ContactSurface.of(model, model.flesh_faces)
    face = Surface(skin.rest, skin.faces)
    head = Surface(model.skin.vertices, model.skin.faces[skin_parts(model.skin)["skin"]])
    for name, each in objects.items():
        depth = max(depth_inside(each.vertices, face), depth_inside(face.vertices, each))
        if inside(head, each.vertices).all():
            depth = depth_inside(each.vertices, head)
        both = collision_mesh(join_surfaces([face, each]))
        # parts of an object may cross each other, and so may the skin
        sides = np.repeat([0, 1], [len(face.vertices), len(each.vertices)])
        both.can_collide = ipctk.make_vertex_patches_filter(sides.astype(np.int32))
        if depth > 0.0 or ipctk.has_intersections(both, both.rest_positions):
            reason = f"{name} begins in the face, {depth:.1f} mm deep: let it come from outside"
            raise InputError("scene.object_inside", reason, object=name, depth_mm=round(depth, 2))
