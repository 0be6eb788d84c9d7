"""The preview of a fitted face: sliders, reduced skin, and how far it is off the simulation."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp

from solver.errors import InputError, SolveError
from solver.fitting.face import Face
from solver.fitting.resting import Resting
from solver.model import SubjectModel
from solver.rig.preview.basis import ReducedSkin, modes_of, quadratic_map, reduced
from solver.rig.preview.controls import Controls, controls_of
from solver.rig.preview.error import PreviewError
from solver.rig.preview.poses import learned_from, measured_on
from solver.rig.preview.response import Responses
from solver.rig.preview.samples import Sample, Simulator
from solver.rig.result import ExpressionFit
from solver.surface import Floats

OFF_FACE = 0.1
"""Weight of a skin vertex off the face, where nothing is measured, beside one on it."""

LEARNING, MEASURING = 0.6, 0.85
"""Parts of the time by which the poses to learn from, and those to measure with, are done."""

Listener = Callable[[str, float], None]
"""Called with what is being done and how much of all is ready, in [0, 1]."""


@dataclass(frozen=True)
class Preview:
    """The sliders of a rig, as ``preview.bin`` holds them.

    ``unseen`` tells the error on poses that ``skin`` was not made from, ``fitted`` that at the
    fitted expressions. ``learned`` of the ``planned`` poses to learn from were simulated; the
    others, and ``dropped`` of those to measure with, are out of reach or out of time.
    """

    controls: Controls
    skin: ReducedSkin
    unseen: PreviewError
    fitted: PreviewError
    planned: int
    learned: int
    dropped: int

    def figures(self) -> dict[str, Any]:
        """Return what is told of it, as JSON values; lengths in mm."""
        overall, by_sort = self.unseen.overall, self.unseen.of_sorts()
        return {
            "controls": len(self.controls),
            "modes": len(self.skin.basis),
            "poses": {"planned": self.planned, "learned": self.learned, "dropped": self.dropped},
            "error_mm": overall.as_dict(),
            "error_by_sort_mm": {sort: each.as_dict() for sort, each in by_sort.items()},
            "presets_mm": {name: self.fitted.mean_about(name) for name in self.controls.presets},
        }


def make_preview(
    face: Face,
    S: sp.csr_array,
    fits: Sequence[ExpressionFit],
    *,
    seed: int,
    seconds: float,
    listen: Listener,
) -> Preview:
    """Make the preview of a face with its fitted expressions.

    The same ``seed`` gives the same preview unless it takes longer than about ``seconds``: then
    it is made of those poses that were ready. Raises :class:`InputError` (``preview.nothing``) for
    a rig without a fitted expression, :class:`SolveError` (``preview.unreachable``) if no pose to
    learn from or none to measure with can be simulated.
    """
    if not fits:
        raise InputError("preview.nothing", "the rig has no fitted expression to make sliders from")
    begin = time.monotonic()
    rest = Resting(face, S)
    listen("controls", 0.0)
    controls = controls_of(face, S, rest, fits)
    learning, measuring = learned_from(controls, seed), measured_on(controls, seed)
    known = {fit.name: fit.x for fit in fits if fit.x is not None}
    simulator = Simulator(face, S, controls, rest.state, known)
    samples = simulator.solve(
        learning,
        begin + LEARNING * seconds,
        lambda done: listen("simulate", LEARNING * done / len(learning)),
    )
    way = MEASURING - LEARNING
    unseen = simulator.solve(
        measuring,
        begin + MEASURING * seconds,
        lambda done: listen("measure", LEARNING + way * done / len(measuring)),
    )
    if not samples or not unseen:
        message = "too few poses of the sliders could be simulated to make and to measure them"
        raise SolveError("preview.unreachable", message, learned=len(samples), measured=len(unseen))
    skin = _learned(face, S, controls, samples, begin + seconds, listen)
    neutral, shown = face.model.skin.vertices, face.model.face
    presets = [
        sample
        for sample in samples
        if sample.slid.sort == "expression"
        and np.array_equal(sample.slid.values, controls.presets[str(sample.slid.about)])
    ]
    return Preview(
        controls,
        skin,
        PreviewError(skin, unseen, neutral, shown),
        PreviewError(skin, presets, neutral, shown),
        planned=len(learning),
        learned=len(samples),
        dropped=len(measuring) - len(unseen),
    )


def _learned(
    face: Face,
    S: sp.csr_array,
    controls: Controls,
    samples: Sequence[Sample],
    deadline: float,
    listen: Listener,
) -> ReducedSkin:
    """Return the reduced skin of samples; slopes are left out after the ``deadline``.

    Those of a control alone say nothing that mixed poses do not.
    """
    motions = np.array([sample.skin for sample in samples]) - face.model.skin.vertices
    weights = vertex_weights(face.model)
    modes = modes_of(motions, weights)
    measure = modes * weights[:, None]
    responses = Responses(face, S, controls, measure)
    slopes: list[Floats | None] = []
    for number, sample in enumerate(samples):
        listen("slopes", MEASURING + (1.0 - MEASURING) * number / len(samples))
        is_wanted = sample.slid.sort != "alone" and time.monotonic() < deadline
        slopes.append(responses.at(sample) if is_wanted else None)
    values = np.array([sample.slid.values for sample in samples])
    amounts = np.einsum("rnc,snc->sr", measure, motions, optimize=True)
    return reduced(modes, quadratic_map(values, amounts, slopes))


def vertex_weights(model: SubjectModel) -> Floats:
    """Return what every skin vertex counts, (n,), with a sum of 1."""
    weights = np.full(len(model.skin.vertices), OFF_FACE)
    weights[model.face] = 1.0
    return np.asarray(weights / weights.sum())
