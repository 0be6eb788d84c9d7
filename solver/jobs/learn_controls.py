"""The job that learns a rig's controls."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from solver.animation.blendshapes import driven_motions
from solver.animation.controls import FILE
from solver.animation.controls.learn import Learned, LearnOptions, blend_of, learn
from solver.animation.controls.maps import ShapeSizes
from solver.animation.controls.mixtures import Mixtures
from solver.animation.controls.pairs import FILE as PAIRS_FILE
from solver.animation.controls.pairs import Pairs, Walks, solve_pairs
from solver.drawing.head import DrawnHead, face_camera
from solver.drawing.sheet import Column, SheetLayout, draw_sheet
from solver.errors import SolveError
from solver.fitting.face import Face, Pose
from solver.fitting.target_checks import check_held
from solver.jobs import Task, read_template
from solver.kinds.learn_controls import LearnControls
from solver.mechanics.linear import fastest
from solver.progress import Step
from solver.rig import Rig
from solver.storage import write_json
from solver.surface import Floats

READ = 0.02  # share of the job after which its inputs are read
SOLVED = 0.9  # share after which the pairs are solved
LEARNED = 0.97  # share after which the maps are learned


def run(task: Task[LearnControls]) -> list[Path]:
    """Learn what the muscles and the jaw of a rig do in mixtures of the template's shapes.

    Pairs of an earlier job, or of an attempt before, count. Raises ``blendshapes.none``,
    ``control_pairs.*`` and ``controls.few``, besides what reading a rig raises.
    """
    given = task.options
    out = task.out
    progress = task.progress
    progress(Step("read", 0.0, message=task.inputs["rig"].name))
    begin = time.perf_counter()
    rig = Rig.load(task.inputs)
    motions = driven_motions(rig.model, read_template(task).shapes)
    face = rig.face(fastest())
    check_held(face)
    kept = out / PAIRS_FILE
    names = tuple(motions)
    walks = Walks(face, Mixtures(names), np.array([*motions.values()]), given.seed)

    def tell(count: int) -> None:
        part = READ + (SOLVED - READ) * min(count / given.pairs, 1.0)
        progress(Step("pairs", part, count, message=f"{count} of {given.pairs} mixtures"))

    known = _known_pairs(task, kept, face, names)
    pairs = solve_pairs(
        walks, given.pairs, known, lambda pairs: pairs.save(kept, face), tell, given.max_seconds
    )
    solved = time.perf_counter() - begin
    options = LearnOptions(map=given.map, modes=given.modes)
    span = LEARNED - SOLVED
    learned = learn(
        face,
        pairs,
        ShapeSizes.of(walks.motions),
        given.seed,
        options,
        lambda done: progress(Step("learn", SOLVED + span * done)),
    )
    files = [out / FILE, kept, out / "controls.json", out / "controls.png"]
    controls = learned.controls
    controls.save(files[0], rig.model, rig.weights)
    progress(Step("pictures", LEARNED))
    draw_worst(face, learned, pairs, files[3])
    seconds = {"pairs_seconds": round(solved, 1), "known": 0 if known is None else len(known)}
    write_json(files[2], {**controls.figures, **seconds, "map": given.map, "seed": given.seed})
    progress(Step("done", 1.0))
    return files


def _known_pairs(
    task: Task[LearnControls], kept: Path, face: Face, names: Sequence[str]
) -> Pairs | None:
    """Return the pairs of an attempt before, else those of an earlier job."""
    if task.resume and kept.is_file():
        return Pairs.load(kept, face, names)
    given = task.inputs.get("control_pairs")
    return None if given is None else Pairs.load(given, face, names)


# Pictures of unseen mixtures.

SHOWN = (0.5, 0.9, 0.99, 1.0)  # quantiles of the error of those that are shown
LAYOUT = SheetLayout(
    cell=(300, 380),
    label=120,
    foot=130,
    notes=(
        "colour of a heat map: distance of the skin above it to the exact one, mm",
        "grey: no part of the face, not compared",
    ),
)


def draw_worst(face: Face, learned: Learned, pairs: Pairs, path: Path) -> None:
    """Draw mixtures that were not learned from: exact, as learned, and blended.

    They are from the middle one by its error to the worst, and simulated without contact.
    """
    model = face.model
    unseen = learned.unseen
    order = np.argsort(learned.off_mm)
    shown = dict.fromkeys(int(order[round(part * (len(order) - 1))]) for part in SHOWN)
    head = DrawnHead(model.skin)
    camera = face_camera(model.skin.vertices, model.face, 0.0)
    blend = blend_of(pairs)
    columns = []
    for row in shown:
        weights = unseen.weights[row]
        exact = np.asarray(pairs.modes.expand(unseen.skins[row]), float)
        bodies = [head.body(head.lit(exact))]
        words = []
        for pose in (learned.controls.pose(weights), blend.pose(weights)):
            skin = simulate(face, pose)
            error = np.full(len(skin), np.nan)
            error[model.face] = np.linalg.norm((skin - exact)[model.face], axis=1)
            bodies += head.compare(exact, skin, error)[1:]
            words.append(f"{np.nanmean(error):.2f}")
        columns.append(Column.of(" and ".join(words) + " mm", bodies, camera, LAYOUT))
    figures = learned.controls.figures
    off = figures["unseen_mm"]
    detail = "{pairs} pairs    unseen: mean {mean:.3f} mm    95 % below {p95:.3f} mm".format(
        pairs=figures["pairs"], **off
    )
    titles = ("Exact", "Learned", "Error, mm", "Blended", "Error, mm")
    draw_sheet(
        path, "Mixtures that controls were not learned from", detail, titles, columns, LAYOUT
    )


def simulate(face: Face, pose: Pose) -> Floats:
    """Return the whole skin (v, 3) of a pose of a rig; the neutral one where there is no way."""
    try:
        state = face.continuation(face.rest, face.pose_of(pose.a, pose.b))
    except SolveError:
        state = face.rest
    return face.whole_skin(state.x, state.pose.b)
