"""Checks of a template's muscles: where they lie, what they are attached to, their partners."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from solver.anatomy.muscle_weights import contains, enclosed_volume
from solver.anatomy.skin_depth import SkinDepth, boundary_edges
from solver.anatomy.template import Muscle, Template
from solver.anatomy.template_checks import distance_to, flesh_surface, in_front
from solver.anatomy.template_finding import Finding, error, warning
from solver.surface import Surface

LEAST_MM3 = 15.0
"""No muscle of the face is smaller."""
OPEN_EDGES = 12
"""Smaller gaps do not matter: the inside is found by winding numbers."""
OUT_MM = 0.5
"""Vertices further outside the flesh, or deeper in a bone, are counted."""
FEW, MOST = 0.05, 0.5
"""Parts of a muscle's vertices that are worth a look, and that make it useless."""
ORIGIN_MM, INSERTION_MM = 15.0, 20.0
"""How far the middle of an attachment may be from bone or skin: it is the middle of a broad one."""
PARTNER_MM, PARTNER_VOLUME = 8.0, 1.5
"""How far two partners' middles may be from mirror images, and the greatest ratio of volumes."""


def check_muscles(template: Template) -> Iterator[Finding]:
    """Check every muscle by itself, then each pair."""
    names = [muscle.name for muscle in template.muscles]
    if not names:
        yield error("muscles.missing", "muscles", "there is none")
    for name in sorted({name for name in names if names.count(name) > 1}):
        yield error("muscle.twice", name, "there are several of that name")
    depth = SkinDepth(flesh_surface(template))
    for muscle in template.muscles:
        yield from _check_shape(muscle)
        yield from _check_place(template, muscle, depth)
        yield from _check_attachments(template, muscle)
    yield from _check_pairs(template)


def _check_shape(muscle: Muscle) -> Iterator[Finding]:
    volume = enclosed_volume(muscle.surface)
    if volume < LEAST_MM3:
        yield error("muscle.volume", muscle.name, f"it encloses {volume:.1f} mm3, which is nothing")
    open_edges = len(boundary_edges(muscle.surface.faces)[0])
    if open_edges > OPEN_EDGES:
        yield warning("muscle.open", muscle.name, f"its surface has {open_edges} open edges")
    if not np.isclose(np.linalg.norm(muscle.fibre), 1.0, atol=1e-3):
        yield error("muscle.fibre", muscle.name, "its fibre axis is not of length 1")


def _check_place(template: Template, muscle: Muscle, depth: SkinDepth) -> Iterator[Finding]:
    points = muscle.surface.vertices
    ahead = in_front(template, points)
    if not ahead.any():
        yield error("muscle.behind", muscle.name, "all of it is behind or below the planes")
        return
    points = np.ascontiguousarray(points[ahead])
    out = -depth(points)[0]
    yield from _share(muscle, "muscle.outside", "outside the flesh", out)
    for name, bone in (("cranium", template.cranium), ("mandible", template.mandible)):
        within = contains(bone, points)
        deep = np.where(within, distance_to(bone, points), 0.0)
        yield from _share(muscle, "muscle.in_bone", f"inside the {name}", deep)


def _share(muscle: Muscle, code: str, where: str, millimetres: np.ndarray) -> Iterator[Finding]:
    share = float(np.mean(millimetres > OUT_MM))
    if share > FEW:
        kind = error if share > MOST else warning
        yield kind(
            code, muscle.name, f"{share:.0%} of it is {where}, up to {millimetres.max():.1f} mm"
        )


def _check_attachments(template: Template, muscle: Muscle) -> Iterator[Finding]:
    if muscle.ring:
        return
    bones = [
        distance_to(bone, muscle.origin[None])[0] for bone in (template.cranium, template.mandible)
    ]
    if min(bones) > ORIGIN_MM and in_front(template, muscle.origin[None]).all():
        yield warning(
            "muscle.origin", muscle.name, f"its origin is {min(bones):.0f} mm from any bone"
        )
    ends = [flesh_surface(template), template.cranium, template.mandible]
    far = min(distance_to(end, muscle.insertion[None])[0] for end in ends)
    if far > INSERTION_MM:
        yield warning(
            "muscle.insertion", muscle.name, f"its insertion is {far:.0f} mm from the skin"
        )
    if (muscle.insertion - muscle.origin) @ muscle.fibre < 0:
        yield error("muscle.fibre", muscle.name, "its fibre axis runs from insertion to origin")


def _check_pairs(template: Template) -> Iterator[Finding]:
    muscles = {muscle.name: muscle for muscle in template.muscles}
    for name, muscle in muscles.items():
        partner = _partner(name)
        if partner is None:
            continue
        if partner not in muscles:
            yield warning("muscle.pair", name, f"there is no {partner}")
        elif _is_left(name):
            yield from _check_pair(name, muscle.surface, muscles[partner].surface)


def _check_pair(name: str, left: Surface, right: Surface) -> Iterator[Finding]:
    middles = [surface.vertices.mean(axis=0) for surface in (left, right)]
    if middles[0][0] < middles[1][0]:
        yield error("muscle.side", name, "left and right are swapped: left is +x")
        return
    apart = float(np.linalg.norm(middles[0] * [-1, 1, 1] - middles[1]))
    if apart > PARTNER_MM:
        yield warning("muscle.pair", name, f"its partner is {apart:.0f} mm from its mirror image")
    ratio = enclosed_volume(left) / max(enclosed_volume(right), 1e-9)
    if not 1 / PARTNER_VOLUME < ratio < PARTNER_VOLUME:
        yield warning("muscle.pair", name, f"it has {ratio:.2f} times its partner's volume")


def _partner(name: str) -> str | None:
    """Return the name of a muscle's partner on the other side; None of one in the middle."""
    swapped = {"left": "right", "right": "left", "_l": "_r", "_r": "_l"}
    found = re.search(r"\b(left|right)\b|_[lr]$", name)
    if found is None:
        return None
    return name[: found.start()] + swapped[found[0]] + name[found.end() :]


def _is_left(name: str) -> bool:
    return name.endswith("_l") or re.search(r"\bleft\b", name) is not None
