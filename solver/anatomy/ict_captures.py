"""Registered scans of ICT-FaceKit subjects: the standard experiments' training and unseen sets.

``capture_sets.json`` names subjects by the seed of their identity and expressions by weights of
the model's expression shapes: a scan is neutral + sum(identity_i I_i) + sum(weight_e E_e).
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from solver.anatomy.capture_set import CaptureSet
from solver.anatomy.ict_facekit import FaceKit, read_facekit
from solver.errors import InputError
from solver.surface import Floats, Surface

Weights = dict[str, float]


def ict_capture_set(faces: Path, subject: str, capture_sets: Path | None = None) -> CaptureSet:
    """Return the scans (mm) of one subject of a capture-sets file.

    Parameters
    ----------
    faces
        Folder of ICT-FaceKit.
    subject
        A subject's name in the file, such as ``A``.
    capture_sets
        The file; default: ``capture_sets.json`` in ``faces``.

    Raises
    ------
    InputError
        ``captures.unreadable``, ``captures.subject`` or ``captures.expression`` (a shape that
        ICT-FaceKit does not have), or as :func:`~solver.anatomy.ict_facekit.read_facekit`.
    """
    path = capture_sets or faces / "capture_sets.json"
    sets = _read(path)
    kit = read_facekit(faces)
    neutral = ict_neutral(kit, faces, subject, capture_sets)

    def scans(expressions: dict[str, Weights]) -> dict[str, Surface]:
        return {
            name: neutral.moved(neutral.vertices + _displacement(kit, weights, path))
            for name, weights in expressions.items()
        }

    return CaptureSet(neutral, scans(sets["train"]), scans(sets["test"]))


def ict_neutral(
    kit: FaceKit, faces: Path, subject: str, capture_sets: Path | None = None
) -> Surface:
    """Return the neutral of one subject of a capture-sets file; raises as its scans' function."""
    path = capture_sets or faces / "capture_sets.json"
    subjects = _read(path)["subjects"]
    if subject not in subjects:
        raise InputError(
            "captures.subject",
            f"{path.name} has no subject {subject}, only {', '.join(subjects)}",
            file=str(path),
        )
    seed = subjects[subject]["identity_seed"]
    return kit.skin if seed is None else identity(kit, seed)


def identity(kit: FaceKit, seed: int) -> Surface:
    """Return a random person's neutral: standard normal identity coefficients by ``seed``."""
    coefficients = np.random.default_rng(seed).standard_normal(len(kit.identities))
    return kit.skin.moved(kit.skin.vertices + np.tensordot(coefficients, kit.identities, 1))


def _displacement(kit: FaceKit, weights: Weights, path: Path) -> Floats:
    total = np.zeros_like(kit.skin.vertices)
    for name, weight in weights.items():
        if name not in kit.deltas:
            raise InputError(
                "captures.expression", f"ICT-FaceKit has no expression {name}", file=str(path)
            )
        total += weight * kit.deltas[name]
    return total


def _read(path: Path) -> dict[str, Any]:
    try:
        sets: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        missing = {"subjects", "train", "test"} - sets.keys()
    except FileNotFoundError:
        raise InputError(
            "captures.unreadable",
            f"there is no {path.name} in {path.parent}: it names the subjects and expressions",
            file=str(path),
        ) from None
    except (OSError, ValueError, AttributeError) as error:
        raise InputError(
            "captures.unreadable", f"{path} is not a capture-sets file: {error}", file=str(path)
        ) from error
    if missing:
        raise InputError(
            "captures.unreadable", f"{path} lacks {', '.join(sorted(missing))}", file=str(path)
        )
    for fault in _faults(sets):
        raise InputError("captures.unreadable", f"{path.name}: {fault}", file=str(path))
    return sets


def _faults(sets: dict[str, Any]) -> Iterator[str]:
    """Yield what is not of the form that a capture-sets file has, the first thing first."""
    for key in ("subjects", "train", "test"):
        entries = sets[key]
        if not (isinstance(entries, dict) and all(isinstance(e, dict) for e in entries.values())):
            yield f"{key} is not an object of objects"
            return
    for name, subject in sets["subjects"].items():
        seed = subject.get("identity_seed", "")
        whole = isinstance(seed, int) and not isinstance(seed, bool) and seed >= 0
        if not (seed is None or whole):
            yield f"subject {name} has no identity_seed: null, or a whole number from 0"
    for name, weights in [*sets["train"].items(), *sets["test"].items()]:
        for shape, weight in weights.items():
            number = isinstance(weight, int | float) and not isinstance(weight, bool)
            if not (number and np.isfinite(weight)):
                yield f"expression {name}: the weight of {shape} is not a number but {weight!r}"
    for name in sorted(sets["train"].keys() & sets["test"].keys()):
        yield f"expression {name} is both in train and in test"
