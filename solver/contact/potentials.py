"""All that a face's flesh may touch, as potentials."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from solver.contact.barrier import Barrier
from solver.contact.mouth import LIPS, LOWER_TEETH, UPPER_TEETH, Mouth
from solver.contact.one_sided import Arch, Eyeball, OneSided, OneSidedOptions, free_depths
from solver.contact.surface import ContactSurface
from solver.mechanics.potential import Potential
from solver.model import SubjectModel
from solver.surface import Ints, Surface, vertex_areas


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

    Parameters
    ----------
    model
        The face; at its rest nothing pushes (but for lips within a tenth of a millimetre, and
        teeth that an edit has moved into them).
    stiffness_pa
        The flesh's.
    unedited
        The person before edits, the face itself by default: lips may lie as deep in teeth as
        that person's do at rest.
    lips
        Skin meets skin: lips, and lids with ``eyes``; all skin if there are ``objects``.
    teeth
        Lips meet teeth, where the model has both.
    eyes
        Lids meet eyeballs, where the model has both.
    objects
        Closed surfaces from outside, in the head's frame, where they are to begin with; that they
        do not cross the skin there is for :func:`solver.scene.objects.check_objects`.
    friction
        Coefficient between skins and with objects.

    Raises
    ------
    InputError
        ``contact.crossed`` where the neutral skin crosses itself widely.
    """
    mouth = Mouth.of(unedited or model)
    potentials: list[Potential] = []
    faces = touching(model, mouth, lips=lips, eyes=eyes, objects=bool(objects))
    if len(faces):
        surface = ContactSurface.of(model, faces, mouth)
        barrier = Barrier(surface, stiffness_pa, objects=objects, itself=lips, friction=friction)
        potentials.append(barrier)
    if teeth and mouth is not None:
        potentials += arches(model, mouth, stiffness_pa)
    if eyes:
        potentials += eyeballs(model, stiffness_pa)
    return potentials


def touching(
    model: SubjectModel, mouth: Mouth | None, *, lips: bool, eyes: bool, objects: bool
) -> Ints:
    """Return the skin's triangles (f, 3) that may touch other skin or objects."""
    faces = model.skin.faces
    on_flesh = faces[np.isin(faces, model.embedded).all(axis=1)]
    if objects:
        return on_flesh
    near = [np.empty(0, np.int64)]
    if lips and mouth is not None:
        near.append(mouth.skin[mouth.flesh].ravel())
    if lips and eyes:
        near += [ids for name, ids in model.regions.items() if name.endswith("_lid")]
    return on_flesh[np.isin(on_flesh, np.concatenate(near)).all(axis=1)]


def arches(
    model: SubjectModel, mouth: Mouth, stiffness_pa: float, options: OneSidedOptions | None = None
) -> list[OneSided]:
    """Return what keeps lips in front of upper and of lower teeth, as far as there are any.

    ``mouth`` is that of the unedited person: lips may lie in teeth that an edit has moved as deep
    as they did where these were before.
    """
    options = options or OneSidedOptions()
    before, now = mouth.points(model.rest), model.skin.vertices[mouth.skin]
    lips = np.flatnonzero(mouth.label == LIPS)
    stiffness = options.stiffness_per_mm * stiffness_pa * vertex_areas(before, mouth.flesh)[lips]
    kept = []
    for label, carried in ((UPPER_TEETH, None), (LOWER_TEETH, model.jaw)):
        faces = mouth.faces_of(label)
        if len(faces):
            free = free_depths(Arch.of(Surface(before, faces)), before[lips], -options.margin_mm)
            arch = Arch.of(Surface(now, faces))
            rows, offset = mouth.rows[lips], mouth.offset[lips]
            kept.append(OneSided(arch, rows, offset, free, stiffness, carried))
    return kept


def eyeballs(
    model: SubjectModel, stiffness_pa: float, options: OneSidedOptions | None = None
) -> list[OneSided]:
    """Return what keeps lids on their eyeballs, as far as the model names them."""
    options = options or OneSidedOptions()
    skin, faces = model.skin.vertices, model.skin.faces
    area = vertex_areas(skin, faces[np.isin(faces, model.embedded).all(axis=1)])
    kept = []
    for side in ("left", "right"):
        named = [model.regions.get(f"{side}_{lid}_lid", _NONE) for lid in ("upper", "lower")]
        lids = np.intersect1d(np.concatenate(named), model.embedded)
        ball = model.regions.get(f"{side}_eyeball", _NONE)
        if len(lids) and len(ball):
            number = np.searchsorted(model.embedded, lids)
            rows, offset = model.embedding[number], model.offset[number]
            stiffness = options.stiffness_per_mm * stiffness_pa * area[lids]
            eyeball = Eyeball.of(skin[ball])
            free = free_depths(eyeball, rows @ model.rest + offset, -options.margin_mm)
            kept.append(OneSided(eyeball, rows, offset, free, stiffness))
    return kept


_NONE: Ints = np.empty(0, dtype=np.int64)
