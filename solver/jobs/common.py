"""Parts that several jobs share: targets, warnings, the place of a part's progress."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from solver.errors import Finding, InputError
from solver.fitting import target_checks
from solver.fitting.objective import Target
from solver.kinds.options import Distance
from solver.meshio.registered import RegisteredScan
from solver.model import SubjectModel
from solver.progress import Progress, Step
from solver.rig.result import ExpressionFit
from solver.surface import Floats, Ints, Surface, vertex_normals


def within(step: Step, start: float, end: float) -> Step:
    """Map a part's progress into [start, end] of the whole."""
    given = {**step.as_dict(), "fraction": start + step.fraction * (end - start)}
    return Step(**given)


def refuse(faults: Sequence[InputError]) -> None:
    """Raise what is wrong with the inputs, all of it at once, so that all can be mended at once."""
    if not faults:
        return
    if len(faults) == 1:
        raise faults[0]
    messages = "; ".join(fault.message for fault in faults)
    raise InputError(
        "scan.several",
        f"{len(faults)} scans cannot be used: {messages}",
        faults=[fault.as_dict() for fault in faults],
    )


# Registered scans as targets: the distance to their points, or to their surface.


class Targets:
    """Makes targets of the scans of one person.

    Along the surface the distance ``plane`` lets the skin slide: registration is least certain in
    that direction.
    """

    def __init__(self, model: SubjectModel, distance: Distance) -> None:
        self._face, self._distance = model.face, distance
        self._triangles = _face_triangles(model)

    def of_scan(self, scan: RegisteredScan) -> Target:
        """Return the target of a scan of the whole topology."""
        return self.of_points(scan.vertices[self._face], scan.confidence[self._face])

    def of_points(self, points: Floats, confidence: Floats) -> Target:
        """Return the target of the face's points (k, 3), NaN where nothing was seen."""
        if self._distance == "point":
            return Target.from_points(points, confidence)
        return Target.from_points(points, confidence, _normals(points, self._triangles))


def _face_triangles(model: SubjectModel) -> Ints:
    """Return the skin's triangles within the face, (f, 3), by numbers of the face's points."""
    number = np.full(len(model.skin.vertices), -1)
    number[model.face] = np.arange(len(model.face))
    triangles = number[model.skin.faces]
    return np.asarray(triangles[(triangles >= 0).all(axis=1)])


def _normals(points: Floats, triangles: Ints) -> Floats:
    """Return the unit normals (k, 3) of what is seen; NaN at a point of no triangle."""
    whole = triangles[np.isfinite(points[triangles]).all(axis=(1, 2))]
    normals = vertex_normals(Surface(np.nan_to_num(points), whole))
    normals[np.bincount(whole.ravel(), minlength=len(points)) == 0] = np.nan
    return normals


# The warnings of a job: told while it runs, and kept for its report.


class Telling:
    """Notices are sent as steps of the phase ``warning`` and sorted by expression."""

    def __init__(self, model: SubjectModel, progress: Progress) -> None:
        self._model = model
        self._progress = progress
        self._notices: list[Finding] = []

    def tell(self, fraction: float, notices: Iterable[Finding]) -> None:
        """Tell notices when ``fraction`` of the job is done."""
        for notice in notices:
            self._notices.append(notice)
            self._progress(Step("warning", fraction, message=notice.message))

    def about(self, fit: ExpressionFit, fraction: float, solve: Iterable[Finding]) -> ExpressionFit:
        """Return a fit with all that was told of it, what its solve says and what it leaves."""
        own = {"expression": fit.name}
        left = target_checks.after_fit(self._model, fit.name, fit.error_mm)
        self.tell(fraction, [replace(each, context={**own, **each.context}) for each in solve])
        self.tell(fraction, left)
        mine = [each for each in self._notices if each.context.get("expression") == fit.name]
        return replace(fit, notices=tuple(mine))

    @property
    def general(self) -> tuple[Finding, ...]:
        """Return the notices that are about no expression."""
        return tuple(each for each in self._notices if "expression" not in each.context)
