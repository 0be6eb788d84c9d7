"""How close the light rig that a studio ships is to the flesh.

    python -m benchmarks.studio_rig [--rig FILE] [--blendshapes FILE] [--only eye] [--learned FILE]
        [--recording FILE] [--scan FILE [--template FILE] [--picture FILE]] [--detail-picture FILE]
        [--pair-picture FILE]
        [--parts shapes,blink,levels,files,played,texture,detail,stereo] --json -

``shapes`` are ARKit's, each alone and whole: ``mean_mm`` is the face's mean distance to the
template's shape, over all, and ``worst_mm`` of the worst. ``blink`` has what is left between the
lids beyond what the template's own blink leaves (``gap_mm``), how far lids come into the eyeball
through twenty steps of closing (``lid_in_eye_mm``, beyond the neutral's), and ``mean_mm`` to the
template's. ``levels`` are how far half and a quarter of the triangles are off in the worst shape.
``files`` have the size and the Khronos validator's word. ``played_mm`` compares the rig with the
flesh over frames of a recording, by blendshapes or by learned controls, for both ways to drive it.
``texture`` registers a scan with colours and compares the textured skin with it from three views:
``coverage`` of the face's area that the scan shows, ``delta_e_mean`` (CIE 1976) and ``ssim``.
``detail`` registers scans of a made person with pores and furrows of known depth, at rest and with
an expression, and ``--scan`` if one is given: ``normal_error_deg`` is how far mesh and normal map
are off the raw scan's normals where the mesh alone is off by 7 degrees or more, which has
``mesh_error_deg`` there, ``recovered_correlation`` that of the displacement with the known depths,
and ``wrinkles_correlation`` that of its change with the change of depth. ``stereo`` takes the two
photographs of a stereo rig, whose ``--scan`` has its texture coordinates in them: the skin wears
one and is drawn in the other's camera, ``ssim``, as the scan itself is, ``scan_ssim``.
"""

from __future__ import annotations

import argparse
import logging
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks import report, subject_fits, subjects
from benchmarks.baked_detail import measure as measure_detail
from benchmarks.documents import Figures, Section, Table
from benchmarks.muscle_actions import has_lids, lid_gap
from benchmarks.stereo_views import measure_stereo
from benchmarks.texture_views import measure_texture
from myoface.demo.outcome import khronos_validation
from solver.anatomy.action_units import SIDES
from solver.anatomy.template import CORRECTED, ShapeBasis
from solver.animation import RecordedDrives
from solver.animation.blendshapes import (
    Blendshapes,
    DrivenShapes,
    Solved,
    expression_targets,
    solve_blendshapes,
)
from solver.animation.controls import Controls
from solver.animation.lids import Lids
from solver.cache import cache_directory
from solver.jobs.build_studio_rig import LEVELS, tell_level
from solver.jobs.scenes import play, skin_of
from solver.kinds.scene import SimulateScene
from solver.mechanics.linear import fastest
from solver.rig.studio.glb import compare_glb, write_glb
from solver.rig.studio.levels import simplify
from solver.rig.studio.light_rig import DrivenBy, LightRig
from solver.rig.studio.shapes import FleshShapes, StudioShapes, solve_studio_shapes
from solver.scans.live_link import ARKIT_NAMES, read_live_link
from solver.scene import Stage
from solver.scene.places import Places
from solver.templates.ict_facekit import arkit_source

log = logging.getLogger(__name__)
PARTS = ("shapes", "blink", "levels", "files", "played", "texture", "detail", "stereo")
OF_A_SCAN = ("texture", "detail", "stereo")
START = 2000  # of the recording: jaw, lips and cheeks
FRAMES = 300
STEPS = 20
DRIVEN_BY: tuple[DrivenBy, ...] = ("shapes", "joints")


def main() -> None:
    """Print the figures."""
    parser = report.parser(__doc__ or "")
    subjects.add_options(parser)
    subjects.add_controls(parser)
    parser.add_argument("--rig", type=Path, help="rig.npz: read if there, else left in it")
    parser.add_argument("--recording", type=Path, help="of Live Link Face, for ``played``")
    parser.add_argument(
        "--blendshapes", type=Path, help="blendshapes.npz: what it lacks is solved and left in it"
    )
    parser.add_argument("--only", default="", help="shapes whose names begin so")
    parser.add_argument("--learned", type=Path, help="controls.npz that move the flesh")
    parser.add_argument(
        "--scan", type=Path, help="a raw scan with colours, for ``texture`` and ``detail``"
    )
    parser.add_argument("--template", type=Path, help="that it is registered to, else the built-in")
    parser.add_argument("--picture", type=Path, help="PNG of the scan and its textured skin")
    parser.add_argument("--detail-picture", type=Path, help="PNG of the made scans, for ``detail``")
    parser.add_argument("--pair-picture", type=Path, help="PNG of a pair and its skins: ``stereo``")
    parser.add_argument("--start", type=int, default=START, help="first frame that is played")
    parser.add_argument("--frames", type=int, default=FRAMES, help="that are played")
    report.add_list(parser, "--parts", PARTS)
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Return the figures of a rig."""
    of_a_rig = [part for part in options.parts if part not in OF_A_SCAN]
    told: Figures = {}
    parts: Figures = {}
    if of_a_rig:
        bench = _Bench(options)
        told = bench.told
        parts = {part: getattr(bench, part)() for part in of_a_rig}
    if "texture" in options.parts:
        parts["texture"] = {"note": "not measured: --scan names a scan with colours"}
        if options.scan is not None:
            parts["texture"] = measure_texture(options.scan, options.template, options.picture)
    if "detail" in options.parts:
        parts["detail"] = {"note": "not measured: it takes minutes"}
        if not options.quick:
            parts["detail"] = measure_detail(options.scan, options.template, options.detail_picture)
    if "stereo" in options.parts:
        parts["stereo"] = {"note": "not measured: --pair-picture asks for it, of a pair's --scan"}
        if options.scan is not None and options.pair_picture is not None:
            parts["stereo"] = measure_stereo(options.scan, options.template, options.pair_picture)
    return {**told, "parts": parts}


class _Bench:
    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self.rig = subject_fits.subject_rig(options, options.rig)
        self.model = self.rig.model
        self.basis = _beginning(subjects.shapes(options), options.only)
        self.driven = self._blendshapes()
        flesh = FleshShapes(self.rig, self.driven, Places(self.model, {}))
        begin = time.perf_counter()
        self.solved: StudioShapes = solve_studio_shapes(
            self.model, flesh, self.basis, lambda done, of: log.info("shape %d of %d", done, of)
        )
        seconds = time.perf_counter() - begin
        self.lids = Lids.of(self.model)
        self.told = {"seconds": round(seconds, 1), "vertices": len(self.model.skin.vertices)}
        self.light = self._light("shapes")

    def _light(self, driven_by: DrivenBy) -> LightRig:
        return LightRig.of(self.model, self.solved, driven_by).with_lids(self.lids)

    def _blendshapes(self) -> Blendshapes:
        path = self.options.blendshapes
        model = self.model
        S = self.rig.weights
        done: dict[str, Solved] = {}
        if path and path.is_file():
            done.update(Blendshapes.load(path, model, S).shapes)

        def keep(name: str, solved: Solved) -> None:
            done[name] = solved
            log.info("%s: %.3f mm", name, solved.mean_mm)
            if path:
                Blendshapes(model.muscle_names, done, self.rig.drive).save(path, model, S)

        targets = expression_targets(model, self.basis)
        return solve_blendshapes(self.rig.face(fastest()), targets, dict(done), keep)

    def shapes(self) -> Figures:
        """Return how far the shapes are off the template's."""
        off = self.solved.off_mm
        worst = int(off.argmax())
        return {
            "count": len(off),
            "mean_mm": float(off.mean()),
            "worst_mm": float(off[worst]),
            "worst": self.solved.names[worst],
            "above_0.25_mm": [
                name for name, each in zip(self.solved.names, off, strict=True) if each > 0.25
            ],
            "off_mm": dict(zip(self.solved.names, off.round(4).tolist(), strict=True)),
            "by_freed_muscles": list(self.solved.freed),
            "not_settled": list(self.solved.unsettled),
        }

    def blink(self) -> Figures:
        """Return how eyes close."""
        names = [f"eyeBlink{side.capitalize()}" for side in SIDES]
        ways = [
            self.light.play(dict.fromkeys(names, weight)) for weight in np.linspace(0, 1, STEPS + 1)
        ]
        shapes = dict(zip(self.basis.expression_names, self.basis.expressions, strict=True))
        gap = None
        if has_lids(self.model) and names[0] in shapes:
            left = lid_gap(self.model, self.model.skin.vertices + shapes[names[0]])
            gap = max(0.0, lid_gap(self.model, ways[-1]) - left)
        deep = [float(each.depth(skin).max()) for each in self.lids for skin in ways]
        return {
            "gap_mm": gap,
            "lid_in_eye_mm": max(0.0, *deep) if deep else None,
            "mean_mm": float(max(self.solved.off_mm[self.solved.number[name]] for name in names)),
        }

    def levels(self) -> Figures:
        """Return how far levels of detail are off the whole rig."""
        shares = {name: share for name, share in LEVELS.items() if share < 1.0}
        return {name: tell_level(self.light, simplify(self.light, s)) for name, s in shares.items()}

    def files(self) -> Figures:
        """Return size and validity of the file."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "studio.glb"
            write_glb(self.light, path)
            found = khronos_validation(path, cache_directory() / "gltf-validator")
            size = path.stat().st_size / 2**20
            checked = {"errors": found.errors, "warnings": found.warnings}
            return {"glb_mb": size, **checked, **compare_glb(self.light, path)}

    def played(self) -> Figures:
        """Return how far the rig is off the flesh over a recording."""
        options = self.options
        if options.recording is None:
            return {"note": "not played: --recording names one"}
        take = read_live_link(options.recording)
        frames = 4 if options.quick else options.frames
        driven: DrivenShapes = self.driven
        if options.learned:
            driven = Controls.load(options.learned, self.model, self.rig.weights)
        span = options.start, options.start + frames
        drives = RecordedDrives(take, driven, self.model, *span, limits=self.rig.limits)
        stage = Stage(SimulateScene(), Places(self.model, {}), self.rig.weights, drives)
        with tempfile.TemporaryDirectory() as folder:
            done = play(stage, Path(folder), "studio rig")
        rigs = {driven_by: self._light(driven_by) for driven_by in DRIVEN_BY}
        off: dict[str, list[float]] = {driven_by: [] for driven_by in DRIVEN_BY}
        names = self.light.names
        face = self.model.face
        for frame, number in zip(done, range(*span), strict=True):
            weights = {name: float(take.weights[number, ARKIT_NAMES.index(name)]) for name in names}
            flesh = skin_of(stage, frame)[face]
            for driven_by, rig in rigs.items():
                points = rig.play(weights)[face]
                off[driven_by].append(float(np.linalg.norm(points - flesh, axis=1).mean()))
        means = {
            key: {"mean": np.mean(each), "worst_frame": max(each)} for key, each in off.items()
        }
        return {"played_mm": means, "frames": frames, "learned": bool(options.learned)}


def _beginning(basis: ShapeBasis, letters: str) -> ShapeBasis:
    """Return a template's shapes that begin with some ``letters``, and what they correct."""
    sources = [arkit_source(name) for name in basis.expression_names]
    kept = {name for name in sources if name.startswith(letters)}
    kept |= {CORRECTED[name] for name in kept & CORRECTED.keys()}
    rows = [row for row, name in enumerate(sources) if name in kept]
    names = tuple(basis.expression_names[row] for row in rows)
    return replace(basis, expression_names=names, expressions=basis.expressions[rows])


def section(figures: Figures) -> Section:
    """Return the section of docs/science/benchmarks.md."""
    parts: dict[str, Figures] = figures["parts"]
    rows = [
        [part, name, value]
        for part, found in parts.items()
        for name, value in found.items()
        if isinstance(value, int | float)
    ]
    solved = ""
    if "vertices" in figures:
        solved = f"; {figures['vertices']} vertices, solved in {figures['seconds']:.0f} s"
    return Section(
        title="The studio's rig",
        compared="The light rig's shapes, alone and whole, against the template's shapes, its "
        f"frames against the flesh, and a textured skin against its scan{solved}.",
        parts=[Table(["part", "figure", "value"], rows)],
    )


if __name__ == "__main__":
    main()
