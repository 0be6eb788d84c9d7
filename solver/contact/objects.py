"""Objects from outside: what they have to be before a face can meet them."""

from __future__ import annotations

from collections.abc import Mapping

import ipctk
import numpy as np

from solver.contact.penetration import depth_inside, is_inside
from solver.contact.potentials import touching
from solver.contact.surface import ContactSurface, collision_mesh
from solver.drawing.parts import skin_parts
from solver.errors import InputError
from solver.model import SubjectModel
from solver.surface import Surface
from solver.triangles import directed_edges


def check_objects(model: SubjectModel, objects: Mapping[str, Surface]) -> None:
    """Refuse objects, in the head's frame where they begin, that contact can not start with.

    Raises
    ------
    InputError
        ``scene.object_open`` where one is not closed and turned outward, ``scene.object_inside``
        where one begins inside the face, crosses its skin or is wholly in the head, from where it
        would come out through the skin; ``contact.crossed`` as
        :meth:`ContactSurface.of`.
    """
    for name, each in objects.items():
        if not _closed(each):
            raise InputError(
                "scene.object_open",
                f"{name} is not a closed surface whose triangles look outward",
                object=name,
            )
    if not objects:
        return
    skin = ContactSurface.of(model, touching(model, None, lips=False, eyes=False, objects=True))
    face = Surface(skin.rest, skin.faces)
    head = Surface(model.skin.vertices, model.skin.faces[skin_parts(model.skin)["skin"]])
    for name, each in objects.items():
        depth = max(depth_inside(each.vertices, face), depth_inside(face.vertices, each))
        if is_inside(each.vertices, head).all():
            depth = depth_inside(each.vertices, head)
        both = collision_mesh(
            np.vstack([face.vertices, each.vertices]),
            np.vstack([face.faces, each.faces + len(face.vertices)]),
        )
        # parts of an object may cross each other, and so may the skin
        sides = np.repeat([0, 1], [len(face.vertices), len(each.vertices)])
        both.can_collide = ipctk.make_vertex_patches_filter(sides.astype(np.int32))
        if depth > 0.0 or ipctk.has_intersections(both, both.rest_positions):
            raise InputError(
                "scene.object_inside",
                f"{name} begins in the face, {depth:.1f} mm deep: let it come from outside",
                object=name,
                depth_mm=round(depth, 2),
            )


def _closed(surface: Surface) -> bool:
    """Tell whether every edge has two triangles, one to either side, that look outward."""
    corners = surface.vertices[surface.faces]
    volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    edges = directed_edges(surface.faces)
    ways, there = np.unique(edges, axis=0, return_counts=True)
    back = np.unique(edges[:, ::-1], axis=0)
    return bool(volume > 0.0 and (there == 1).all() and np.array_equal(ways, back))
