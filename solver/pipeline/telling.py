"""The warnings of a job: told while it runs, and kept for its report."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from solver.fitting import target_checks
from solver.fitting.notices import Notice
from solver.model import SubjectModel
from solver.progress import Progress, Step
from solver.rig.result import ExpressionFit


class Telling:
    """Notices are sent as steps of the phase ``warning`` and sorted by expression."""

    def __init__(self, model: SubjectModel, progress: Progress) -> None:
        self._model = model
        self._progress = progress
        self._notices: list[Notice] = []

    def tell(self, fraction: float, notices: Iterable[Notice]) -> None:
        """Tell notices when ``fraction`` of the job is done."""
        for notice in notices:
            self._notices.append(notice)
            self._progress(Step("warning", fraction, message=notice.message))

    def about(self, fit: ExpressionFit, fraction: float, solve: Iterable[Notice]) -> ExpressionFit:
        """Return a fit with all that was told of it, what its solve says and what it leaves."""
        own = {"expression": fit.name}
        left = target_checks.after_fit(self._model, fit.name, fit.error_mm)
        self.tell(fraction, [replace(each, context={**own, **each.context}) for each in solve])
        self.tell(fraction, left)
        mine = [each for each in self._notices if each.context.get("expression") == fit.name]
        return replace(fit, notices=tuple(mine))

    @property
    def general(self) -> tuple[Notice, ...]:
        """Return the notices that are about no expression."""
        return tuple(each for each in self._notices if "expression" not in each.context)
