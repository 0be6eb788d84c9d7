"""ICT-FaceKit (USC Institute for Creative Technologies, MIT): its files, and captures made of it.

``capture_sets.json`` names subjects by the seed of their identity and expressions by weights of
the model's expression shapes: a scan is neutral + sum(identity_i I_i) + sum(weight_e E_e). These
are the standard experiments' training and unseen sets; a recording gives whole performances.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from solver.anatomy.domain import split_quads
from solver.anatomy.template import ShapeBasis
from solver.anatomy.texture_coordinates import NOWHERE, TextureCoordinates
from solver.errors import InputError
from solver.model import SubjectModel
from solver.scans.live_link import ARKIT_NAMES, FaceTake, read_live_link
from solver.storage import read_arrays
from solver.surface import Floats, Ints, Surface, own_numbers
from solver.templates.tables import (
    CaptureSet,
    PublicFile,
    file_fault,
    obj_mesh,
    obj_texture,
    obj_vertices,
    public_files,
)

# The model as USC ICT publishes it: the folder ``FaceXModel`` of OBJ meshes, in cm.
#
# ``generic_neutral_mesh.obj`` is the average head; ``identity000.obj`` ... are whole heads one
# standard deviation of a component away from it, and every other OBJ is one expression at its full
# strength. A shape is the difference to the neutral.

NEUTRAL = "generic_neutral_mesh"
_IDENTITY = re.compile(r"identity\d{3}")


def public_facekit(folder: Path) -> dict[str, np.ndarray]:
    """Return the arrays of the published model under the names of ``ict_facekit.npz``, in cm.

    ``folder`` holds the OBJs at any depth, or an archive of the repository.

    Raises :class:`InputError`: ``faces.unreadable`` if there is no neutral, ``faces.topology`` if a
    shape has another number of vertices, ``download.*`` for a file that cannot be read.
    """
    files = _of_one_folder(folder)
    file = files.pop(NEUTRAL)
    neutral, quads = obj_mesh(file)
    texture = obj_texture(file)
    identities = sorted(name for name in files if _IDENTITY.fullmatch(name))
    expressions = sorted(files.keys() - set(identities))
    return {
        "V": neutral,
        "quads": quads,
        "E": _shapes([files[name] for name in expressions], neutral),
        "ex": np.array(expressions),
        "I": _shapes([files[name] for name in identities], neutral),
        **({} if texture is None else dict(zip(("T", "T_quads"), texture, strict=True))),
    }


def _of_one_folder(folder: Path) -> dict[str, PublicFile]:
    """Return name -> OBJ of those beside the neutral: the repository has other meshes elsewhere."""
    files = public_files(folder, ".obj")
    home = next((file.folder for file in files if file.name == f"{NEUTRAL}.obj"), None)
    if home is None:
        reason = f"{folder} has neither ict_facekit.npz nor ICT-FaceKit's {NEUTRAL}.obj"
        raise file_fault("faces.unreadable", reason, folder)
    return {file.name.removesuffix(".obj"): file for file in files if file.folder == home}


def _shapes(files: list[PublicFile], neutral: Floats) -> np.ndarray:
    shapes = np.empty((len(files), *neutral.shape), dtype=np.float32)
    for shape, file in zip(shapes, files, strict=True):
        vertices = obj_vertices(file)
        if len(vertices) != len(neutral):
            raise _topology_fault(file, len(vertices), "the neutral", len(neutral))
        shape[:] = vertices - neutral
    return shapes


# The head and its variation, from the published files or from one: ``ict_facekit.npz`` holds ``V``
# (26719, 3) neutral in cm, ``quads`` with -1 in the fourth column of a triangle, ``E`` and ``ex``
# expression displacements and their names, ``I`` and ``idn`` identities.

VERTEX_COUNT = 26719  # of the published topology
MM_PER_UNIT = 10.0  # published in cm

# Ranges of vertex numbers, as published with the model.
NARROW_FACE = range(0, 6706)
HEAD = range(0, 11248)
FLESH = range(0, 14062)
GUMS_AND_TONGUE = range(14062, 17039)
UPPER_TEETH = range(17039, 19247)
LOWER_TEETH = range(19247, 21451)
EYEBALLS = range(21451, 24591)

TEETH_NAMES = tuple(
    f"{side} {{jaw}} {tooth} tooth"
    for side, order in (("left", 1), ("right", -1))
    for tooth in (
        "second secondary molar",
        "first secondary molar",
        "second secondary premolar",
        "first secondary premolar",
        "secondary canine",
        "lateral secondary incisor",
        "central secondary incisor",
    )[::order]
)


@dataclass(frozen=True)
class FaceKit:
    """The head and how it varies, in mm."""

    skin: Surface  # with all vertices
    deltas: dict[str, Floats]  # (n, 3) of the expressions
    identities: Floats  # (k, n, 3) one standard deviation of each independent component
    texture: TextureCoordinates | None = None  # of the flesh, where the files have them

    def part(self, vertices: range) -> Surface:
        """Return the skin with only the faces whose vertices all lie in a range."""
        skin = self.skin
        return Surface(skin.vertices, skin.faces[faces_within(skin.faces, vertices)])


def read_facekit(folder: Path) -> FaceKit:
    """Return the neutral head, its expressions and its identities.

    ``folder`` holds ``ict_facekit.npz``, or else the model as USC ICT publishes it.

    Raises :class:`InputError`: ``faces.unreadable`` if there is neither or ``ict_facekit.npz`` is
    not such a file, ``faces.topology`` if its vertices are not those of ICT-FaceKit, or as
    :func:`public_facekit`.
    """
    path = folder / "ict_facekit.npz"
    if not path.exists():
        return _face_kit(public_facekit(folder), folder)
    try:
        return _face_kit(read_arrays(path), path)
    except InputError:
        raise
    except (LookupError, TypeError, ValueError) as error:
        reason = f"{path} is not an ICT-FaceKit file: {error}"
        raise file_fault("faces.unreadable", reason, path) from error


def _face_kit(data: dict[str, np.ndarray], path: Path) -> FaceKit:
    vertices, expressions, identities = (MM_PER_UNIT * data[key].astype(float) for key in "VEI")
    if len(vertices) != VERTEX_COUNT:
        raise _topology_fault(path, len(vertices), "ICT-FaceKit", VERTEX_COUNT)
    skin = Surface(vertices, triangulate(data["quads"].astype(np.int64)))
    names = [str(name) for name in data["ex"]]
    deltas = dict(zip(names, expressions, strict=True))
    return FaceKit(skin, deltas, identities, _texture(data, skin.faces))


def _texture(data: dict[str, np.ndarray], faces: Ints) -> TextureCoordinates | None:
    """Return the published texture coordinates of the flesh; packed anew if they fill many tiles.

    They are the arrays ``T`` (k, 2) and ``T_quads`` (f, 4), corners as those of ``quads``.
    """
    if not {"T", "T_quads"} <= data.keys() or len(data["T_quads"]) != len(data["quads"]):
        return None
    corners = np.full(faces.shape, NOWHERE)
    own = faces_within(faces, FLESH)
    corners[own] = triangulate(data["T_quads"].astype(np.int64))[own]
    used, numbers = own_numbers(corners[own])
    corners[own] = numbers
    places = data["T"][used].astype(np.float64)
    if places.min() < 0.0 or places.max() > 1.0:
        return TextureCoordinates.packed(places, corners)
    return TextureCoordinates(places.astype(np.float32), corners.astype(np.int32))


def _topology_fault(file: object, found: int, whose: str, expected: int) -> InputError:
    reason = f"{file} has {found} vertices, {whose} has {expected}"
    return file_fault("faces.topology", reason, file, expected=expected, found=found)


def triangulate(quads: Ints) -> Ints:
    """Return triangles (f, 3) of quads (k, 4) whose fourth vertex is -1 where it is a triangle."""
    whole = quads[:, 3] >= 0
    return np.vstack([split_quads(quads[whole]), quads[~whole, :3]])


def faces_within(faces: Ints, vertices: range) -> Ints:
    """Return the numbers of the faces whose vertices all lie in a range."""
    return np.flatnonzero(np.all((faces >= vertices.start) & (faces < vertices.stop), axis=1))


def arkit_name(expression: str) -> str:
    """Return ARKit's name of an expression: ``browDown_L`` is ``browDownLeft`` there."""
    sides = {"_L": "Left", "_R": "Right"}
    return expression[:-2] + sides[expression[-2:]] if expression[-2:] in sides else expression


def shape_basis(kit: FaceKit) -> ShapeBasis:
    """Return how the head varies over persons and expressions."""
    return ShapeBasis(
        identity=kit.identities.astype(np.float32),
        expressions=np.stack(list(kit.deltas.values())).astype(np.float32),
        expression_names=tuple(arkit_name(name) for name in kit.deltas),
    )


def ict_capture_set(faces: Path, subject: str, capture_sets: Path | None = None) -> CaptureSet:
    """Return the scans (mm) of one subject of a capture-sets file.

    ``faces`` is the folder of ICT-FaceKit, ``subject`` a name in the file, such as ``A``, and
    ``capture_sets`` the file; default: ``capture_sets.json`` in ``faces``.

    Raises :class:`InputError`: ``captures.unreadable``, ``captures.subject`` or
    ``captures.expression`` (a shape that ICT-FaceKit does not have), or as :func:`read_facekit`.
    """
    path = capture_sets or faces / "capture_sets.json"
    sets = _read(path)
    kit = read_facekit(faces)
    neutral = ict_neutral(kit, faces, subject, capture_sets)

    def scan(weights: dict[str, float]) -> Surface:
        unknown = [name for name in weights if name not in kit.deltas]
        if unknown:
            reason = f"ICT-FaceKit has no expression {unknown[0]}"
            raise file_fault("captures.expression", reason, path)
        moves = (weight * kit.deltas[name] for name, weight in weights.items())
        return neutral.with_vertices(neutral.vertices + sum(moves, np.zeros_like(neutral.vertices)))

    train, test = (
        {name: scan(weights) for name, weights in sets[kind].items()} for kind in ("train", "test")
    )
    return CaptureSet(neutral, train, test)


def ict_neutral(
    kit: FaceKit, faces: Path, subject: str, capture_sets: Path | None = None
) -> Surface:
    """Return the neutral of one subject; arguments and errors as :func:`ict_capture_set`'s."""
    path = capture_sets or faces / "capture_sets.json"
    subjects = _read(path)["subjects"]
    if subject not in subjects:
        reason = f"{path.name} has no subject {subject}, only {', '.join(subjects)}"
        raise file_fault("captures.subject", reason, path)
    seed = subjects[subject]["identity_seed"]
    return kit.skin if seed is None else identity(kit, seed)


def identity(kit: FaceKit, seed: int) -> Surface:
    """Return a random person's neutral: standard normal identity coefficients by ``seed``."""
    coefficients = np.random.default_rng(seed).standard_normal(len(kit.identities))
    return kit.skin.with_vertices(kit.skin.vertices + np.tensordot(coefficients, kit.identities, 1))


def _read(path: Path) -> dict[str, Any]:
    """Return a capture-sets file; of several faults the first is told."""
    try:
        sets: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        missing = {"subjects", "train", "test"} - sets.keys()
    except FileNotFoundError:
        needed = "it names the subjects and expressions"
        raise _unreadable(path, f"there is no {path.name} in {path.parent}: {needed}") from None
    except (OSError, ValueError, AttributeError) as error:
        raise _unreadable(path, f"{path} is not a capture-sets file: {error}") from error
    if missing:
        raise _unreadable(path, f"{path} lacks {', '.join(sorted(missing))}")
    for fault in _faults(sets):
        raise _unreadable(path, f"{path.name}: {fault}")
    return sets


def _unreadable(path: Path, reason: str) -> InputError:
    return file_fault("captures.unreadable", reason, path)


def _faults(sets: dict[str, Any]) -> Iterator[str]:
    """Yield what is not of the form that a capture-sets file has, the first thing first."""
    for key in ("subjects", "train", "test"):
        entries = sets[key]
        if not (isinstance(entries, dict) and all(isinstance(e, dict) for e in entries.values())):
            yield f"{key} is not an object of objects"
            return
    for name, subject in sets["subjects"].items():
        seed = subject.get("identity_seed", "")
        if seed is not None and not (type(seed) is int and seed >= 0):
            yield f"subject {name} has no identity_seed: null, or a whole number from 0"
    for name, weights in [*sets["train"].items(), *sets["test"].items()]:
        for shape, weight in weights.items():
            if type(weight) not in (int, float) or not np.isfinite(weight):
                yield f"expression {name}: the weight of {shape} is not a number but {weight!r}"
    for name in sorted(sets["train"].keys() & sets["test"].keys()):
        yield f"expression {name} is both in train and in test"


# A recorded performance on an ICT-FaceKit subject: a real sequence of registered scans.
#
# Weights of ARKit's blend shapes (Live Link Face) drive ICT-FaceKit's expressions:
# frame = neutral + sum(weight_e E_e).


@dataclass(frozen=True)
class IctPerformance:
    """Frames (V, 3) in mm, made when they are asked for."""

    neutral: Floats  # (V, 3)
    shapes: Floats  # (e, 3 V) displacements of the expressions that are driven
    weights: Floats  # (f, e)
    times: Floats  # (f,) in s

    def __len__(self) -> int:
        return len(self.weights)

    def __iter__(self) -> Iterator[Floats]:
        return (self.frame(number) for number in range(len(self)))

    @property
    def fps(self) -> float:
        """Return the usual number of frames per second."""
        return round(1.0 / float(np.median(np.diff(self.times))), 3) if len(self) > 1 else 30.0

    def frame(self, number: int) -> Floats:
        """Return the skin (V, 3) in a frame, mm."""
        return np.asarray(self.neutral + (self.weights[number] @ self.shapes).reshape(-1, 3))


def drive(kit: FaceKit, neutral: Floats, take: FaceTake) -> IctPerformance:
    """Return the performance of a person with the skin ``neutral`` (V, 3), mm."""
    sources = {name: arkit_source(name) for name in kit.deltas}
    driven = {name: source for name, source in sources.items() if source in ARKIT_NAMES}
    columns = [ARKIT_NAMES.index(source) for source in driven.values()]
    shapes = np.stack([kit.deltas[name].ravel() for name in driven])
    return IctPerformance(neutral, shapes, take.weights[:, columns], take.times)


def model_performance(faces: Path, recording: Path, model: SubjectModel) -> IctPerformance:
    """Return a Live Link Face recording as the face's points (k, 3) of a subject's model.

    Raises as :func:`read_facekit` and :func:`read_live_link`, and ``performance.topology`` if the
    model's skin does not have ICT-FaceKit's vertices.
    """
    skin = model.skin.vertices
    if len(skin) != VERTEX_COUNT:
        counts = f"the model's skin has {len(skin)} vertices, ICT-FaceKit's {VERTEX_COUNT}"
        reason = f"{counts}: a recording can drive models of that template alone"
        raise InputError("performance.topology", reason, expected=VERTEX_COUNT, found=len(skin))
    whole = drive(read_facekit(faces), skin, read_live_link(recording))
    coordinates = (3 * model.face[:, None] + np.arange(3)).ravel()
    return replace(whole, neutral=skin[model.face], shapes=whole.shapes[:, coordinates])


def arkit_source(expression: str) -> str:
    """Return the ARKit shape that drives an expression of ICT-FaceKit or of a template.

    ICT-FaceKit splits ``browInnerUp`` and ``cheekPuff`` in two halves. It has no tongue, and ARKit
    has no ``cheekRaiser`` and no ``PupilDilate``; names that ARKit does not have drive nothing.
    """
    name = arkit_name(expression)
    return name if name in ARKIT_NAMES else name.removesuffix("Left").removesuffix("Right")
