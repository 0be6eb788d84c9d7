"""The preview of a fitted face: sliders, reduced skin, and how far it is off the simulation."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from solver.drawing.head import DrawnHead, face_camera
from solver.drawing.sheet import Column, SheetLayout, draw_sheet
from solver.errors import InputError, SolveError
from solver.fitting.expression_basis import ExpressionBasis
from solver.fitting.face import Face
from solver.model import SubjectModel
from solver.rig.expression import ExpressionFit
from solver.rig.frames.read_back import Comparison
from solver.rig.frames.skin_basis import (
    ReducedSkin,
    ReductionOptions,
    modes_of,
    quadratic_map,
    reduce_skin,
)
from solver.rig.preview.poses import (
    PoseSample,
    Responses,
    SampleOptions,
    SamplePlan,
    ShapeSampleOptions,
    Slid,
    SliderSolver,
)
from solver.rig.preview.sliders import SliderOptions, Sliders, controls_of, controls_of_basis
from solver.storage import read_container, write_container
from solver.surface import Floats, Ints


class PreviewError:
    """Distances ``off`` (s, k), mm, of ``samples`` on the ``face`` (k,) of ``neutral`` (n, 3)."""

    def __init__(
        self, skin: ReducedSkin, samples: Sequence[PoseSample], neutral: Floats, face: Ints
    ) -> None:
        self.samples = samples
        self.off: Floats = np.empty((len(samples), len(face)))
        self._moved = np.empty_like(self.off)
        for row, sample in enumerate(samples):
            motion = (sample.skin - neutral)[face]
            away = skin.motion(sample.slid.values)[face] - motion
            self.off[row] = np.linalg.norm(away, axis=1)
            self._moved[row] = np.linalg.norm(motion, axis=1)

    def overall(self) -> dict[str, float]:
        """Return the figures of all samples, of which there has to be one.

        They are distances in mm, ``moved`` the simulated skin's from the neutral, and the number of
        ``poses``.
        """
        return self._over(np.arange(len(self.samples)))

    def of_sorts(self) -> dict[str, dict[str, float]]:
        """Return the same figures of every sort of pose."""
        sorts = np.array([sample.slid.sort for sample in self.samples])
        names = dict.fromkeys(sorts.tolist())
        return {sort: self._over(np.flatnonzero(sorts == sort)) for sort in names}

    def mean_about(self, name: str) -> float | None:
        """Return the mean distance, mm, of the poses about a control or an expression."""
        rows = [row for row, sample in enumerate(self.samples) if sample.slid.about == name]
        return round(float(self.off[rows].mean()), 4) if rows else None

    def _over(self, rows: Ints) -> dict[str, float]:
        off = self.off[rows]
        moved = self._moved[rows].mean()
        figures = {"moved": moved, "mean": off.mean(), "p95": np.percentile(off, 95)}
        figures["max"] = off.max()
        rounded = {name: round(float(value), 4) for name, value in figures.items()}
        return {**rounded, "poses": len(rows)}


# called with what is being done and how much of all is ready, in [0, 1]
Listener = Callable[[str, float], None]


@dataclass(frozen=True)
class PreviewOptions:
    """Weights and times of a preview's making."""

    off_face: float = 0.1  # weight of a skin vertex off the face, where nothing is measured
    learning: float = 0.6  # part of the time by which the poses to learn from are done
    measuring: float = 0.85  # part of the time by which those to measure with are done
    sliders: SliderOptions = field(default_factory=SliderOptions)
    samples: SampleOptions = field(default_factory=SampleOptions)
    shape_samples: ShapeSampleOptions = field(default_factory=ShapeSampleOptions)
    reduction: ReductionOptions = field(default_factory=ReductionOptions)


@dataclass(frozen=True)
class Preview:
    """The sliders of a rig, as ``preview.bin`` holds them."""

    controls: Sliders
    skin: ReducedSkin
    unseen: PreviewError  # on poses that ``skin`` was not made from
    fitted: PreviewError  # at the fitted expressions
    planned: int  # number of poses to learn from
    learned: int  # of these, those that could be simulated in time
    dropped: int  # number of poses to measure with that could not

    def figures(self) -> dict[str, Any]:
        """Return the figures for a report, as JSON values; lengths in mm."""
        return {
            "controls": len(self.controls),
            "modes": len(self.skin.basis),
            "poses": {"planned": self.planned, "learned": self.learned, "dropped": self.dropped},
            "error_mm": self.unseen.overall(),
            "error_by_sort_mm": self.unseen.of_sorts(),
            "presets_mm": {name: self.fitted.mean_about(name) for name in self.controls.presets},
        }


def make_preview(
    face: Face,
    fits: Sequence[ExpressionFit],
    *,
    seed: int,
    seconds: float,
    listen: Listener,
    options: PreviewOptions = PreviewOptions(),
) -> Preview:
    """Make the preview of a face with its fitted expressions.

    The same ``seed`` gives the same preview unless it takes longer than about ``seconds``: then
    it is made of those poses that were ready. Raises :class:`InputError` (``preview.nothing``) for
    a rig without a fitted expression, :class:`SolveError` (``preview.unreachable``) if no pose to
    learn from or none to measure with can be simulated.
    """
    if not fits:
        raise InputError("preview.nothing", "the rig has no fitted expression to make sliders from")
    listen("controls", 0.0)
    controls = controls_of(face, fits, options.sliders)
    known = {fit.name: fit.x for fit in fits if fit.x is not None}
    return _make(face, controls, options.samples, known, seed, seconds, listen, options)


def make_live_preview(
    face: Face,
    names: Sequence[str],
    basis: ExpressionBasis,
    *,
    seed: int,
    seconds: float,
    listen: Listener,
    options: PreviewOptions = PreviewOptions(),
) -> Preview:
    """Make sliders for a live session (``solver.live``): a template's expressions.

    They are those of the face's ``basis``, one that a job of its rig left or a new one. Otherwise
    as :func:`make_preview`, whose sliders span the person's own few expressions: markers of a whole
    take were twice as far off by them.
    """
    listen("controls", 0.0)
    controls = controls_of_basis(face, names, basis)
    return _make(face, controls, options.shape_samples, {}, seed, seconds, listen, options)


def _make(
    face: Face,
    controls: Sliders,
    plan: SamplePlan,
    known: Mapping[str, Floats],
    seed: int,
    seconds: float,
    listen: Listener,
    options: PreviewOptions,
) -> Preview:
    """Return the preview of ``controls``; ``known`` are equilibria of presets."""
    begin = time.monotonic()
    learning = plan.to_learn(controls, seed)
    measuring = plan.to_measure(controls, seed)
    simulator = SliderSolver(face, controls, face.rest, known)

    def simulate(phase: str, poses: Sequence[Slid], start: float, end: float) -> list[PoseSample]:
        def announce(count: int) -> None:
            listen(phase, start + (end - start) * count / len(poses))

        return simulator.solve(poses, begin + end * seconds, announce)

    samples = simulate("simulate", learning, 0.0, options.learning)
    unseen = simulate("measure", measuring, options.learning, options.measuring)
    if not samples or not unseen:
        message = "too few poses of the sliders could be simulated to make and to measure them"
        raise SolveError("preview.unreachable", message, learned=len(samples), measured=len(unseen))
    skin = _learn(face, controls, samples, begin + seconds, listen, options)
    neutral = face.model.skin.vertices
    shown = face.model.face
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


def _learn(
    face: Face,
    controls: Sliders,
    samples: Sequence[PoseSample],
    deadline: float,
    listen: Listener,
    options: PreviewOptions,
) -> ReducedSkin:
    """Return the reduced skin of samples; slopes are left out after the ``deadline``."""
    motions = np.array([sample.skin for sample in samples]) - face.model.skin.vertices
    weights = skin_weights(face.model, options)
    modes = modes_of(motions, weights, options.reduction)
    measure = modes * weights[:, None]
    responses = Responses(face, controls, measure)
    slopes: list[Floats | None] = []
    for number, sample in enumerate(samples):
        part = number / len(samples)
        listen("slopes", options.measuring + (1.0 - options.measuring) * part)
        # a control alone says nothing that mixed poses do not
        is_wanted = sample.slid.sort != "alone" and time.monotonic() < deadline
        slopes.append(responses.at(sample) if is_wanted else None)
    values = np.array([sample.slid.values for sample in samples])
    amounts = np.einsum("rnc,snc->sr", measure, motions, optimize=True)
    return reduce_skin(modes, quadratic_map(values, amounts, slopes, options.reduction))


def skin_weights(model: SubjectModel, options: PreviewOptions = PreviewOptions()) -> Floats:
    """Return weights (n,) of the skin's vertices, which sum to 1: those off the face count less."""
    weights = np.full(len(model.skin.vertices), options.off_face)
    weights[model.face] = 1.0
    return np.asarray(weights / weights.sum())


def write_preview(path: Path, preview: Preview) -> None:
    """Write ``preview.bin`` (docs/guide/preview.md); a mean that was not measured is null."""
    skin = preview.skin
    controls = preview.controls
    figures = preview.figures()
    header = {
        "controls": [asdict(control) for control in controls.each],
        "error_mm": {
            **figures["error_mm"],
            "by_sort": figures["error_by_sort_mm"],
            "per_control": [preview.unseen.mean_about(each.name) for each in controls.each],
        },
        "presets": [
            {
                "name": name,
                "values": [round(float(value), 6) for value in values],
                "mean_mm": figures["presets_mm"][name],
            }
            for name, values in controls.presets.items()
        ],
    }
    arrays = {"basis": skin.basis, "linear": skin.linear, "quadratic": skin.quadratic}
    write_container(path, header, arrays)


def read_back(
    path: Path, preview: Preview, neutral: Floats, face: Ints
) -> tuple[Preview, dict[str, Any]]:
    """Return the preview that ``preview.bin`` holds, its error measured by what is in the file.

    With it comes how far the file's skins are off those of ``preview``, at the poses that it was
    measured on; a frame is one of them. Raises :class:`SolveError` (``file.differs``).
    """
    arrays = read_container(path).arrays
    skin = ReducedSkin(arrays["basis"], arrays["linear"], arrays["quadratic"])
    found = Comparison(path.name)
    for number, sample in enumerate(preview.unseen.samples):
        values = sample.slid.values
        found.add(number, skin.motion(values), preview.skin.motion(values))
    unseen, fitted = (
        PreviewError(skin, each.samples, neutral, face) for each in (preview.unseen, preview.fitted)
    )
    return replace(preview, skin=skin, unseen=unseen, fitted=fitted), found.figures()


LEGEND = (
    "colour of the bottom row: distance between the two skins above it, mm",
    "grey: no part of the face, not compared",
    "plausible: a random pose of a few muscles; variation: an expression with one slider changed;",
    "blend: a mixture of two expressions; pair: two sliders that an expression moves together",
)


def preview_picture(model: SubjectModel, preview: Preview, path: Path) -> None:
    """Draw four unseen poses, from the middle one by their error to the worst."""
    unseen = preview.unseen
    neutral = model.skin.vertices
    # the controls alone say nothing that mixed poses do not
    mixed = [row for row, sample in enumerate(unseen.samples) if sample.slid.sort != "alone"]
    order = sorted(mixed, key=lambda row: float(unseen.off[row].mean()))
    places = np.linspace(0.5, 1.0, 4 if order else 0) * (len(order) - 1)
    chosen = dict.fromkeys(order[round(place)] for place in places)
    head = DrawnHead(model.skin)
    camera = face_camera(neutral, model.face, 0.0)
    layout = SheetLayout(cell=(330, 420), label=110, foot=160, notes=LEGEND)
    columns = []
    for number in chosen:
        sample = unseen.samples[number]
        shown = neutral + preview.skin.motion(sample.slid.values)
        error = np.full(len(neutral), np.nan)
        error[model.face] = unseen.off[number]
        bodies = head.compare(sample.skin, shown, error)
        words = f"{sample.slid.sort}, mean {unseen.off[number].mean():.2f} mm"
        columns.append(Column.of(words, bodies, camera, layout))
    detail = (
        "{poses} poses    mean {mean:.2f} mm    95 % below {p95:.2f} mm    greatest {max:.2f} mm"
    ).format(**unseen.overall())
    rows = ("Simulated", "Sliders", "Error, mm")
    draw_sheet(path, "Sliders on poses they were not made from", detail, rows, columns, layout)
