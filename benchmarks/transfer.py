"""A video's face on a rig, drawn and looked at again: whether it does what the filmed one does.

A video is played by the rig with its learned controls (job `animate`), every frame is drawn, brows
and lips painted, and MediaPipe looks at it as at the video. ``r`` is the correlation over time of
each of its weights that deviates by more than 0.05 in the video, with the video's own; ``ceiling``
the same of the template's own shapes, driven and drawn in the same way. ``head_rms_deg`` is how far
the head is turned off the one in the video, from rest on. A quick run films the person itself.
"""

from __future__ import annotations

import argparse
import json
import logging
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks import played_person, report
from benchmarks.documents import Figures, Section, Table
from benchmarks.played_person import PlayedPerson
from solver.animation import Gaze, neck, shape_weights, turn_about
from solver.animation.controls import Controls
from solver.drawing.render import Pixels
from solver.jobs import run_job
from solver.kinds.scene_recording import Recording
from solver.registration.detector import DetectorOptions, FaceDetector
from solver.rig import Rig
from solver.rig.frames import FRAMES, read_chunks
from solver.rig.frames.animation import MotionRecord, write_video
from solver.rig.painted_faces import PaintedFaces
from solver.scans.live_link import ARKIT_NAMES, FaceTake
from solver.scans.signals import play_signals
from solver.scans.video import read_video
from solver.surface import Floats

MOVING = 0.05  # deviation of a weight in the video that is compared
QUICK_FRAMES = 12

log = logging.getLogger(__name__)


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    played_person.add_options(parser)
    parser.add_argument("video", type=Path, nargs="?", help="of a face; quick runs make one")
    parser.add_argument("--end", type=int, help="the frame after the last")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Return the figures of the chosen person and video."""
    file = played_person.detector_file()
    if file is None:
        return played_person.SKIPPED
    person = PlayedPerson.of(options)
    controls = person.controls()
    drawn = PaintedFaces(person.face.model, person.points)
    with tempfile.TemporaryDirectory() as folder:
        video = options.video or _film(Path(folder) / "made.mp4", person, drawn)
        begun = time.perf_counter()
        measured = read_video(video)
        seconds = time.perf_counter() - begun
        entry = Recording(asset="video", end=options.end)
        played = play_signals(video.name, measured, entry)
        count = len(played.times) if options.end is None else options.end
        seen = np.flatnonzero(played.seen[:count])
        begun = time.perf_counter()
        weights = shape_weights(played, controls.names)[:count]
        for row in weights:
            controls.pose_of(row)
        spent = time.perf_counter() - begun
        skins = _animated(Path(folder), person, controls, video, entry)
        with FaceDetector(file, DetectorOptions(most_faces=1, weights=True)) as detector:
            rig = _look(drawn, skins, detector)
            ceiling = _look(drawn, _shaped(person, controls, played, weights), detector)
    figures: Figures = {
        "frames": count,
        "seen": len(seen),
        "detect_ms": round(1e3 * seconds / len(measured.times), 1),
        "activations_s": round(spent, 4),
        "not_seen_again": {
            "rig": int((~rig.seen[seen]).sum()),
            "ceiling": int((~ceiling.seen[seen]).sum()),
        },
    }
    both = seen[rig.seen[seen] & ceiling.seen[seen]]
    source = measured.weights[both]
    rows = np.flatnonzero(source.std(axis=0) > MOVING)
    figures["r"] = {ARKIT_NAMES[k]: _correlation(source[:, k], rig.weights[both, k]) for k in rows}
    figures["ceiling"] = {
        ARKIT_NAMES[k]: _correlation(source[:, k], ceiling.weights[both, k]) for k in rows
    }
    figures["median_r"], figures["median_ceiling"] = (
        round(float(np.median([*figures[name].values()])), 4) for name in ("r", "ceiling")
    )
    figures["r_over_ceiling"] = round(figures["median_r"] / figures["median_ceiling"], 4)
    figures["head_rms_deg"] = _head_rms(measured.head[both], rig.head[both])
    return figures


def _correlation(first: Floats, second: Floats) -> float:
    if second.std() < 1e-9:
        return 0.0
    return round(float(np.corrcoef(first, second)[0, 1]), 4)


def _head_rms(first: Floats, second: Floats) -> float:
    """Return the root mean square angle, degrees, between turns (f, 3), each from its mean on."""
    a, b = (Rotation.from_rotvec(turns) for turns in (first, second))
    apart = (a.mean().inv() * a).inv() * (b.mean().inv() * b)
    return round(float(np.degrees(np.sqrt((apart.magnitude() ** 2).mean()))), 3)


def _animated(
    folder: Path, person: PlayedPerson, controls: Controls, video: Path, entry: Recording
) -> Iterator[Floats]:
    """Yield the skins (v, 3) in the world that the job leaves, with contact."""
    face = person.face
    out = folder / "animation"
    out.mkdir()
    rig = Rig(face.model, person.S, (), drive=face.drive)
    rig.save(folder / "rig.npz")
    controls.save(folder / "controls.npz", face.model, person.S)
    scene = {"recording": entry.model_dump(exclude_unset=True)}
    run_job(
        "animate",
        out,
        options={"scene": scene},
        captures={"video": video},
        rig=folder / "rig.npz",
        controls=folder / "controls.npz",
    )
    log.info("%s", json.loads((out / "animation.json").read_text())["transfer"])
    gaze = Gaze(face.model)
    model = face.model
    for frame in read_chunks(out / FRAMES, MotionRecord, "simulate.frames", lambda _: True):
        whole = face.whole_skin(model.rest + frame.moved, frame.jaw)
        yield frame.into_world(gaze.turn(whole, frame.eyes))


def _shaped(
    person: PlayedPerson, controls: Controls, take: FaceTake, weights: Floats
) -> Iterator[Floats]:
    """Yield the skins (v, 3) of the template's own shapes, with the same head and eyes."""
    model = person.face.model
    order = [person.names.index(name) for name in controls.names]
    gaze = Gaze(model)
    pivot = neck(model)
    rest = model.skin.vertices
    for row, head, eyes in zip(weights, take.head, take.eyes, strict=False):
        skin = rest + np.tensordot(row, person.deltas[order], 1)
        yield turn_about(pivot, head, np.zeros(3))(gaze.turn(skin, eyes))


def _look(drawn: PaintedFaces, skins: Iterator[Floats], detector: FaceDetector) -> FaceTake:
    """Return what the detector sees of skins that are drawn; nothing where it sees no face."""
    weights = []
    head = []
    seen = []
    for skin in skins:
        face = drawn.look(skin, detector)
        seen.append(face is not None)
        known = {} if face is None else face.weights
        weights.append([known.get(name, 0.0) for name in ARKIT_NAMES])
        turn = np.eye(3) if face is None else face.rotation
        head.append(Rotation.from_matrix(turn).as_rotvec())
    log.info("looked at %d pictures", len(seen))
    signals = np.array(weights), np.array(head), np.zeros((len(seen), 2, 3))
    return FaceTake(np.arange(len(seen)) / 1.0, *signals, np.array(seen), "video")


def _film(path: Path, person: PlayedPerson, drawn: PaintedFaces) -> Path:
    """Film the person: a smile and an open mouth come and go."""
    rows = [person.names.index(name) for name in ("mouthSmileLeft", "mouthSmileRight", "jawOpen")]

    def pictures() -> Iterator[Pixels]:
        for phase in np.linspace(0.0, 2.0 * np.pi, QUICK_FRAMES):
            weights = np.zeros(len(person.names))
            weights[rows] = (
                0.4 * (1.0 - np.cos(phase)),
                0.4 * (1.0 - np.cos(phase)),
                0.3 * (1.0 - np.cos(2.0 * phase)),
            )
            yield drawn.picture(person.shaped(weights))

    write_video(path, pictures(), drawn.options.size, 25.0)
    return path


def section(figures: Figures) -> Section:
    """Return the section of docs/science/benchmarks.md."""
    rows = [[name, r, figures["ceiling"][name]] for name, r in figures.get("r", {}).items()]
    return Section(
        title="A video on a rig",
        compared=f"What MediaPipe sees of {figures['seen']} filmed frames, and of the rig that "
        f"plays them: correlations over time, in the middle {figures['median_r']:.2f}, of the "
        f"template's own shapes {figures['median_ceiling']:.2f}; the head "
        f"{figures['head_rms_deg']:.1f} deg off. A frame is decoded and looked at "
        f"in {figures['detect_ms']:.0f} ms.",
        parts=[Table(["shape", "rig", "template's own shapes"], rows)],
    )


if __name__ == "__main__":
    main()
