"""The job that brings a raw scan into a template's topology."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from solver.errors import Finding, InputError
from solver.jobs import Task, read_template
from solver.kinds.kind import FrameOptions
from solver.kinds.register_scan import RegisterScan
from solver.meshio.colours import read_colours
from solver.meshio.raw import RawScan, mend, read_raw
from solver.meshio.registered import read_registered, write_registered
from solver.meshio.scan_archive import opened_scan
from solver.progress import Step
from solver.registration.detector import landmarker_file
from solver.registration.landmarks import match, read_landmarks
from solver.registration.register import RegisteredFace, register
from solver.registration.report import distance_picture, report
from solver.registration.texture import TEXTURE, Texture, bake, texture_coordinates
from solver.registration.topology import Topology, topology
from solver.similarity import IDENTITY
from solver.storage import write_json


def run(task: Task[RegisterScan]) -> list[Path]:
    """Register a raw scan: a neutral, or an expression if the person's ``neutral`` is given.

    The scan may be a ZIP of a mesh with its images. ``landmarks`` are in its own unit and axes.
    ``registered.ply`` has the template's
    vertices in mm with the property ``confidence``. Of a scan with colours there are
    ``texture.png`` and ``texture_confidence.png``, too; images that cannot be used are a finding.
    Raises :class:`solver.errors.InputError` for files that cannot be used and for a scan without a
    face (``scan.not_a_face``).
    """
    with opened_scan(task.inputs["scan"]) as scan:
        return _register(task, scan)


def _register(task: Task[RegisterScan], scan: Path) -> list[Path]:
    progress = task.progress
    neutral = task.inputs.get("neutral")
    landmarks = task.inputs.get("landmarks")
    progress(Step("read", 0.0, message=scan.name))
    anatomy = read_template(task)
    skin = anatomy.skin
    rest = None
    if neutral is not None:
        rest = read_registered(neutral, skin.faces, len(skin.vertices))
    marks = None
    if landmarks is not None:
        marks = match(landmarks.name, read_landmarks(landmarks), anatomy)
    as_read = read_raw(scan)
    raw, _ = mend(as_read)
    known = topology(anatomy)
    registered = register(
        raw,
        known,
        None if rest is None else rest.vertices,
        frame=task.options.model_dump(include=set(FrameOptions.model_fields)),
        landmarks=marks,
        landmarker=landmarker_file(),
        progress=progress,
    )
    progress(Step("pictures", 0.85))
    files = [task.out / name for name in ("registered.ply", "registration.json", "distance.png")]
    size_from = registered.start.size.taken_from if rest is None else rest.size_from
    write_registered(files[0], registered.skin, registered.trust.confidence, size_from)
    told = report(registered, known, size_from)
    distance_picture(registered, known, files[2])
    progress(Step("texture", 0.9))
    try:
        texture = _texture(scan, as_read, registered, known, task.options.texture_size)
    except InputError as error:
        if not error.code.startswith("texture."):
            raise
        advice = "The skin is registered; to have its colours, send the files again with it."
        told["findings"].append(Finding(error.code, "warning", error.message, advice).to_dict())
    else:
        if texture is not None:
            told["texture"] = texture.figures
            images = [task.out / name for name in ("texture.png", "texture_confidence.png")]
            texture.write(*images)
            files += images
    write_json(files[1], told)
    progress(Step("done", 1.0))
    return files


def _texture(
    scan: Path, raw: RawScan, registered: RegisteredFace, known: Topology, size: int
) -> Texture | None:
    """Return the scan's colours on the registered skin; None: it has none."""
    colours = read_colours(scan, raw)
    if colours is None:
        return None
    coordinates = texture_coordinates(known.template)
    motion = replace(IDENTITY, scale=registered.start.mm_per_unit).then(registered.motion)
    options = replace(TEXTURE, size=size)
    return bake(colours, motion, registered.skin, known, coordinates, options)
