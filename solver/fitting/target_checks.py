"""Targets that a face cannot reach: found before the fit where possible, else by what it leaves.

The limits are the project's own. Captured expressions stay well within them; what they are for are
mistakes (a scan that was turned, named twice or replaced) and artifacts of scanners.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from solver.errors import Finding, InputError, make_warning
from solver.fitting.face import Face
from solver.meshio.registered import RegisteredScan
from solver.model import SubjectModel
from solver.similarity import robust_motion, weighted_motion
from solver.surface import Floats, Ints, directed_edges, vertex_areas, vertex_normals


@dataclass(frozen=True)
class TargetLimits:
    """Limits beyond which a target, or the error that a fit leaves, is reported."""

    same_mm: float = 0.01  # scans nearer everywhere are one; a repeated capture differs by noise
    # motion of the whole head, which stabilised scans do not have
    turned_degrees: float = 4.0
    shifted_mm: float = 5.0
    # an edge stretched by this ratio and by more than this length is a registration error
    stretch_ratio: float = 3.0
    stretch_mm: float = 5.0
    coverage: float = 0.4  # of the face, at least
    # distance left by a fit that is worth a look, also as a multiple of the expression's median,
    # and the diameter of a disc as large as the patch where it is
    residual_mm: float = 2.0
    residual_ratio: float = 5.0
    patch_mm: float = 5.0
    patches: int = 3  # that are named, at most
    # what stands up from muscles: a patch that is left outside of the fit by this, along its
    # normals by so much of all that is left, where so much of the scan's own motion is outward, too
    inflated_mm: float = 1.0
    outward: float = 0.8
    outward_motion: float = 0.64
    still_mm: float = 2.0  # skin farther from the head's motion moves by itself ...
    rounds: int = 10  # ... and loses its say in so many rounds


def before_fit(
    model: SubjectModel,
    scans: Mapping[str, RegisteredScan],
    limits: TargetLimits = TargetLimits(),
    is_head_placed: bool = False,
) -> list[Finding]:
    """Return what is odd about scans by name, each a registered scan of ``model``'s topology.

    A head may lie anywhere if the fit places it.
    """
    found = [*_find_repeated(model, scans, limits), *_find_same_name(model, scans, limits)]
    head = () if is_head_placed else (_check_head,)
    for name, scan in scans.items():
        for check in (_check_coverage, _check_mouth, *head, _check_edges):
            found += check(model, name, scan, limits)
    return found


def check_replaced(
    model: SubjectModel,
    name: str,
    before: Floats,
    scan: RegisteredScan,
    limits: TargetLimits = TargetLimits(),
) -> list[Finding]:
    """Return whether ``scan`` is another one than ``before`` (V, 3), whose name it takes."""
    vertex, away = _farthest(scan.vertices, before, _seen(model, scan))
    if away <= limits.residual_mm:
        return []
    message = (
        f"{name} takes the place of the rig's expression of that name, whose scan lies "
        f"{away:.1f} mm away at vertex {vertex} ({_where(model, vertex)})"
    )
    return [_notice("target.replaced", message, name, model, vertex, away)]


def after_fit(
    model: SubjectModel, name: str, error_mm: Floats, limits: TargetLimits = TargetLimits()
) -> list[Finding]:
    """Return where an expression stays away from its scan; ``error_mm`` (V,), NaN where unseen.

    One notice for each of the worst connected patches of the face whose error stands out.
    """
    error = np.zeros(len(error_mm))
    error[model.face] = np.nan_to_num(error_mm[model.face])
    seen = error_mm[model.face][np.isfinite(error_mm[model.face])]
    if not len(seen):
        return []
    high = error > max(limits.residual_mm, limits.residual_ratio * float(np.median(seen)))
    edges = _edges(model)
    patch = _parts(len(error), edges[high[edges].all(axis=1)])
    area = np.bincount(patch[high], vertex_areas(model.skin.vertices, model.skin.faces)[high])
    found = []
    for number in np.unique(patch[high]):
        size = 2.0 * float(np.sqrt(area[number] / np.pi))
        if size < limits.patch_mm:
            continue
        vertices = np.flatnonzero((patch == number) & high)
        worst = int(vertices[error[vertices].argmax()])
        message = (
            f"{name}: the fit stays up to {error[worst]:.1f} mm away from the scan around vertex "
            f"{worst} ({_where(model, worst)}), over {size:.0f} mm: an artifact of the scan, or a "
            "motion that no expression for the muscle geometry has shown"
        )
        more = {"size_mm": round(size, 1)}
        found.append(_notice("fit.unreached", message, name, model, worst, error[worst], **more))
    return sorted(found, key=lambda notice: -notice.context["mm"])[: limits.patches]


def find_inflated(
    model: SubjectModel,
    name: str,
    scan: Floats,
    skin: Floats,
    limits: TargetLimits = TargetLimits(),
) -> list[Finding]:
    """Return where a ``scan`` (V, 3) stands up from its fit ``skin`` as no muscle lifts skin.

    Muscles move skin along itself. Air in a cheek, filler and bumps move it along its normals, and
    a fit leaves a patch of the scan outside of its skin. The largest patch is named. Unseen
    vertices are NaN.
    """
    left = np.zeros_like(scan)
    motion = np.zeros_like(scan)
    left[model.face] = np.nan_to_num(scan - skin)[model.face]
    motion[model.face] = np.nan_to_num(scan - model.skin.vertices)[model.face]
    height = np.einsum("vi,vi->v", left, vertex_normals(model.skin.with_vertices(skin)))
    high = height > limits.inflated_mm
    if not high.any():
        return []
    edges = _edges(model)
    patch = _parts(len(height), edges[high[edges].all(axis=1)])
    area = np.bincount(patch[high], vertex_areas(model.skin.vertices, model.skin.faces)[high])
    vertices = np.flatnonzero((patch == area.argmax()) & high)
    size = 2.0 * float(np.sqrt(area.max() / np.pi))
    worst = int(vertices[height[vertices].argmax()])
    outward = np.einsum("vi,vi->v", motion, vertex_normals(model.skin))[vertices].sum()
    is_inflated = (
        size >= limits.patch_mm
        and height[worst] >= limits.residual_mm
        and height[vertices].sum() >= limits.outward * _lengths(left[vertices])
        and outward >= limits.outward_motion * _lengths(motion[vertices])
    )
    if not is_inflated:
        return []
    message = (
        f"{name}: the scan stands up to {height[worst]:.1f} mm out of what muscles make of "
        f"it around vertex {worst} ({_where(model, worst)}), over {size:.0f} mm: air in the cheek, "
        "filler, a swelling or a bump of the scan"
    )
    more = {"size_mm": round(size, 1)}
    return [_notice("fit.inflated", message, name, model, worst, height[worst], **more)]


def _lengths(vectors: Floats) -> float:
    """Return the sum of the lengths of ``vectors`` (n, 3)."""
    return float(np.linalg.norm(vectors, axis=1).sum())


def _find_repeated(
    model: SubjectModel, scans: Mapping[str, RegisteredScan], limits: TargetLimits
) -> Iterator[Finding]:
    """Find scans that are the neutral, or each other."""
    known = {"the neutral": model.skin.vertices}
    for name, scan in scans.items():
        yield from check_repeated(model, name, scan, known, limits)
        known[name] = scan.vertices


def check_repeated(
    model: SubjectModel,
    name: str,
    scan: RegisteredScan,
    known: Mapping[str, Floats],
    limits: TargetLimits = TargetLimits(),
) -> list[Finding]:
    """Return whether a scan is one of those ``known``, name -> vertices (V, 3), NaN in holes."""
    face = _seen(model, scan)
    for other, vertices in known.items():
        away = np.abs(scan.vertices[face] - vertices[face])
        if np.max(away, initial=0.0, where=np.isfinite(away)) <= limits.same_mm:
            message = f"{name} and {other} are the same scan: one of them was sent for another"
            return [make_warning("target.repeated", message, {"expression": name, "other": other})]
    return []


def _find_same_name(
    model: SubjectModel, scans: Mapping[str, RegisteredScan], limits: TargetLimits
) -> Iterator[Finding]:
    """Find names that differ only in case or spaces though the scans are of different faces."""
    first: dict[str, str] = {}
    for name, scan in scans.items():
        plain = "".join(letter for letter in name.casefold() if letter.isalnum())
        other = first.setdefault(plain, name)
        if other == name:
            continue
        both = np.intersect1d(_seen(model, scan), _seen(model, scans[other]))
        vertex, away = _farthest(scan.vertices, scans[other].vertices, both)
        if away > limits.residual_mm:
            message = (
                f"{name} and {other} have one name but lie {away:.1f} mm apart at vertex "
                f"{vertex} ({_where(model, vertex)}): the fit will find each its own activations"
            )
            yield _notice("target.conflict", message, name, model, vertex, away, other=other)


def _check_coverage(
    model: SubjectModel, name: str, scan: RegisteredScan, limits: TargetLimits
) -> Iterator[Finding]:
    part = len(_seen(model, scan)) / len(model.face)
    if part < limits.coverage:
        message = (
            f"{name} shows only {100 * part:.0f} % of the face; the rest of the fit is a guess"
        )
        context = {"expression": name, "found": round(part, 3)}
        yield make_warning("target.coverage", message, context)


def _check_mouth(
    model: SubjectModel, name: str, scan: RegisteredScan, _limits: TargetLimits
) -> Iterator[Finding]:
    """Find a scan with a hole where the mouth is."""
    lips = np.concatenate([model.region("upper_lip"), model.region("lower_lip")])
    if len(lips) and not np.isin(lips, _seen(model, scan)).any():
        message = f"{name} shows nothing of the lips: what the fit makes of them is a guess"
        yield make_warning("target.mouth", message, {"expression": name, "region": "lips"})


def _check_head(
    model: SubjectModel, name: str, scan: RegisteredScan, limits: TargetLimits
) -> list[Finding]:
    """Find motion of the whole head, which a fit would take for expression.

    It is the rigid motion from the neutral to the scan that most of the skin agrees on.
    """
    weights = scan.confidence.copy()
    weights[model.attached_mandible] = 0.0
    used = np.flatnonzero(weights > 0.0)
    seen = model.skin.vertices[used], scan.vertices[used], weights[used]
    motion = robust_motion(*seen, limits.still_mm, limits.rounds, weighted_motion(*seen))
    centre = model.skin.vertices.mean(0)
    shift = float(np.linalg.norm(motion(centre[None]) - centre))
    if motion.degrees <= limits.turned_degrees and shift <= limits.shifted_mm:
        return []
    message = (
        f"{name}: the whole head is turned by {motion.degrees:.0f} degrees and moved by "
        f"{shift:.0f} mm against the neutral; the fit takes that for expression: align the skulls"
    )
    context = {"expression": name, "degrees": round(motion.degrees, 1), "mm": round(shift, 1)}
    return [make_warning("target.turned", message, context)]


def _check_edges(
    model: SubjectModel, name: str, scan: RegisteredScan, limits: TargetLimits
) -> list[Finding]:
    edges = _edges(model)
    edges = edges[np.isin(edges, _seen(model, scan)).all(axis=1)]
    before, now = (
        np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
        for points in (model.skin.vertices, scan.vertices)
    )
    torn = (now > limits.stretch_ratio * before) & (now - before > limits.stretch_mm)
    if not torn.any():
        return []
    worst = int(np.argmax(np.where(torn, now - before, 0.0)))
    ends = edges[worst]
    motion = np.linalg.norm(scan.vertices[ends] - model.skin.vertices[ends], axis=1)
    vertex = int(ends[motion.argmax()])
    message = (
        f"{name}: skin at vertex {vertex} ({_where(model, vertex)}) is stretched from "
        f"{before[worst]:.1f} to {now[worst]:.1f} mm, as are {int(torn.sum())} edges; no face "
        "does that: look for a spike of the scan there"
    )
    return [_notice("target.stretched", message, name, model, vertex, now[worst])]


def _seen(model: SubjectModel, scan: RegisteredScan) -> Ints:
    return model.face[scan.confidence[model.face] > 0.0]


def _farthest(first: Floats, second: Floats, ids: Ints) -> tuple[int, float]:
    """Return where two skins (V, 3) are farthest apart among ``ids``, and how far, else 0."""
    away = np.linalg.norm(first[ids] - second[ids], axis=1)
    return (int(ids[away.argmax()]), float(away.max())) if len(ids) else (-1, 0.0)


def _edges(model: SubjectModel) -> Ints:
    return np.unique(np.sort(directed_edges(model.skin.faces), axis=1), axis=0)


def _parts(count: int, edges: Ints) -> Ints:
    """Return the number of the connected part that each of ``count`` vertices is in."""
    graph = sp.coo_array((np.ones(len(edges)), edges.T), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1])


def _where(model: SubjectModel, vertex: int) -> str:
    """Return the first region that has a vertex."""
    names = (name for name, ids in model.regions.items() if vertex in ids)
    return next(names, "face").replace("_", " ")


def _notice(
    code: str,
    message: str,
    name: str,
    model: SubjectModel,
    vertex: int,
    distance: float,
    **more: float | str,
) -> Finding:
    context = {"expression": name, "region": _where(model, vertex), "vertex": vertex}
    return make_warning(code, message, {**context, "mm": round(float(distance), 2), **more})


def check_held(face: Face) -> None:
    """Raise ``model.floating`` if a part of the flesh can move without being deformed.

    A part hangs together by its vertices; it is held if its held vertices do not lie on a line.
    """
    flesh = face.flesh
    tets = flesh.tets
    points = flesh.rest
    part = _parts(len(points), np.concatenate([tets[:, [0, k]] for k in (1, 2, 3)]))
    for number in np.unique(part[tets[:, 0]]):
        vertices = np.flatnonzero(part == number)
        held = points[vertices[flesh.free_numbers[vertices] < 0]]
        if len(held) >= 3 and np.linalg.matrix_rank(held - held[0], tol=1e-6) >= 2:
            continue
        count = int((part[tets[:, 0]] == number).sum())
        first = int(vertices[0])
        message = (
            f"{count} tetrahedra around {np.round(points[vertices].mean(axis=0), 1).tolist()} mm "
            f"are held by no bone (vertex {first} is one of theirs): build the model again"
        )
        raise InputError("model.floating", message, vertex=first, tets=count)


def idle_muscles(face: Face) -> list[Finding]:
    """Return the muscles that have no share of any tet: their activations stay at rest."""
    shares = np.asarray(face.S.sum(axis=0)).ravel()[1:]
    candidates = np.bincount(face.S.indices, minlength=face.S.shape[1])[1:]
    found = []
    for name, count, share in zip(face.model.muscle_names, candidates, shares, strict=True):
        if share <= 0.0:
            code = "muscle.no_share" if count else "muscle.no_candidates"
            lack = "share of any tetrahedron" if count else "flesh within reach"
            message = f"{name} has no {lack}: it moves nothing and stays at rest"
            found.append(make_warning(code, message, {"muscle": name}))
    return found
