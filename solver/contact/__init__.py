"""All that a face's flesh may touch: as potentials, and how deep it lies in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from solver.contact.barrier import Barrier, ContactSurface
from solver.contact.crossing import crossing_at, depth_inside
from solver.contact.mouth import LIPS, LOWER_TEETH, UPPER_TEETH, Mouth
from solver.contact.obstacles import Arch, Eyeball
from solver.contact.one_sided import ONE_SIDED, OneSided, OneSidedOptions, free_depths
from solver.mechanics.boundary import Potential, move_jaw
from solver.model import SubjectModel
from solver.surface import Floats, Ints, Surface, vertex_areas


def contact_potentials(
    model: SubjectModel,
    stiffness_pa: float,
    *,
    unedited: SubjectModel | None = None,
    lips: bool = True,
    teeth: bool = True,
    eyes: bool = True,
    objects: Sequence[Surface] = (),
    friction: float = 0.0,
) -> list[Potential]:
    """Return what keeps a face's flesh out of itself and of what is rigid.

    At the rest of the ``model`` nothing pushes (but for lips within a tenth of a millimetre, and
    teeth that an edit has moved into them). ``stiffness_pa`` is the flesh's, ``unedited`` the
    person before edits, the face itself by default: see :func:`arches`. With ``lips`` skin meets
    skin: lips, and lids with ``eyes``, or all skin if there are ``objects``. With ``teeth`` lips
    meet these, with ``eyes`` lids meet eyeballs, where the model has both. ``objects`` are closed
    surfaces from outside, in the head's frame, where they are to begin with; that they do not cross
    the skin there is for :func:`solver.scene.places.check_objects`. ``friction`` is the
    coefficient between skins and with objects.

    Raises :class:`InputError` (``contact.crossed``) where the neutral skin crosses itself widely.
    """
    mouth = Mouth.of(unedited or model)
    potentials: list[Potential] = []
    faces = touching(model, mouth, lips=lips, eyes=eyes, objects=bool(objects))
    if len(faces):
        surface = ContactSurface.of(model, faces, mouth)
        barrier = Barrier(surface, stiffness_pa, objects=objects, itself=lips, friction=friction)
        potentials.append(barrier)
    if teeth and mouth is not None:
        potentials += arches(model, mouth, stiffness_pa, unedited)
    if eyes:
        potentials += eyeballs(model, stiffness_pa)
    return potentials


def touching(
    model: SubjectModel, mouth: Mouth | None, *, lips: bool, eyes: bool, objects: bool
) -> Ints:
    """Return the skin's triangles (f, 3) that may touch other skin or objects."""
    on_flesh = model.flesh_faces
    if objects:
        return on_flesh
    near = [np.empty(0, np.int64)]
    if lips and mouth is not None:
        near.append(mouth.skin[mouth.flesh].ravel())
    if lips and eyes:
        near += [ids for name, ids in model.regions.items() if name.endswith("_lid")]
    return on_flesh[np.isin(on_flesh, np.concatenate(near)).all(axis=1)]


def arches(
    model: SubjectModel,
    mouth: Mouth,
    stiffness_pa: float,
    unedited: SubjectModel | None = None,
    options: OneSidedOptions = ONE_SIDED,
) -> list[OneSided]:
    """Return what keeps lips in front of upper and of lower teeth, as far as there are any.

    ``mouth`` is that of the ``unedited`` person (the model itself by default): lips may lie in
    teeth that an edit has moved as deep as they did where these were before.
    """
    before, now = ((each or model).skin.vertices[mouth.skin] for each in (unedited, model))
    rest = mouth.points(model.rest)
    lips = np.flatnonzero(mouth.label == LIPS)
    stiffness = options.stiffness_per_mm * stiffness_pa * vertex_areas(rest, mouth.flesh)[lips]
    rows = mouth.rows[lips]
    offset = mouth.offset[lips]
    kept = []
    for label, carried in ((UPPER_TEETH, None), (LOWER_TEETH, model.jaw)):
        faces = mouth.faces_of(label)
        if len(faces):
            arch = Arch.of(Surface(now, faces))
            # a tenth to a quarter of a second each: once where no edit has moved the teeth
            moved = not np.array_equal(before[faces], now[faces])
            own = Arch.of(Surface(before, faces)) if moved else arch
            free = free_depths(own, rest[lips], -options.margin_mm)
            kept.append(OneSided(arch, rows, offset, free, stiffness, carried))
    return kept


def eyeballs(
    model: SubjectModel, stiffness_pa: float, options: OneSidedOptions = ONE_SIDED
) -> list[OneSided]:
    """Return what keeps lids on their eyeballs, as far as the model names them."""
    skin = model.skin.vertices
    area = vertex_areas(skin, model.flesh_faces)
    kept = []
    for side in ("left", "right"):
        named = [model.region(f"{side}_{lid}_lid") for lid in ("upper", "lower")]
        lids = np.intersect1d(np.concatenate(named), model.embedded)
        ball = model.region(f"{side}_eyeball")
        if len(lids) and len(ball):
            number = np.searchsorted(model.embedded, lids)
            rows = model.embedding[number]
            offset = model.offset[number]
            stiffness = options.stiffness_per_mm * stiffness_pa * area[lids]
            eyeball = Eyeball.of(skin[ball])
            free = free_depths(eyeball, rows @ model.rest + offset, -options.margin_mm)
            kept.append(OneSided(eyeball, rows, offset, free, stiffness))
    return kept


@dataclass(frozen=True)
class Penetration:
    """Depths in mm that contact is judged by, and how many of the lips' vertices are behind teeth.

    ``lips`` is a lip's depth in the other lip, ``teeth`` a lip's in teeth, ``objects`` that of skin
    in objects or of objects in the flesh; zero where nothing crosses, or there is nothing to cross.
    """

    lips: float
    teeth: float
    objects: float
    behind_teeth: int

    @property
    def most(self) -> float:
        """Return the greatest depth."""
        return max(self.lips, self.teeth, self.objects)


class Gauge:
    """Measures the penetration of one model's flesh, frame by frame.

    ``unedited`` is the person before edits, the model itself by default: lips are behind teeth
    where they lie deeper in them, by ``behind_mm``, than that person's do at rest. Rows of teeth
    that the model's ``potentials`` have are not tabulated again.
    """

    def __init__(
        self,
        model: SubjectModel,
        unedited: SubjectModel | None = None,
        potentials: Sequence[Potential] = (),
        behind_mm: float = 0.2,
    ) -> None:
        self._behind_mm = behind_mm
        self._model = model
        self._unedited = unedited or model
        self._mouth = Mouth.of(self._unedited)
        one_sided = [each for each in potentials if isinstance(each, OneSided)]
        self._arches = [each for each in one_sided if isinstance(each.obstacle, Arch)]
        if self._mouth is not None and not self._arches:
            self._arches = arches(model, self._mouth, 1.0, unedited)
        self._faces: Ints = np.searchsorted(model.embedded, model.flesh_faces)

    def neutral(self) -> Penetration:
        """Measure the unedited person at rest: scans of closed lips cross themselves."""
        gauge = self if self._unedited is self._model else Gauge(self._unedited)
        return gauge.at(self._unedited.rest, np.zeros(5))

    def at(self, x: Floats, b: Floats, objects: Sequence[Surface] = ()) -> Penetration:
        """Measure vertices x (p, 3), the jaw at b (5,), and objects in the head's frame."""
        lips = teeth = 0.0
        if self._mouth is not None:
            found = crossing_at(self._mouth, self._mouth_points(self._mouth, x, b))
            lips = found.lips
            teeth = max(found.upper_teeth or 0.0, found.lower_teeth or 0.0)
        behind = sum(len(each.behind(x, b, self._behind_mm)) for each in self._arches)
        skin = np.asarray(self._model.embedding @ x + self._model.offset)
        own = Surface(skin, self._faces)
        pairs = [pair for each in objects for pair in ((skin, each), (each.vertices, own))]
        depth = max((depth_inside(*pair) for pair in pairs), default=0.0)
        return Penetration(lips, teeth, depth, behind)

    def _mouth_points(self, mouth: Mouth, x: Floats, b: Floats) -> Floats:
        """Return the positions (m, 3) of the mouth, teeth where edits and the jaw put them.

        An edit bends the mandible, whose vertices then say no more where its teeth are.
        """
        model = self._model
        points = model.skin.vertices[mouth.skin]
        on_flesh = np.isin(mouth.skin, model.embedded)
        on_jaw = np.isin(mouth.skin, model.attached_mandible)
        points[on_flesh] = mouth.points(x)[on_flesh]
        points[on_jaw] = move_jaw(model.jaw, points[on_jaw], b)
        return points
