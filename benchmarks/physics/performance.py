"""Show 6: ten seconds of a recording, played by a person's muscles, quasi-static with contact.

Figures are a job's (docs/guide/simulation.md), and these: ``direct_mm`` compares with driving the
shapes themselves (neutral + sum of weight times displacement), the distance over the face's
points, mean of all frames and in the worst frame. ``shapes_mm`` is how far the solved blendshapes
are off theirs, the mean of all and the worst. ``clamped`` counts the frames in which a muscle was
kept from folding. ``glb.errors`` and ``glb.warnings`` are the Khronos validator's, None where it
could not run.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.documents import Figures
from benchmarks.physics.fitted import Fitted
from myoface.demo.outcome import khronos_validation
from solver.anatomy.template import ShapeBasis
from solver.animation import RecordedDrives
from solver.animation.blendshapes import driven_motions
from solver.animation.controls import Controls
from solver.animation.controls.exact import ShapesAtRest, fit_frames
from solver.animation.controls.learn import LearnOptions
from solver.cache import cache_directory
from solver.drawing.head import DrawnHead, face_camera
from solver.drawing.render import render_bust
from solver.drawing.sheet import HEADER, MARGIN, Sheet
from solver.jobs.scenes import finish, play, skin_of
from solver.kinds.scene import SimulateScene
from solver.progress import silent
from solver.rig.frames.animation import MotionRecord, motion_report
from solver.scans.live_link import FaceTake
from solver.scene import Stage
from solver.scene.places import Places
from solver.surface import Floats

START = 2000
FRAMES = 300
"""Of alex_rom_3.csv: jaw, lips and cheeks, with hardly a frame at rest."""
TITLE = "Ten seconds of a recording"
CELL = (270, 330)
SIDE = 90
FOOTER = 64
SHOWN = 5


@dataclass(frozen=True)
class Played:
    """A performance: ``skins`` (f, V, 3) are in the head's frame, ``direct`` what they stand for.

    ``direct`` (f, k, 3) are the face's points where the shapes themselves lead, mm.
    """

    frames: Sequence[MotionRecord]
    skins: Floats
    direct: Floats

    def distances(self, person: Fitted) -> Floats:
        """Return how far the face's points are off, (f, k) in mm."""
        off = self.skins[:, person.model.face] - self.direct
        return np.asarray(np.linalg.norm(off, axis=2))


def run(
    person: Fitted,
    basis: ShapeBasis,
    take: FaceTake,
    out: Path,
    *,
    start: int = START,
    frames: int = FRAMES,
) -> tuple[Figures, Played]:
    """Play a part of ``take``, write its files into ``out`` and measure it.

    ``basis`` are the shapes that the person's blendshapes were solved for.
    """
    span = start, start + frames
    drives = RecordedDrives(take, person.shapes, person.model, *span, limits=person.limits)
    stage, played = _play(person, basis, drives, out)
    done = played.frames
    off = played.distances(person).mean(axis=1)
    shapes = [shape.mean_mm for shape in person.shapes.shapes.values()]
    figures = {
        "direct_mm": {"mean": float(off.mean()), "worst_frame": float(off.max())},
        "shapes_mm": {"mean": float(np.mean(shapes)), "worst": max(shapes)},
        "clamped": sum(drives(time).clamped > 0 for time in drives.times),
    }
    finish(stage, done, out, silent, title=TITLE, video=True, more=figures)
    told = json.loads((out / "animation.json").read_text(encoding="utf-8"))
    found = khronos_validation(out / "animation.glb", cache_directory() / "gltf-validator")
    told["glb"] |= {"errors": found.errors, "warnings": found.warnings}
    return told, played


def compare_controls(
    person: Fitted,
    basis: ShapeBasis,
    take: FaceTake,
    controls: Controls,
    out: Path,
    *,
    start: int = START,
    frames: int = FRAMES,
) -> Figures:
    """Return the figures of frames by learned controls, and of frames that are all fitted."""
    span = (start, start + frames)
    model = person.model
    learned = RecordedDrives(take, controls, model, *span, limits=person.limits)
    still = ShapesAtRest(controls.names, model.muscle_count)
    motions = driven_motions(model, basis)
    chosen = np.ones(frames, bool)
    changes, _ = fit_frames(person.rig_face(), still, motions, learned.weights, chosen)
    exact = RecordedDrives(take, still, model, *span, limits=person.limits, changes=changes)
    limit = LearnOptions().exact_above_mm
    figures: Figures = {"doubtful": float(np.mean(controls.doubt_mm(learned.weights) > limit))}
    for name, drives in (("learned", learned), ("exact", exact)):
        _, played = _play(person, basis, drives, out / name)
        off = played.distances(person).mean(axis=1)
        told = motion_report(played.frames, model)
        keys = ("frame_ms", "penetration_max_mm", "inverted")
        direct = {"mean": float(off.mean()), "worst_frame": float(off.max())}
        figures[name] = {"direct_mm": direct, **{key: told[key] for key in keys}}
    return figures


def _play(
    person: Fitted, basis: ShapeBasis, drives: RecordedDrives, out: Path
) -> tuple[Stage, Played]:
    out.mkdir(parents=True, exist_ok=True)
    stage = Stage(SimulateScene(), Places(person.model, {}), person.S, drives)
    done = play(stage, out, TITLE)
    skins = np.array([skin_of(stage, frame) for frame in done])
    return stage, Played(done, skins, _direct(person, basis, drives))


def _direct(person: Fitted, basis: ShapeBasis, drives: RecordedDrives) -> Floats:
    """Return the face's points (f, k, 3) of the shapes' own blend."""
    face = person.model.face
    rows = [basis.expression_names.index(name) for name in drives.names]
    shapes = basis.expressions[rows][:, face].astype(np.float64)
    return np.asarray(person.model.skin.vertices[face] + np.tensordot(drives.weights, shapes, 1))


def picture(path: Path, person: Fitted, played: Played) -> None:
    """Draw frames in columns: driven directly, simulated, and the distance between them."""
    model, (width, height) = person.model, CELL
    head = DrawnHead(model.skin)
    camera = face_camera(model.skin.vertices, model.face, 0.0)
    distances = played.distances(person)
    page = Sheet(SIDE + SHOWN * width + MARGIN, HEADER + 30 + 3 * height + FOOTER)
    detail = f"{len(played.frames)} frames, {distances.mean():.2f} mm apart on average"
    page.heading(TITLE, detail)
    for row, name in enumerate(("Shapes", "Muscles", "Apart")):
        page.text((MARGIN, HEADER + 30 + row * height + height // 2), name, 18)
    numbers = np.linspace(0, len(played.frames) - 1, SHOWN + 2).round().astype(int)[1:-1]
    for column, number in enumerate(numbers):
        left = SIDE + column * width
        frame = played.frames[number]
        skin = played.skins[number]
        words = f"{frame.time:.1f} s, mean {distances[number].mean():.2f} mm"
        page.text((left + width // 2, HEADER), words, 17, anchor="ma")
        shapes = skin.copy()
        apart = np.full(len(skin), np.nan)
        shapes[model.face] = played.direct[number]
        apart[model.face] = distances[number]
        lit = head.lit(skin)
        for row, body in enumerate(
            (head.body(head.lit(shapes)), head.body(lit), head.heat_map(lit, apart))
        ):
            page.panel((left, HEADER + 30 + row * height), render_bust([body], camera, CELL))
    page.scale((SIDE + 20, HEADER + 30 + 3 * height + 12), 4 * width)
    path.parent.mkdir(parents=True, exist_ok=True)
    page.save(path)
