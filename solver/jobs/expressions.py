"""The template's expressions on a rig, which jobs solve once and leave for each other."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from solver.fitting.expression_basis import FILE, ExpressionBasis
from solver.fitting.face import Face
from solver.jobs import Task


def known_basis(
    task: Task[Any], face: Face, shapes: NDArray[np.floating]
) -> ExpressionBasis | None:
    """Return the basis that an earlier attempt or an earlier job left; None if it is of others."""
    kept = task.out / FILE
    known: Path | None = task.inputs.get("expression_basis")
    if task.resume and kept.is_file():
        known = kept
    return ExpressionBasis.load(known, face, shapes) if known else None


def solve_basis(
    task: Task[Any], face: Face, shapes: NDArray[np.floating], listen: Callable[[float], None]
) -> ExpressionBasis:
    """Return the known basis, else solve it; it is left for later jobs."""
    basis = known_basis(task, face, shapes)
    if basis is None:
        basis = ExpressionBasis.solve(face, shapes, listen=listen)
    basis.save(task.out / FILE, face)
    return basis
