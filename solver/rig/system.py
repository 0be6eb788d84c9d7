"""The systems of a rig beside its muscles: the same scans, fitted by other controls.

In a rig's ``systems`` they are ``T``, muscle tracks, ``B``, plain blendshapes, and ``P``,
activations of single tets; ``S``, its muscles, are its own expressions.
docs/reference/rig-format.md describes their arrays.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from typing_extensions import override

from solver.mechanics.boundary import JAW_FREEDOM
from solver.model import SubjectModel
from solver.rig.expression import ExpressionFit, expression_arrays, expressions_from
from solver.similarity import small_motion
from solver.storage import Arrays
from solver.surface import Floats, Ints

HEAD_FREEDOM = 6
SAME_MM = 1e-3  # between a placed scan and the same in single precision


def place_scan(scan: Floats, head: Floats) -> Floats:
    """Return a scan (v, 3) in the axes of the skull that a ``head`` (6,) takes to it."""
    return small_motion(head).inverse()(scan) if head.any() else scan


@dataclass(frozen=True, kw_only=True)
class ShapeFit(ExpressionFit):
    """One expression, fitted by weights of K shapes and a jaw.

    Its ``activations`` are what the shapes ask of the muscles, its ``jaw`` is that of the shapes
    with what is on top of it. A ``head`` that was placed takes ``skin`` and ``target``, which are
    in the skull's axes, to where the scan is.
    """

    weights: Floats  # (K,)
    jaw_on_top: Floats  # (5,) of the shapes', rad and mm
    lengths: Floats  # (m,) mm of the muscles' centre lines, zero where there is none
    # (6,) rotation vector and shift, rad and mm; zero where the scan was taken as it lies
    head: Floats = field(default_factory=lambda: np.zeros(HEAD_FREEDOM))
    photos: tuple[str, ...] = ()  # it was fitted to: names of cameras in ``photo.npz``

    @override
    def is_of(self, scan: Floats) -> bool:
        if not self.head.any():
            return super().is_of(scan)
        back = place_scan(scan, self.head)
        return np.allclose(self.target, back, rtol=0.0, atol=SAME_MM, equal_nan=True)


@dataclass(frozen=True, kw_only=True)
class TetFit(ExpressionFit):
    """One expression, fitted by activations of single tets and a jaw.

    Its ``activations`` are the means over each muscle's flesh.
    """

    tet_activations: Floats  # (k, 6) as those of muscles, see ENTRIES


@dataclass(frozen=True)
class System(ABC):
    """A rig's expressions fitted by one kind of controls.

    Scans of one name are the same in all systems.
    """

    expressions: tuple[ExpressionFit, ...]

    def without(self, scans: Mapping[str, Floats]) -> Self:
        """Return the system without the expressions that have other ``scans`` (v, 3) now."""
        kept = [
            fit for fit in self.expressions if fit.name not in scans or fit.is_of(scans[fit.name])
        ]
        return replace(self, expressions=tuple(kept))

    def replaced(self, other: System) -> System:
        """Return ``other`` with those expressions of this one that it does not have.

        Values of other controls say nothing beside it, and are dropped.
        """
        if not self.has_controls_of(other):
            return other
        names = {fit.name for fit in other.expressions}
        kept = [fit for fit in self.expressions if fit.name not in names]
        return replace(other, expressions=(*kept, *other.expressions))

    @abstractmethod
    def has_controls_of(self, other: System) -> bool:
        """Return whether the same numbers mean the same in both."""

    @abstractmethod
    def header(self) -> dict[str, Any]:
        """Return what a file's header says of the controls."""

    @abstractmethod
    def arrays(self, model: SubjectModel) -> Arrays:
        """Return the arrays of a file."""


@dataclass(frozen=True)
class ShapeSystem(System):
    """Muscle tracks, or plain shapes."""

    expressions: tuple[ShapeFit, ...]
    shapes: tuple[str, ...]  # names of the K shapes

    @override
    def has_controls_of(self, other: System) -> bool:
        return isinstance(other, ShapeSystem) and self.shapes == other.shapes

    @override
    def header(self) -> dict[str, Any]:
        return {"shapes": self.shapes}

    @override
    def arrays(self, model: SubjectModel) -> Arrays:
        controls = {
            name: np.reshape([getattr(fit, name) for fit in self.expressions], (-1, size))
            for name, size in _shape_controls(self.shapes, model).items()
        }
        heads = [fit.head for fit in self.expressions]
        photos = [json.dumps(fit.photos) for fit in self.expressions]
        return {
            **expression_arrays(self.expressions, model),
            **controls,
            "head": np.reshape(heads, (-1, HEAD_FREEDOM)),
            "photos": np.array(photos, dtype=np.str_),
        }


@dataclass(frozen=True)
class TetSystem(System):
    """Activations of single tets."""

    expressions: tuple[TetFit, ...]
    tets: Ints  # (k,) numbers of the tets with muscle

    @override
    def has_controls_of(self, other: System) -> bool:
        return isinstance(other, TetSystem) and np.array_equal(self.tets, other.tets)

    @override
    def header(self) -> dict[str, Any]:
        return {"tets": len(self.tets)}

    @override
    def arrays(self, model: SubjectModel) -> Arrays:
        activations = [fit.tet_activations for fit in self.expressions]
        shape = len(activations), len(self.tets), 6
        return {
            **expression_arrays(self.expressions, model),
            "tets": self.tets,
            "tet_activations": np.reshape(activations, shape).astype(np.float32),
        }


def read_system(
    about: Mapping[str, Any], data: Arrays, model: SubjectModel, path: Path
) -> ShapeSystem | TetSystem:
    """Return a system by what a file's header says ``about`` it, and its arrays.

    Raises LookupError, TypeError or ValueError where they do not fit each other, and
    :class:`~solver.errors.InputError` as :func:`~solver.rig.expression.expressions_from`.
    """
    fits = expressions_from(data, model, path)
    if "shapes" in about:
        shapes = tuple(about["shapes"])
        controls = _shape_controls(shapes, model)
        for name, size in controls.items():
            _check_shape(data, name, len(fits), size)
        places = _places(data, len(fits))
        shaped = [
            ShapeFit(**vars(fit), **{name: data[name][k] for name in controls}, **places[k])
            for k, fit in enumerate(fits)
        ]
        return ShapeSystem(tuple(shaped), shapes)
    tets = data["tets"]
    _check_shape(data, "tets", int(about["tets"]))
    _check_shape(data, "tet_activations", len(fits), len(tets), 6)
    if len(tets) and not 0 <= tets.min() <= tets.max() < len(model.tets):
        raise ValueError("tets are others than the model's")
    activations = data["tet_activations"].astype(np.float64)
    single = [TetFit(**vars(fit), tet_activations=activations[k]) for k, fit in enumerate(fits)]
    return TetSystem(tuple(single), tets)


def _places(data: Arrays, count: int) -> list[dict[str, Any]]:
    """Return head and photographs of each expression; older files have none of either."""
    found: list[dict[str, Any]] = [{} for _ in range(count)]
    if "head" in data:
        _check_shape(data, "head", count, HEAD_FREEDOM)
        for each, head in zip(found, data["head"], strict=True):
            each["head"] = head
    if "photos" in data:
        _check_shape(data, "photos", count)
        for each, names in zip(found, data["photos"], strict=True):
            each["photos"] = tuple(json.loads(str(names)))
    return found


def _shape_controls(shapes: tuple[str, ...], model: SubjectModel) -> dict[str, int]:
    """Return how many numbers each control of an expression has, in the order of its arrays."""
    return {"weights": len(shapes), "jaw_on_top": JAW_FREEDOM, "lengths": model.muscle_count}


def _check_shape(data: Arrays, name: str, *shape: int) -> None:
    if data[name].shape != shape:
        raise ValueError(f"{name} are {data[name].shape}")
